"""Solids as trees of half-spaces joined by union, intersection and difference.

A part is immutable. For the kernels the tree is flattened into a program for a small stack machine
(`FlatPart`). Equal surfaces become one, whichever solids they bound: two boxes side by side then
share their top exactly, and a face is known by the number of its surface.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, reduce
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.types import SurfaceKind
from scanner_sim.quadric import Surface, Surfaces, canonical, pack

if TYPE_CHECKING:
    from collections.abc import Sequence

    from scanner_sim.cubes import Cubes
    from scanner_sim.scanner import View

    Triple: TypeAlias = Sequence[float] | np.ndarray

_MAX_DEPTH = 30  # the stack of two-bit values lives in one 64-bit word


class Op(IntEnum):
    """Instructions of the stack machine."""

    LEAF = 0
    """Push whether a point is inside of surface ``arg``; outside of it where ``flag`` is 1."""
    UNION = 1
    """Put one value in place of two."""
    INTERSECTION = 2
    """Put one value in place of two."""
    DIFFERENCE = 3
    """Of trees alone: programs intersect with what is turned inside out, surface by surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FlatPart:
    """A part as arrays; ``M`` instructions, ``S`` surfaces."""

    box: np.ndarray
    """Box around the part [mm], shape (2, 3), f64."""
    code: np.ndarray
    """Instructions (`Op`, arg, flag), shape (M, 3), i32."""
    surfaces: Surfaces
    """The surfaces, each once."""
    surface_boxes: np.ndarray
    """Box around all faces on each surface [mm], shape (S, 2, 3), f64."""

    @cached_property
    def cubes(self) -> Cubes:
        """What is left of the program in each of many cubes: what kernels walk."""
        from scanner_sim.cubes import divide

        return divide(self)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """A solid: one side of a surface, or an operation on other solids."""

    operation: Op
    children: tuple[Part, ...] = ()
    surface: Surface | None = None
    outside: bool = False
    """The solid is the outside of the surface."""
    box: np.ndarray
    """Axis-aligned box around the solid [mm], shape (2, 3); may be infinite or too large."""
    name: str = ""
    nominal_points: int | None = None
    """Points that a scan of this part shall have, unless the scanner says otherwise."""
    views: tuple[View, ...] = ()
    """Directions from which the part is scanned, unless the scanner says otherwise."""

    def __or__(self, other: Part) -> Part:
        """Return the union."""
        return union(self, other)

    def __and__(self, other: Part) -> Part:
        """Return the intersection."""
        return intersection(self, other)

    def __sub__(self, other: Part) -> Part:
        """Return what is left of this part without the other."""
        return difference(self, other)

    def moved(self, transform: np.ndarray) -> Part:
        """Return the part after a rigid transform, shape (4, 4)."""
        if self.surface is not None:
            surface = self.surface.moved(transform)
            box = _everything() if self.outside else surface.box()
            return dataclasses.replace(self, surface=surface, box=box)
        children = tuple(child.moved(transform) for child in self.children)
        part = _combine(self.operation, children)
        box = _meet(part.box, _moved_box(self.box, transform))
        return dataclasses.replace(self, children=children, box=box)

    def shifted(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Part:
        """Return the part after a translation [mm]."""
        transform = np.eye(4)
        transform[:3, 3] = x, y, z
        return self.moved(transform)

    def turned(self, axis: str, angle: float) -> Part:
        """Return the part after a rotation about a coordinate axis ("x", "y", "z") [rad]."""
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        transform = np.eye(4)
        transform[i, i] = transform[j, j] = math.cos(angle)
        transform[i, j], transform[j, i] = -math.sin(angle), math.sin(angle)
        return self.moved(transform)

    def flat(self) -> FlatPart:
        """Return the part as arrays.

        Raises:
            DataError: The part is unbounded, or its tree is too deep.
        """
        if not np.isfinite(self.box).all():
            raise DataError(
                f"the box around part {self.name or 'without a name'!r} is infinite",
                hint="intersect it with a box",
            )
        return _Flattener().run(self)


def union(*parts: Part) -> Part:
    """Return the points in any of the parts."""
    return _combine(Op.UNION, parts)


def intersection(*parts: Part) -> Part:
    """Return the points in all of the parts."""
    return _combine(Op.INTERSECTION, parts)


def difference(part: Part, *others: Part) -> Part:
    """Return the points of the first part that are in none of the others."""
    return _combine(Op.DIFFERENCE, (part, *others))


def half_space(point: Triple, normal: Triple) -> Part:
    """Return the side of a plane that its normal points away from."""
    axis = np.asarray(normal, np.float64)
    return _leaf(SurfaceKind.PLANE, point, axis)


def sphere(center: Triple, radius: float, *, fillet: bool = False) -> Part:
    """Return a ball [mm]."""
    return _leaf(SurfaceKind.SPHERE, center, (0, 0, 1), radius, fillet=fillet)


def cylinder(point: Triple, axis: Triple, radius: float, *, fillet: bool = False) -> Part:
    """Return an endless cylinder around an axis [mm]."""
    return _leaf(SurfaceKind.CYLINDER, point, axis, radius, fillet=fillet)


def cone(apex: Triple, axis: Triple, half_angle: float) -> Part:
    """Return an endless cone that opens from its apex [mm] along the axis; half angle in rad."""
    if not 0.0 < half_angle < math.pi / 2:
        raise DataError(f"half angle of a cone must be between 0 and pi/2, not {half_angle}")
    return _leaf(SurfaceKind.CONE, apex, axis, half_angle)


def torus(
    center: Triple,
    axis: Triple,
    ring: float,
    tube: float,
    *,
    fillet: bool = False,
) -> Part:
    """Return a torus with the radii of its ring and of its tube [mm]; the tube must be thinner."""
    if not 0.0 < tube < ring:
        raise DataError(f"a torus needs 0 < tube < ring, not tube {tube} and ring {ring}")
    return _leaf(SurfaceKind.TORUS, center, axis, ring, tube, fillet=fillet)


def box(low: Triple, high: Triple) -> Part:
    """Return the box between two corners [mm]."""
    sides = []
    for k in range(3):
        for corner, sign in ((low, -1.0), (high, 1.0)):
            normal = np.zeros(3)
            normal[k] = sign
            sides.append(half_space(corner, normal))
    return intersection(*sides)


def rod(start: Triple, end: Triple, radius: float) -> Part:
    """Return a cylinder with flat ends [mm]."""
    axis = np.subtract(end, start)
    return intersection(
        cylinder(start, axis, radius), half_space(start, -axis), half_space(end, axis)
    )


def _leaf(
    kind: SurfaceKind, point: Triple, axis: Triple,
    a: float = 0.0, b: float = 0.0, *, fillet: bool = False,
) -> Part:  # fmt: skip
    direction = np.asarray(axis, np.float64)
    length = float(np.linalg.norm(direction))
    if length == 0.0 or not np.isfinite([*point, *direction, a, b]).all():
        raise DataError("a surface needs finite numbers and an axis that is not zero")
    if kind in (SurfaceKind.SPHERE, SurfaceKind.CYLINDER) and a <= 0.0:
        raise DataError(f"a radius must be above 0, not {a}")
    x, y, z = (float(v) for v in point)
    u, v, w = (float(c) for c in direction / length)
    surface = Surface(kind=kind, point=(x, y, z), axis=(u, v, w), a=a, b=b, fillet=fillet)
    return Part(operation=Op.LEAF, surface=surface, box=surface.box())


def outside(part: Part) -> Part:
    """Return the other side of a single surface; for whole solids use `difference`."""
    if part.surface is None:
        raise DataError("only a part with one surface can be turned inside out")
    flipped = not part.outside
    limits = _everything() if flipped else part.surface.box()
    return dataclasses.replace(part, outside=flipped, box=limits)


def _combine(operation: Op, parts: tuple[Part, ...]) -> Part:
    if not parts:
        raise DataError("an operation on solids needs at least one")
    if operation == Op.UNION:
        limits = np.stack(
            [np.min([p.box[0] for p in parts], axis=0), np.max([p.box[1] for p in parts], axis=0)]
        )
    elif operation == Op.INTERSECTION:
        limits = reduce(_meet, (p.box for p in parts))
    else:
        limits = parts[0].box
    return Part(operation=operation, children=parts, box=limits)


def _everything() -> np.ndarray:
    return np.array([[-math.inf] * 3, [math.inf] * 3])


def _meet(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.stack([np.maximum(first[0], second[0]), np.minimum(first[1], second[1])])


def _moved_box(limits: np.ndarray, transform: np.ndarray) -> np.ndarray:
    if not np.isfinite(limits).all():
        return _everything()
    corners = np.array([[limits[i, 0], limits[j, 1], limits[k, 2]]
                        for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip
    moved = corners @ transform[:3, :3].T + transform[:3, 3]
    return np.stack([moved.min(axis=0), moved.max(axis=0)])


class _Flattener:
    """Writes the program of one part."""

    def __init__(self) -> None:
        self.code: list[tuple[int, int, int]] = []
        self.surfaces: dict[tuple[object, ...], int] = {}
        self.forms: list[Surface] = []
        self.surface_boxes: list[np.ndarray] = []

    def run(self, part: Part) -> FlatPart:
        self._write(part, part.box, 1, False)
        return FlatPart(
            box=part.box,
            code=np.array(self.code, np.int32),
            surfaces=pack(self.forms),
            surface_boxes=np.array(self.surface_boxes),
        )

    def _write(self, part: Part, limits: np.ndarray, depth: int, away: bool) -> None:
        """Write the program of a part, or of what is not in it where it is taken away."""
        if depth > _MAX_DEPTH:
            raise DataError(f"a part may be nested {_MAX_DEPTH} operations deep, not more")
        # Nothing outside of the limits matters, so they also bound what is cut away.
        own = _meet(part.box, limits)
        if part.surface is not None:
            self._write_leaf(part, own, away)
            return
        # What is not in a union is in none of its solids, and so on.
        union = (part.operation == Op.UNION) != away
        for k, child in enumerate(part.children):
            cut = k > 0 and part.operation == Op.DIFFERENCE
            self._write(child, own, depth + 1, away != cut)
            if k > 0:
                self.code.append((Op.UNION if union else Op.INTERSECTION, 0, 0))

    def _write_leaf(self, part: Part, limits: np.ndarray, away: bool) -> None:
        assert part.surface is not None
        form, flipped = canonical(part.surface)
        number = self.surfaces.setdefault(form.key(), len(self.forms))
        if number == len(self.forms):
            self.forms.append(form)
            self.surface_boxes.append(limits.copy())
        else:
            known = self.surface_boxes[number]
            known[0] = np.minimum(known[0], limits[0])
            known[1] = np.maximum(known[1], limits[1])
        self.code.append((Op.LEAF, number, int((part.outside != flipped) != away)))
