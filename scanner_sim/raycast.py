"""Rays against parts, in parallel: the nearest hit, what hides a point, and where a face ends.

A point of a surface lies on the solid exactly when being inside or outside of that one surface
decides whether the point is solid. So each value on the stack of the part's program has two
bits: the answer if the point were outside of the surface (bit 0), and if it were inside (bit 1).
"""

import math
from typing import NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, I32Rows, ti
from scanner_sim.crossings import FAR, crossings, distance, surface_normal, vector
from scanner_sim.part import FlatPart, Op

_LEAF, _UNION, _INTERSECTION = int(Op.LEAF), int(Op.UNION), int(Op.INTERSECTION)
_DIFFERENCE, _BOX = int(Op.DIFFERENCE), int(Op.BOX)
_SKIP_FALSE, _SKIP_TRUE = int(Op.SKIP_FALSE), int(Op.SKIP_TRUE)
_NEAR = 1e-9  # a hit closer to the origin of its ray than this is the origin itself [mm]
_ANY, _INTO = 1, 2  # modes of a ray: any hit will do; only ways into the solid count
FIRST_INTO, ANY_INTO = _INTO, _ANY + _INTO
_SLACK = 1e-5  # a hit may be this far outside of the box around the faces of its surface [mm]


class Hits(NamedTuple):
    """What rays hit; ``N`` rays."""

    distance: np.ndarray
    """Distance along the ray [mm], shape (N,), f64; infinite without a hit."""
    surface: np.ndarray
    """Number of the surface, shape (N,), i32; -1 without a hit."""
    side: np.ndarray
    """1 where the solid is inside of the surface (the outward normal is the gradient), -1 where it
    is outside, 0 without a hit, shape (N,), i32."""


def cast(
    part: FlatPart,
    origins: np.ndarray,
    directions: np.ndarray,
    reach: np.ndarray,
    *,
    any_hit: bool = False,
    from_outside: bool = False,
) -> Hits:
    """Follow rays to the first surface of the solid.

    Args:
        part: The solid.
        origins: Starting points [mm], shape (N, 3).
        directions: Unit vectors, shape (N, 3).
        reach: Length of every ray [mm], shape (N,); hits beyond it do not count.
        any_hit: Stop at any hit within reach, not the nearest one: enough to know what is hidden.
        from_outside: Every ray begins outside of the solid. Then only the ways into it are looked
            at, which is faster.

    Returns:
        One hit a ray.
    """
    runtime.ensure_started()
    count = len(origins)
    if count == 0:
        return Hits(np.empty(0), np.empty(0, np.int32), np.empty(0, np.int32))
    limits = np.where(np.isfinite(reach), reach, FAR).astype(np.float64)
    distances = runtime.empty(count, np.float64)
    surfaces = runtime.empty(count, np.int32)
    sides = runtime.empty(count, np.int32)
    _cast_rays(
        *upload_program(part), _rows(part.surface_boxes.reshape(-1, 6)),
        _rows(origins), _rows(directions), runtime.upload(limits),
        _ANY * int(any_hit) + _INTO * int(from_outside),
        distances, surfaces, sides,
    )  # fmt: skip
    runtime.sync()
    found = runtime.download(surfaces)[:count]
    distance = np.where(found >= 0, runtime.download(distances)[:count], math.inf)
    return Hits(distance, found, runtime.download(sides)[:count])


def classify(part: FlatPart, points: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Say for points of surfaces whether they lie on the solid's boundary.

    Args:
        part: The solid.
        points: Positions on their surfaces [mm], shape (N, 3).
        surface: Surface of every point, shape (N,), i32.

    Returns:
        1 where the solid is inside of the surface, -1 where it is outside, 0 where the surface does
        not bound the solid, shape (N,), i32.
    """
    runtime.ensure_started()
    count = len(points)
    if count == 0:
        return np.empty(0, np.int32)
    sides = runtime.empty(count, np.int32)
    _classify_points(
        *upload_program(part), _rows(points), runtime.upload(np.asarray(surface, np.int32)), sides
    )
    runtime.sync()
    return runtime.download(sides)[:count]


def upload_program(part: FlatPart) -> tuple[object, ...]:
    """Return the program of a part for kernels: code, boxes, kinds and data of its surfaces."""
    boxes = part.boxes if len(part.boxes) else np.zeros((1, 6))
    arrays = (part.code, boxes, part.surfaces.kind, part.surfaces.data)
    return tuple(runtime.upload(array) for array in arrays)


def _rows(values: np.ndarray) -> object:
    return runtime.upload(np.ascontiguousarray(values, np.float64))


@ti.func
def side_of(bits):
    """Return 1 when the solid is inside of the surface, -1 when it is outside, else 0."""
    result = 0
    if bits == 1:
        result = -1
    elif bits == 2:
        result = 1
    return result


@ti.func
def solid_if(code: ti.template(), boxes: ti.template(), kinds: ti.template(),
             data: ti.template(), p, surface):  # fmt: skip
    """Return two bits: is p solid if it is outside (bit 0) or inside (bit 1) of the surface?"""
    stack = ti.i64(0)
    pc = 0
    while pc < code.shape[0]:
        op = code[pc, 0]
        arg = code[pc, 1]
        jump = code[pc, 2]
        pc += 1
        if op == _LEAF:
            value = ti.i64(2)
            if arg != surface:
                value = ti.i64(3) if distance(kinds[arg], data, arg, p) <= 0.0 else ti.i64(0)
            if (jump & 1) == 1:
                value = value ^ 3
            stack = (stack << 2) | value
        elif op == _BOX:
            hit = True
            for k in ti.static(range(3)):
                if p[k] < boxes[arg, k] or p[k] > boxes[arg, k + 3]:
                    hit = False
            if not hit:
                stack = stack << 2
                pc = jump
        elif op == _SKIP_FALSE:
            if (stack & 3) == 0:
                pc = jump
        elif op == _SKIP_TRUE:
            if (stack & 3) == 3:
                pc = jump
        else:
            upper = stack & 3
            stack = stack >> 2
            lower = stack & 3
            value = lower & upper
            if op == _UNION:
                value = lower | upper
            elif op == _DIFFERENCE:
                value = lower & (upper ^ 3)
            stack = ((stack >> 2) << 2) | value
    return ti.i32(stack & 3)


@ti.func
def _meets_box(boxes: ti.template(), b, origin, direction, inverse, reach, slack):
    """Say whether a ray meets box b, made larger by a slack, within its reach."""
    enter = 0.0
    leave = reach
    for k in ti.static(range(3)):
        low = boxes[b, k] - slack
        high = boxes[b, k + 3] + slack
        first = (low - origin[k]) * inverse[k]
        second = (high - origin[k]) * inverse[k]
        if direction[k] == 0.0:  # parallel to these sides: between them for ever, or never
            outer = origin[k] < low or origin[k] > high
            first = FAR if outer else -FAR
            second = FAR
        enter = ti.max(enter, ti.min(first, second))
        leave = ti.min(leave, ti.max(first, second))
    return enter <= leave


@ti.func
def _in_box(boxes: ti.template(), b, p):
    """Say whether a place is in box b, or as good as in it."""
    inside = True
    for k in ti.static(range(3)):
        if p[k] < boxes[b, k] - _SLACK or p[k] > boxes[b, k + 3] + _SLACK:
            inside = False
    return inside


@ti.func
def nearest_hit(code: ti.template(), boxes: ti.template(), kinds: ti.template(),
                data: ti.template(), faces: ti.template(),
                origin, direction, reach, mode):  # fmt: skip
    """Return (distance, surface or -1, side) of a ray's nearest hit, or of any within reach.

    The part's program is walked once; every crossing that is nearer than the best hit is tested.
    The mode says whether any hit will do, and whether only ways into the solid are looked at: a
    surface knows which of its sides is solid wherever it bounds the part.
    """
    best = reach
    surface = -1
    side = 0
    inverse = 1.0 / direction
    pc = 0
    while pc < code.shape[0] and not ((mode & _ANY) != 0 and surface >= 0):
        op = code[pc, 0]
        arg = code[pc, 1]
        jump = code[pc, 2]
        pc += 1
        if op == _BOX:
            if not _meets_box(boxes, arg, origin, direction, inverse, best, 0.0):
                pc = jump
        elif op == _LEAF:
            # Nested, because `and` looks at both sides. A surface is asked where its faces can be,
            # and the whole part only about crossings that are there.
            if _meets_box(faces, arg, origin, direction, inverse, best, _SLACK):
                found = crossings(kinds[arg], data, arg, origin, direction)
                for k in range(4):
                    t = found[k]
                    if _NEAR < t < best:
                        p = origin + t * direction
                        asked = _in_box(faces, arg, p)
                        if asked and (mode & _INTO) != 0:
                            outside = (jump ^ (jump >> 1)) & 1  # the outside of it is solid
                            slope = surface_normal(kinds[arg], data, arg, p).dot(direction)
                            asked = slope > 0.0 if outside == 1 else slope < 0.0
                        if asked:
                            found_side = side_of(solid_if(code, boxes, kinds, data, p, arg))
                            if found_side != 0:
                                best = t
                                surface = arg
                                side = found_side
    return ti.Vector([best, ti.f64(surface), ti.f64(side)])


@ti.kernel
def _cast_rays(
    # In:
    code_in: I32Rows,
    boxes_in: F64Rows,
    kinds_in: I32Array,
    data_in: F64Rows,
    faces_in: F64Rows,
    origins_in: F64Rows,
    directions_in: F64Rows,
    reach_in: F64Array,
    mode: ti.i32,
    # Out:
    distances_out: F64Array,
    surfaces_out: I32Array,
    sides_out: I32Array,
):
    """Follow every ray to its nearest hit."""
    for i in range(origins_in.shape[0]):
        hit = nearest_hit(
            code_in, boxes_in, kinds_in, data_in, faces_in, vector(origins_in, i, 0),
            vector(directions_in, i, 0), reach_in[i], mode,
        )  # fmt: skip
        distances_out[i] = hit[0]
        surfaces_out[i] = ti.i32(hit[1])
        sides_out[i] = ti.i32(hit[2])


@ti.kernel
def _classify_points(
    # In:
    code_in: I32Rows,
    boxes_in: F64Rows,
    kinds_in: I32Array,
    data_in: F64Rows,
    points_in: F64Rows,
    surface_in: I32Array,
    # Out:
    sides_out: I32Array,
):
    """Ask for every point whether its surface decides that it is solid."""
    for i in range(points_in.shape[0]):
        p = vector(points_in, i, 0)
        sides_out[i] = side_of(solid_if(code_in, boxes_in, kinds_in, data_in, p, surface_in[i]))
