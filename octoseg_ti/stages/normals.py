"""Stage 2: point normals from edge pairs of neighbouring stripes (section 3.2, Figs 4-6).

Two stripes at a time: the march goes along both, and every step makes one triangle whose origin is
on the second stripe. Triangles with an edge longer than the gap are left out, so that no phantom
wall crosses a step or a shadow.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, ti


@ti.func
def _add(sums: ti.template(), i: ti.i32, n: vec3):
    """Add to row ``i``; plain stores, because a strip shares its points with none of its colour."""
    for k in ti.static(range(3)):
        sums[i, k] = sums[i, k] + n[k]


@ti.func
def _edge_pair(origin: vec3, first: vec3, second: vec3, gap: ti.f64, by_area: ti.i32) -> vec3:
    """Return the normal of an edge pair; zero for a degenerate one or one that spans a gap."""
    e1 = first - origin
    e2 = second - origin
    n = vec3(0.0, 0.0, 0.0)
    a = e1.norm_sqr()
    b = e2.norm_sqr()
    if ti.max(a, b) <= gap * gap and (first - second).norm_sqr() <= gap * gap:
        cross = e1.cross(e2)
        square = cross.norm_sqr()
        if square > 1e-24 * a * b:
            n = cross
            if by_area == 0:
                n = cross / ti.sqrt(square)
    return n


@ti.kernel
def _march(
    colour: ti.i32,
    pairs: ti.i32,
    stride: ti.i32,
    gap: ti.f64,
    literal: ti.i32,
    by_area: ti.i32,
    # In:
    point_in: F64Rows,
    start_in: I32Array,
    view_in: I32Array,
    axis_in: F64Rows,
    # Out:
    sum_inout: F64Rows,
):
    """March along every second pair of stripes, adding each normal to its three points."""
    for u in range(pairs * stride):
        s = 2 * (u // stride) + colour
        if u % stride == 0 and view_in[start_in[s]] == view_in[start_in[s + 1]]:
            b = start_in[s]
            b_last = start_in[s + 1] - 1
            a = start_in[s + 1]
            a_last = start_in[s + 2] - 1
            axis = row(axis_in, view_in[b])
            sum_a = vec3(0.0, 0.0, 0.0)
            sum_b = vec3(0.0, 0.0, 0.0)
            origin = row(point_in, a)
            first = row(point_in, b)
            next_a = row(point_in, ti.min(a + 1, a_last))
            next_b = row(point_in, ti.min(b + 1, b_last))
            while a < a_last or b < b_last:
                along_first = 0  # 1: case I, the next point of the first stripe
                if a == a_last:
                    along_first = 1
                elif b < b_last:
                    if literal == 1:
                        along_first = ti.cast((next_b - next_a).dot(axis) <= 0.0, ti.i32)
                    else:
                        along_first = ti.cast(
                            (next_b - origin).norm_sqr() <= (next_a - first).norm_sqr(), ti.i32
                        )
                if along_first == 1:
                    n = _edge_pair(origin, first, next_b, gap, by_area)
                    sum_a += n
                    _add(sum_inout, b, sum_b + n)
                    sum_b = n
                    b += 1
                    first = next_b
                    next_b = row(point_in, ti.min(b + 1, b_last))
                else:
                    n = _edge_pair(origin, first, next_a, gap, by_area)
                    sum_b += n
                    _add(sum_inout, a, sum_a + n)
                    sum_a = n
                    a += 1
                    origin = next_a
                    next_a = row(point_in, ti.min(a + 1, a_last))
            _add(sum_inout, a, sum_a)
            _add(sum_inout, b, sum_b)


@ti.kernel
def _normalise(
    n: ti.i32,
    workers: ti.i32,
    stride: ti.i32,
    # In:
    point_in: F64Rows,
    view_in: I32Array,
    reference_in: F64Rows,
    # Out:
    normal_inout: F64Rows,
    vote_inout: I32Array,
):
    """Scale the sums to unit length (Eq. 2) and count, view by view, which side they point to."""
    chunk = (n + workers - 1) // workers
    for u in range(workers * stride):
        if u % stride == 0:
            lo = (u // stride) * chunk
            votes = 0
            for i in range(lo, ti.min(n, lo + chunk)):
                v = view_in[i]
                m = row(normal_inout, i)
                size = m.norm()
                if size > 0.0:
                    m = m / size
                for k in ti.static(range(3)):
                    normal_inout[i, k] = m[k]
                side = m.dot(row(reference_in, v) - row(point_in, i))
                if side > 0.0:
                    votes += 1
                elif side < 0.0:
                    votes -= 1
                if i + 1 == ti.min(n, lo + chunk) or view_in[ti.min(i + 1, n - 1)] != v:
                    ti.atomic_add(vote_inout[v], votes)
                    votes = 0


@ti.kernel
def _flip(
    # In:
    view_in: I32Array,
    sign_in: I32Array,
    # Out:
    normal_inout: F64Rows,
):
    """Turn the normals of the views that point away from the probe."""
    for i in view_in:
        if sign_in[view_in[i]] < 0:
            for k in ti.static(range(3)):
                normal_inout[i, k] = -normal_inout[i, k]


def stripe_axes(points: np.ndarray, start: np.ndarray, view: np.ndarray, views: int) -> np.ndarray:
    """Return the direction along the stripes of every view, unit length, shape (views, 3), f64.

    The mean over the stripes of the vector from their first to their last point.
    """
    first, last = start[:-1], start[1:] - 1
    axes = np.zeros((views, 3))
    np.add.at(axes, view[first], points[last] - points[first])
    size = np.linalg.norm(axes, axis=1, keepdims=True)
    return np.divide(axes, size, out=np.zeros_like(axes), where=size > 0)


def edge_pair_normals(
    points: np.ndarray,
    start: np.ndarray,
    view: np.ndarray,
    *,
    gap: float,
    rule: str = "diagonal",
    weight: str = "unit",
    origin: np.ndarray | None = None,
) -> np.ndarray:
    """Estimate the normal of every point from the edge pairs that use it (Eqs 1-2).

    Args:
        points: Positions [mm], shape (N, 3), f64, in stripe order, in the frame of their view.
        start: First point of every stripe, and N at the end, shape (S + 1,), i32.
        view: View of every point, shape (N,), i32, 0..V-1.
        gap: Longest edge of a triangle [mm].
        rule: "paper": of the two next points the one that comes first along the stripe (the paper's
            distance along y from the origin, taken with its sign, so that a stripe that starts
            earlier catches up); "diagonal": the shorter of the two diagonals, in space.
        weight: "unit" for the mean of unit normals (Eq. 1), "area" to weight by area.
        origin: Probe position of every view in the frame of ``points`` [mm], shape (V, 3). Normals
            point to the probe; without it, away from the middle of the view.

    Returns:
        Unit normals, shape (N, 3), f64; zero for a point without an edge pair.

    Raises:
        ValueError: Unknown rule or weight.
    """
    if rule not in ("diagonal", "paper"):
        raise ValueError(f"rule must be 'diagonal' or 'paper', not {rule!r}")
    if weight not in ("unit", "area"):
        raise ValueError(f"weight must be 'unit' or 'area', not {weight!r}")
    runtime.ensure_started()
    n, stripes = len(points), len(start) - 1
    views = int(view.max(initial=0)) + 1
    axes = stripe_axes(points, start, view, views)
    point, starts, seen = runtime.upload(points), runtime.upload(start), runtime.upload(view)
    normal = runtime.zeros((n, 3), np.float64)
    _, stride = runtime.workers()
    for colour in (0, 1):
        pairs = (stripes - colour) // 2
        if pairs > 0:
            _march(
                colour,
                pairs,
                stride,
                gap,
                int(rule == "paper"),
                int(weight == "area"),
                point,
                starts,
                seen,
                runtime.upload(axes),
                normal,
            )
    if origin is None:
        # The middle of the view, by the middle points of its stripes.
        middle = (start[:-1] + start[1:] - 1) // 2
        reference = np.zeros((views, 3))
        np.add.at(reference, view[middle], points[middle])
        reference /= np.maximum(np.bincount(view[middle], minlength=views), 1)[:, None]
    else:
        reference = np.asarray(origin, np.float64)
    vote = runtime.zeros(views, np.int32)
    workers, stride = runtime.workers()
    _normalise(n, workers, stride, point, seen, runtime.upload(reference), normal, vote)
    votes = runtime.download(vote)
    sign = np.where(votes >= 0, 1, -1).astype(np.int32)
    if origin is None:
        sign = -sign
    if np.any(sign < 0):
        _flip(seen, runtime.upload(sign), normal)
    return runtime.download(normal)
