"""The surfaces that bound a part: plane, sphere, cylinder, cone, and the torus of filleted rims.

All five are surfaces of revolution (the plane aside), so one record holds them: a point, an axis
and two lengths, in the same order as `octoseg_ti.types.Segmentation.parameters`. The quadrics are
kept in this geometric form instead of ten coefficients: the implicit function is then a true
distance, and rays near a small radius far from the origin keep their digits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from octoseg_ti.types import SurfaceKind

_DIGITS = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """One unbounded surface; the side where `distance` is negative is its inside."""

    kind: SurfaceKind
    point: tuple[float, float, float]
    """A point of a plane, the centre of a sphere or torus, a point of the axis of a cylinder, the
    apex of a cone [mm]."""
    axis: tuple[float, float, float]
    """Unit normal of a plane (points to the outside), else the axis; a cone opens along it."""
    a: float = 0.0
    """Radius of a cylinder, a sphere or the ring of a torus [mm], half angle of a cone [rad]."""
    b: float = 0.0
    """Radius of the tube of a torus [mm]."""
    fillet: bool = False
    """The surface rounds an edge: its points are edge points and belong to no patch."""

    def key(self) -> tuple[object, ...]:
        """Return a value that is equal for equal surfaces."""
        numbers = (*self.point, *self.axis, self.a, self.b)
        return (self.kind, self.fillet, *(round(v, _DIGITS) + 0.0 for v in numbers))

    def moved(self, transform: np.ndarray) -> Surface:
        """Return the surface after a rigid transform, shape (4, 4)."""
        rotation, shift = transform[:3, :3], transform[:3, 3]
        point = rotation @ np.array(self.point) + shift
        axis = rotation @ np.array(self.axis)
        return Surface(
            kind=self.kind, point=_triple(point), axis=_triple(axis), a=self.a, b=self.b,
            fillet=self.fillet,
        )  # fmt: skip

    def box(self) -> np.ndarray:
        """Return the axis-aligned box of the inside [mm], shape (2, 3); may be infinite."""
        point, axis = np.array(self.point), np.array(self.axis)
        low, high = np.full(3, -math.inf), np.full(3, math.inf)
        if self.kind == SurfaceKind.SPHERE:
            low, high = point - self.a, point + self.a
        elif self.kind == SurfaceKind.TORUS:
            reach = self.a * np.sqrt(np.clip(1.0 - axis**2, 0.0, None)) + self.b
            low, high = point - reach, point + reach
        elif self.kind == SurfaceKind.CYLINDER:
            across = np.abs(axis) < 1e-12
            low[across], high[across] = (point - self.a)[across], (point + self.a)[across]
        elif self.kind == SurfaceKind.PLANE:
            along = np.abs(axis) > 1.0 - 1e-12
            high[along & (axis > 0)] = point[along & (axis > 0)]
            low[along & (axis < 0)] = point[along & (axis < 0)]
        elif self.kind == SurfaceKind.CONE:
            along = np.abs(axis) > 1.0 - 1e-12
            low[along & (axis > 0)] = point[along & (axis > 0)]
            high[along & (axis < 0)] = point[along & (axis < 0)]
        return np.stack([low, high])


class Surfaces(NamedTuple):
    """Surfaces as arrays, for vectorised work; ``S`` surfaces."""

    kind: np.ndarray
    """`SurfaceKind`, shape (S,), i32."""
    data: np.ndarray
    """point (3), axis (3), a, b, shape (S, 8), f64."""
    fillet: np.ndarray
    """True where the surface rounds an edge, shape (S,), bool."""


def canonical(surface: Surface) -> tuple[Surface, bool]:
    """Return the surface in its one normal form, and whether inside and outside were exchanged.

    Two records of one plane (or axis) then have the same key, whatever their point and direction.
    """
    point, axis = np.array(surface.point), np.array(surface.axis)
    flipped = False
    if surface.kind == SurfaceKind.SPHERE:
        axis = np.array([0.0, 0.0, 1.0])
    elif surface.kind != SurfaceKind.CONE:
        leading = axis[np.flatnonzero(np.abs(axis) > 1e-9)[0]]
        if leading < 0:
            axis = -axis
            flipped = surface.kind == SurfaceKind.PLANE
    if surface.kind == SurfaceKind.PLANE:
        point = axis * (axis @ point)
    elif surface.kind == SurfaceKind.CYLINDER:
        point = point - axis * (axis @ point)
    normal_form = Surface(
        kind=surface.kind, point=_triple(point), axis=_triple(axis), a=surface.a, b=surface.b,
        fillet=surface.fillet,
    )  # fmt: skip
    return normal_form, flipped


def pack(surfaces: list[Surface]) -> Surfaces:
    """Return surfaces as arrays."""
    rows = [[*s.point, *s.axis, s.a, s.b] for s in surfaces]
    return Surfaces(
        kind=np.array([s.kind for s in surfaces], np.int32),
        data=np.array(rows, np.float64).reshape(-1, 8),
        fillet=np.array([s.fillet for s in surfaces], bool),
    )


def distance(surfaces: Surfaces, index: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the signed distance of every point to its surface [mm]; negative is inside.

    Args:
        surfaces: All surfaces.
        index: Surface of every point, shape (N,).
        points: Positions [mm], shape (N, 3).

    Returns:
        Distances [mm], shape (N,). For a cone it is the distance to the flank, continued past the
        apex.
    """
    kind, data = surfaces.kind[index], surfaces.data[index]
    height, radius, _ = _meridian(data, points)
    a, b = data[:, 6], data[:, 7]
    return np.select(
        [kind == SurfaceKind.PLANE, kind == SurfaceKind.SPHERE, kind == SurfaceKind.CYLINDER,
         kind == SurfaceKind.CONE],
        [height, np.hypot(radius, height) - a, radius - a, radius * np.cos(a) - height * np.sin(a)],
        np.hypot(radius - a, height) - b,
    )  # fmt: skip


def gradient(surfaces: Surfaces, index: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the unit gradient of `distance` at every point: the outward normal, shape (N, 3)."""
    kind, data = surfaces.kind[index], surfaces.data[index]
    height, radius, outward = _meridian(data, points)
    a = data[:, 6]
    ball = np.maximum(np.hypot(radius, height), 1e-300)
    tube = np.maximum(np.hypot(radius - a, height), 1e-300)
    kinds = [kind == SurfaceKind.PLANE, kind == SurfaceKind.SPHERE, kind == SurfaceKind.CYLINDER,
             kind == SurfaceKind.CONE]  # fmt: skip
    zero, one = np.zeros(len(points)), np.ones(len(points))
    sideways = np.select(kinds, [zero, radius / ball, one, np.cos(a)], (radius - a) / tube)
    upwards = np.select(kinds, [one, height / ball, zero, -np.sin(a)], height / tube)
    return sideways[:, None] * outward + upwards[:, None] * data[:, 3:6]


def _meridian(data: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return height along the axis, distance from it, and the unit vector away from it."""
    q = points - data[:, :3]
    axis = data[:, 3:6]
    height = np.einsum("ij,ij->i", q, axis)
    off_axis = q - height[:, None] * axis
    radius = np.sqrt(np.einsum("ij,ij->i", off_axis, off_axis))
    return height, radius, off_axis / np.maximum(radius, 1e-300)[:, None]


def frames(surfaces: Surfaces) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that are perpendicular to each axis and each other, shapes (S, 3)."""
    axis = surfaces.data[:, 3:6]
    # Start from the coordinate axis that is most perpendicular, so that aligned surfaces stay
    # aligned.
    helper = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    first = helper - np.einsum("ij,ij->i", helper, axis)[:, None] * axis
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(axis, first)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
