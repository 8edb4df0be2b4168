"""The kind of a smooth group of triangles: plane, cylinder, cone or sphere where it is certain.

A form counts only when all vertices lie on it within the tolerance, and when there are more of them
than any such form would pass through by chance. All else is free-form.
"""

from __future__ import annotations

import numpy as np

from octoseg_ti.types import SurfaceKind
from scanner_sim.topology import Mesh

_RULINGS = (
    6  # a circle goes through any 3 points; so many different ones make it a cylinder or cone
)
_SPHERE_POINTS = 8  # a sphere goes through any 4
_TURN = 1e-3  # directions that differ by less are one [rad]
_STRAIGHT = 1e-2  # normals of a cylinder or cone keep their angle with the axis this well [rad]


def kinds_of(mesh: Mesh, normals: np.ndarray, group: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the `SurfaceKind` of every group, shape (G,), i32.

    Args:
        mesh: The triangles.
        normals: Their unit normals, shape (T, 3).
        group: Group of every triangle, 0..G-1, shape (T,).
        tolerance: Largest distance of a vertex from the form [mm].
    """
    order = np.argsort(group, kind="stable")
    starts = np.searchsorted(group[order], np.arange(group.max() + 2))
    kinds = np.empty(len(starts) - 1, np.int32)
    for g in range(len(kinds)):
        own = order[starts[g] : starts[g + 1]]
        points = mesh.vertices[np.unique(mesh.triangles[own])]
        kinds[g] = _kind(points, normals[own], tolerance)
    return kinds


def _kind(points: np.ndarray, normals: np.ndarray, tolerance: float) -> SurfaceKind:
    """Return the first kind that holds all points."""
    centred = points - points.mean(axis=0)
    flat = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    if np.abs(centred @ flat).max() <= tolerance:
        return SurfaceKind.PLANE
    if len(np.unique(np.round(normals / _TURN), axis=0)) < _RULINGS - 1:
        return SurfaceKind.FREE_FORM
    # The normals of a cylinder or cone keep one angle with the axis: they differ least along it.
    spread = normals - normals.mean(axis=0)
    axis = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    along = normals @ axis
    if np.ptp(along) <= _STRAIGHT:
        if _is_cylinder(centred, axis, float(along.mean()), tolerance):
            return SurfaceKind.CYLINDER
        if _is_cone(centred, axis, tolerance):
            return SurfaceKind.CONE
    if _is_sphere(centred, tolerance):
        return SurfaceKind.SPHERE
    return SurfaceKind.FREE_FORM


def _frame(axis: np.ndarray) -> np.ndarray:
    """Return two unit vectors perpendicular to the axis and each other, shape (3, 2)."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first)], axis=1)


def _distinct(values: np.ndarray, tolerance: float) -> int:
    """Return the number of different rows, up to the tolerance."""
    return len(np.unique(np.round(values / (4.0 * tolerance)), axis=0))


def _ball(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return centre and radius of the circle or sphere through points, by least squares."""
    rows = np.column_stack([2.0 * points, np.ones(len(points))])
    answer = np.linalg.lstsq(rows, (points**2).sum(axis=1), rcond=None)[0]
    return answer[:-1], float(np.sqrt(max(answer[-1] + answer[:-1] @ answer[:-1], 0.0)))


def _is_cylinder(points: np.ndarray, axis: np.ndarray, along: float, tolerance: float) -> bool:
    """Return whether all points are as far from the axis."""
    if abs(along) > _STRAIGHT:
        return False
    across = points @ _frame(axis)
    if _distinct(across, tolerance) < _RULINGS:
        return False
    centre, radius = _ball(across)
    gap = np.abs(np.linalg.norm(across - centre, axis=1) - radius)
    return bool(gap.max() <= tolerance)


def _is_cone(points: np.ndarray, axis: np.ndarray, tolerance: float) -> bool:
    """Return whether the distance of all points from the axis grows evenly along it."""
    height = points @ axis
    across = points @ _frame(axis)
    # The square of the distance from the axis is a square of height: linear in its coefficients.
    rows = np.column_stack([2.0 * across, height**2, height, np.ones(len(points))])
    answer = np.linalg.lstsq(rows, (across**2).sum(axis=1), rcond=None)[0]
    centre = answer[:2]
    radius = np.linalg.norm(across - centre, axis=1)
    slope, rest = np.polyfit(height, radius, 1)
    around = np.arctan2(*(across - centre).T)[radius > 4.0 * tolerance]
    enough = len(np.unique(np.round(around / _TURN))) >= _RULINGS and abs(slope) > _STRAIGHT
    gap = np.abs(radius - (slope * height + rest)) / np.hypot(slope, 1.0)
    return bool(enough and gap.max() <= tolerance)


def _is_sphere(points: np.ndarray, tolerance: float) -> bool:
    """Return whether all points are as far from one place."""
    if _distinct(points, tolerance) < _SPHERE_POINTS:
        return False
    centre, radius = _ball(points)
    gap = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
    return bool(gap.max() <= tolerance)
