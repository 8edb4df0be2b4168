"""Sizes are said with their deviations, where these are known."""

import numpy as np
import pytest

from octoseg_ti.types import SurfaceKind
from octoseg_ti.view.surface_text import surface_text

UNKNOWN = np.full(8, np.nan)


def surface(kind: SurfaceKind, a: float, b: float = np.nan, da: float = np.nan) -> str:
    parameters = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 1.0, a, b])
    return surface_text(kind, parameters, np.where(np.arange(8) == 6, da, np.nan))


@pytest.mark.parametrize(
    ("deviation", "text"),
    [
        (np.nan, "radius 12.346 mm"),
        (0.0, "radius 12.346 mm"),
        (np.inf, "radius 12.346 mm"),
        (0.00123, "radius 12.3457 ± 0.0012 mm"),
        (0.0123, "radius 12.346 ± 0.012 mm"),
        (0.25, "radius 12.346 ± 0.25 mm"),
        (7.0, "radius 12.346 ± 7 mm"),
        (1.2e-6, "radius 12.3456789 ± 1.2e-06 mm"),
    ],
)
def test_a_radius_has_the_digits_that_count(deviation: float, text: str) -> None:
    words = surface(SurfaceKind.CYLINDER, 12.3456789, da=deviation)
    assert words == f"{text}, axis (0.000, 0.000, 1.000)"
    assert surface(SurfaceKind.SPHERE, 12.3456789, da=deviation).startswith(f"{text}, center")


def test_other_kinds() -> None:
    assert surface(SurfaceKind.PLANE, np.nan) == "normal (0.000, 0.000, 1.000)"
    half = surface(SurfaceKind.CONE, np.radians(30.0), da=np.radians(0.0123))
    assert half == "half angle 30.000 ± 0.012 deg, axis (0.000, 0.000, 1.000)"
    ring = surface(SurfaceKind.TORUS, 9.0, 2.0, 0.01)
    assert ring == "radii 9.000 ± 0.01 and 2.000 mm, axis (0.000, 0.000, 1.000)"
    for kind in (SurfaceKind.FREE_FORM, SurfaceKind.NONE):
        assert surface_text(kind, UNKNOWN, UNKNOWN) == "-"
    assert surface_text(SurfaceKind.PLANE, UNKNOWN, UNKNOWN) == "-"
