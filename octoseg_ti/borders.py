"""Borders between patches: sharp edges, smooth joints, and fillets with their radii.

Patches in contact, and patches with a strip between them, make pairs. A ball that rolls along both
surfaces of a pair is fitted to the points around their edge (`stages.profiles`); its radius is the
only unknown. Balls that explain points which neither surface explains are fillets, the best
supported first: each claims the points on it, and what is left has to support the next.

A fillet has a radius of up to `EdgeParams.fillet_radius`, turns over at least two point spacings,
and touches the surfaces on both of its sides. A round joint that is larger is a patch like any
other, and so are cylinders that touch nothing along their sides: bosses, holes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.surfaces import evaluate_surfaces
from octoseg_ti.stages.extraction import Surfaces, fit_sets, spread
from octoseg_ti.stages.labelling import label_lists, near_lists
from octoseg_ti.stages.leaves import Leaves, Samples
from octoseg_ti.stages.marking import nearest_marked
from octoseg_ti.stages.profiles import BALL, NOWHERE, Places, place, sums
from octoseg_ti.types import NONE, EdgeClass, SurfaceKind

# Rounds of claims; between them surfaces are fitted anew without what was claimed.
_ROUNDS = 2
# Samples of a patch that tell its side, and of a strip that tell what it lies between.
_SIDE, _STRIP = 200, 60
# Points of the zone of an edge that are looked at, and that the radius is fitted to.
_MANY, _SOME = 3000, 600
# A strip lies between two surfaces when this share of its samples does.
_BETWEEN = 0.3
# Radii that are tried: from the least [spacings], each larger by this ratio, up to so many limits.
_LEAST, _RATIO, _MOST = 1.0, 1.15, 1.35
_RATIO_STRIP = 1.3  # a strip is only to be recognised
_COARSE = 0.4  # while radii are tried, distances beyond so many spacings count as this many
_FEW = 150  # points that these are tried on
_HOPE = 0.03  # share of the points that a radius has to explain beyond a sharp edge, to go on
_NEWTON = 6
# Distances beyond this many noises count as this many; a point lies on a ball within so many.
_CAP, _ON = 4.0, 3.5
_TURN = 0.5  # ... and its normal is that of the ball within this angle [rad]
# A fillet gains at least this much over a sharp edge, in squares of the noise: in all, and for each
# point on it.
_GAIN, _EACH = 40.0, 0.25
_ARC = 1.5  # a fillet is at least this wide [spacings]
_SLACK = 1.05  # its radius may be above the limit by so much: that it is not known exactly
_FEWEST = 8
_SHARED = 2.0  # neighbours share some of their noise, and the sides are not known exactly
# Its points are no farther from the ball than from the surfaces of their patches, times this, plus
# so many noises.
_WORSE, _EVEN = 1.2, 0.3
_FRESH = 0.5  # ... and this share of its points is on no better one
_WEAK = 2.0  # a point so many noises from the surface of its patch lies on that
_STRIP_SHARE = 0.5  # a patch is the strip of a fillet when so much of it is claimed
_REFIT = 300
_EDGE = 2.0  # edge points are this near an edge [spacings]
_SMOOTH = 0.09  # surfaces that meet at a smaller angle [rad] meet smoothly, if one is curved


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Borders:
    """What borders of patches were found, ``F`` fillets."""

    edge: np.ndarray
    """`EdgeClass` of every sorted point, shape (n,), u8."""
    fillet: np.ndarray
    """Fillet that every sorted point lies on, -1 = none, shape (n,), i32."""
    sides: np.ndarray
    """The two patches that every fillet touches, shape (F, 2), i32."""
    radius: np.ndarray
    """Radius [mm], above 0 = concave, below 0 = convex, shape (F,), f64."""
    deviation: np.ndarray
    """Standard deviation of the radius [mm], shape (F,), f64."""
    strip: np.ndarray
    """Fillet that every patch is a strip of, -1 = none, shape (K,), i32."""


class Zones(NamedTuple):
    """Pairs of patches that may share an edge, and the leaves around it."""

    pairs: np.ndarray
    """The patches, the smaller number first, shape (P, 2)."""
    pair: np.ndarray
    """Pair of every entry, ascending, shape (E,)."""
    leaf: np.ndarray
    """Leaf of every entry, shape (E,)."""
    fine: np.ndarray
    """Whether the leaf is small, shape (E,), bool: the others are next to the edge, or far off."""
    labels: np.ndarray
    """Pair and label of points that may lie on the edge, as one number, ascending."""
    count: int
    """Labels are below this."""

    def allows(self, pair: np.ndarray, label: np.ndarray) -> np.ndarray:
        """Say which points may lie on an edge: on its sides, on a strip between them, on nothing."""
        key = pair.astype(np.int64) * self.count + label
        hit = np.minimum(np.searchsorted(self.labels, key), max(len(self.labels) - 1, 0))
        return (label < 0) | (self.labels[hit] == key)


class Fit(NamedTuple):
    """The balls of all pairs."""

    radius: np.ndarray
    """Radius [mm], above 0 = concave, shape (P,)."""
    deviation: np.ndarray
    """Its standard deviation [mm]."""
    hollow: np.ndarray
    """1 where the edge is concave, -1 where it is convex."""
    turn: np.ndarray
    """Mean angle by which the surface turns over the edge [rad]."""
    points: np.ndarray
    """Points of the zone near the edge."""
    good: np.ndarray
    """Whether the ball may be a fillet."""
    quality: np.ndarray
    """Weight of its support, 0.1..1."""


class Search:
    """What the steps of the search for borders share."""

    def __init__(
        self,
        points: Any,
        normals: Any,
        leaves: Leaves,
        label: np.ndarray,
        surface: np.ndarray,
        surfaces: Surfaces,
        noise: float,
        spacing: float,
        limit: float,
    ) -> None:
        self.device = points, normals
        self.points, self.normals = runtime.download(points), runtime.download(normals)
        self.leaves, self.label = leaves, label
        self.noise, self.spacing, self.limit = noise, spacing, limit
        self.count = len(surface)
        self.analytic = surface >= 0
        order = np.argsort(label, kind="stable")
        ends = np.searchsorted(label[order], np.arange(self.count + 1))
        self.members = [order[lo:hi] for lo, hi in zip(ends[:-1], ends[1:], strict=True)]
        self.size = np.diff(ends)
        which = np.maximum(surface, 0)
        self.table = np.zeros((self.count, 10))
        if len(surfaces):
            self.table[:, :8], self.table[:, 8] = surfaces.parameters[which], surfaces.kind[which]
        self.table[~self.analytic] = 0.0
        self.set_sides()
        # Distance of every point from the surface of its patch [mm], capped.
        self.off = np.full(len(label), _CAP * noise)
        there = np.flatnonzero((label >= 0) & self.analytic[np.maximum(label, 0)])
        far, _ = evaluate_surfaces(
            self.points[there], label[there], self.table[:, 8].astype(np.int32), self.table[:, :8]
        )
        self.off[there] = np.minimum(np.abs(far), _CAP * noise)
        self.own = label_lists(leaves, label)
        self.near = near_lists(leaves, self.own)
        self.claim = np.full(len(label), NONE, np.int32)
        self.box = np.concatenate(
            [
                np.minimum.reduceat(self.points, leaves.first),
                np.maximum.reduceat(self.points, leaves.first),
            ],
            axis=1,
        )

    def set_sides(self) -> None:
        """Say for every surface on which side the air is."""
        index, owner = listed([spread(m, _SIDE) for m in self.members])
        _, outward = evaluate_surfaces(
            self.points[index], owner, self.table[:, 8].astype(np.int32), self.table[:, :8]
        )
        cosine = np.nan_to_num(np.einsum("ij,ij->i", outward, self.normals[index]))
        self.table[:, 9] = np.where(np.bincount(owner, cosine, self.count) < 0.0, -1.0, 1.0)

    def place(
        self, pairs: np.ndarray, radius: np.ndarray, point: np.ndarray, pair: np.ndarray
    ) -> Places:
        """Place points on profiles."""
        return place(*self.device, self.table, pairs, radius, point, pair)

    def near_edge(
        self,
        pairs: np.ndarray,
        radius: np.ndarray,
        points: np.ndarray,
        point: np.ndarray,
        pair: np.ndarray,
        reach: np.ndarray,
    ) -> np.ndarray:
        """Say which of other points are within reach of edges."""
        device = runtime.upload(points)
        return place(device, device, self.table, pairs, radius, point, pair).along <= reach

    def sums(
        self, task: np.ndarray, shape: np.ndarray, entry: np.ndarray, cap: float
    ) -> np.ndarray:
        """Sum up how profiles fit."""
        return sums(self.device[0], self.table, task, shape, entry, cap)

    def reach(self, turn: np.ndarray) -> np.ndarray:
        """Return how far from the sharp edge a fillet can reach [mm]."""
        wide = np.minimum(np.tan(turn / 2.0), 3.0)
        return _MOST * self.limit * wide + _EDGE * self.spacing

    def absorbed(self) -> float:
        """Return how wide a piece of a fillet may pass as a part of the surface beside it [mm]."""
        return float(np.sqrt(2.0 * _CAP * self.noise * self.limit)) + 1.5 * self.spacing

    def radii(self, ratio: float) -> np.ndarray:
        """Return the radii that are tried, each larger than the last by this ratio."""
        least = _LEAST * self.spacing
        steps = int(np.ceil(np.log(max(_MOST * self.limit / least, 1.1)) / np.log(ratio))) + 1
        return least * ratio ** np.arange(steps)

    def coarse(self) -> float:
        """Return the distance beyond which points count alike while radii are tried [mm]."""
        return max(_CAP * self.noise, _COARSE * self.spacing)

    def tried(
        self, task: np.ndarray, radii: np.ndarray, hollow: np.ndarray, point: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the cost of every radius for every task, and the points on its ball."""
        cap = self.coarse()
        shape = np.column_stack([np.tile(radii, len(task)), np.repeat(hollow, len(radii))])
        got = self.sums(np.repeat(task, len(radii), axis=0), shape, point, cap)
        got = got.reshape(len(task), len(radii), 4)
        return got[..., 0] / cap**2, got[..., 3]


def listed(sets: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the members of all sets, and the set of each."""
    owner = np.repeat(np.arange(len(sets)), [len(s) for s in sets])
    return (np.concatenate(sets) if sets else np.zeros(0, np.int64)), owner


def ranges(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the numbers from every first on, so many each, one range after the other."""
    ends = np.cumsum(count, dtype=np.int64)
    total = int(ends[-1]) if len(ends) else 0
    return np.arange(total) + np.repeat(first - (ends - count), count)


def thinned(owner: np.ndarray, pairs: int, most: int) -> np.ndarray:
    """Return which entries to keep so that every pair keeps at most about so many, evenly."""
    total = np.bincount(owner, minlength=pairs)
    rank = np.arange(len(owner)) - (np.cumsum(total) - total)[owner]
    return rank % np.maximum(-(-total // most), 1)[owner] == 0


def pairs_near(near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of labels that are near the same leaf, smaller first, and these leaves."""
    found, leaf = [np.zeros((0, 2), np.int64)], [np.zeros(0, np.int64)]
    there = np.arange(len(near))
    for j in range(1, near.shape[1]):
        there = there[near[there, j] >= 0]
        for i in range(j if len(there) else 0):
            found.append(near[there][:, [i, j]])
            leaf.append(there)
    return np.concatenate(found), np.concatenate(leaf)


def strips_between(search: Search, touching: np.ndarray) -> np.ndarray:
    """Return patches that lie on a ball between two of the patches they touch, shape (S, 3).

    Args:
        search: What is known.
        touching: Pairs of patches that touch, each once.
    """
    both = np.concatenate([touching, touching[:, ::-1]])
    both = both[search.analytic[both[:, 1]]]
    sets = [np.sort(both[both[:, 0] == s, 1]) for s in range(search.count)]
    triples = [np.zeros((0, 3), np.int64)]
    for s, sides in enumerate(sets):
        i, j = np.triu_indices(len(sides), 1)
        triples.append(np.column_stack([np.full(len(i), s), sides[i], sides[j]]))
    triple = np.concatenate(triples)
    samples = [spread(m, _STRIP) for m in search.members]
    size = np.array([len(s) for s in samples])

    def listed_for(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return listed([samples[s] for s in rows[:, 0]])

    if len(triple) == 0:
        return triple
    entry, owner = listed_for(triple)
    at = search.place(triple[:, 1:], np.zeros(len(triple)), entry, owner)
    inside = (at.region != NOWHERE) & (at.along <= search.reach(at.turn))
    height = np.bincount(owner, inside * np.sign(at.height), len(triple))
    kept = np.bincount(owner, inside, len(triple)) >= _BETWEEN * size[triple[:, 0]]
    triple, hollow = triple[kept], np.where(height[kept] < 0.0, -1.0, 1.0)
    if len(triple) == 0:
        return triple
    entry, _ = listed_for(triple)
    ends = np.cumsum(size[triple[:, 0]])
    task = np.column_stack([triple[:, 1:], ends - size[triple[:, 0]], ends])
    cost, on = search.tried(task, search.radii(_RATIO_STRIP), hollow, entry)
    best = (on - cost).argmax(axis=1)
    return triple[on[np.arange(len(triple)), best] >= _BETWEEN * size[triple[:, 0]]]


def find_zones(search: Search) -> Zones:
    """Return the pairs of patches that may share an edge, and where."""
    pairs, leaf = pairs_near(search.near)
    width, cells = search.count + 1, len(search.leaves)
    touching = np.unique(pairs[:, 0].astype(np.int64) * width + pairs[:, 1])
    triple = strips_between(search, np.column_stack([touching // width, touching % width]))
    cell, rank = np.nonzero(search.own >= 0)
    name = search.own[cell, rank]
    order = np.argsort(name, kind="stable")
    cell, first = cell[order], np.searchsorted(name[order], np.arange(search.count + 1))
    each = (first[1:] - first[:-1])[triple[:, 0]]
    along = cell[ranges(first[triple[:, 0]], each)]
    # Large leaves are far inside a patch: their points say nothing about its edges.
    size = search.leaves.size
    small = size <= max(2.0 * size.min(), search.absorbed())
    real = search.analytic[pairs].all(axis=1)
    key = np.concatenate(
        [
            (pairs[real, 0].astype(np.int64) * width + pairs[real, 1]) * cells + leaf[real],
            np.repeat(triple[:, 1] * width + triple[:, 2], each) * cells + along,
        ]
    )
    key = np.unique(key)
    code, which = np.unique(key // cells, return_inverse=True)
    pairs = np.column_stack([code // width, code % width])
    fine = small[key % cells]
    fine |= (np.bincount(which, fine, len(code)) == 0)[which]
    number = np.arange(len(code))
    between = np.searchsorted(code, triple[:, 1] * width + triple[:, 2])
    labels = np.unique(
        np.concatenate(
            [number * width + pairs[:, 0], number * width + pairs[:, 1],
             between * width + triple[:, 0]]
        )
    )  # fmt: skip
    return Zones(pairs, which, key % cells, fine, labels, width)


def points_of(search: Search, zones: Zones, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points that may lie on the edges of some pairs, and the pair of each."""
    kept = which[zones.pair] & zones.fine
    leaf, pair = zones.leaf[kept], zones.pair[kept]
    count = search.leaves.count[leaf]
    point, pair = ranges(search.leaves.first[leaf], count), np.repeat(pair, count)
    kept = zones.allows(pair, search.label[point])
    return point[kept], pair[kept]


def fit_balls(search: Search, zones: Zones) -> Fit:
    """Fit a ball to the points around the edge of every pair."""
    pairs, noise = len(zones.pairs), search.noise
    point, pair = points_of(search, zones, np.ones(pairs, bool))
    whole = np.bincount(pair, minlength=pairs)
    kept = thinned(pair, pairs, _MANY)
    point, pair = point[kept], pair[kept]
    share = np.bincount(pair, minlength=pairs) / np.maximum(whole, 1)
    at = search.place(zones.pairs, np.zeros(pairs), point, pair)
    kept = (at.region != NOWHERE) & (at.along <= search.reach(at.turn))
    point, pair = point[kept], pair[kept]
    total = np.bincount(pair, minlength=pairs)
    turn = np.bincount(pair, at.turn[kept], pairs) / np.maximum(total, 1)
    whole = total / np.maximum(share, 1e-9)
    height = np.bincount(pair, np.sign(at.height[kept]), pairs)
    hollow = np.where(height < 0.0, -1.0, 1.0)
    kept = thinned(pair, pairs, _SOME)
    point, pair = point[kept], pair[kept]
    kept = thinned(pair, pairs, _FEW)
    total = np.bincount(pair[kept], minlength=pairs)
    ends = np.cumsum(total)
    radii = np.concatenate([[0.0], search.radii(_RATIO)])
    task = np.column_stack([zones.pairs, ends - total, ends])
    cost, _ = search.tried(task, radii, hollow, point[kept])
    best = cost.argmin(axis=1)
    gain = (cost[:, 0] - cost.min(axis=1)) * (search.coarse() / noise) ** 2
    hope = gain > np.maximum(_HOPE * total, 1.0)
    radius = np.maximum(radii[best], 0.5 * search.spacing)
    total = np.bincount(pair, minlength=pairs)
    ends = np.cumsum(total)
    task = np.column_stack([zones.pairs, ends - total, ends])[hope]
    now, none = np.zeros((pairs, 4)), np.zeros((pairs, 4))
    shape = np.column_stack([radius, hollow])[hope]
    cap = _CAP * noise
    none[hope] = search.sums(task, shape * [0.0, 1.0], point, cap)
    for turn_ in range(_NEWTON):
        now[hope] = search.sums(task, shape, point, cap)
        if turn_ + 1 < _NEWTON:
            step = -now[hope, 1] / np.maximum(now[hope, 2], 1e-12)
            least = 0.2 * shape[:, 0]
            shape[:, 0] += np.clip(step, -least, least)
            shape[:, 0] = np.clip(shape[:, 0], 0.02, 2.0 * search.limit)
    radius[hope] = shape[:, 0]
    gain = (none[:, 0] - now[:, 0]) / noise**2
    rms = np.sqrt(now[:, 0] / np.maximum(total, 1))
    good = hope & (
        (gain * whole >= _GAIN * np.maximum(total, 1))
        & (gain >= _EACH * now[:, 3])
        & (radius * turn >= _ARC * search.spacing)
        & (radius <= _SLACK * search.limit)
        & (now[:, 3] >= _FEWEST)
    )
    return Fit(
        radius=radius * hollow,
        deviation=_SHARED * np.maximum(rms, 0.3 * noise) / np.sqrt(np.maximum(now[:, 2], 1e-12)),
        hollow=hollow,
        turn=turn,
        points=total,
        good=good,
        quality=np.clip(1.5 - rms / (2.0 * noise), 0.1, 1.0),
    )


def claim_points(search: Search, zones: Zones, fit: Fit) -> np.ndarray:
    """Let balls claim the points on them, the best supported first; say which remain, (P,) bool."""
    point, pair = points_of(search, zones, fit.good)
    at = search.place(zones.pairs, fit.radius, point, pair)
    on = (at.region == BALL) & (np.abs(at.off) <= _ON * search.noise)
    on &= at.cosine >= np.cos(_TURN)
    point, pair = point[on], pair[on]
    # What the surface of a patch explains better is no fillet: a chamfer, the next fillet.
    _, of = np.unique(
        pair.astype(np.int64) * (search.count + 1) + search.label[point], return_inverse=True
    )
    number = np.bincount(of)
    ball, own = np.bincount(of, at.off[on] ** 2), np.bincount(of, search.off[point] ** 2)
    better = ball <= _WORSE**2 * own + (_EVEN * search.noise) ** 2 * number
    side = (search.label[point][:, None] == zones.pairs[pair]).any(axis=1)
    kept = better[of] | side
    others = np.bincount(pair, ~side, len(zones.pairs))
    agree = 2.0 * np.bincount(pair, kept & ~side, len(zones.pairs)) >= others
    point, pair = point[kept], pair[kept]
    ends = np.searchsorted(pair, np.arange(len(zones.pairs) + 1))
    support = np.diff(ends)
    search.claim[:] = NONE
    chosen = np.zeros(len(zones.pairs), bool)
    for p in np.argsort(-support * fit.quality, kind="stable"):
        if support[p] < _FEWEST or not agree[p]:
            continue
        mine = point[ends[p] : ends[p + 1]]
        fresh = mine[search.claim[mine] < 0]
        if len(fresh) < max(_FRESH * len(mine), _FEWEST):
            continue
        search.claim[fresh] = p
        chosen[p] = True
    drop_weak_claims(search, zones, fit)
    return chosen


def drop_weak_claims(search: Search, zones: Zones, fit: Fit) -> None:
    """Give back points that lie on a side of the fillet as well, unless others are next to them.

    Near the line of contact the ball is as good as the surface; beyond the end of a fillet both go
    on, and there nothing else lies on the ball.
    """
    mine = np.flatnonzero(search.claim >= 0)
    pair = search.claim[mine]
    side = (search.label[mine][:, None] == zones.pairs[pair]).any(axis=1)
    weak = side & (search.off[mine] <= _WEAK * search.noise)
    mark = search.claim.copy()
    mark[mine[weak]] = NONE
    mine, pair = mine[weak], pair[weak]
    leaf = np.searchsorted(search.leaves.first, mine, side="right") - 1
    reach = np.sqrt(2.0 * _ON * search.noise * np.abs(fit.radius[pair])) + search.spacing
    far = nearest_marked(search.device[0], mark, search.leaves, search.box, mine, leaf, pair, reach)
    search.claim[mine[~np.isfinite(far)]] = NONE


def refit_sides(search: Search) -> None:
    """Fit the surfaces of patches anew without the points that fillets claim."""
    claimed = np.bincount(
        search.label[(search.claim >= 0) & (search.label >= 0)], minlength=search.count
    )
    left = search.size - claimed
    again = np.flatnonzero(
        search.analytic
        & (claimed > 0.01 * search.size)
        & (left >= 0.5 * search.size)
        & (left >= 50)
    )
    if len(again) == 0:
        return
    sets = [spread(search.members[k][search.claim[search.members[k]] < 0], _REFIT) for k in again]
    index, owner = listed(sets)
    samples = Samples(
        index=index.astype(np.int32), leaf=owner.astype(np.int32), point=search.points[index],
        normal=search.normals[index], weight=np.ones(len(index)),
    )  # fmt: skip
    ends = np.cumsum([len(s) for s in sets])
    order = np.split(np.arange(len(index)), ends[:-1])
    fitted, surfaces = fit_sets(samples, order, search.noise, robust=True)
    k = again[fitted]
    search.table[k, :8], search.table[k, 8] = surfaces.parameters, surfaces.kind
    search.set_sides()


def find_borders(
    points: Any,
    normals: Any,
    leaves: Leaves,
    label: np.ndarray,
    surface: np.ndarray,
    surfaces: Surfaces,
    *,
    noise: float,
    spacing: float,
    limit: float,
) -> Borders:
    """Find the edges between patches, and the fillets.

    Args:
        points: Sorted positions relative to the corner of the grid [mm], shape (n, 3), f64 (kernel
            array).
        normals: Their unit normals, shape (n, 3), f64 (kernel array).
        leaves: The leaves.
        label: Patch of every point, -1 = none, shape (n,), i32.
        surface: Surface of every patch, -1 = none, shape (K,), i32.
        surfaces: The surfaces.
        noise: Deviation of a point from its surface [mm].
        spacing: The larger of the two point spacings [mm].
        limit: Largest radius of a fillet [mm].
    """
    search = Search(points, normals, leaves, label, surface, surfaces, noise, spacing, limit)
    for turn in range(_ROUNDS):
        if turn:
            refit_sides(search)
        zones = find_zones(search)
        fit = fit_balls(search, zones)
        chosen = claim_points(search, zones, fit)
    fillets = np.flatnonzero(chosen)
    number = np.full(len(zones.pairs) + 1, NONE, np.int32)
    number[fillets] = np.arange(len(fillets), dtype=np.int32)
    strip = strips_of(search, number)
    edge = mark_points(search, zones, fit, chosen, strip)
    return Borders(
        edge=edge,
        fillet=number[search.claim],
        sides=zones.pairs[fillets].astype(np.int32),
        radius=fit.radius[fillets],
        deviation=fit.deviation[fillets],
        strip=strip,
    )


def strips_of(search: Search, number: np.ndarray) -> np.ndarray:
    """Return the fillet that every patch is a strip of, -1 = none, shape (K,), i32."""
    there = (search.claim >= 0) & (search.label >= 0)
    fillets = int(number.max(initial=NONE)) + 1
    key = search.label[there].astype(np.int64) * max(fillets, 1) + number[search.claim[there]]
    table = np.bincount(key, minlength=search.count * max(fillets, 1)).reshape(search.count, -1)
    most = table.sum(axis=1) >= np.maximum(_STRIP_SHARE * search.size, 1)
    return np.where(most, table.argmax(axis=1), NONE).astype(np.int32)


def mark_points(
    search: Search, zones: Zones, fit: Fit, chosen: np.ndarray, strip: np.ndarray
) -> np.ndarray:
    """Return the `EdgeClass` of every point: that of the nearest edge within two spacings."""
    leaves, reach = search.leaves, _EDGE * search.spacing
    radius = np.where(chosen, fit.radius, 1e-12 * fit.hollow)
    smooth = ~chosen & (smooth_pairs(search, zones.pairs, fit.turn) | (fit.points < 5))
    idle = ~chosen & (strip[zones.pairs] >= 0).any(axis=1) & smooth
    # The leaves of the zones, and those that touch them.
    around = np.diff(leaves.start)[zones.leaf]
    beside = leaves.neighbor[ranges(leaves.start[zones.leaf], around)]
    key = np.concatenate(
        [zones.pair.astype(np.int64) * len(leaves) + zones.leaf,
         np.repeat(zones.pair.astype(np.int64), around) * len(leaves) + beside]
    )  # fmt: skip
    key = np.unique(key)
    pair, leaf = key // len(leaves), key % len(leaves)
    pair, leaf = pair[~idle[pair]], leaf[~idle[pair]]
    box = search.box
    wide = 0.5 * np.linalg.norm(box[:, 3:] - box[:, :3], axis=1)
    kept = search.near_edge(
        zones.pairs, radius, 0.5 * (box[:, :3] + box[:, 3:]), leaf, pair, reach + wide[leaf]
    )
    kept |= smooth[pair]
    pair, leaf = pair[kept], leaf[kept]
    count = leaves.count[leaf]
    point = ranges(leaves.first[leaf], count)
    pair, leaf = np.repeat(pair, count), np.repeat(leaf, count)
    label = search.label[point]
    ours = (label[:, None] == zones.pairs[pair]).any(axis=1)
    ours |= chosen[pair] & zones.allows(pair, label)
    point, pair, leaf, label = point[ours], pair[ours], leaf[ours], label[ours]
    at = search.place(zones.pairs, radius, point, pair)
    tangent = smooth[pair]
    along = np.where(tangent, 0.0, at.along)
    ball = at.region == BALL
    fits = (np.abs(at.off) <= np.where(ball, _ON, _CAP) * search.noise) | (ball & ~chosen[pair])
    near = (along <= reach) & (fits | tangent)
    point, pair, leaf, label = point[near], pair[near], leaf[near], label[near]
    along = along[near]
    other = np.where(label == zones.pairs[pair, 0], zones.pairs[pair, 1], zones.pairs[pair, 0])
    found = np.ones(len(point), bool)
    far = np.where(smooth[pair], reach - 0.5 * search.spacing, along + reach)
    # A small leaf that holds the other label needs no search.
    held = (search.own[leaf] == other[:, None]).any(axis=1) & (2.0 * wide[leaf] <= far)
    for k, marks, wanted in (
        (np.flatnonzero(~chosen[pair] & ~held), search.label, other),
        (np.flatnonzero(chosen[pair]), search.claim, pair),
    ):
        distance = nearest_marked(
            search.device[0], marks, leaves, box, point[k], leaf[k], wanted[k], far[k]
        )
        found[k] = np.isfinite(distance)
    point, pair, along = point[found], pair[found], along[found]
    code = np.full(len(zones.pairs), int(EdgeClass.SHARP), np.uint8)
    code[smooth], code[chosen] = int(EdgeClass.SMOOTH), int(EdgeClass.FILLET)
    # A smooth joint has no line; what is nearer to another edge belongs to that.
    order = np.argsort(-np.where(smooth[pair], reach, along), kind="stable")
    edge = np.zeros(len(search.points), np.uint8)
    edge[point[order]] = code[pair[order]]
    edge[search.claim >= 0] = int(EdgeClass.FILLET)
    return edge


def smooth_pairs(search: Search, pairs: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Say which pairs of surfaces meet without an angle, as far as their errors tell, (P,) bool."""
    kind = search.table[:, 8].astype(np.int32)
    curved = np.full(search.count, np.inf)
    ball = (kind == int(SurfaceKind.CYLINDER)) | (kind == int(SurfaceKind.SPHERE))
    ring = kind == int(SurfaceKind.TORUS)
    curved[ball], curved[ring] = search.table[ball, 6], search.table[ring, 7]
    # An error of place as large as the noise opens a tangent joint by this angle.
    radius = np.maximum(curved[pairs].min(axis=1), 1e-9)
    open_ = np.maximum(_SMOOTH, np.sqrt(4.0 * search.noise / radius))
    flat = (kind[pairs] == int(SurfaceKind.PLANE)).all(axis=1)
    return ~flat & (turn < open_)
