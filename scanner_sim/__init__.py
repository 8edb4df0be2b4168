"""A stripe laser scanner that knows the truth.

    from scanner_sim import StripeScanner, blocks, plan_views, scan_views, simulate

    part = blocks.test_block()
    scans, truth = simulate(part, StripeScanner(range_noise=0.02), seed=7)

    views = plan_views(part, overlap=0.3)              # indexed orientations that cover the part
    scanner = StripeScanner(stripe_pitch=0.1, views=views)
    for scans in scan_views(part, scanner, seed=7, truth=False):
        print(scans.view[0], len(scans))               # one pass at a time, in bounded memory

Names are resolved when they are first used, so that importing the package loads no Taichi.
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scanner_sim import blocks
    from scanner_sim.part import Part, box, cone, cylinder, half_space, rod, sphere, torus
    from scanner_sim.scanner import StripeScanner, View
    from scanner_sim.simulate import ScanStream, measure, scan_views, simulate
    from scanner_sim.solid_options import SolidOptions
    from scanner_sim.solids import read_part
    from scanner_sim.views import ProbeHead, parse_views, plan_views

_HOME = {
    "Part": "part",
    "ProbeHead": "views",
    "ScanStream": "simulate",
    "SolidOptions": "solid_options",
    "StripeScanner": "scanner",
    "View": "scanner",
    "box": "part",
    "cone": "part",
    "cylinder": "part",
    "half_space": "part",
    "measure": "simulate",
    "parse_views": "views",
    "plan_views": "views",
    "read_part": "solids",
    "rod": "part",
    "scan_views": "simulate",
    "simulate": "simulate",
    "sphere": "part",
    "torus": "part",
}

__all__ = [
    "Part",
    "ProbeHead",
    "ScanStream",
    "SolidOptions",
    "StripeScanner",
    "View",
    "blocks",
    "box",
    "cone",
    "cylinder",
    "half_space",
    "measure",
    "parse_views",
    "plan_views",
    "read_part",
    "rod",
    "scan_views",
    "simulate",
    "sphere",
    "torus",
]


def __getattr__(name: str) -> Any:
    """Import a public name from the module that holds it."""
    if name in _HOME:
        module = import_module(f"scanner_sim.{_HOME[name]}")
        value = globals()[name] = getattr(module, name)
        # The import may have bound the module `simulate` to the package; the function must win.
        simulating = sys.modules.get("scanner_sim.simulate")
        if simulating is not None and hasattr(simulating, "simulate"):
            globals()["simulate"] = simulating.simulate
        return value
    if name == "blocks":
        return import_module("scanner_sim.blocks")
    raise AttributeError(f"module 'scanner_sim' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names."""
    return __all__
