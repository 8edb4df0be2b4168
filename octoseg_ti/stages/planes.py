"""Which patches are planes: a plane through every patch, and how far its points are from it."""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row
from octoseg_ti.device.runtime import F64Rows, I32Array, I64Rows, ti
from octoseg_ti.stages.grid import Grid
from octoseg_ti.types import SurfaceKind

_ONE = 68719476736.0  # 2^36: room for 10^8 points, 3e-6 of the box for the distance from the plane
_SLICE = 256
_SUMS = 10


@ti.kernel
def _sum_patches(
    slices: ti.i32,
    middle: ti.types.vector(3, ti.f64),
    scale: ti.f64,
    # In:
    point_in: F64Rows,
    label_in: I32Array,
    # Out:
    sum_inout: I64Rows,
):
    """Add up count, positions and their products for every patch, in fixed point."""
    for u in range(slices):
        i = u * _SLICE
        end = ti.min(i + _SLICE, label_in.shape[0])
        while i < end:
            label = label_in[i]
            s = ti.Vector([ti.i64(0)] * _SUMS)
            while i < end and label_in[ti.min(i, label_in.shape[0] - 1)] == label:
                p = scale * (row(point_in, i) - middle)
                s[0] += ti.i64(1)
                for k in ti.static(range(3)):
                    s[1 + k] += ti.cast(p[k] * _ONE, ti.i64)
                for k in ti.static(range(6)):
                    a, b = ti.static((0, 0, 0, 1, 1, 2)[k]), ti.static((0, 1, 2, 1, 2, 2)[k])
                    s[4 + k] += ti.cast(p[a] * p[b] * _ONE, ti.i64)
                i += 1
            if label >= 0:
                for k in ti.static(range(_SUMS)):
                    ti.atomic_add(sum_inout[label, k], s[k])


def fit_planes(
    grid: Grid, label: np.ndarray, patches: int, *, limit: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit a plane to every patch and call it one if its points lie on it.

    Args:
        grid: The sparse grid: its sorted points.
        label: Label of every sorted point, shape (n,), i32; -1 = none.
        patches: Number of patches K.
        limit: Largest root mean square distance of a plane's points [mm].

    Returns:
        `SurfaceKind` PLANE or NONE, shape (K,), i8; parameters, shape (K, 8), f64: a point, the
        normal (its side is not determined), NaN; and the root mean square distance [mm], shape
        (K,). Parameters and distance are NaN where the patch is no plane.
    """
    runtime.ensure_started()
    kind = np.full(patches, int(SurfaceKind.NONE), np.int8)
    parameters = np.full((patches, 8), np.nan)
    residual = np.full(patches, np.nan)
    if patches == 0:
        return kind, parameters, residual
    extent = np.array(grid.shape) * grid.size
    half = float(extent.max()) / 2.0
    sums = runtime.zeros((patches, _SUMS), np.int64)
    _sum_patches(
        -(-len(label) // _SLICE),
        ti.Vector((extent / 2.0).tolist()),
        1.0 / half,
        grid.point,
        runtime.upload(label),
        sums,
    )
    total = runtime.download(sums)
    count = np.maximum(total[:, :1], 1).astype(np.float64)
    mean = total[:, 1:4] / count / _ONE
    product = total[:, 4:10] / count / _ONE
    a, b = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
    covariance = np.empty((patches, 3, 3))
    covariance[:, a, b] = covariance[:, b, a] = product - mean[:, a] * mean[:, b]
    value, vector = np.linalg.eigh(covariance)
    rms = half * np.sqrt(np.maximum(value[:, 0], 0.0))
    flat = rms <= limit
    kind[flat] = int(SurfaceKind.PLANE)
    parameters[flat, :3] = (mean * half + extent / 2.0 + grid.corner)[flat]
    parameters[flat, 3:6] = vector[flat, :, 0]
    residual[flat] = rms[flat]
    return kind, parameters, residual
