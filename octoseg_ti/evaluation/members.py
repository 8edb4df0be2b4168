"""All points that lie on each patch: a point of a crease lies on several."""

from dataclasses import dataclass

import numpy as np

from octoseg_ti.defaults import spacing_of
from octoseg_ti.device.surfaces import KINDS, evaluate_surfaces
from octoseg_ti.types import Segmentation

# A patch is near a point when it has one of so many nearest points, within so many spacings.
_NEAREST, _SPACINGS = 24, 3.0
# A point lies on a surface within this many noises.
_ON = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Members:
    """The points on every one of ``K`` patches; a point may be on several."""

    start: np.ndarray
    """First entry of every patch in ``index``, and the number of entries, shape (K + 1,)."""
    index: np.ndarray
    """Rows of the points, patch after patch."""
    kind: np.ndarray
    """`SurfaceKind` of every patch, shape (K,)."""


def patch_members(result: Segmentation) -> Members:
    """Return the points that lie on every patch of a segmentation.

    Labels give every point to one patch. Here the points of neighbouring patches that lie on the
    surface of a patch too, where these meet, are with both.

    Args:
        result: A segmentation with analytic surfaces.
    """
    from scipy.spatial import cKDTree

    count = result.patch_count
    analytic = (result.kind >= 0) & (result.kind < KINDS)
    rows = np.flatnonzero(result.labels >= 0)
    mine = result.labels[rows]
    point = result.points[rows]
    noise = result.params.surfaces.noise
    if len(rows) and noise is not None:
        far, near = cKDTree(point).query(point, k=min(_NEAREST, len(point)))
        far, near = far.reshape(len(point), -1), near.reshape(len(point), -1)
        reach = _SPACINGS * spacing_of(result.measured)
        name = mine[near]
        other = (name != mine[:, None]) & (far <= reach) & analytic[name]
        at, rank = np.nonzero(other)
        pair = np.unique(at * count + name[at, rank])
        at, name = pair // count, pair % count
        off, _ = evaluate_surfaces(point[at], name, result.kind, result.parameters)
        on = np.abs(off) <= _ON * noise
        rows = np.concatenate([rows, rows[at[on]]])
        mine = np.concatenate([mine, name[on]])
    order = np.lexsort((rows, mine))
    size = np.bincount(mine, minlength=count)
    return Members(np.concatenate([[0], np.cumsum(size)]), rows[order], result.kind)
