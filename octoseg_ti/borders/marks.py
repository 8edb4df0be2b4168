"""Which points are at edges: those within two spacings of one, if the other side is near too."""

from __future__ import annotations

import numpy as np

from octoseg_ti.borders.blends import find_blends, mark_blends
from octoseg_ti.borders.fillets import ON, Fit, smooth_pairs
from octoseg_ti.borders.zones import CAP, EDGE, Search, Zones, starts_of
from octoseg_ti.stages.leaves import distinct, ranges
from octoseg_ti.stages.marking import marked_near
from octoseg_ti.stages.profiles import SHARP, SMOOTH, points_beside
from octoseg_ti.types import EdgeClass

_FEWEST = 5  # an edge with fewer points around it is no line

FILLET = int(EdgeClass.FILLET)


def mark_points(
    search: Search,
    zones: Zones,
    fit: Fit,
    chosen: np.ndarray,
    strip: np.ndarray,
    joined: np.ndarray,
) -> np.ndarray:
    """Return the `EdgeClass` of every point: that of the nearest edge within two spacings.

    Args:
        search: What is known.
        zones: The pairs of patches.
        fit: The balls of all pairs.
        chosen: Which pairs are fillets, shape (P,), bool.
        strip: Fillet that every patch is a strip of, -1 = none, shape (K,).
        joined: Which pairs are known to join smoothly, shape (P,), bool.
    """
    reach = EDGE * search.spacing
    smooth = smooth_pairs(search, zones.pairs, fit.turn) | fit.large | joined
    smooth |= fit.points < _FEWEST
    smooth &= ~chosen
    form = np.full(len(zones.pairs), SHARP, np.uint8)
    form[smooth], form[chosen] = SMOOTH, FILLET
    radius = np.where(chosen, fit.radius, 1e-12 * fit.hollow)
    # Where a strip joins its sides is no edge of its own.
    idle = smooth & (strip[zones.pairs] >= 0).any(axis=1)
    pair, leaf = leaves_beside(search, zones, form, radius, idle)
    point, at, along = points_beside(
        search.device[0], search.label, search.table, edges_of(zones, form),
        zones.strips % zones.width, radius, pair, search.leaves.first[leaf],
        search.leaves.count[leaf], reach=reach, on_ball=ON * search.noise,
        on_side=CAP * search.noise,
    )  # fmt: skip
    pair, leaf = pair[at], leaf[at]
    near = np.zeros(len(point), bool)
    far = np.where(smooth[pair], reach - 0.5 * search.spacing, along + reach)
    other = zones.pairs.sum(axis=1)[pair] - search.label[point]
    for k, marks, wanted in (
        (np.flatnonzero(~chosen[pair]), search.label, other),
        (np.flatnonzero(chosen[pair]), search.claim, pair),
    ):
        near[k] = marked_near(
            search.device[0], marks, search.leaves, point[k], leaf[k], wanted[k], far[k]
        )
    point, pair, along = point[near], pair[near], along[near]
    # What is nearer to another edge than to a smooth joint belongs to that.
    along[smooth[pair]] = reach
    nearest = np.full(len(search.points), np.inf)
    np.minimum.at(nearest, point, along)
    first = along == nearest[point]
    edge = np.zeros(len(search.points), np.uint8)
    edge[point[first]] = form[pair[first]]
    blend = find_blends(search, zones, fit.turn) & (strip < 0)
    mark_blends(search, zones, blend, smooth, edge)
    edge[search.claim >= 0] = FILLET
    return edge


def leaves_beside(
    search: Search, zones: Zones, form: np.ndarray, radius: np.ndarray, idle: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the leaves that may hold points at edges, and the pair of each, pair after pair.

    Args:
        search: What is known.
        zones: The pairs of patches.
        form: `EdgeClass` of every pair, shape (P,).
        radius: Its signed radius [mm], shape (P,).
        idle: Pairs that are left out, shape (P,), bool.

    Returns:
        Pair of every entry, ascending, and its leaf: those of the zone of a pair, and those that
        touch these, which are near its line, if it has one.
    """
    leaves = search.leaves
    more = form[zones.pair] != SMOOTH
    near_pair, near_leaf = zones.pair[more], zones.leaf[more]
    around = (leaves.start[1:] - leaves.start[:-1])[near_leaf]
    beside = leaves.neighbor[ranges(leaves.start[near_leaf], around)]
    key = distinct(
        np.concatenate(
            [
                zones.pair * len(leaves) + zones.leaf,
                np.repeat(near_pair * len(leaves), around) + beside,
            ]
        )
    )
    pair, leaf = np.divmod(key, len(leaves))
    kept = ~idle[pair]
    pair, leaf = pair[kept], leaf[kept]
    middle, wide = search.balls
    reach = EDGE * search.spacing + wide[leaf]
    kept = search.near_edge(zones.pairs, radius, middle, leaf, pair, reach)
    kept |= form[pair] == SMOOTH
    return pair[kept], leaf[kept]


def edges_of(zones: Zones, form: np.ndarray) -> np.ndarray:
    """Return sides, `EdgeClass` and range of strips of every pair, shape (P, 5)."""
    start = starts_of(zones.strips // zones.width, len(zones.pairs))
    return np.column_stack([zones.pairs, form, start[:-1], start[1:]])
