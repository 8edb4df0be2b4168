"""Noisy normals made smooth within faces, with the edges between them kept or restored.

A mean over neighbours rounds edges off, and weights by the angle between two normals (a bilateral
filter) cannot keep an edge that is no larger than the noise of one normal. So the mean comes first
and edges are restored from it: how far the normals around a point spread tells a point on a rounded
edge from one inside a face, and every further pass takes a mean with weights that favour neighbours
inside faces. The faces thus grow back to the edge from both sides.

What is curved all over spreads as well, and must stay as it is. Only the part of the spread counts
that is narrow, as a rounded edge is: what a morphological opening takes away.

After the ideas of guided and of Tukey-weighted normal filtering (Zhang et al. 2015, Yadav et al.
2018), in a form that needs sums over eight neighbours only.
"""

import math

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F32Array, F32Rows, F64Rows, I32Array, I32Rows, ti
from octoseg_ti.stages.sampling import sample_stripes, trimmed_mean

# The first mean leaves out normals farther away than this many standard deviations: at 0.01 mm and
# 0.25 mm spacing a sharp edge of 15 degrees. Nearer limits leave single bad normals alone for good.
_GATE = 8.5
# Diagonal neighbours are farther away by the root of two.
_DIAGONAL = 0.7
# An opening of twice two rings removes what is narrower than five points: an edge after the first
# mean, and no fillet that stripes could resolve.
_OPENING = 2
# Spread that is nothing: in means of what noise leaves, plus so many times that of a curved face.
_SPREAD_NOISES = 4.0
_SPREAD_CURVED = 4.0
_SAMPLES = 6000
# The neighbours by number, the diagonal ones last: on which stripe, 0 for that of the point, 1 for
# the one before, 2 for the one after, and how many steps from the nearest point there.
_RING = (
    (0, 0, -1), (1, 0, 1), (2, 1, 0), (3, 2, 0), (4, 1, -1), (5, 1, 1), (6, 2, -1), (7, 2, 1)
)  # fmt: skip

_vec3_f32 = ti.types.vector(3, ti.f32)


@ti.func
def _row32(rows: ti.template(), i: ti.i32) -> _vec3_f32:
    """Return row ``i`` in the precision of the noisy normals, which is all they need."""
    return _vec3_f32(rows[i, 0], rows[i, 1], rows[i, 2])


@ti.func
def _write_direction(total, before, i: ti.i32, normal_out: ti.template()):
    """Write the direction of a sum of normals, or the normal before where they cancel."""
    size = total.norm()
    n = before
    if size > 0:
        n = total / size
    for k in ti.static(range(3)):
        normal_out[i, k] = n[k]


@ti.func
def _nearest_ahead(p: vec3, j: ti.i32, last: ti.i32, point: ti.template()) -> ti.i32:
    """Return the point of a stripe that is nearest to p, going on from j.

    Looking two points ahead gets over noise.
    """
    at = j
    best = (row(point, at) - p).norm_sqr()
    going = 1
    while going == 1:
        going = 0
        for ahead in ti.static((1, 2)):
            if going == 0 and at + ahead <= last:
                d = (row(point, at + ahead) - p).norm_sqr()
                if d <= best:
                    best = d
                    at += ahead
                    going = 1
    return at


@ti.func
def _linked(
    i: ti.i32, j: ti.i32, first: ti.i32, last: ti.i32, gap: ti.f64, point: ti.template(),
    normal: ti.template(),
) -> ti.i32:  # fmt: skip
    """Return j if it is one of its stripe, near to i and with a normal; else i."""
    found = i
    if j >= first and j <= last:
        if (row(point, j) - row(point, i)).norm_sqr() <= gap * gap:
            if _row32(normal, j).norm_sqr() > 0.25:
                found = j
    return found


@ti.kernel
def _link(
    lag: ti.i32,
    stripes: ti.i32,
    stride: ti.i32,
    gap: ti.f64,
    # In:
    point_in: F64Rows,
    normal_in: F32Rows,
    start_in: I32Array,
    view_in: I32Array,
    # Out:
    ring_out: I32Rows,
):
    """Write the eight neighbours of every point; itself where one is missing.

    Two on its own stripe, the nearest points of the stripes before and after, and two beside each
    of these. The nearest are found by going along, for neighbouring stripes run the same way.
    """
    for u in range(stripes * stride):
        s = u // stride
        if u % stride == 0:
            # Of the stripe itself, the one before, and the one after; these may not be there.
            first = ti.Vector([start_in[s]] * 3)
            last = ti.Vector([start_in[s + 1] - 1, -1, -1])
            for side in ti.static((1, 2)):
                other = s + ti.static(2 * side - 3)
                if other >= 0 and other < stripes:
                    if view_in[start_in[other]] == view_in[start_in[s]]:
                        first[side] = start_in[other]
                        last[side] = start_in[other + 1] - 1
            at = first
            for i in range(start_in[s], start_in[s + 1]):
                at[0] = i
                for side in ti.static((1, 2)):
                    if last[side] >= 0:
                        at[side] = _nearest_ahead(row(point_in, i), at[side], last[side], point_in)
                for k, side, step in ti.static(_RING):
                    j = at[side] + step * lag
                    ring_out[i, k] = _linked(
                        i, j, first[side], last[side], gap, point_in, normal_in
                    )


@ti.kernel
def _average_near(
    per_limit: ti.f32,
    # In:
    ring_in: I32Rows,
    normal_in: F32Rows,
    # Out:
    normal_out: F32Rows,
):
    """Write the mean of every normal and its neighbours by Tukey's biweight of their distance.

    Per limit is one over the square of the distance from which on they count nothing.
    """
    for i in range(ring_in.shape[0]):
        n = _row32(normal_in, i)
        total = n
        for k in ti.static(range(8)):
            j = ring_in[i, k]
            m = _row32(normal_in, j)
            w = ti.max(ti.cast(0.0, ti.f32), 1 - per_limit * (m - n).norm_sqr())
            w = w * w * (j != i)
            if ti.static(k >= 4):
                w = w * ti.cast(_DIAGONAL, ti.f32)
            total += w * m
        _write_direction(total, n, i, normal_out)


@ti.kernel
def _average(
    # In:
    ring_in: I32Rows,
    normal_in: F32Rows,
    weight_in: F32Array,
    # Out:
    normal_out: F32Rows,
):
    """Write the weighted mean of every normal and its neighbours."""
    for i in weight_in:
        n = _row32(normal_in, i)
        total = weight_in[i] * n
        for k in ti.static(range(8)):
            j = ring_in[i, k]
            w = weight_in[j] * (j != i)
            if ti.static(k >= 4):
                w = w * ti.cast(_DIAGONAL, ti.f32)
            total += w * _row32(normal_in, j)
        _write_direction(total, n, i, normal_out)


@ti.kernel
def _measure_spread(
    # In:
    ring_in: I32Rows,
    normal_in: F32Rows,
    # Out:
    spread_out: F32Array,
):
    """Write the mean square distance of the neighbouring normals from each normal."""
    for i in spread_out:
        n = _row32(normal_in, i)
        near = ti.cast(0.0, ti.f32)
        far = ti.cast(0.0, ti.f32)
        count = 0
        for k in ti.static(range(8)):
            j = ring_in[i, k]
            d = (_row32(normal_in, j) - n).norm_sqr()
            if ti.static(k < 4):
                near += d
                count += 2 * ti.cast(j != i, ti.i32)
            else:
                far += d
                count += ti.cast(j != i, ti.i32)
        spread_out[i] = (2 * near + far) / ti.max(count, 1)


@ti.kernel
def _open(
    sign: ti.i32,
    # In:
    ring_in: I32Rows,
    value_in: F32Array,
    # Out:
    value_out: F32Array,
):
    """Write the least value of every neighbourhood (sign 1), or the largest (sign -1)."""
    for i in value_in:
        least = sign * value_in[i]
        for k in ti.static(range(8)):
            least = ti.min(least, sign * value_in[ring_in[i, k]])
        value_out[i] = sign * least


@ti.kernel
def _weigh(
    nothing: ti.f64,
    # In:
    spread_in: F32Array,
    curved_in: F32Array,
    # Out:
    weight_out: F32Array,
):
    """Write how much a point counts: 1 inside a face, little on an edge."""
    for i in spread_in:
        curved = ti.cast(curved_in[i], ti.f64)
        least = nothing + _SPREAD_CURVED * curved
        w = least / (least + ti.max(0.0, spread_in[i] - curved))
        weight_out[i] = ti.cast(w * w, ti.f32)


@ti.kernel
def _finish(
    # In:
    filtered_in: F32Rows,
    normal_in: F64Rows,
    # Out:
    normal_out: F64Rows,
):
    """Write the filtered normals in full length where there was a normal."""
    for i in range(normal_in.shape[0]):
        n = row(normal_in, i)
        if n.norm_sqr() > 0.25:
            n = row(filtered_in, i).normalized()
        for k in ti.static(range(3)):
            normal_out[i, k] = n[k]


def square_lag(along: float, across: float) -> int:
    """Return how many points of a stripe reach as far as the next stripe at most: 1, 2, 4 ...

    Args:
        along: Spacing along the stripes [mm].
        across: Spacing of the stripes [mm].
    """
    if along <= 0.0 or across <= along:
        return 1
    return int(2 ** math.floor(math.log2(across / along)))


def independent_lag(passes: int, lag: int = 1) -> int:
    """Return how many points apart on a stripe the errors of two filtered normals are independent.

    Args:
        passes: Passes of the filter after the first mean; 0 = not filtered.
        lag: Distance of neighbours in the filter [points].
    """
    if passes == 0:
        return 3
    # Every mean spreads an error by 0.8 neighbours, edge pairs by 0.7. Two and a half times the
    # root of the sum of squares apart they share next to nothing. (Farther is no better: there may
    # be another face.)
    return lag * math.ceil(2.5 * math.sqrt(0.6 * (passes + 1) + 0.5))


def filter_normals(
    points: np.ndarray,
    normals: np.ndarray,
    start: np.ndarray,
    run: np.ndarray,
    view: np.ndarray,
    *,
    passes: int,
    gap: float,
    noise: float,
    lag: int = 1,
) -> np.ndarray:
    """Smooth the normals of stripes within faces and keep the edges between them.

    Args:
        points: Positions [mm], shape (N, 3), f64, in stripe order.
        normals: Unit normals, shape (N, 3), f64; zero rows have none, and keep none.
        start: First point of every stripe, and N at the end, shape (S + 1,), i32.
        run: Index of the stripe of every point, shape (N,), i32.
        view: View of every point, shape (N,), i32.
        passes: Passes that restore edges, after the one that averages; 0 returns the normals.
        gap: Longest distance between neighbours [mm].
        noise: Deviation of the normals from those of the surface [rad].
        lag: Neighbours on a stripe are this many points apart, a power of two: as far as stripes.

    Returns:
        Unit normals, shape (N, 3), f64.
    """
    if passes == 0:
        return normals
    runtime.ensure_started()
    n, stripes = len(points), len(start) - 1
    point, starts, seen = runtime.upload(points), runtime.upload(start), runtime.upload(view)
    ring = runtime.empty((n, 8), np.int32)
    _, stride = runtime.workers()
    raw = runtime.upload(normals.astype(np.float32))
    old, new, spare = raw, *(runtime.empty((n, 3), np.float32) for _ in range(2))
    # Dense stripes: means over one, two, four ... points first, until the steps are square.
    step = 1
    while True:
        _link(step, stripes, stride, gap, point, raw, starts, seen, ring)
        _average_near(1.0 / (_GATE * max(noise, 1e-6)) ** 2, ring, old, new)
        old, new, spare = new, spare, new
        if step >= lag:
            break
        step *= 2
    spread, curved, scratch, weight = (runtime.empty(n, np.float32) for _ in range(4))
    sample = sample_stripes(start, _SAMPLES)
    for again in range(passes):
        _measure_spread(ring, old, spread)
        if again == 0:
            _open(1, ring, spread, curved)
            for sign in (1,) * (_OPENING - 1) + (-1,) * _OPENING:
                _open(sign, ring, curved, scratch)
                curved, scratch = scratch, curved
        # Where there is no spread at all, every weight is the same.
        nothing = _SPREAD_NOISES * trimmed_mean(runtime.download(spread)[sample])
        _weigh(max(nothing, 1e-12), spread, curved, weight)
        _average(ring, old, weight, new)
        old, new = new, old
    result = runtime.empty((n, 3), np.float64)
    _finish(old, runtime.upload(normals), result)
    return runtime.download(result)
