"""Which patches are planes: a plane through every patch, and how far its points are from it.

The moments of the cells are enough: no point is touched again.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.moments import X, Z, point_sums
from octoseg_ti.types import SurfaceKind

_UNKNOWNS = 3  # of a plane
_LINE = 1e-14  # of the largest mean square: less is rounding


def fit_planes(
    grid: Grid, leaves: np.ndarray, label: np.ndarray, patches: int, *, limit: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fit a plane to every patch and call it one if its points lie on it.

    Args:
        grid: The sparse grid.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        label: Patch of every leaf, shape (C,), i32; -1 = none.
        patches: Number of patches K.
        limit: Largest root mean square distance of a plane's points [mm].

    Returns:
        `SurfaceKind` PLANE or NONE, shape (K,), i8; parameters, shape (K, 8), f64: a point, the
        normal (its side is not determined), NaN; their covariance, shape (K, 8, 8), f64; and the
        root mean square distance [mm], shape (K,). All are NaN where the patch is no plane; none is
        if none has a leaf.
    """
    kind = np.full(patches, int(SurfaceKind.NONE), np.int8)
    parameters, spread = np.full((patches, 8), np.nan), np.full((patches, 8, 8), np.nan)
    residual = np.full(patches, np.nan)
    inside = label >= 0
    cells, owner = leaves[inside], label[inside]
    if not inside.any():
        return kind, parameters, spread, residual
    # About a cell of the patch itself: small numbers lose few digits.
    size = grid.edge_length[cells]
    middle = (runtime.download(grid.node)[cells, X : Z + 1].T + 0.5) * size
    some = np.zeros(patches, np.int64)
    some[owner] = np.arange(len(owner))
    anchor = middle[:, some]
    sums = point_sums(runtime.download(grid.moment)[cells], middle - anchor[:, owner], size)
    total = np.stack([np.bincount(owner, weights=row, minlength=patches) for row in sums])
    mean, product = total[1:4].T, total[4:].T
    points = np.maximum(total[0], 1.0)[:, None]
    mean, product = mean / points, product / points
    a, b = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
    square = np.empty((patches, 3, 3))
    square[:, a, b] = square[:, b, a] = product - mean[:, a] * mean[:, b]
    value, vector = np.linalg.eigh(square)
    rms = np.sqrt(np.maximum(value[:, 0], 0.0))
    flat = rms <= limit
    kind[flat] = int(SurfaceKind.PLANE)
    parameters[flat, :3] = (anchor.T + mean + grid.corner)[flat]
    parameters[flat, 3:6] = vector[flat, :, 0]
    residual[flat] = rms[flat]
    sure = flat & (total[0] > _UNKNOWNS)
    variance = rms[sure] ** 2 / (total[0, sure] - _UNKNOWNS)
    spread[sure, :6, :6] = 0.0
    # The point is the mean, so that it and the normal err independently.
    spread[sure, :3, :3] = variance[:, None, None] * _outer(vector[sure, :, 0])
    for k in (1, 2):
        # In both directions; points on a line leave one of them open.
        wide = np.maximum(value[sure, k], _LINE * value[sure, 2])
        tilt = np.divide(variance, wide, out=np.zeros_like(wide), where=wide > 0.0)
        spread[sure, 3:6, 3:6] += tilt[:, None, None] * _outer(vector[sure, :, k])
    return kind, parameters, spread, residual


def _outer(vector: np.ndarray) -> np.ndarray:
    """Return the products of the coordinates of vectors, shape (K, 3, 3)."""
    return vector[:, :, None] * vector[:, None, :]
