"""Where a scanned face ends although nothing was measured beside it, and what the probe saw there.

Such a border is an edge of the part, or the rim of a shadow, or the end of the field of view. In
scan order a border is a point whose stripe breaks off, or beside which the next stripe has no point
at the same ray; among the points of all views it is one with a wide sector around it free of
points. What lies beyond tells which it is: a ray that went on to something behind the plane of the
face crossed that plane, so the face is not there; where something stands in front of the plane, or
lies in it, the face may go on in its shadow. (Occluding and occluded contours of range images:
Besl & Jain 1988; Fisher 1989.)
"""

from typing import NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, I32Rows, ti
from octoseg_ti.device.searching import first_not_less

NEXT, BEFORE, UP, DOWN = 1, 2, 4, 8
"""Sides of a point in scan order that may be open: along its stripe, and towards the next stripe
or the one before."""

ENDED, BEHIND, PASSED, HIDDEN = 1, 2, 4, 8
"""What is beyond an open side: no further point, amid the field of view; something behind the
plane of the face; no further stripe; something in the plane or in front of it, or the end of the
field of view."""

_LANES = 2.0  # a point of another stripe is on the same ray within so many lanes
_SLOPE = 0.02  # the plane of a face is known so well, far from it
_TOWARDS = 0.3  # a side is open towards the free sector within the angle of this cosine


class Lines(NamedTuple):
    """Points in scan order, ``S`` stripes."""

    points: np.ndarray
    """Positions [mm], shape (n, 3), f64."""
    start: np.ndarray
    """First point of every stripe, and n at the end, shape (S + 1,), i32."""
    run: np.ndarray
    """Stripe of every point, shape (n,), i32."""
    view: np.ndarray
    """View of every stripe, shape (S,), i32."""
    lane: np.ndarray
    """Ray of every point, rising along its stripe, about 1 from point to point, shape (n,), f64."""
    source: np.ndarray | None
    """Probe at every stripe [mm], shape (S, 3), f64; None = not known."""
    order: np.ndarray
    """Place in scan order of every sorted point, shape (n,)."""
    place: np.ndarray
    """The sorted point that every point is, shape (n,)."""


@ti.func
def _on_ray(
    lane_in: ti.template(), start_in: ti.template(), view_in: ti.template(), s: ti.i32, t: ti.i32,
    stripes: ti.i32, lane: ti.f64,
) -> ti.i32:  # fmt: skip
    """Return the point of stripe t on a ray, -1 if there is none or t belongs to another view."""
    found = -1
    if t >= 0 and t < stripes and view_in[ti.max(0, ti.min(t, stripes - 1))] == view_in[s]:
        lo = first_not_less(lane_in, lane, start_in[t], start_in[t + 1] - 1)
        if lo > start_in[t] and lane - lane_in[lo - 1] < ti.abs(lane_in[lo] - lane):
            lo -= 1
        if ti.abs(lane_in[lo] - lane) <= _LANES:
            found = lo
    return found


@ti.func
def _close(point_in: ti.template(), i: ti.i32, j: ti.i32, gap: ti.f64) -> ti.i32:
    """Say whether j is a point, and near point i."""
    near = 0
    if j >= 0:
        near = ti.cast((row(point_in, j) - row(point_in, i)).norm_sqr() <= gap * gap, ti.i32)
    return near


@ti.func
def _beside(
    point_in: ti.template(), lane_in: ti.template(), i: ti.i32, j: ti.i32, hi: ti.i32, gap: ti.f64
):  # fmt: skip
    """Return (the point of another stripe nearest to the ray of point i, whether it is near i).

    The search goes on from point j to the end of that stripe, hi.
    """
    lane = lane_in[i]
    near = 0
    # Taichi works out both sides of "and": an empty stripe must not be read.
    if j < hi:
        while j + 1 < hi and (
            ti.abs(lane_in[ti.min(j + 1, hi - 1)] - lane) <= ti.abs(lane_in[j] - lane)
        ):
            j += 1
        if ti.abs(lane_in[j] - lane) <= _LANES:
            near = _close(point_in, i, j, gap)
    return j, near


@ti.kernel
def _open_sides(
    gap: ti.f64,
    stride: ti.i32,
    # In:
    asked_in: I32Array,
    point_in: F64Rows,
    start_in: I32Array,
    view_in: I32Array,
    lane_in: F64Array,
    # Out:
    side_out: I32Array,
):
    """Write on which sides a point has no neighbour, though it has one on the other side."""
    last = view_in.shape[0] - 1
    for u in range(view_in.shape[0] * stride):
        if u % stride == 0:
            s = u // stride
            up = start_in[s + 1]
            up_end = up
            if s < last and view_in[ti.min(s + 1, last)] == view_in[s]:
                up_end = start_in[s + 2]
            down = start_in[ti.max(s - 1, 0)]
            down_end = down
            if s > 0 and view_in[ti.max(s - 1, 0)] == view_in[s]:
                down_end = start_in[s]
            ahead = 0
            for i in range(start_in[s], start_in[s + 1]):
                side = 0
                back = ahead
                ahead = _close(point_in, i, ti.select(i + 1 < start_in[s + 1], i + 1, -1), gap)
                if asked_in[i] == 1:
                    if ahead != back:
                        side += ti.select(back == 1, NEXT, BEFORE)
                    next_near = 0
                    last_near = 0
                    up, next_near = _beside(point_in, lane_in, i, up, up_end, gap)
                    down, last_near = _beside(point_in, lane_in, i, down, down_end, gap)
                    if next_near != last_near:
                        side += ti.select(last_near == 1, UP, DOWN)
                side_out[i] = side


@ti.func
def _crossing(p: vec3, q: vec3, n: vec3, away: vec3, off: ti.f64) -> ti.f64:
    """Return how far from p the ray to q crossed the plane of p; -1 unless q is behind that plane.

    Args:
        p: The last point of a face.
        q: A point that was measured beyond it.
        n: The normal of the face.
        away: Where the probe is, seen from q.
        off: Points are off the plane when they are so far from it [mm].
    """
    found = -1.0
    height = (q - p).dot(n)
    fall = away.dot(n)
    if height < -off - _SLOPE * (q - p).norm() and fall > 0.0:
        found = (q - (height / fall) * away - p).norm()
    return found


@ti.func
def _sight(source_in: ti.template(), s: ti.i32, q: vec3, n: vec3) -> vec3:
    """Return where the probe is, seen from q on stripe s; where n points if that is not known."""
    away = n
    if source_in.shape[0] > s:
        away = row(source_in, s) - q
    return away


@ti.func
def _seen_along(
    point_in: ti.template(), start_in: ti.template(), lane_in: ti.template(),
    source_in: ti.template(), i: ti.i32, s: ti.i32, step: ti.i32, n: vec3, low: ti.f64,
    high: ti.f64, gap: ti.f64, off: ti.f64,
) -> ti.i32:  # fmt: skip
    """Return what is beyond point i along its stripe s."""
    found = HIDDEN
    k = i + step
    if k >= start_in[s] and k < start_in[s + 1]:
        q = row(point_in, k)
        far = _crossing(row(point_in, i), q, n, _sight(source_in, s, q, n), off)
        if far >= 0.0 and far <= gap:
            found = BEHIND
    elif lane_in[i] > low and lane_in[i] < high:
        found = ENDED
    return found


@ti.func
def _seen_across(
    point_in: ti.template(), start_in: ti.template(), view_in: ti.template(),
    lane_in: ti.template(), source_in: ti.template(), i: ti.i32, s: ti.i32, step: ti.i32, n: vec3,
    gap: ti.f64, off: ti.f64,
) -> ti.i32:  # fmt: skip
    """Return what is beyond point i of stripe s, on the same ray of the stripes that follow.

    The camera stands on one of these sides. What is behind the face is often hidden from it by the
    face itself, for some stripes; what stands in front of the plane of the face may hide the face.
    """
    stripes = view_in.shape[0]
    p = row(point_in, i)
    t = s + step
    found = PASSED
    first = 1
    going = 1
    while going == 1 and t >= 0 and t < stripes:
        going = ti.cast(view_in[t] == view_in[s], ti.i32)
        if going == 1:
            if found == PASSED:
                found = ENDED
            k = _on_ray(lane_in, start_in, view_in, s, t, stripes, lane_in[i])
            if k >= 0:
                q = row(point_in, k)
                far = _crossing(p, q, n, _sight(source_in, t, q, n), off)
                if first == 1:
                    # Without a place of the probe normals may point to the wrong side.
                    found = ti.select(far >= 0.0 and source_in.shape[0] > t, BEHIND, HIDDEN)
                    if far >= 0.0 and far <= gap:
                        found = BEHIND
                        going = 0
                elif (q - p).dot(n) > off + _SLOPE * (q - p).norm():
                    found = HIDDEN
                first = 0
                if found == HIDDEN:
                    going = 0
            t += step
    return found


@ti.kernel
def _look_beyond(
    # In:
    limit_in: F64Array,
    point_in: F64Rows,
    start_in: I32Array,
    view_in: I32Array,
    lane_in: F64Array,
    source_in: F64Rows,
    field_in: F64Rows,
    entry_in: I32Rows,
    border_in: F64Rows,
    # Out:
    found_out: I32Array,
):
    """Write what is beyond the open sides of border points that agree with their free sector."""
    for e in found_out:
        i = entry_in[e, 0]
        s = entry_in[e, 1]
        v = view_in[s]
        n = vec3(border_in[e, 0], border_in[e, 1], border_in[e, 2])
        outward = vec3(border_in[e, 3], border_in[e, 4], border_in[e, 5])
        found = 0
        for bit in range(4):
            if (entry_in[e, 2] >> bit) & 1 == 1:
                step = 1 - 2 * (bit % 2)
                inner = i - step
                if bit >= 2:
                    inner = _on_ray(
                        lane_in, start_in, view_in, s, s - step, view_in.shape[0], lane_in[i]
                    )
                way = row(point_in, i) - row(point_in, inner)
                towards = way.dot(outward) >= _TOWARDS * way.norm()
                if towards and bit < 2:
                    found |= _seen_along(
                        point_in, start_in, lane_in, source_in, i, s, step, n, field_in[v, 0],
                        field_in[v, 1], limit_in[0], limit_in[1],
                    )  # fmt: skip
                if towards and bit >= 2:
                    found |= _seen_across(
                        point_in, start_in, view_in, lane_in, source_in, i, s, step, n,
                        limit_in[0], limit_in[1],
                    )  # fmt: skip
        found_out[e] = found


def open_sides(lines: Lines, asked: np.ndarray, gap: float) -> np.ndarray:
    """Return on which sides points have no neighbour in scan order, shape (n,), i32 of bits.

    Args:
        lines: The points in scan order.
        asked: Which of them are looked at, shape (n,), bool.
        gap: Neighbours are at most so far apart [mm].
    """
    runtime.ensure_started()
    side = runtime.empty(len(lines.points), np.int32)
    stride = runtime.stride_of(len(lines.view))
    _open_sides(
        gap, stride, runtime.upload(asked.astype(np.int32)), runtime.upload(lines.points),
        runtime.upload(lines.start), runtime.upload(lines.view), runtime.upload(lines.lane), side,
    )  # fmt: skip
    return runtime.download(side)


def look_beyond(
    lines: Lines,
    field: np.ndarray,
    point: np.ndarray,
    side: np.ndarray,
    normal: np.ndarray,
    outward: np.ndarray,
    *,
    gap: float,
    off: float,
) -> np.ndarray:
    """Return what was seen beyond border points, shape (E,), i32 of bits.

    Args:
        lines: The points in scan order.
        field: Lanes between which a stripe that ends has ended amid the field of view, for every
            view, shape (V, 2).
        point: Border points, places in scan order, shape (E,).
        side: Their open sides, shape (E,).
        normal: Normals of the faces there, shape (E, 3).
        outward: Direction in which no points lie, shape (E, 3).
        gap: The ray to a point behind a face, on the same stripe, crosses the plane of the face so
            close [mm].
        off: Points are off that plane when they are so far from it [mm].
    """
    runtime.ensure_started()
    entries = len(point)
    if entries == 0:
        return np.zeros(0, np.int32)
    source = np.zeros((0, 3)) if lines.source is None else lines.source
    found = runtime.empty(entries, np.int32)
    _look_beyond(
        runtime.upload(np.array([gap, off])), runtime.upload(lines.points),
        runtime.upload(lines.start), runtime.upload(lines.view), runtime.upload(lines.lane),
        runtime.upload(source), runtime.upload(field.astype(np.float64)),
        runtime.upload(np.stack([point, lines.run[point], side], axis=1).astype(np.int32)),
        runtime.upload(np.concatenate([normal, outward], axis=1)), found,
    )  # fmt: skip
    return runtime.download(found)
