"""Normals of points without stripes, from their neighbourhoods (I8).

The neighbourhood of a point is every point strictly nearer than its k-th neighbour. Unlike "the k
nearest", that set does not depend on the order of the points, not even on a regular lattice where
many distances are equal; and its moments are integer sums, so the normal does not either.

A neighbourhood across a crease has a plane of neither face. Its points leave that plane, while
those of a neighbour farther from the crease lie on theirs; and if that neighbour is of the same
face, its plane holds the point as well. So a point takes the mean of its neighbours' planes by how
well each of them holds its own points and this one. Twice sharpens creases, and once more smooths
noise.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, symmetric_eigen, vec3
from octoseg_ti.device.runtime import F32Array, F64Array, F64Rows, I32Rows, ti
from octoseg_ti.types import Measurement

_ONE = 1099511627776.0  # 2^40; a few dozen squares of at most 1 fit easily
PASSES = 3
"""Passes over the planes of the neighbours that creases and noise need."""
# Two planes are equally good when their points leave them by less than half the noise, or by this
# share of the spacing where there is none.
_EQUAL_NOISES = 0.5
_EQUAL_SPACINGS = 0.001
# What a pass leaves of the noise of the normals, measured on planes with noise.
_LEFT = (1.0, 0.64, 0.53, 0.48)


@ti.kernel
def _fit_planes(
    # In:
    point_in: F64Rows,
    neighbor_in: I32Rows,
    radius_in: F64Array,
    outward_in: F64Rows,
    # Out:
    normal_out: F64Rows,
    middle_out: F64Rows,
    height_out: F32Array,
):
    """Write the plane through each neighbourhood, and the rms distance of its points from it.

    A plane is a normal and a point of it, the latter as seen from the point itself.
    """
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
        middle = vec3(0.0, 0.0, 0.0)
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
                middle = r * m
                height = r * ti.sqrt(ti.max(0.0, values[0]))
        if normal.dot(row(outward_in, i)) < 0.0:
            normal = -normal
        for k in ti.static(range(3)):
            normal_out[i, k] = normal[k]
            middle_out[i, k] = middle[k]
        height_out[i] = ti.cast(height, ti.f32)


@ti.func
def _misfit(p: vec3, q: vec3, normal: vec3, height: ti.f32) -> ti.f64:
    """Return the square by which a plane through q misses the point p and its own points."""
    off = normal.dot(p - q)
    return off * off + ti.cast(height, ti.f64) ** 2


@ti.kernel
def _take_planes(
    equal: ti.f64,
    # In:
    point_in: F64Rows,
    neighbor_in: I32Rows,
    radius_in: F64Array,
    normal_in: F64Rows,
    middle_in: F64Rows,
    height_in: F32Array,
    # Out:
    normal_out: F64Rows,
    height_out: F32Array,
):
    """Write the mean of the normals of the neighbours' planes, by how well these fit."""
    for i in radius_in:
        p = row(point_in, i)
        n = row(normal_in, i)
        h = height_in[i]
        if h >= 0.0:
            r = radius_in[i]
            least = _misfit(p, p + row(middle_in, i), n, h)
            for k in range(neighbor_in.shape[1]):
                j = neighbor_in[i, k]
                q = row(point_in, j)
                if (q - p).norm() < r and height_in[j] >= 0.0:
                    q += row(middle_in, j)
                    least = ti.min(least, _misfit(p, q, row(normal_in, j), height_in[j]))
            s = ti.Vector([ti.i64(0)] * 5)
            for k in range(neighbor_in.shape[1]):
                j = neighbor_in[i, k]
                q = row(point_in, j)
                if (q - p).norm() < r and height_in[j] >= 0.0:
                    m = row(normal_in, j)
                    w = (least + equal) / (
                        _misfit(p, q + row(middle_in, j), m, height_in[j]) + equal
                    )
                    w = w * w * _ONE
                    if m.dot(n) < 0.0:
                        m = -m
                    for c in ti.static(range(3)):
                        s[c] += ti.cast(ti.round(w * m[c]), ti.i64)
                    s[3] += ti.cast(ti.round(w * (height_in[j] / r) ** 2), ti.i64)
                    s[4] += ti.cast(ti.round(w), ti.i64)
            n = vec3(s[0], s[1], s[2]).normalized()
            h = ti.cast(r * ti.sqrt(ti.cast(s[3], ti.f64) / ti.cast(s[4], ti.f64)), ti.f32)
        for c in ti.static(range(3)):
            normal_out[i, c] = n[c]
        height_out[i] = h


def neighbor_normals(
    points: np.ndarray, outward: np.ndarray, neighbors: int, *, passes: int = 0
) -> tuple[np.ndarray, Measurement]:
    """Estimate normals from planes through the neighbours, and measure spacing and noise.

    Args:
        points: Positions [mm], shape (N, 3), f64.
        outward: A direction on the outer side of every point, shape (N, 3), f64.
        neighbors: How many neighbours bound a neighbourhood, at least 3.
        passes: How often a point takes the planes of its neighbours; 0 = the plane of its own.

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
    normal, middle = runtime.empty((n, 3), np.float64), runtime.empty((n, 3), np.float64)
    height = runtime.empty(n, np.float32)
    around = (
        runtime.upload(points),
        runtime.upload(neighbor.astype(np.int32)),
        runtime.upload(radius),
    )
    _fit_planes(*around, runtime.upload(outward), normal, middle, height)
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
    # Slope of a plane through n points spread evenly in a disc of radius r: 2 sigma / r / sqrt(n)
    # in each of two directions; n - 3 because few points may happen to lie nearly on a line. The
    # point that bounds the neighbourhood is not in it.
    tilt = 2.0 * np.sqrt(2.0 / max(1, count - 4)) * noise / float(np.median(radius))
    equal = max(_EQUAL_NOISES * noise, _EQUAL_SPACINGS * spacing) ** 2
    for _ in range(passes if spacing > 0 else 0):
        new = runtime.empty((n, 3), np.float64), runtime.empty(n, np.float32)
        _take_planes(equal, *around, normal, middle, height, *new)
        normal, height = new
        # From now on a plane is one through the point itself.
        middle = runtime.zeros((n, 3), np.float64)
    found = runtime.download(normal)
    if passes:
        found[np.einsum("ni,ni->n", found, outward) < 0] *= -1.0
    return found, Measurement(
        spacing_along=spacing,
        spacing_across=spacing,
        noise=noise,
        normal_noise=_LEFT[min(passes, len(_LEFT) - 1)] * tilt,
    )
