"""What the data say about themselves: spacing of the points, noise of points and normals.

The default parameters are derived from these figures, so they must not depend on the order of the
views: every figure is a median or a trimmed mean over points chosen by their place in the stripe.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row
from octoseg_ti.device.runtime import F32Array, F64Rows, I32Array, ti
from octoseg_ti.stages.sampling import ascending, median, sample_stripes, trimmed_mean

# Mean of the lower three quarters of |x| for x normal, and of a Rayleigh variable, both of unit
# scale.
_HALF_NORMAL_TRIMMED = 0.5149
_RAYLEIGH_TRIMMED = 0.9558
_HALF_NORMAL_QUARTILE = 1.1503  # three quarters of |x| lie below
_QUARTILE = 0.75


@ti.kernel
def _measure_spacing(
    runs: ti.i32,
    # In:
    sample_in: I32Array,
    point_in: F64Rows,
    start_in: I32Array,
    view_in: I32Array,
    run_in: I32Array,
    # Out:
    along_out: F32Array,
    across_out: F32Array,
):
    """Write the distance to the next point of the stripe, and to the next stripe."""
    for s in sample_in:
        along_out[s] = -1.0
        across_out[s] = -1.0
        i = sample_in[s]
        run = run_in[i]
        lo = start_in[run]
        hi = start_in[run + 1]
        p = row(point_in, i)
        if i + 1 < hi:
            along_out[s] = ti.cast((row(point_in, i + 1) - p).norm(), ti.f32)
        if run + 1 < runs and view_in[start_in[ti.min(run + 1, runs - 1)]] == view_in[lo]:
            # A guess by proportion, then downhill to the nearest point.
            first = hi
            last = start_in[run + 2] - 1
            j = first + ti.cast((last - first) * ((i - lo) / ti.max(1, hi - lo - 1)), ti.i32)
            best = (row(point_in, j) - p).norm()
            moving = 1
            while moving == 1:
                moving = 0
                for side in ti.static((-1, 1)):
                    k = j + side
                    if k >= first and k <= last:
                        d = (row(point_in, k) - p).norm()
                        if d < best:
                            best = d
                            j = k
                            moving = 1
            across_out[s] = ti.cast(best, ti.f32)


@ti.kernel
def _measure_roughness(
    # In:
    sample_in: I32Array,
    point_in: F64Rows,
    start_in: I32Array,
    run_in: I32Array,
    # Out:
    off_out: F32Array,
):
    """Write the distance of a point from the line through its two neighbours on the stripe."""
    for s in sample_in:
        off_out[s] = -1.0
        i = sample_in[s]
        if i > start_in[run_in[i]] and i + 1 < start_in[run_in[i] + 1]:
            a = row(point_in, i - 1)
            along = row(point_in, i + 1) - a
            p = row(point_in, i) - a
            t = p.dot(along) / ti.max(along.norm_sqr(), 1e-300)
            off_out[s] = ti.cast((p - t * along).norm(), ti.f32)


@ti.kernel
def _measure_noise(
    lag: ti.i32,
    gap: ti.f64,
    # In:
    sample_in: I32Array,
    point_in: F64Rows,
    normal_in: F64Rows,
    start_in: I32Array,
    run_in: I32Array,
    # Out:
    range_out: F32Array,
    tilt_out: F32Array,
):
    """Write second differences along the stripe: of the range with lag 1, of the normal with a lag.

    Only the part of the latter along the surface counts: the other is curvature.
    """
    for s in sample_in:
        range_out[s] = -1.0
        tilt_out[s] = -1.0
        i = sample_in[s]
        lo = start_in[run_in[i]]
        hi = start_in[run_in[i] + 1]
        normal = row(normal_in, i)
        if normal.norm() > 0.5:
            p = row(point_in, i)
            if i - 1 >= lo and i + 1 < hi:
                before = row(point_in, i - 1) - p
                after = row(point_in, i + 1) - p
                if before.norm() <= gap and after.norm() <= gap:
                    range_out[s] = ti.cast(ti.abs((before + after).dot(normal)), ti.f32)
            if i - lag >= lo and i + lag < hi:
                a = row(normal_in, i - lag)
                b = row(normal_in, i + lag)
                near = (row(point_in, i - lag) - row(point_in, i + lag)).norm()
                if a.norm() > 0.5 and b.norm() > 0.5 and near <= 2 * lag * gap:
                    middle = 0.5 * (a + b)
                    tilt_out[s] = ti.cast((middle - middle.dot(normal) * normal).norm(), ti.f32)


def stripe_spacing(
    points: np.ndarray, start: np.ndarray, run: np.ndarray, view: np.ndarray
) -> tuple[float, float]:
    """Return the median spacing along and across the stripes [mm].

    Args:
        points: Positions [mm], shape (N, 3), f64, in stripe order.
        start: First point of every stripe, and N at the end, shape (S + 1,), i32.
        run: Index of the stripe of every point, shape (N,), i32.
        view: View of every point, shape (N,), i32.

    Returns:
        Spacing along and across; 0 where nothing could be measured.
    """
    runtime.ensure_started()
    sample = sample_stripes(start)
    along = runtime.empty(len(sample), np.float32)
    across = runtime.empty(len(sample), np.float32)
    _measure_spacing(
        len(start) - 1,
        runtime.upload(sample),
        runtime.upload(points),
        runtime.upload(start),
        runtime.upload(view),
        runtime.upload(run),
        along,
        across,
    )
    return median(runtime.download(along)), median(runtime.download(across))


def stripe_roughness(points: np.ndarray, start: np.ndarray, run: np.ndarray) -> float:
    """Return the noise across the stripes' own direction, for want of normals [mm].

    Unlike `stripe_noise` it sees little of the noise where a stripe runs along the line of sight.

    Args:
        points: Positions [mm], shape (N, 3), f64, in stripe order.
        start: First point of every stripe, and N at the end, shape (S + 1,), i32.
        run: Index of the stripe of every point, shape (N,), i32.

    Returns:
        Standard deviation; 0 where nothing could be measured.
    """
    runtime.ensure_started()
    sample = sample_stripes(start)
    off = runtime.empty(len(sample), np.float32)
    _measure_roughness(
        runtime.upload(sample),
        runtime.upload(points),
        runtime.upload(start),
        runtime.upload(run),
        off,
    )
    known = ascending(runtime.download(off))
    if len(known) == 0:
        return 0.0
    # A quantile, and no mean of what lies below: where positions come in coarse steps, most points
    # of a stripe lie exactly on one.
    upper = float(known[int(_QUARTILE * (len(known) - 1))])
    # The point itself and half of either neighbour: 1 + 1/4 + 1/4 of its variance.
    return upper / _HALF_NORMAL_QUARTILE / float(np.sqrt(1.5))


def stripe_noise(
    points: np.ndarray,
    normals: np.ndarray,
    start: np.ndarray,
    run: np.ndarray,
    gap: float,
    *,
    lag: int = 3,
) -> tuple[float, float]:
    """Return the noise of the range [mm] and of the normals [rad], measured along the stripes.

    Second differences remove position, slope and constant curvature; what remains is noise. The
    mean of the lower three quarters ignores edges.

    Args:
        points: Positions [mm], shape (N, 3), f64, in stripe order.
        normals: Unit normals, shape (N, 3), f64; zero rows have none.
        start: First point of every stripe, and N at the end, shape (S + 1,), i32.
        run: Index of the stripe of every point, shape (N,), i32.
        gap: Longest distance between neighbours [mm].
        lag: Points between normals whose errors are independent. Three edge-pair normals with a
            lag of 3 share no triangle; filtered normals need more.

    Returns:
        Standard deviation of the range, and root mean square deviation of the normals.
    """
    runtime.ensure_started()
    sample = sample_stripes(start)
    second = runtime.empty(len(sample), np.float32)
    tilt = runtime.empty(len(sample), np.float32)
    _measure_noise(
        lag,
        gap,
        runtime.upload(sample),
        runtime.upload(points),
        runtime.upload(normals),
        runtime.upload(start),
        runtime.upload(run),
        second,
        tilt,
    )
    noise = trimmed_mean(runtime.download(second)) / _HALF_NORMAL_TRIMMED / np.sqrt(6.0)
    # Two components of the tilt, each with 1 + 1/4 + 1/4 of the variance of one normal.
    component = trimmed_mean(runtime.download(tilt)) / _RAYLEIGH_TRIMMED / np.sqrt(1.5)
    return float(noise), float(component * np.sqrt(2.0))
