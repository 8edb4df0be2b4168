"""Stage 1: mark spikes, runs of them, and small detached groups, before normals are estimated (I3).

Along a stripe a point is in doubt when it is off the lines through its neighbours on every side, or
when its piece between two steps is short. Most of these are true: corners, small faces, what is
seen through gaps. So the surroundings are asked, in the stripes beside and in other views: a point
in doubt is an outlier when no surface goes through it, or when it belongs to a group too small for
a patch that nothing else holds.

Nothing is dropped: the caller keeps every row and learns which ones were marked.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, ti
from octoseg_ti.stages.support import find_support

_STEP = 1.5  # neighbours farther apart than this many spacings may stand on both sides of a step
_SHORT = 16  # a piece of a stripe with fewer points is in doubt
_BACKING = 0.15  # share of a full surface around it that holds a point
_KINK, _BREAK = 1, 2


@ti.func
def _off_line(p: vec3, a: vec3, b: vec3) -> ti.f64:
    """Return the distance of a point from a line."""
    along = b - a
    t = (p - a).dot(along) / ti.max(along.norm_sqr(), 1e-300)
    return (p - a - t * along).norm()


@ti.kernel
def _inspect(
    off: ti.f64,
    step: ti.f64,
    far: ti.f64,
    # In:
    point_in: F64Rows,
    start_in: I32Array,
    run_in: I32Array,
    # Out:
    code_out: I32Array,
):
    """Write whether a point is off all lines beside it, and whether its stripe breaks after it."""
    for i in run_in:
        lo = start_in[run_in[i]]
        hi = start_in[run_in[i] + 1] - 1
        p = row(point_in, i)
        a = row(point_in, ti.max(i - 1, lo))
        b = row(point_in, ti.min(i + 1, hi))
        # Inner tests only where the outer ones leave it open: Taichi works out both sides of "and".
        kink = 1
        if i - 1 >= lo and i + 1 <= hi:
            kink = ti.cast(_off_line(p, a, b) > off, ti.i32)
        gap = (b - p).norm()
        apart = gap > step
        behind = 1  # the point is off the line through the next two
        if i + 2 <= hi and (kink == 1 or apart):
            behind = ti.cast(_off_line(p, b, row(point_in, i + 2)) > off, ti.i32)
            kink = ti.min(kink, behind)
        if i - 2 >= lo and kink == 1:
            kink = ti.cast(_off_line(p, row(point_in, i - 2), a) > off, ti.i32)
        code = kink * _KINK
        if i == hi or gap > far:
            code += _BREAK
        elif behind == 1 and apart:
            ahead = 1  # the next point is off the line through this one and the last
            if i > lo:
                ahead = ti.cast(_off_line(b, a, p) > off, ti.i32)
            code += ahead * _BREAK
        code_out[i] = code


def _doubtful(code: np.ndarray) -> np.ndarray:
    """Return the rows of kinks and of short pieces, rising, i32."""
    doubt = (code & _KINK) > 0
    end = np.flatnonzero(code >= _BREAK) + 1
    begin = np.concatenate([[0], end[:-1]])
    length = end - begin
    short = np.flatnonzero(length < _SHORT)
    length = length[short]
    within = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    doubt[np.repeat(begin[short], length) + within] = True
    return np.flatnonzero(doubt).astype(np.int32)


def mark_outliers(
    points: np.ndarray,
    start: np.ndarray,
    run: np.ndarray,
    view: np.ndarray,
    poses: np.ndarray | None,
    *,
    spike: float,
    isolation: float,
    detached: int,
    along: float,
    across: float,
) -> np.ndarray:
    """Mark spikes, isolated points and small detached groups.

    An outlier is an exception: where more than half of the points would be one, none is marked.

    Args:
        points: Positions [mm], shape (N, 3), f64, in stripe order, in the frames of their views.
        start: First point of every stripe, and N at the end, shape (S + 1,), i32.
        run: Index of the stripe of every point, shape (N,), i32.
        view: View of every point, shape (N,), i32.
        poses: Poses that carry the views to the world, shape (V, 4, 4); None = they are there.
        spike: Smallest distance of a spike from the surfaces around it [mm].
        isolation: A point stands alone when its neighbours are farther than this [mm].
        detached: A group of fewer points that nothing else holds is an outlier.
        along: Spacing along the stripes [mm].
        across: Spacing across the stripes [mm].

    Returns:
        1 for a marked point, else 0, shape (N,), i32.
    """
    runtime.ensure_started()
    marked = np.zeros(len(points), np.int32)
    if not (isolation > 0.0 and along > 0.0 and across > 0.0):
        return marked
    code = runtime.empty(len(points), np.int32)
    _inspect(
        spike,
        _STEP * along,
        2.0 * isolation,
        runtime.upload(points),
        runtime.upload(start),
        runtime.upload(run),
        code,
    )
    doubtful = _doubtful(runtime.download(code))
    if len(doubtful) == 0:
        return marked
    if poses is None:
        poses = np.tile(np.eye(4), (int(view.max()) + 1, 1, 1))
    # Neighbours on a full surface count from 1 in the middle to 0 at the rim: a third of all.
    full = np.pi * isolation**2 / (along * across) / 3.0
    true = find_support(
        points, view, poses, doubtful,
        radius=isolation, off=spike, backing=_BACKING * full, detached=detached,
    )  # fmt: skip
    out = doubtful[~true]
    if 2 * len(out) <= len(points):
        marked[out] = 1
    return marked
