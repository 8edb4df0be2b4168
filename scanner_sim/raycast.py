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
from octoseg_ti.types import SurfaceKind
from scanner_sim.part import FlatPart, Op

_PLANE, _CYLINDER = int(SurfaceKind.PLANE), int(SurfaceKind.CYLINDER)
_CONE, _SPHERE = int(SurfaceKind.CONE), int(SurfaceKind.SPHERE)
_LEAF, _UNION, _INTERSECTION = int(Op.LEAF), int(Op.UNION), int(Op.INTERSECTION)
_DIFFERENCE, _BOX = int(Op.DIFFERENCE), int(Op.BOX)
_SKIP_FALSE, _SKIP_TRUE = int(Op.SKIP_FALSE), int(Op.SKIP_TRUE)
_FAR = 1e30
_NEAR = 1e-9  # a hit closer to the origin of its ray than this is the origin itself [mm]
_HALVINGS = 48
_STILL = 4e-16  # a step this small, beside the root, is none
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
) -> Hits:
    """Follow rays to the first surface of the solid.

    Args:
        part: The solid.
        origins: Starting points [mm], shape (N, 3).
        directions: Unit vectors, shape (N, 3).
        reach: Length of every ray [mm], shape (N,); hits beyond it do not count.
        any_hit: Stop at any hit within reach, not the nearest one: enough to know what is hidden.

    Returns:
        One hit a ray.
    """
    runtime.ensure_started()
    count = len(origins)
    if count == 0:
        return Hits(np.empty(0), np.empty(0, np.int32), np.empty(0, np.int32))
    limits = np.where(np.isfinite(reach), reach, _FAR).astype(np.float64)
    distances = runtime.empty(count, np.float64)
    surfaces = runtime.empty(count, np.int32)
    sides = runtime.empty(count, np.int32)
    _cast_rays(
        runtime.upload(part.code), _boxes(part), runtime.upload(part.surfaces.kind),
        runtime.upload(part.surfaces.data), _rows(part.surface_boxes.reshape(-1, 6)),
        _rows(origins), _rows(directions), runtime.upload(limits), int(any_hit),
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
        runtime.upload(part.code), _boxes(part), runtime.upload(part.surfaces.kind),
        runtime.upload(part.surfaces.data), _rows(points),
        runtime.upload(np.asarray(surface, np.int32)), sides,
    )  # fmt: skip
    runtime.sync()
    return runtime.download(sides)[:count]


def _rows(values: np.ndarray) -> object:
    return runtime.upload(np.ascontiguousarray(values, np.float64))


def _boxes(part: FlatPart) -> object:
    return runtime.upload(part.boxes if len(part.boxes) else np.zeros((1, 6)))


@ti.func
def _vector(rows: ti.template(), i, k):
    """Read three neighbouring columns of a row."""
    return ti.Vector([rows[i, k], rows[i, k + 1], rows[i, k + 2]])


@ti.func
def _distance(kind, data: ti.template(), s, p):
    """Return the signed distance of a point to surface s."""
    q = p - _vector(data, s, 0)
    axis = _vector(data, s, 3)
    height = q.dot(axis)
    result = height
    if kind != _PLANE:
        radius = (q - height * axis).norm()
        if kind == _CYLINDER:
            result = radius - data[s, 6]
        elif kind == _SPHERE:
            result = q.norm() - data[s, 6]
        elif kind == _CONE:
            result = radius * ti.cos(data[s, 6]) - height * ti.sin(data[s, 6])
        else:
            ring = radius - data[s, 6]
            result = ti.sqrt(ring * ring + height * height) - data[s, 7]
    return result


@ti.func
def _solid_if(code: ti.template(), boxes: ti.template(), kinds: ti.template(),
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
                value = ti.i64(3) if _distance(kinds[arg], data, arg, p) <= 0.0 else ti.i64(0)
            if jump == 1:
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
def _quadratic(a, b, c):
    """Return the roots of a t^2 + 2 b t + c, without cancellation; far away when there is none."""
    roots = ti.Vector([_FAR, _FAR])
    disc = b * b - a * c
    if disc >= 0.0:
        q = -(b + ti.sqrt(disc)) if b > 0.0 else -(b - ti.sqrt(disc))
        if ti.abs(a) > 1e-14:
            roots[0] = q / a
        if ti.abs(q) > 1e-300:
            roots[1] = c / q
    return roots


@ti.func
def _between(c3, c2, c1, c0, lead, low, high):
    """Return the root of lead t^4 + c3 t^3 + c2 t^2 + c1 t + c0 between two signs.

    Newton's steps while they stay between the signs, halvings where they do not.
    """
    rising = (((lead * low + c3) * low + c2) * low + c1) * low + c0 < 0.0
    t = 0.5 * (low + high)
    for _ in range(_HALVINGS):
        value = (((lead * t + c3) * t + c2) * t + c1) * t + c0
        slope = ((4.0 * lead * t + 3.0 * c3) * t + 2.0 * c2) * t + c1
        if (value < 0.0) == rising:
            low = t
        else:
            high = t
        following = 0.5 * (low + high)
        if slope != 0.0:
            step = t - value / slope
            if low < step < high:
                following = step
        moved = ti.abs(following - t)
        t = following
        if moved <= _STILL * ti.max(1.0, ti.abs(t)):
            break
    return t


@ti.func
def _quartic(c2, c1, c0, limit):
    """Return the roots of t^4 + c2 t^2 + c1 t + c0 within the limits, between its extrema.

    The extrema are the roots of the derivative, found between the extrema of that one.
    """
    roots = ti.Vector([_FAR, _FAR, _FAR, _FAR])
    turn = ti.sqrt(-c2 / 6.0) if c2 < 0.0 else 0.0
    bends = ti.Vector([-limit, ti.max(-limit, -turn), ti.min(limit, turn), limit])
    extrema = ti.Vector([-limit, limit, limit, limit, limit])
    found = 1
    for k in range(3):
        low, high = bends[k], bends[k + 1]
        slope_low = (4.0 * low * low + 2.0 * c2) * low + c1
        slope_high = (4.0 * high * high + 2.0 * c2) * high + c1
        if (slope_low < 0.0) != (slope_high < 0.0):
            extrema[found] = _between(4.0, 0.0, 2.0 * c2, c1, 0.0, low, high)
            found += 1
    count = 0
    for k in range(4):
        low, high = extrema[k], extrema[k + 1]
        value_low = ((low * low + c2) * low + c1) * low + c0
        value_high = ((high * high + c2) * high + c1) * high + c0
        if (value_low < 0.0) != (value_high < 0.0):
            roots[count] = _between(0.0, c2, c1, c0, 1.0, low, high)
            count += 1
    return roots


@ti.func
def crossings(kind, data: ti.template(), s, origin, direction):
    """Return where a ray crosses surface s: up to four distances, unused ones far away."""
    found = ti.Vector([_FAR, _FAR, _FAR, _FAR])
    axis = _vector(data, s, 3)
    a = data[s, 6]
    # Measured from the place nearest to the centre, the numbers stay small and exact.
    start = (_vector(data, s, 0) - origin).dot(direction)
    q = origin + start * direction - _vector(data, s, 0)
    along = direction.dot(axis)
    height = q.dot(axis)
    if kind == _PLANE:
        if ti.abs(along) > 1e-14:
            found[0] = start - height / along
    elif kind == _SPHERE:
        pair = _quadratic(1.0, q.dot(direction), q.dot(q) - a * a)
        found[0], found[1] = start + pair[0], start + pair[1]
    elif kind == _CYLINDER or kind == _CONE:
        off = q - height * axis
        turn = direction - along * axis
        k = ti.tan(a) * ti.tan(a) if kind == _CONE else 0.0
        rest = 0.0 if kind == _CONE else a * a
        pair = _quadratic(
            turn.dot(turn) - k * along * along,
            off.dot(turn) - k * height * along,
            off.dot(off) - k * height * height - rest,
        )
        for m in ti.static(range(2)):
            # The other half of the double cone is no part of the surface.
            if kind == _CYLINDER or height + pair[m] * along >= 0.0:
                found[m] = start + pair[m]
    else:
        b = data[s, 7]
        m = q.dot(q)
        limit = (a + b) * (a + b) - m
        if limit > 0.0:
            k = m + a * a - b * b
            found = _quartic(
                2.0 * k - 4.0 * a * a * (1.0 - along * along),
                8.0 * a * a * height * along,
                k * k - 4.0 * a * a * (m - height * height),
                ti.sqrt(limit) + 1e-6,
            )
            for n in range(4):
                if found[n] < _FAR:
                    found[n] = start + _polished(
                        data, s, origin + start * direction, direction, found[n]
                    )
    return found


@ti.func
def _polished(data: ti.template(), s, origin, direction, t):
    """Return a root of the torus after two Newton steps on the distance itself."""
    for _ in range(2):
        q = origin + t * direction - _vector(data, s, 0)
        axis = _vector(data, s, 3)
        height = q.dot(axis)
        off = q - height * axis
        ring = off.norm() - data[s, 6]
        tube = ti.sqrt(ring * ring + height * height)
        slope = (ring / off.norm() * off.dot(direction) + height * axis.dot(direction)) / tube
        if ti.abs(slope) > 1e-6:
            t -= (tube - data[s, 7]) / slope
    return t


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
            first = _FAR if outer else -_FAR
            second = _FAR
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
                origin, direction, reach, any_hit):  # fmt: skip
    """Return (distance, surface or -1, side) of a ray's nearest hit, or of any within reach.

    The part's program is walked once; every crossing that is nearer than the best hit is tested.
    """
    best = reach
    surface = -1
    side = 0
    inverse = 1.0 / direction
    pc = 0
    while pc < code.shape[0] and not (any_hit == 1 and surface >= 0):
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
                        if _in_box(faces, arg, p):
                            bits = _solid_if(code, boxes, kinds, data, p, arg)
                            if bits == 1 or bits == 2:
                                best = t
                                surface = arg
                                side = 1 if bits == 2 else -1
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
    any_hit: ti.i32,
    # Out:
    distances_out: F64Array,
    surfaces_out: I32Array,
    sides_out: I32Array,
):
    """Follow every ray to its nearest hit."""
    for i in range(origins_in.shape[0]):
        hit = nearest_hit(
            code_in, boxes_in, kinds_in, data_in, faces_in, _vector(origins_in, i, 0),
            _vector(directions_in, i, 0), reach_in[i], any_hit,
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
        bits = _solid_if(
            code_in, boxes_in, kinds_in, data_in, _vector(points_in, i, 0), surface_in[i]
        )
        side = 0
        if bits == 1:
            side = -1
        elif bits == 2:
            side = 1
        sides_out[i] = side
