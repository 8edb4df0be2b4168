"""Rays against parts, in parallel: the nearest hit, what hides a point, and where a face ends.

Rays go from cube to cube (`scanner_sim.cubes`) and end at the first hit.

A point of a surface lies on the solid exactly when being inside or outside of that one surface
decides whether the point is solid. So each value on the stack of a program has two bits: the
answer if the point were outside of the surface (bit 0), and if it were inside (bit 1).
"""

import math
from typing import NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, I32Rows, ti
from octoseg_ti.types import SurfaceKind
from scanner_sim.crossings import FAR, crossings, distance, surface_normal, vector
from scanner_sim.part import FlatPart, Op

_LEAF, _UNION = int(Op.LEAF), int(Op.UNION)
_TORUS = int(SurfaceKind.TORUS)
_STEPS = 12  # after so many a torus is taken to be near
_NEAR = 1e-9  # a hit closer to the origin of its ray than this is the origin itself [mm]
INTO = 1  # mode of a ray: only ways into the solid count
_SLACK = 1e-5  # a hit may be this far outside of the cube of the ray [mm]


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
    from_outside: bool = False,
) -> Hits:
    """Follow rays to the first surface of the solid.

    Args:
        part: The solid.
        origins: Starting points [mm], shape (N, 3).
        directions: Unit vectors, shape (N, 3).
        reach: Length of every ray [mm], shape (N,); hits beyond it do not count.
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
        *upload_program(part), _rows(origins), _rows(directions), runtime.upload(limits),
        INTO * int(from_outside),
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
    """Return a part for kernels: the three arrays of its cells, kinds and data of its surfaces."""
    arrays = (*part.cubes, part.surfaces.kind, part.surfaces.data)
    return tuple(runtime.upload(array) for array in arrays)


def _rows(values: np.ndarray) -> object:
    return runtime.upload(np.ascontiguousarray(values, np.float64))


@ti.func
def _side_within(code: ti.template(), start, stop, kinds: ti.template(), data: ti.template(),
                 p, surface):  # fmt: skip
    """Return on which side of a surface the solid lies, by some instructions; 0 = on none."""
    stack = ti.i64(0)
    for i in range(start, stop):
        op, arg, flag = code[i, 0], code[i, 1], code[i, 2]
        if op == _LEAF:
            value = ti.i64(2)
            if arg != surface:
                value = ti.i64(3) if distance(kinds[arg], data, arg, p) <= 0.0 else ti.i64(0)
            if flag == 1:
                value = value ^ 3
            stack = (stack << 2) | value
        else:
            upper = stack & 3
            stack = stack >> 2
            value = stack & upper
            if op == _UNION:
                value = stack | upper
            stack = ((stack >> 2) << 2) | (value & 3)
    result = 0
    bits = stack & 3
    if bits == 1:
        result = -1
    elif bits == 2:
        result = 1
    return result


@ti.func
def _cube_of(grid: ti.template(), p):
    """Return which cube a place is in, or the nearest one to it, as three numbers."""
    cube = ti.Vector([0, 0, 0])
    for k in ti.static(range(3)):
        place = ti.i32((p[k] - grid[0, k]) / grid[1, k])
        cube[k] = ti.max(0, ti.min(place, ti.i32(grid[2, k]) - 1))
    return cube


@ti.func
def _number(grid: ti.template(), cube):
    """Return the number of a cube."""
    return (cube[0] * ti.i32(grid[2, 1]) + cube[1]) * ti.i32(grid[2, 2]) + cube[2]


@ti.func
def side_at(code: ti.template(), first: ti.template(), grid: ti.template(),
            kinds: ti.template(), data: ti.template(), p, surface):  # fmt: skip
    """Return on which side of a surface, at a place on it, the solid lies.

    1 where it is inside of the surface, -1 where it is outside, 0 where neither or both are.
    """
    within = True
    for k in ti.static(range(3)):
        if p[k] < grid[0, k] or p[k] > grid[0, k] + grid[1, k] * grid[2, k]:
            within = False
    result = 0
    if within:
        c = _number(grid, _cube_of(grid, p))
        result = _side_within(code, first[c], first[c + 1], kinds, data, p, surface)
    return result


@ti.func
def _span(grid: ti.template(), origin, direction, inverse, reach):
    """Return where a ray enters the cubes and where it leaves them; before that, if nowhere."""
    enter = 0.0
    leave = reach
    for k in ti.static(range(3)):
        low = grid[0, k]
        high = low + grid[1, k] * grid[2, k]
        first = (low - origin[k]) * inverse[k]
        second = (high - origin[k]) * inverse[k]
        if direction[k] == 0.0:  # parallel to these sides: between them for ever, or never
            outer = origin[k] < low or origin[k] > high
            first = FAR if outer else -FAR
            second = FAR
        enter = ti.max(enter, ti.min(first, second))
        leave = ti.min(leave, ti.max(first, second))
    return ti.Vector([enter, leave])


@ti.func
def _may_cross(kind, data: ti.template(), s, origin, direction, low, high):
    """Say whether a ray may cross surface s between two distances.

    Only a torus costs more to cross than to ask: by steps as long as the surface is far away.
    """
    t = low
    if kind == _TORUS:
        steps = 0
        gap = 1.0
        while steps < _STEPS and t < high and gap > _SLACK:
            gap = ti.abs(distance(kind, data, s, origin + t * direction))
            t += gap
            steps += 1
    return t <= high


@ti.func
def _nearest_within(code: ti.template(), start, stop, kinds: ti.template(), data: ti.template(),
                    origin, direction, low, high, mode):  # fmt: skip
    """Return (distance, surface or -1, side) of the nearest hit between two distances.

    Every crossing that is nearer than the best hit is tested by the same instructions.
    """
    best = high
    surface = -1
    side = 0
    for i in range(start, stop):
        if code[i, 0] == _LEAF:
            arg = code[i, 1]
            found = ti.Vector([FAR, FAR, FAR, FAR])
            if _may_cross(kinds[arg], data, arg, origin, direction, low, best):
                found = crossings(kinds[arg], data, arg, origin, direction)
            for k in range(4):
                t = found[k]
                if low < t < best:
                    p = origin + t * direction
                    asked = True
                    if (mode & INTO) != 0:
                        # A surface knows which of its sides is solid wherever it bounds the part.
                        slope = surface_normal(kinds[arg], data, arg, p).dot(direction)
                        asked = slope > 0.0 if code[i, 2] == 1 else slope < 0.0
                    if asked:
                        found_side = _side_within(code, start, stop, kinds, data, p, arg)
                        if found_side != 0:
                            best = t
                            surface = arg
                            side = found_side
    return ti.Vector([best, ti.f64(surface), ti.f64(side)])


@ti.func
def nearest_hit(code: ti.template(), first: ti.template(), grid: ti.template(),
                kinds: ti.template(), data: ti.template(),
                origin, direction, reach, mode):  # fmt: skip
    """Return (distance, surface or -1, side) of a ray's nearest hit.

    The ray goes from cube to cube until a surface in one of them is hit. The mode says whether only
    ways into the solid are looked at.
    """
    hit = ti.Vector([reach, -1.0, 0.0])
    inverse = 1.0 / direction
    span = _span(grid, origin, direction, inverse, reach)
    t = span[0]
    cube = _cube_of(grid, origin + t * direction)
    # Along each axis: where the ray leaves its cube, how far it then is to the end of the next, how
    # many are left, and how the number of the cube changes.
    ahead = ti.Vector([FAR, FAR, FAR])
    pitch = ti.Vector([0.0, 0.0, 0.0])
    left = ti.Vector([0, 0, 0])
    jump = ti.Vector([ti.i32(grid[2, 1]) * ti.i32(grid[2, 2]), ti.i32(grid[2, 2]), 1])
    c = cube.dot(jump)
    for k in ti.static(range(3)):
        count = ti.i32(grid[2, k])
        left[k] = cube[k]
        if direction[k] > 0.0:
            left[k] = count - 1 - cube[k]
        else:
            jump[k] = -jump[k]
        if direction[k] != 0.0:
            side = cube[k] + (1 if direction[k] > 0.0 else 0)
            ahead[k] = (grid[0, k] + side * grid[1, k] - origin[k]) * inverse[k]
            pitch[k] = grid[1, k] * ti.abs(inverse[k])
    while t <= span[1] and hit[1] < 0.0 and ti.min(left[0], left[1], left[2]) >= 0:
        beyond = ti.min(ahead[0], ahead[1], ahead[2])
        start, stop = first[c], first[c + 1]
        if start < stop:
            low, high = ti.max(t - _SLACK, _NEAR), ti.min(beyond + _SLACK, reach)
            hit = _nearest_within(
                code, start, stop, kinds, data, origin, direction, low, high, mode
            )
        t = beyond
        if ahead[0] == beyond:
            ahead[0] += pitch[0]
            c += jump[0]
            left[0] -= 1
        elif ahead[1] == beyond:
            ahead[1] += pitch[1]
            c += jump[1]
            left[1] -= 1
        else:
            ahead[2] += pitch[2]
            c += jump[2]
            left[2] -= 1
    return hit


@ti.kernel
def _cast_rays(
    # In:
    code_in: I32Rows,
    first_in: I32Array,
    grid_in: F64Rows,
    kinds_in: I32Array,
    data_in: F64Rows,
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
            code_in, first_in, grid_in, kinds_in, data_in, vector(origins_in, i, 0),
            vector(directions_in, i, 0), reach_in[i], mode,
        )  # fmt: skip
        distances_out[i] = hit[0]
        surfaces_out[i] = ti.i32(hit[1])
        sides_out[i] = ti.i32(hit[2])


@ti.kernel
def _classify_points(
    # In:
    code_in: I32Rows,
    first_in: I32Array,
    grid_in: F64Rows,
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
        sides_out[i] = side_at(code_in, first_in, grid_in, kinds_in, data_in, p, surface_in[i])
