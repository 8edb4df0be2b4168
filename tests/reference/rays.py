"""Plain NumPy answers to compare with: membership by the tree, crossings by polynomial roots."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import Polynomial

from octoseg_ti.types import SurfaceKind
from scanner_sim.part import Op, Part
from scanner_sim.quadric import Surface


def implicit(surface: Surface, points: np.ndarray) -> np.ndarray:
    """A polynomial whose sign tells inside (negative) from outside; not a distance."""
    q = points - np.array(surface.point)
    h = q @ np.array(surface.axis)
    square = np.sum(q * q, axis=-1)
    a, b = surface.a, surface.b
    if surface.kind == SurfaceKind.PLANE:
        return h
    if surface.kind == SurfaceKind.SPHERE:
        return square - a**2
    if surface.kind == SurfaceKind.CYLINDER:
        return square - h**2 - a**2
    if surface.kind == SurfaceKind.CONE:
        return np.where(h < 0, 1.0, square - h**2 / np.cos(a) ** 2)
    return (square + a**2 - b**2) ** 2 - 4 * a**2 * (square - h**2)


def solid(part: Part, points: np.ndarray) -> np.ndarray:
    """Whether points are in the part."""
    if part.surface is not None:
        return (implicit(part.surface, points) <= 0) != part.outside
    values = [solid(child, points) for child in part.children]
    if part.operation == Op.UNION:
        return np.any(values, axis=0)
    if part.operation == Op.INTERSECTION:
        return np.all(values, axis=0)
    return values[0] & ~np.any(values[1:], axis=0)


def leaves(part: Part) -> list[Surface]:
    """All surfaces of the tree."""
    if part.surface is not None:
        return [part.surface]
    return [s for child in part.children for s in leaves(child)]


def crossings(surface: Surface, origin: np.ndarray, direction: np.ndarray) -> list[float]:
    """Where a ray crosses a surface, by the roots of a polynomial along it."""
    q = origin - np.array(surface.point)
    axis = np.array(surface.axis)
    h = Polynomial([q @ axis, direction @ axis])
    square = Polynomial([q @ q, 2 * (q @ direction), 1.0])
    a, b = surface.a, surface.b
    along = {
        SurfaceKind.PLANE: lambda: h,
        SurfaceKind.SPHERE: lambda: square - a**2,
        SurfaceKind.CYLINDER: lambda: square - h**2 - a**2,
        SurfaceKind.CONE: lambda: square - h**2 / np.cos(a) ** 2,
        SurfaceKind.TORUS: lambda: (square + a**2 - b**2) ** 2 - 4 * a**2 * (square - h**2),
    }[surface.kind]()
    roots = along.roots()
    return [float(r.real) for r in roots if abs(r.imag) < 1e-9]


def first_hit(part: Part, origin: np.ndarray, direction: np.ndarray, reach: float) -> float:
    """Distance of the first place where the ray enters the part or leaves it; inf = none."""
    found = {t for s in leaves(part) for t in crossings(s, origin, direction) if 1e-9 < t < reach}
    times = np.array([0.0, *sorted(found), reach])
    middle = 0.5 * (times[:-1] + times[1:])
    inside = solid(part, origin + middle[:, None] * direction)
    change = np.flatnonzero(inside[1:] != inside[:-1])
    return float(times[change[0] + 1]) if len(change) else np.inf
