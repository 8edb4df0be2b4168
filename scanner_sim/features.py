"""Shapes of machined features: round and rectangular ones, domes; their rims sharp or rounded.

A shape stands upright on the plane z = 0 of its own frame, with a root below that plane. Joined to
a body it is a boss; turned upside down and cut away it is a hole or a pocket. So the round at the
end of a boss is the round along the floor of a pocket, and the round at the foot of a boss is the
round along the rim of a hole.

A tangent round of up to `FILLET_LIMIT` stands for an edge: it is a fillet, and its points belong to
no patch. A larger one is a blend, which is a patch of its own. A chamfer is always a patch.
"""

from __future__ import annotations

import dataclasses
import math
from itertools import product
from typing import NamedTuple

import numpy as np

from octoseg_ti.types import SurfaceKind
from scanner_sim.part import (
    Part,
    box,
    cone,
    cylinder,
    difference,
    half_space,
    intersection,
    rod,
    sphere,
    torus,
    union,
)

FILLET_LIMIT = 3.0
"""Largest radius of a fillet [mm]; a tangent round with a larger one is a blend, which is a patch.
"""

ROOT = 1.0
"""Depth of the root of a shape below its plane [mm]."""

_LEAST = 1e-9  # a shorter straight side is none [mm]
_PLANE, _CYLINDER, _CONE = SurfaceKind.PLANE, SurfaceKind.CYLINDER, SurfaceKind.CONE
_SPHERE, _TORUS = SurfaceKind.SPHERE, SurfaceKind.TORUS


class Rim(NamedTuple):
    """How an edge of a shape is finished."""

    round: float = 0.0
    """Radius of a tangent round [mm]; 0 = none."""
    chamfer: float = 0.0
    """Legs of a chamfer of 45 degrees [mm]; 0 = none."""

    @property
    def reach(self) -> float:
        """How far the finish reaches from the edge on either face [mm]."""
        return self.round + self.chamfer

    @property
    def is_fillet(self) -> bool:
        """Whether the points on this rim belong to no patch."""
        return 0.0 < self.round <= FILLET_LIMIT

    @property
    def is_blend(self) -> bool:
        """Whether this rim is round and a patch."""
        return self.round > FILLET_LIMIT


SHARP = Rim()


class Shape(NamedTuple):
    """A solid on the plane z = 0, and the patches that it bounds."""

    solid: Part
    kinds: tuple[SurfaceKind, ...]
    """Kind of every patch."""
    extent: tuple[float, float]
    """Half of its size along x and y at z = 0 [mm]."""
    height: float
    """Its height above z = 0 [mm]."""


def round_shape(
    radius: float, height: float, *, lean: float = 0.0, end: Rim = SHARP, foot: Rim = SHARP
) -> Shape:
    """Return a round column or, leaning inwards, the frustum of a cone.

    Args:
        radius: Radius at z = 0, without the finish of the foot [mm].
        height: Height of the flat end [mm].
        lean: Angle between wall and axis [rad]; a chamfer needs 0.
        end: Finish of the upper rim.
        foot: Finish of the joint with the plane z = 0.
    """
    sin, cos, tan = math.sin(lean), math.cos(lean), math.tan(lean)
    kinds = [_PLANE, _CONE if lean else _CYLINDER]
    pieces = []
    if end.round:
        # The tube touches the flat end from below and the wall from inside.
        ring = radius - height * tan - end.round * (1.0 - sin) / cos
        middle = height - end.round
        pieces += [
            _column(radius, lean, middle + end.round * sin),
            rod((0, 0, -ROOT), (0, 0, height), ring),
            torus((0, 0, middle), (0, 0, 1), ring, end.round, fillet=end.is_fillet),
        ]
    elif end.chamfer:
        slope = cone((0, 0, height + radius - end.chamfer), (0, 0, -1), math.pi / 4)
        pieces.append(intersection(_column(radius, 0.0, height), slope))
        kinds.append(_CONE)
    else:
        pieces.append(_column(radius, lean, height))
    foot_piece, wide = _round_foot(radius, lean, foot)
    kinds += [_TORUS] * (end.is_blend + foot.is_blend) + [_CONE] * (foot.chamfer > 0)
    return Shape(union(*pieces, *foot_piece), tuple(kinds), (wide, wide), height)


def drill_shape(radius: float, height: float, *, foot: Rim = SHARP, tip: bool = False) -> Shape:
    """Return what a drill cuts away, upside down: through the part, or to the cone of its tip.

    Args:
        radius: Radius [mm].
        height: Length of the wall [mm].
        foot: Finish of the rim; a chamfer makes a countersink.
        tip: It ends in a cone of 118 degrees; otherwise it ends somewhere in the air, flat.
    """
    foot_piece, wide = _round_foot(radius, 0.0, foot)
    kinds = [_CYLINDER] + [_TORUS] * foot.is_blend + [_CONE] * (foot.chamfer > 0)
    column = _column(radius, 0.0, height)
    if tip:
        half = math.radians(59.0)
        top = height + radius / math.tan(half)
        # The cone is as wide as the column just where the wall ends.
        column = intersection(_column(radius, 0.0, top), cone((0, 0, top), (0, 0, -1), half))
        kinds.append(_CONE)
        height = top
    return Shape(union(column, *foot_piece), tuple(kinds), (wide, wide), height)


def pin_shape(radius: float, height: float, *, foot: Rim = SHARP) -> Shape:
    """Return a column with a ball on its end that continues the wall without an angle [mm]."""
    foot_piece, wide = _round_foot(radius, 0.0, foot)
    kinds = (_CYLINDER, _SPHERE) + (_TORUS,) * foot.is_blend
    solid = union(_column(radius, 0.0, height), sphere((0, 0, height), radius), *foot_piece)
    return Shape(solid, kinds, (wide, wide), height + radius)


def dome_shape(radius: float, height: float, *, foot: Rim = SHARP) -> Shape:
    """Return the cap of a ball, ``radius`` wide at z = 0 without the finish of its foot [mm]."""
    ball = (radius**2 + height**2) / (2.0 * height)
    middle = height - ball
    cap = intersection(sphere((0, 0, middle), ball), half_space((0, 0, -ROOT), (0, 0, -1)))
    if not foot.round:
        return Shape(cap, (_SPHERE,), (radius, radius), height)
    # The tube lies on the plane and touches the ball from outside.
    tube = foot.round
    ring = math.sqrt((ball + tube) ** 2 - (tube - middle) ** 2)
    touch = middle + ball / (ball + tube) * (tube - middle)
    flare = _flare(ring, tube, touch, fillet=foot.is_fillet)
    kinds = (_SPHERE,) + (_TORUS,) * foot.is_blend
    return Shape(union(cap, flare), kinds, (ring, ring), height)


def block_shape(
    half: tuple[float, float],
    height: float,
    *,
    corner: float = 0.0,
    end: Rim = SHARP,
    foot: Rim = SHARP,
    root: float = ROOT,
) -> Shape:
    """Return a block, its upright corners sharp or round; as round as wide, it is a slot.

    Args:
        half: Half of its size along x and y at z = 0, without the finish of the foot [mm].
        height: Height of its flat end [mm].
        corner: Radius of the upright corners [mm], at most half of the smaller size; 0 = sharp. A
            round end needs it to be the same radius, or more than twice of it; a round foot needs
            it above 0; a chamfer needs it to be 0.
        end: Finish of the upper rim.
        foot: Finish of the joint with the plane z = 0.
        root: Depth of the root [mm].
    """
    a, b = half
    slot = corner > 0.0 and corner == min(a, b)
    sides, corners = (2, 2) if slot else (4, 4)
    kinds = [_PLANE] * (1 + sides) + [_CYLINDER] * (corners if corner > FILLET_LIMIT else 0)
    pieces = []
    if end.round:
        pieces += [
            prism(half, corner, -root, height - end.round),
            prism((a - end.round, b - end.round), corner - end.round, -root, height),
            *_round_end(half, corner, height, end),
        ]
        if end.is_blend:
            kinds += [_CYLINDER] * sides
            kinds += [_SPHERE if corner == end.round else _TORUS] * corners
    elif end.chamfer:
        slopes = _slopes((a - end.chamfer, b - end.chamfer), height)
        pieces.append(intersection(prism(half, 0.0, -root, height), *slopes))
        kinds += [_PLANE] * 4
    else:
        pieces.append(prism(half, corner, -root, height))
    if foot.round:
        pieces += _block_foot(half, corner, foot)
    elif foot.chamfer:
        wide = foot.chamfer + root
        low, high = (-a - wide, -b - wide, -root), (a + wide, b + wide, foot.chamfer)
        pieces.append(intersection(box(low, high), *_slopes(half, foot.chamfer)))
        kinds += [_PLANE] * 4
    extent = a + foot.reach, b + foot.reach
    return Shape(union(*pieces), tuple(kinds), extent, height)


def prism(half: tuple[float, float], corner: float, low: float, high: float) -> Part:
    """Return an upright block with round corners, between two heights [mm]."""
    a, b = half
    if corner == 0.0:
        return box((-a, -b, low), (a, b, high))
    x, y = a - corner, b - corner
    fillet = corner <= FILLET_LIMIT
    pieces = [
        intersection(
            cylinder((u, v, 0), (0, 0, 1), corner, fillet=fillet),
            half_space((0, 0, low), (0, 0, -1)),
            half_space((0, 0, high), (0, 0, 1)),
        )
        for u, v in _signed(x, y)
    ]
    if x > _LEAST:
        pieces.append(box((-x, -b, low), (x, b, high)))
    if y > _LEAST:
        pieces.append(box((-a, -y, low), (a, y, high)))
    return union(*pieces)


def upside_down(shape: Shape) -> Part:
    """Return what a shape cuts away from below the plane z = 0."""
    return shape.solid.moved(np.diag([1.0, 1.0, -1.0, 1.0]))


def _column(radius: float, lean: float, height: float) -> Part:
    """Return a column from its root to a height; its radius counts at z = 0."""
    if not lean:
        return rod((0, 0, -ROOT), (0, 0, height), radius)
    tan = math.tan(lean)
    flank = cone((0, 0, radius / tan), (0, 0, -1), lean)
    solid = intersection(
        flank, half_space((0, 0, -ROOT), (0, 0, -1)), half_space((0, 0, height), (0, 0, 1))
    )
    wide = radius + ROOT * tan
    return dataclasses.replace(solid, box=np.array([[-wide, -wide, -ROOT], [wide, wide, height]]))


def _round_foot(radius: float, lean: float, foot: Rim) -> tuple[list[Part], float]:
    """Return what finishes the foot of a round shape, and the radius up to which it reaches."""
    if foot.round:
        sin, cos = math.sin(lean), math.cos(lean)
        ring = radius + foot.round * (1.0 - sin) / cos
        touch = foot.round * (1.0 - sin)
        return [_flare(ring, foot.round, touch, fillet=foot.is_fillet)], ring
    if foot.chamfer:
        wide = radius + foot.chamfer + ROOT
        apex = radius + foot.chamfer
        sink = intersection(
            cone((0, 0, apex), (0, 0, -1), math.pi / 4),
            half_space((0, 0, -ROOT), (0, 0, -1)),
            half_space((0, 0, foot.chamfer), (0, 0, 1)),
        )
        limits = np.array([[-wide, -wide, -ROOT], [wide, wide, foot.chamfer]])
        return [dataclasses.replace(sink, box=limits)], apex
    return [], radius


def _flare(ring: float, tube: float, touch: float, *, fillet: bool) -> Part:
    """Return what a ring on the plane z = 0 leaves of a disc: hollow all around, up to a height."""
    return difference(
        rod((0, 0, -ROOT), (0, 0, touch), ring),
        torus((0, 0, tube), (0, 0, 1), ring, tube, fillet=fillet),
    )


def _signed(x: float, y: float) -> list[tuple[float, float]]:
    """Return the corners of a rectangle, each once; of a line, its two ends."""
    xs, ys = ((-v, v) if v > _LEAST else (0.0,) for v in (x, y))
    return list(product(xs, ys))


def _round_end(half: tuple[float, float], corner: float, height: float, end: Rim) -> list[Part]:
    """Return the tubes along the upper rim of a block and around its corners."""
    (a, b), tube = half, end.round
    x, y, z = a - corner, b - corner, height - tube
    pieces = []
    for u, v in _signed(x, y):
        if corner == tube:
            pieces.append(sphere((u, v, z), tube, fillet=end.is_fillet))
        else:
            ring = corner - tube
            pieces.append(torus((u, v, z), (0, 0, 1), ring, tube, fillet=end.is_fillet))
    lines = []
    for sign in (-1.0, 1.0):
        if x > _LEAST:
            lines.append(((-x, sign * (b - tube), z), (x, sign * (b - tube), z)))
        if y > _LEAST:
            lines.append(((sign * (a - tube), -y, z), (sign * (a - tube), y, z)))
    for start, stop in lines:
        axis = np.subtract(stop, start)
        pieces.append(
            intersection(
                cylinder(start, axis, tube, fillet=end.is_fillet),
                half_space(start, -axis), half_space(stop, axis),
            )
        )  # fmt: skip
    return pieces


def _block_foot(half: tuple[float, float], corner: float, foot: Rim) -> list[Part]:
    """Return what fills the joint of a block and the plane z = 0, along its sides and corners."""
    (a, b), tube = half, foot.round
    x, y = a - corner, b - corner
    pieces = []
    for u, v in _signed(x, y):
        ring = corner + tube
        disc = rod((u, v, -ROOT), (u, v, tube), ring)
        hollow = torus((u, v, tube), (0, 0, 1), ring, tube, fillet=foot.is_fillet)
        pieces.append(difference(disc, hollow))
    for sign in (-1.0, 1.0):
        if x > _LEAST:
            low, high = sorted((sign * (b - corner), sign * (b + tube)))
            hollow = cylinder((0, sign * (b + tube), tube), (1, 0, 0), tube, fillet=foot.is_fillet)
            pieces.append(difference(box((-x, low, -ROOT), (x, high, tube)), hollow))
        if y > _LEAST:
            low, high = sorted((sign * (a - corner), sign * (a + tube)))
            hollow = cylinder((sign * (a + tube), 0, tube), (0, 1, 0), tube, fillet=foot.is_fillet)
            pieces.append(difference(box((low, -y, -ROOT), (high, y, tube)), hollow))
    return pieces


def _slopes(half: tuple[float, float], height: float) -> list[Part]:
    """Return four planes that fall outwards by 45 degrees from a rectangle at a height."""
    a, b = half
    return [
        half_space((sign * a, 0, height), (sign, 0, 1)) for sign in (-1.0, 1.0)
    ] + [half_space((0, sign * b, height), (0, sign, 1)) for sign in (-1.0, 1.0)]  # fmt: skip
