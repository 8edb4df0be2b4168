"""How far points scatter about the smooth surface through their neighbourhood.

Second differences along a stripe see what two neighbours do not share. What decides whether a point
lies on a surface is more than that: steps of the range, speckle over several points, views that do
not quite meet. It is measured where it matters, as the residual of the best analytic surface
through neighbourhoods of about a hundred points: of half of them, for edges run through the others.
A quadric does for most of them; where it bends too much, surfaces are fitted.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.primitives import FREEDOM, fit_all
from octoseg_ti.stages.quadrics import QUADRIC_FREEDOM, fit_quadrics

# Neighbourhoods, and the points of each.
_COUNT, _POINTS = 256, 128
_FEWEST = 24
# The median counts, up to so many times the lower quartile: edges may run through most.
_CALM, _MIDDLE, _EDGES = 0.25, 0.5, 1.5
# A quadric is no surface any more where it turns by so much from the middle to the rim [rad].
_BEND = 0.35
# Where it leaves so many times what it leaves of the calm ones, there is an edge.
_EDGE = 8.0


def surface_noise(grid: Grid) -> float:
    """Return the standard deviation of points about the surface through their neighbourhood [mm].

    Args:
        grid: The sparse grid: points that follow one another in Morton order are near each other.
    """
    key = runtime.download(grid.key)
    n = len(key)
    begin = np.unique(np.arange(_COUNT) * n // _COUNT)
    # Whole boxes: which points of a box come first would depend on the order of the input.
    first = np.searchsorted(key, key[begin])
    last = np.searchsorted(key, key[np.minimum(first + _POINTS, n - 1)])
    fits = (last - first >= _FEWEST) & (last - first <= 4 * _POINTS)
    first, count = np.unique(first[fits], return_index=True)
    count = last[fits][count] - first
    if len(first) == 0:
        return 0.0
    ends = np.cumsum(count)
    index = np.arange(ends[-1]) + np.repeat(first - (ends - count), count)
    point = runtime.download(grid.point)[index]
    # In an order that has nothing to do with that of the input.
    order = np.lexsort((*point.T, np.repeat(np.arange(len(first)), count)))
    point, normal = point[order], runtime.download(grid.normal)[index[order]]
    rms = _residuals(point, normal, np.concatenate([[0], ends]))
    calm, middle = np.quantile(rms, [_CALM, _MIDDLE])
    return float(min(middle, _EDGES * calm))


def _residuals(point: np.ndarray, normal: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return what the surface through every group leaves [mm], shape (G,).

    Args:
        point: Points of the groups, one group after the other [mm], shape (S, 3).
        normal: Their normals, shape (S, 3).
        start: First point of every group, and S at the end, shape (G + 1,).
    """
    count = np.diff(start)
    found = fit_quadrics(point, normal, start)
    rms = found.rms[:, 1] * np.sqrt(count / np.maximum(count - QUADRIC_FREEDOM, 1))
    bent = (found.bend > _BEND) & (rms <= _EDGE * np.quantile(rms, _CALM))
    if bent.any():
        mine = np.repeat(bent, count)
        ends = np.concatenate([[0], np.cumsum(count[bent])]).astype(np.int32)
        fit = fit_all(point[mine], normal[mine], None, ends)
        spare = count[bent, None] / (count[bent, None] - FREEDOM[None, :])
        best = np.where(np.isfinite(fit.rms), fit.rms * np.sqrt(spare), np.inf).min(axis=1)
        rms[bent] = np.minimum(rms[bent], best)
    return rms
