"""Normals of points without stripes, from their neighbourhoods (I8).

The neighbourhood of a point is every point strictly nearer than its k-th neighbour. Unlike "the k
nearest", that set does not depend on the order of the points, not even on a regular lattice where
many distances are equal; and its moments are integer sums, so the normal does not either.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, symmetric_eigen, vec3
from octoseg_ti.device.runtime import F32Array, F64Array, F64Rows, I32Rows, ti
from octoseg_ti.types import Measurement

_ONE = 1099511627776.0  # 2^40; a few dozen squares of at most 1 fit easily


@ti.kernel
def _fit_planes(
    # In:
    point_in: F64Rows,
    neighbor_in: I32Rows,
    radius_in: F64Array,
    outward_in: F64Rows,
    # Out:
    normal_out: F64Rows,
    height_out: F32Array,
):
    """Write the normal of the plane through each neighbourhood, and the rms distance from it."""
    for i in radius_in:
        r = radius_in[i]
        p = row(point_in, i)
        total = ti.i64(0)
        s = ti.Vector([ti.i64(0)] * 3)
        q = ti.Vector([ti.i64(0)] * 6)
        for j in range(neighbor_in.shape[1]):
            d = row(point_in, neighbor_in[i, j]) - p
            if d.norm() < r:
                d = d / r
                total += ti.i64(1)
                for k in ti.static(range(3)):
                    s[k] += ti.cast(ti.round(d[k] * _ONE), ti.i64)
                for k in ti.static(range(6)):
                    a, b = ti.static((0, 0, 0, 1, 1, 2)[k]), ti.static((0, 1, 2, 1, 2, 2)[k])
                    q[k] += ti.cast(ti.round(d[a] * d[b] * _ONE), ti.i64)
        normal = vec3(0.0, 0.0, 0.0)
        height = -1.0
        if total >= 3:
            scale = 1.0 / (_ONE * ti.cast(total, ti.f64))
            m = scale * vec3(s[0], s[1], s[2])
            c = scale * vec3(q[0], q[1], q[2])
            e = scale * vec3(q[3], q[4], q[5])
            values, u, _, _ = symmetric_eigen(
                c[0] - m[0] * m[0],
                c[1] - m[0] * m[1],
                c[2] - m[0] * m[2],
                e[0] - m[1] * m[1],
                e[1] - m[1] * m[2],
                e[2] - m[2] * m[2],
            )
            # Neighbours on a line, or all in one place, define no plane.
            if values[1] > 1e-6 * values[2]:
                normal = u
                height = r * ti.sqrt(ti.max(0.0, values[0]))
        if normal.dot(row(outward_in, i)) < 0.0:
            normal = -normal
        for k in ti.static(range(3)):
            normal_out[i, k] = normal[k]
        height_out[i] = ti.cast(height, ti.f32)


def neighbor_normals(
    points: np.ndarray, outward: np.ndarray, neighbors: int
) -> tuple[np.ndarray, Measurement]:
    """Estimate normals from planes through the neighbours, and measure spacing and noise.

    Args:
        points: Positions [mm], shape (N, 3), f64.
        outward: A direction on the outer side of every point, shape (N, 3), f64.
        neighbors: How many neighbours bound a neighbourhood, at least 3.

    Returns:
        Unit normals, shape (N, 3), f64, zero where the neighbours define no plane; and the
        measurement: the spacing is the median distance to the nearest other place, noise the rms
        distance from the planes, the noise of the normals what that makes of a plane fit.

    Raises:
        ValueError: ``neighbors`` is below 3.
    """
    if neighbors < 3:
        raise ValueError(f"neighbors must be at least 3, not {neighbors}")
    from scipy.spatial import cKDTree

    options = runtime.ensure_started()
    count = min(neighbors + 1, len(points))
    distance, neighbor = cKDTree(points).query(points, k=count, workers=options.threads)
    radius = np.where(distance[:, -1] > 0, distance[:, -1], 1.0)
    n = len(points)
    normal, height = runtime.empty((n, 3), np.float64), runtime.empty(n, np.float32)
    _fit_planes(
        runtime.upload(points),
        runtime.upload(neighbor.astype(np.int32)),
        runtime.upload(radius),
        runtime.upload(outward),
        normal,
        height,
    )
    # The nearest other place: points may coincide, where clouds were merged even all of them.
    nearest = np.min(distance, axis=1, where=distance > 0, initial=np.inf)
    nearest = nearest[np.isfinite(nearest)]
    spacing = float(np.median(nearest)) if len(nearest) else 0.0
    off = np.sort(runtime.download(height))
    off = off[off >= 0]
    noise = 0.0
    if len(off):
        # The lower three quarters: the others may lie on edges. A plane takes three degrees of
        # freedom.
        kept = off[: max(1, 3 * len(off) // 4)]
        noise = float(np.sqrt(np.mean(kept**2, dtype=np.float64) * count / max(1, count - 3)))
    # Slope of a plane fitted in a disc of radius r: sigma / (r / 2) / sqrt(count), in two
    # directions.
    tilt = 2.0 * np.sqrt(2.0 / count) * noise / float(np.median(radius))
    return runtime.download(normal), Measurement(
        spacing_along=spacing,
        spacing_across=spacing,
        noise=noise,
        normal_noise=tilt,
    )
