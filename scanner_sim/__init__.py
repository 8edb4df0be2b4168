"""A stripe laser scanner that knows the truth.

Names are resolved when they are first used, so that importing the package loads no Taichi.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scanner_sim import blocks
    from scanner_sim.part import Part, box, cone, cylinder, half_space, rod, sphere, torus
    from scanner_sim.scanner import StripeScanner, View
    from scanner_sim.simulate import measure, simulate

_HOME = {
    "Part": "part",
    "StripeScanner": "scanner",
    "View": "scanner",
    "box": "part",
    "cone": "part",
    "cylinder": "part",
    "half_space": "part",
    "measure": "simulate",
    "rod": "part",
    "simulate": "simulate",
    "sphere": "part",
    "torus": "part",
}

__all__ = [
    "Part",
    "StripeScanner",
    "View",
    "blocks",
    "box",
    "cone",
    "cylinder",
    "half_space",
    "measure",
    "rod",
    "simulate",
    "sphere",
    "torus",
]


def __getattr__(name: str) -> Any:
    """Import a public name from the module that holds it."""
    if name in _HOME:
        module = import_module(f"scanner_sim.{_HOME[name]}")
        # The import has bound the module `simulate` to the package; the function must win.
        for known, home in _HOME.items():
            if home == _HOME[name]:
                globals()[known] = getattr(module, known)
        return globals()[name]
    if name == "blocks":
        return import_module("scanner_sim.blocks")
    raise AttributeError(f"module 'scanner_sim' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names."""
    return __all__
