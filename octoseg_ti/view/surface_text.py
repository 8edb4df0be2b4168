"""Surfaces in words: sizes with their deviations, directions, places."""

import math

import numpy as np

from octoseg_ti.types import SurfaceKind


def surface_text(kind: SurfaceKind, parameters: np.ndarray, deviation: np.ndarray) -> str:
    """Say in words what the parameters of a surface mean, and how sure sizes are."""
    point, axis, a, b = parameters[:3], parameters[3:6], parameters[6], parameters[7]
    first, second = _sized(a, deviation[6]), _sized(b, deviation[7])
    angle = _sized(math.degrees(a), math.degrees(deviation[6]), 2)
    texts = {
        SurfaceKind.PLANE: f"normal {_vector(axis)}",
        SurfaceKind.CYLINDER: f"radius {first} mm, axis {_vector(axis)}",
        SurfaceKind.CONE: f"half angle {angle} deg, axis {_vector(axis)}",
        SurfaceKind.SPHERE: f"radius {first} mm, center {_vector(point)} mm",
        SurfaceKind.TORUS: f"radii {first} and {second} mm, axis {_vector(axis)}",
    }
    text = texts.get(kind, "-")
    return "-" if "nan" in text else text


def _sized(value: float, deviation: float, digits: int = 3) -> str:
    """Return a size with its deviation, if that is known, to two digits of the latter."""
    if not 0.0 < deviation < math.inf:
        return f"{value:.{digits}f}"
    digits = max(digits, min(1 - math.floor(math.log10(deviation)), 9))
    return f"{value:.{digits}f} ± {deviation:.2g}"


def _vector(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.3f}" for v in values) + ")"
