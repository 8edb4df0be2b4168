"""All points that lie on each surface: a point of a crease lies on several."""

from typing import NamedTuple

import numpy as np

from octoseg_ti.defaults import spacing_of
from octoseg_ti.device.surfaces import KINDS, evaluate_surfaces
from octoseg_ti.types import Segmentation

# A surface is near a point when it has one of so many nearest points, within so many spacings.
_NEAREST, _SPACINGS = 24, 3.0
# A point lies on a surface within this many noises.
_ON = 3.0


class Members(NamedTuple):
    """The points on every surface."""

    start: np.ndarray
    """First entry of every surface in ``index``, and the number of entries, shape (M + 1,)."""
    index: np.ndarray
    """Rows of the points, ascending for each surface."""
    kind: np.ndarray
    """`SurfaceKind` of every surface, shape (M,)."""


def surface_members(result: Segmentation) -> Members:
    """Return the points that lie on every surface of a segmentation.

    Labels give every point to one patch. Here the pieces of a surface are one, and the points of
    other surfaces that lie on it too, where these meet, are with both.

    Args:
        result: A segmentation with analytic surfaces.

    Returns:
        The points of every surface number of ``result.surface``.
    """
    from scipy.spatial import cKDTree

    count = int(result.surface.max(initial=-1)) + 1
    kind = np.full(count, -1)
    parameters = np.zeros((count, 8))
    kind[result.surface], parameters[result.surface] = result.kind, result.parameters
    rows = np.flatnonzero(result.labels >= 0)
    mine = result.surface[result.labels[rows]]
    point = result.points[rows]
    noise = result.params.surfaces.noise
    if len(rows) and noise is not None:
        far, near = cKDTree(point).query(point, k=min(_NEAREST, len(point)))
        far, near = far.reshape(len(point), -1), near.reshape(len(point), -1)
        reach = _SPACINGS * spacing_of(result.measured)
        name = mine[near]
        other = (name != mine[:, None]) & (far <= reach) & (kind[name] >= 0) & (kind[name] < KINDS)
        at, rank = np.nonzero(other)
        pair = np.unique(at * count + name[at, rank])
        at, name = pair // count, pair % count
        off, _ = evaluate_surfaces(point[at], name, kind, parameters)
        on = np.abs(off) <= _ON * noise
        rows = np.concatenate([rows, rows[at[on]]])
        mine = np.concatenate([mine, name[on]])
    order = np.lexsort((rows, mine))
    size = np.bincount(mine, minlength=count)
    return Members(np.concatenate([[0], np.cumsum(size)]), rows[order], kind)
