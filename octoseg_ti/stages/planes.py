"""Which patches are planes: a plane through every patch, and how far its points are from it.

The moments of the cells are enough: no point is touched again.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.moments import X, Z, point_sums
from octoseg_ti.types import SurfaceKind


def fit_planes(
    grid: Grid, leaves: np.ndarray, label: np.ndarray, patches: int, *, limit: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit a plane to every patch and call it one if its points lie on it.

    Args:
        grid: The sparse grid.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        label: Patch of every leaf, shape (C,), i32; -1 = none.
        patches: Number of patches K.
        limit: Largest root mean square distance of a plane's points [mm].

    Returns:
        `SurfaceKind` PLANE or NONE, shape (K,), i8; parameters, shape (K, 8), f64: a point, the
        normal (its side is not determined), NaN; and the root mean square distance [mm], shape
        (K,). Parameters and distance are NaN where the patch is no plane.
    """
    kind = np.full(patches, int(SurfaceKind.NONE), np.int8)
    parameters = np.full((patches, 8), np.nan)
    residual = np.full(patches, np.nan)
    inside = label >= 0
    cells, owner = leaves[inside], label[inside]
    if patches == 0:
        return kind, parameters, residual
    size = grid.edge_length[cells]
    node = runtime.download(grid.node)[cells, X : Z + 1]
    moment = runtime.download(grid.moment)[cells]
    middle = (node + 0.5) * size[:, None]

    def total(values: np.ndarray) -> np.ndarray:
        columns = [np.bincount(owner, weights=column, minlength=patches) for column in values.T]
        return np.stack(columns, axis=1)

    count, first, _ = point_sums(moment, middle, size, np.zeros(3))
    points = np.maximum(np.bincount(owner, weights=count, minlength=patches), 1.0)[:, None]
    mean = total(first) / points
    # About the middle of the patch: small numbers lose no digits.
    _, first, second = point_sums(moment, middle, size, mean[owner])
    rest = total(first) / points
    product = total(second) / points
    a, b = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
    covariance = np.empty((patches, 3, 3))
    covariance[:, a, b] = covariance[:, b, a] = product - rest[:, a] * rest[:, b]
    value, vector = np.linalg.eigh(covariance)
    rms = np.sqrt(np.maximum(value[:, 0], 0.0))
    flat = rms <= limit
    kind[flat] = int(SurfaceKind.PLANE)
    parameters[flat, :3] = (mean + rest + grid.corner)[flat]
    parameters[flat, 3:6] = vector[flat, :, 0]
    residual[flat] = rms[flat]
    return kind, parameters, residual
