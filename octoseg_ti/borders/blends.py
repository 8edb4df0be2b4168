"""Blends: patches that are fillets themselves, where those of several edges meet.

At a corner the ball that rolls along one edge goes over into that of the next; what it leaves is a
piece of a torus or a sphere between fillets, and no two faces have it as their edge.
"""

from __future__ import annotations

import numpy as np

from octoseg_ti.borders.fillets import SLACK, WEAK, smooth_pairs, without_support
from octoseg_ti.borders.zones import EDGE, Search, Zones, points_of
from octoseg_ti.device.surfaces import evaluate_surfaces
from octoseg_ti.stages.marking import marked_near
from octoseg_ti.types import NONE, EdgeClass

# A blend joins at least so many others smoothly, along this share of its border.
_JOINED, _SHARE = 2, 0.5
# Length of the mean of its normals: a quarter of a tube has 0.9, half a tube 0.64, a boss none.
_OPEN = 0.7


def find_blends(search: Search, zones: Zones, turn: np.ndarray) -> np.ndarray:
    """Say which patches are fillets between fillets, shape (K,), bool.

    Args:
        search: What is known.
        zones: The pairs of patches.
        turn: Mean angle by which the surface turns over the edge of every pair [rad], shape (P,).
    """
    small: np.ndarray = search.ball_radii() <= SLACK * search.limit
    if not small.any():
        return small
    smooth = smooth_pairs(search, zones.pairs, turn)
    sides = zones.pairs.T.ravel()
    joined = np.bincount(sides, np.tile(smooth & (zones.contact > 0), 2), search.count)
    border = np.bincount(sides, np.tile(zones.contact, 2), search.count)
    along = np.bincount(sides, np.tile(smooth * zones.contact, 2), search.count)
    there = np.flatnonzero(search.label >= 0)
    there = there[small[search.label[there]]]
    mean = [
        np.bincount(search.label[there], search.normals[there, k], search.count) for k in range(3)
    ]
    length = np.linalg.norm(mean, axis=0) / np.maximum(search.size, 1)
    blends: np.ndarray = (
        small & (joined >= _JOINED) & (along >= _SHARE * border) & (length >= _OPEN)
    )
    return blends


def mark_blends(
    search: Search, zones: Zones, blend: np.ndarray, smooth: np.ndarray, edge: np.ndarray
) -> None:
    """Mark the points of blends and those beside them as fillets, in place.

    Args:
        search: What is known.
        zones: The pairs of patches.
        blend: Which patches are blends, shape (K,), bool.
        smooth: Which pairs join smoothly, shape (P,), bool.
        edge: `EdgeClass` of every point so far, shape (n,), u8.
    """
    if not blend.any():
        return
    mark = np.full(len(search.label), NONE, np.int32)
    mine = np.flatnonzero(search.label >= 0)
    mine = mine[blend[search.label[mine]]]
    mark[mine] = search.label[mine]
    # A surface that touches another lies on it for a while beyond the end of its patch.
    radius, weak = search.ball_radii(), np.zeros(len(search.label), bool)
    kind = search.table[:, 8].astype(np.int32)
    for patch, beside in np.concatenate([zones.pairs[smooth], zones.pairs[smooth, ::-1]]):
        if blend[patch]:
            of = search.members[patch]
            near = np.full(len(of), beside)
            far, _ = evaluate_surfaces(search.points[of], near, kind, search.table[:, :8])
            weak[of] |= np.abs(far) <= WEAK * search.noise
    doubtful = mine[weak[mine]]
    mark[without_support(search, mark, doubtful, radius[search.label[doubtful]])] = NONE
    edge[mark >= 0] = int(EdgeClass.FILLET)
    # Beside them: points of the patches that they join.
    for column in (0, 1):
        asked = smooth & blend[zones.pairs[:, column]]
        point, pair = points_of(search, zones, asked)
        patch = zones.pairs[pair, column]
        kept = (search.label[point] != patch) & (edge[point] != int(EdgeClass.FILLET))
        point, patch = point[kept], patch[kept]
        near = marked_near(
            search.device[0], mark, search.leaves, point, search.leaf_of(point), patch,
            np.full(len(point), EDGE * search.spacing),
        )  # fmt: skip
        edge[point[near]] = int(EdgeClass.FILLET)
