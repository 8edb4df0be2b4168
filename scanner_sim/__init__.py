"""A stripe laser scanner that knows the truth.

Names are resolved when they are first used, so that importing the package loads no Taichi.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scanner_sim import blocks
    from scanner_sim.part import Part, box, cone, cylinder, half_space, rod, sphere, torus
    from scanner_sim.scanner import StripeScanner, View
    from scanner_sim.simulate import simulate
    from scanner_sim.solid_options import SolidOptions
    from scanner_sim.solids import read_part

_HOME = {
    "Part": "part",
    "SolidOptions": "solid_options",
    "StripeScanner": "scanner",
    "View": "scanner",
    "box": "part",
    "cone": "part",
    "cylinder": "part",
    "half_space": "part",
    "read_part": "solids",
    "rod": "part",
    "simulate": "simulate",
    "sphere": "part",
    "torus": "part",
}

__all__ = [
    "Part",
    "SolidOptions",
    "StripeScanner",
    "View",
    "blocks",
    "box",
    "cone",
    "cylinder",
    "half_space",
    "read_part",
    "rod",
    "simulate",
    "sphere",
    "torus",
]


def __getattr__(name: str) -> Any:
    """Import a public name from the module that holds it."""
    if name in _HOME:
        value = getattr(import_module(f"scanner_sim.{_HOME[name]}"), name)
        # The import has bound the module `simulate` to the package; the function must win.
        globals()[name] = value
        return value
    if name == "blocks":
        return import_module("scanner_sim.blocks")
    raise AttributeError(f"module 'scanner_sim' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names."""
    return __all__
