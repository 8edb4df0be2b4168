"""Stage 2: point normals from edge pairs of neighbouring stripes (section 3.2, Figs 4-6).

Two stripes at a time: the march goes along both, and every step makes one triangle whose origin is
on the second stripe. Triangles with an edge longer than the gap are left out, so that no phantom
wall crosses a step or a shadow.
"""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, ti

WEIGHTS = ("unit", "area")
"""How the normals of triangles can be weighed, in the order of their sums."""

vec6: Any = ti.types.vector(6, ti.f64)


@ti.func
def _add(sums: ti.template(), i: ti.i32, n: vec6):
    """Add to row ``i``; plain stores, because a strip shares its points with none of its colour."""
    for k in ti.static(range(6)):
        sums[i, k] = sums[i, k] + n[k]


@ti.func
def _edge_pair(e1: vec3, e2: vec3, a: ti.f64, b: ti.f64, c: ti.f64, gap: ti.f64) -> vec6:
    """Return the normal of an edge pair twice: of unit length, and as long as its area weighs.

    Zero for a degenerate pair, or one that spans a gap. Known are the squared lengths of the edges,
    and of the third side of their triangle.
    """
    n = vec6(0.0)
    if ti.max(a, b, c) <= gap * gap:
        cross = e1.cross(e2)
        square = cross.norm_sqr()
        if square > 1e-24 * a * b:
            unit = cross / ti.sqrt(square)
            n = vec6(unit[0], unit[1], unit[2], cross[0], cross[1], cross[2])
    return n


@ti.kernel
def _march(
    colour: ti.i32,
    pairs: ti.i32,
    stride: ti.i32,
    gap: ti.f64,
    literal: ti.i32,
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
            b, b_last = start_in[s], start_in[s + 1] - 1
            a, a_last = start_in[s + 1], start_in[s + 2] - 1
            axis = row(axis_in, view_in[b])
            sum_a, sum_b = vec6(0.0), vec6(0.0)
            origin, first = row(point_in, a), row(point_in, b)
            next_a = row(point_in, ti.min(a + 1, a_last))
            next_b = row(point_in, ti.min(b + 1, b_last))
            width = (first - origin).norm_sqr()
            while a < a_last or b < b_last:
                # The two diagonals; one becomes an edge between the stripes.
                square_a = (next_a - first).norm_sqr()
                square_b = (next_b - origin).norm_sqr()
                along_first = 0  # 1: case I, the next point of the first stripe
                if a == a_last:
                    along_first = 1
                elif b < b_last:
                    along_first = ti.cast(square_b <= square_a, ti.i32)
                    if literal == 1:
                        along_first = ti.cast((next_b - next_a).dot(axis) <= 0.0, ti.i32)
                e1 = first - origin
                if along_first == 1:
                    side = (first - next_b).norm_sqr()
                    n = _edge_pair(e1, next_b - origin, width, square_b, side, gap)
                    sum_a += n
                    _add(sum_inout, b, sum_b + n)
                    sum_b = n
                    b += 1
                    first, width = next_b, square_b
                    next_b = row(point_in, ti.min(b + 1, b_last))
                else:
                    e2 = next_a - origin
                    n = _edge_pair(e1, e2, width, e2.norm_sqr(), square_a, gap)
                    sum_b += n
                    _add(sum_inout, a, sum_a + n)
                    sum_a = n
                    a += 1
                    origin, width = next_a, square_a
                    next_a = row(point_in, ti.min(a + 1, a_last))
            _add(sum_inout, a, sum_a)
            _add(sum_inout, b, sum_b)


@ti.kernel
def _normalise(
    n: ti.i32,
    workers: ti.i32,
    stride: ti.i32,
    column: ti.i32,
    # In:
    sum_in: F64Rows,
    point_in: F64Rows,
    view_in: I32Array,
    reference_in: F64Rows,
    # Out:
    normal_out: F64Rows,
    vote_inout: I32Array,
):
    """Scale sums to unit length (Eq. 2) and count, view by view, which side they point to."""
    chunk = (n + workers - 1) // workers
    for u in range(workers * stride):
        if u % stride == 0:
            lo = (u // stride) * chunk
            votes = 0
            for i in range(lo, ti.min(n, lo + chunk)):
                v = view_in[i]
                m = vec3(sum_in[i, column], sum_in[i, column + 1], sum_in[i, column + 2])
                size = m.norm()
                if size > 0.0:
                    m = m / size
                for k in ti.static(range(3)):
                    normal_out[i, k] = m[k]
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


def edge_pair_sums(
    points: np.ndarray,
    start: np.ndarray,
    view: np.ndarray,
    *,
    gap: float,
    rule: str = "diagonal",
) -> Any:
    """Add up, for every point, the normals of the edge pairs that use it (Eq. 1).

    Args:
        points: Positions [mm], shape (N, 3), f64, in stripe order, in the frame of their view.
        start: First point of every stripe, and N at the end, shape (S + 1,), i32.
        view: View of every point, shape (N,), i32, 0..V-1.
        gap: Longest edge of a triangle [mm].
        rule: "paper": of the two next points the one that comes first along the stripe (the paper's
            distance along y from the origin, taken with its sign, so that a stripe that starts
            earlier catches up); "diagonal": the shorter of the two diagonals, in space.

    Returns:
        Sum of the unit normals, and sum weighted by area, shape (N, 6), f64 (kernel array); zero
        for a point without an edge pair.

    Raises:
        ValueError: Unknown rule.
    """
    if rule not in ("diagonal", "paper"):
        raise ValueError(f"rule must be 'diagonal' or 'paper', not {rule!r}")
    runtime.ensure_started()
    stripes, literal = len(start) - 1, rule == "paper"
    views = int(view.max(initial=0)) + 1
    axes = stripe_axes(points, start, view, views) if literal else np.zeros((views, 3))
    shared = (*(runtime.upload(array) for array in (points, start, view, axes)),)
    sums = runtime.zeros((len(points), 6), np.float64)
    _, stride = runtime.workers()
    for colour in (0, 1):
        pairs = (stripes - colour) // 2
        if pairs > 0:
            _march(colour, pairs, stride, gap, int(literal), *shared, sums)
    return sums


def oriented_normals(
    sums: Any,
    points: np.ndarray,
    start: np.ndarray,
    view: np.ndarray,
    *,
    weight: str = "unit",
    origin: np.ndarray | None = None,
) -> np.ndarray:
    """Return the directions of sums of normals (Eq. 2), all of a view on the side of its probe.

    Args:
        sums: What `edge_pair_sums` returned.
        points: As there, and so are the next two.
        start: First point of every stripe.
        view: View of every point.
        weight: "unit" for the mean of unit normals (Eq. 1), "area" to weight by area.
        origin: Probe position of every view in the frame of ``points`` [mm], shape (V, 3). Normals
            point to the probe; without it, away from the middle of the view.

    Returns:
        Unit normals, shape (N, 3), f64; zero for a point without an edge pair.

    Raises:
        ValueError: Unknown weight.
    """
    if weight not in WEIGHTS:
        raise ValueError(f"weight must be 'unit' or 'area', not {weight!r}")
    runtime.ensure_started()
    n, views = len(points), int(view.max(initial=0)) + 1
    if origin is None:
        # The middle of the view, by the middle points of its stripes.
        middle = (start[:-1] + start[1:] - 1) // 2
        reference = np.zeros((views, 3))
        np.add.at(reference, view[middle], points[middle])
        reference /= np.maximum(np.bincount(view[middle], minlength=views), 1)[:, None]
    else:
        reference = np.asarray(origin, np.float64)
    seen, normal = runtime.upload(view), runtime.empty((n, 3), np.float64)
    vote = runtime.zeros(views, np.int32)
    _normalise(
        n, *runtime.workers(), 3 * WEIGHTS.index(weight), sums, runtime.upload(points), seen,
        runtime.upload(reference), normal, vote,
    )  # fmt: skip
    votes = runtime.download(vote)
    sign = np.where(votes >= 0, 1, -1).astype(np.int32)
    if origin is None:
        sign = -sign
    if np.any(sign < 0):
        _flip(seen, runtime.upload(sign), normal)
    return runtime.download(normal)
