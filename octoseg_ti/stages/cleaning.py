"""Stage 1: mark spikes and isolated points, stripe by stripe, before normals are estimated (I3).

Nothing is dropped: the caller keeps every row and learns which ones were marked.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, ti


@ti.func
def _square_to_segment(p: vec3, a: vec3, b: vec3) -> ti.f64:
    """Return the squared distance of a point from a segment."""
    ab = b - a
    t = ti.max(0.0, ti.min(1.0, (p - a).dot(ab) / ti.max(ab.norm_sqr(), 1e-300)))
    return (p - (a + t * ab)).norm_sqr()


@ti.kernel
def _mark(
    spike: ti.f64,
    isolation: ti.f64,
    # In:
    point_in: F64Rows,
    start_in: I32Array,
    run_in: I32Array,
    # Out:
    outlier_out: I32Array,
):
    """Mark a point that stands off from neighbours that agree, or that has no neighbour."""
    for i in run_in:
        lo = start_in[run_in[i]]
        hi = start_in[run_in[i] + 1]
        p = row(point_in, i)
        a = row(point_in, ti.max(i - 1, lo))
        b = row(point_in, ti.min(i + 1, hi - 1))
        nearest = 1e300
        if i > lo:
            nearest = (a - p).norm_sqr()
        if i + 1 < hi:
            nearest = ti.min(nearest, (b - p).norm_sqr())
        marked = ti.cast(nearest > isolation * isolation, ti.i32)
        # Two neighbours on either side must lie close together, as if the point were not there:
        # both sides of a step pass this test with one side missing, so a step marks nothing.
        off = spike * spike
        if nearest > off and marked == 0 and i - 2 >= lo and i + 2 < hi:
            if (
                (a - b).norm_sqr() < isolation * isolation
                and _square_to_segment(p, a, b) > off
                and _square_to_segment(p, row(point_in, i - 2), a) > off
                and _square_to_segment(p, b, row(point_in, i + 2)) > off
            ):
                marked = 1
        outlier_out[i] = marked


def mark_outliers(
    points: np.ndarray, start: np.ndarray, run: np.ndarray, *, spike: float, isolation: float
) -> np.ndarray:
    """Mark spikes and isolated points.

    Args:
        points: Positions [mm], shape (N, 3), f64, in stripe order.
        start: First point of every stripe, and N at the end, shape (S + 1,), i32.
        run: Index of the stripe of every point, shape (N,), i32.
        spike: Smallest distance of a spike from the lines through its neighbours [mm].
        isolation: A point farther than this from its neighbours on the stripe is isolated [mm].

    Returns:
        1 for a marked point, else 0, shape (N,), i32.
    """
    runtime.ensure_started()
    outlier = runtime.empty(len(points), np.int32)
    _mark(
        spike,
        isolation,
        runtime.upload(points),
        runtime.upload(start),
        runtime.upload(run),
        outlier,
    )
    return runtime.download(outlier)
