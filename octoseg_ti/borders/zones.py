"""Where two patches may share an edge: in contact, or with a strip between them.

A strip is a patch whose points lie on a ball that touches two of its neighbours. The zone of an
edge is the leaves where both patches are near, and those of its strips.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.surfaces import distances_to_surfaces, evaluate_surfaces
from octoseg_ti.stages.extraction import Surfaces
from octoseg_ti.stages.labelling import label_lists, near_lists
from octoseg_ti.stages.leaves import Leaves, distinct, members_of, ranges
from octoseg_ti.stages.profiles import BALL, Places, place, sums
from octoseg_ti.stages.sets import spread
from octoseg_ti.types import NONE, SurfaceKind

CAP = 4.0
"""Distances beyond this many noises count as this many."""
TURN = 0.5
"""The normal of a point is that of the ball it lies on within this angle [rad]."""
EDGE = 2.0
"""Edge points are this near an edge [spacings]."""

# Samples of a patch that tell its side, and of a strip that tell what it lies between.
_SIDE, _STRIP = 200, 100
# So many of its samples lie on a ball between two surfaces (or this share of all its points, where
# these are few), and of those between the lines of contact this share.
_LOCAL, _BETWEEN, _MOSTLY = 8, 0.3, 0.5
# Radii that are tried: from the least [spacings] up to so many limits.
_LEAST, _MOST = 1.0, 1.35
_RATIO = 1.3  # each larger by this ratio: a strip is only to be recognised
_WIDE = 3.0  # a fillet reaches no farther from its edge than so many radii
_COARSE = 0.4  # while radii are tried, distances beyond so many spacings count as this many


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
    strips: np.ndarray
    """Pair and patch of every strip, as one number, ascending."""
    width: int
    """Labels are below this."""
    contact: np.ndarray
    """Leaves where both patches of every pair are near, shape (P,)."""

    def holds(self, pair: np.ndarray, label: np.ndarray) -> np.ndarray:
        """Say which points are of the sides of an edge."""
        return (label == self.pairs[:, 0][pair]) | (label == self.pairs[:, 1][pair])

    def allows(self, pair: np.ndarray, label: np.ndarray) -> np.ndarray:
        """Say which points may lie on an edge: those of its sides, its strips, of no patch."""
        allowed = self.holds(pair, label) | (label < 0)
        if len(self.strips):
            other = np.flatnonzero(~allowed)
            key = pair[other] * self.width + label[other]
            hit = np.minimum(np.searchsorted(self.strips, key), len(self.strips) - 1)
            allowed[other] = self.strips[hit] == key
        return allowed


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
        *,
        noise: float,
        spacing: float,
        limit: float,
    ) -> None:
        """Take what the search begins with.

        Args:
            points: Sorted positions relative to the corner of the grid [mm], shape (n, 3), f64
                (kernel array).
            normals: Their unit normals, shape (n, 3), f64 (kernel array).
            leaves: The leaves.
            label: Patch of every point, -1 = none, shape (n,), i32.
            surface: Surface of every patch, -1 = none, shape (K,), i32.
            surfaces: The surfaces.
            noise: Deviation of a point from its surface [mm].
            spacing: The larger of the two point spacings [mm].
            limit: Largest radius of a fillet [mm].
        """
        self.device = points, normals
        self.points, self.normals = runtime.download(points), runtime.download(normals)
        self.leaves, self.label = leaves, label
        self.noise, self.spacing, self.limit = noise, spacing, limit
        self.count = len(surface)
        self.analytic = surface >= 0
        self.members = members_of(label, self.count)
        self.size = np.array([len(m) for m in self.members], np.int64)
        which = np.maximum(surface, 0)
        self.table = np.zeros((self.count, 10))
        if len(surfaces):
            self.table[:, :8], self.table[:, 8] = surfaces.parameters[which], surfaces.kind[which]
        self.table[~self.analytic] = 0.0
        # The surfaces as they came; in the table they change when fillets are known.
        self.given = self.table.copy()
        self.set_sides()
        self.own = label_lists(leaves, label)
        self.near = near_lists(leaves, self.own)
        self.claim = np.full(len(label), NONE, np.int32)
        # Points on the balls of corners, which say nothing about the tubes that end there.
        self.held = np.zeros(len(label), bool)

    @cached_property
    def off(self) -> np.ndarray:
        """Distance of every point from the surface that its patch came with [mm], capped, (n,)."""
        own = np.append(np.where(self.analytic, np.arange(self.count), NONE), NONE)
        kind, parameters = self.given[:, 8], self.given[:, :8]
        far = distances_to_surfaces(
            self.device[0], own.astype(np.int32)[self.label], kind, parameters
        )
        return np.minimum(np.abs(far), CAP * self.noise)

    @cached_property
    def usual(self) -> float:
        """How far points are from the surfaces of their patches [mm]."""
        off = self.off[self.label >= 0]
        return float(np.sqrt(np.mean(off**2))) if len(off) else self.noise

    @cached_property
    def balls(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre and radius of a ball around the points of every leaf, shape (C, 3) and (C,)."""
        low, high = np.split(np.ascontiguousarray(self.leaves.box.T), 2)
        return 0.5 * (low + high).T, 0.5 * np.sqrt(np.square(high - low).sum(axis=0))

    def leaf_of(self, point: np.ndarray) -> np.ndarray:
        """Return the leaves that hold some points, shape (E,)."""
        leaf: np.ndarray = np.searchsorted(self.leaves.first, point, side="right") - 1
        return leaf

    def set_sides(self) -> None:
        """Say for every surface on which side the air is."""
        index, owner = listed([spread(m, _SIDE) for m in self.members])
        points, normals = np.take(self.points, index, axis=0), np.take(self.normals, index, axis=0)
        _, outward = evaluate_surfaces(points, owner, self.table[:, 8], self.table[:, :8])
        cosine = np.nan_to_num(np.einsum("ij,ij->i", outward, normals))
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
        self,
        task: np.ndarray,
        shape: np.ndarray,
        entry: np.ndarray,
        cap: float,
        limit: np.ndarray | None = None,
    ) -> np.ndarray:
        """Sum up how profiles fit."""
        return sums(self.device[0], self.table, task, shape, entry, cap, limit)

    def reach(self, wide: np.ndarray | float = np.inf) -> Any:
        """Return how far from the sharp edge a fillet can reach [mm].

        Args:
            wide: Tangent of half the angle by which it turns; by default any.
        """
        return _MOST * self.limit * np.minimum(wide, _WIDE) + EDGE * self.spacing

    def absorbed(self) -> float:
        """Return how wide a piece of a fillet may pass as a part of the surface beside it [mm]."""
        return float(np.sqrt(2.0 * CAP * self.noise * self.limit)) + 1.5 * self.spacing

    def ball_radii(self) -> np.ndarray:
        """Return the radius of the ball that touches every patch along a line [mm], shape (K,).

        That of a cylinder, of a sphere, of the tube of a torus; infinite for other surfaces.
        """
        kind = np.where(self.analytic, self.table[:, 8], int(SurfaceKind.FREE_FORM))
        radius = np.full(self.count, np.inf)
        ball = (kind == int(SurfaceKind.CYLINDER)) | (kind == int(SurfaceKind.SPHERE))
        ring = kind == int(SurfaceKind.TORUS)
        radius[ball], radius[ring] = self.table[ball, 6], self.table[ring, 7]
        return radius

    def radii(self, ratio: float) -> np.ndarray:
        """Return the radii that are tried, each larger than the last by this ratio."""
        least = _LEAST * self.spacing
        steps = int(np.ceil(np.log(max(_MOST * self.limit / least, 1.1)) / np.log(ratio))) + 1
        return least * ratio ** np.arange(steps)

    def coarse(self) -> float:
        """Return the distance beyond which points count alike while radii are tried [mm]."""
        return max(CAP * self.noise, _COARSE * self.spacing)

    def tried(
        self, task: np.ndarray, radii: np.ndarray, hollow: np.ndarray, point: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the cost of every radius for every task, and the points on its ball."""
        cap = self.coarse()
        got = self.sums(task, _shapes(radii, hollow), point, cap)
        return got[..., 0] / cap**2, got[..., 3]

    def best(
        self, task: np.ndarray, radii: np.ndarray, hollow: np.ndarray, point: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the radius of least cost for every task, and by how much that is below no radius.

        The gain is in squares of the noise; where that is 0 or less the radius may be any.
        """
        if len(task) == 0 or len(radii) == 0:
            return np.zeros(len(task)), np.zeros(len(task))
        cap = self.coarse()
        sharp = self.sums(task, _shapes(np.zeros(1), hollow), point, cap)[:, 0, 0]
        cost = self.sums(task, _shapes(radii, hollow), point, cap, sharp)[..., 0]
        gain = (sharp - cost.min(axis=1)) / self.noise**2
        return radii[cost.argmin(axis=1)], gain


def _shapes(radii: np.ndarray, hollow: np.ndarray) -> np.ndarray:
    """Return all radii for every task, each with the sign of that, as `profiles.sums` takes it."""
    shapes = np.empty((len(hollow), len(radii), 2))
    shapes[..., 0], shapes[..., 1] = radii, hollow[:, None]
    return shapes


def listed(sets: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the members of all sets, and the set of each."""
    owner = np.repeat(np.arange(len(sets)), [len(s) for s in sets])
    return (np.concatenate(sets) if sets else np.zeros(0, np.int64)), owner


def starts_of(owner: np.ndarray, count: int) -> np.ndarray:
    """Return the first entry of each of so many owners, which ascend, and the end, (count + 1,)."""
    return np.searchsorted(owner, np.arange(count + 1))


def tasks(pairs: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return both surfaces of every pair and the range of its entries, shape (P, 4)."""
    return np.column_stack([pairs, start[:-1], start[1:]])


def thinned(start: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which entries to keep so that every pair keeps at most about so many, evenly.

    Args:
        start: First entry of every pair, and the end, shape (P + 1,).
        most: Entries of a pair.

    Returns:
        The entries, ascending, and the first of every pair among these, as ``start``.
    """
    total = np.diff(start)
    step = np.maximum(-(-total // most), 1)
    count = -(-total // step)
    ends = np.append(0, np.cumsum(count))
    kept = np.repeat(start[:-1] - step * ends[:-1], count)
    kept += np.repeat(step, count) * np.arange(ends[-1])
    return kept, ends


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

    A patch may be the strip of several edges, one after the other: for each of them only the
    points near it count.

    Args:
        search: What is known.
        touching: Pairs of patches that touch, each once.
    """
    both = np.concatenate([touching, touching[:, ::-1]])
    both = both[search.analytic[both[:, 1]]]
    patch, side = both[np.lexsort((both[:, 1], both[:, 0]))].T
    # Every two neighbours of a patch.
    here = np.arange(len(patch))
    others = np.searchsorted(patch, patch, side="right") - here - 1
    i, j = np.repeat(here, others), ranges(here + 1, others)
    triple = np.column_stack([patch[i], side[i], side[j]])
    if len(triple) == 0:
        return triple
    sample, of = listed([spread(m, _STRIP) for m in search.members])
    start = starts_of(of, search.count)
    each = np.diff(start)[triple[:, 0]]
    entry, owner = sample[ranges(start[triple[:, 0]], each)], np.repeat(np.arange(len(each)), each)
    at = search.place(triple[:, 1:], np.zeros(len(triple)), entry, owner)
    inside = at.along <= search.reach(at.spread)
    height = np.bincount(owner, inside * np.sign(at.height), len(triple))
    fewest = np.minimum(_LOCAL, _BETWEEN * search.size[triple[:, 0]])
    kept = np.bincount(owner, inside, len(triple)) >= fewest
    inside &= kept[owner]
    entry, owner = entry[inside], (np.cumsum(kept) - 1)[owner[inside]]
    triple, fewest = triple[kept], fewest[kept]
    hollow = np.where(height[kept] < 0.0, -1.0, 1.0)
    if len(triple) == 0:
        return triple
    radii = search.radii(_RATIO)
    cost, on = search.tried(
        tasks(triple[:, 1:], starts_of(owner, len(triple))), radii, hollow, entry
    )
    best = (on - cost).argmax(axis=1)
    at = search.place(triple[:, 1:], hollow * radii[best], entry, owner)
    between = np.bincount(owner, at.region == BALL, len(triple))
    on = on[np.arange(len(triple)), best]
    return triple[(on >= fewest) & (on >= _MOSTLY * between)]


def find_zones(search: Search, strips: np.ndarray | None = None) -> Zones:
    """Return the pairs of patches that may share an edge, and where.

    Args:
        search: What is known.
        strips: Patches known to lie between two others, and these, shape (S, 3).
    """
    pairs, leaf = pairs_near(search.near)
    width, cells = search.count + 1, len(search.leaves)
    code = pairs[:, 0].astype(np.int64) * width + pairs[:, 1]
    touching = distinct(code)
    triple = strips_between(search, np.column_stack([touching // width, touching % width]))
    if strips is not None:
        triple = np.unique(np.concatenate([triple, strips]), axis=0)
    between, along = leaves_between(search, triple)
    # Large leaves are far inside a patch: their points say nothing about its edges.
    size = search.leaves.size
    small = size <= max(2.0 * size.min(), search.absorbed())
    real = search.analytic[pairs[:, 0]] & search.analytic[pairs[:, 1]]
    met = code[real]
    key = np.concatenate(
        [
            met * cells + leaf[real],
            (triple[between, 1] * width + triple[between, 2]) * cells + along,
        ]
    )
    key = distinct(key)
    part = key // cells
    new = np.ones(len(part), bool)
    new[1:] = part[1:] != part[:-1]
    code, which = part[new], np.cumsum(new) - 1
    pairs = np.column_stack([code // width, code % width])
    fine = small[key % cells]
    fine |= (np.bincount(which, fine, len(code)) == 0)[which]
    between = np.searchsorted(code, triple[:, 1] * width + triple[:, 2])
    strips = distinct(between * width + triple[:, 0])
    met = np.bincount(np.searchsorted(code, met), minlength=len(code))
    return Zones(pairs, which, key % cells, fine, strips, width, met)


def leaves_between(search: Search, triple: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the leaves of strips near the edges they lie on, and the triple of each."""
    if len(triple) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    cell, rank = np.nonzero(search.own >= 0)
    name = search.own[cell, rank]
    order = np.argsort(name, kind="stable")
    cell, first = cell[order], np.searchsorted(name[order], np.arange(search.count + 1))
    each = (first[1:] - first[:-1])[triple[:, 0]]
    leaf, owner = cell[ranges(first[triple[:, 0]], each)], np.repeat(np.arange(len(triple)), each)
    middle, wide = search.balls
    # How far fillets reach at most: the nearer ones are picked where points are placed.
    near = search.near_edge(
        triple[:, 1:], np.zeros(len(triple)), middle, leaf, owner,
        search.reach() + wide[leaf],
    )  # fmt: skip
    return owner[near], leaf[near]


def points_of(search: Search, zones: Zones, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points that may lie on the edges of some pairs, and the pair of each."""
    kept = which[zones.pair] & zones.fine
    leaf, pair = zones.leaf[kept], zones.pair[kept]
    count = search.leaves.count[leaf]
    point, pair = ranges(search.leaves.first[leaf], count), np.repeat(pair, count)
    kept = zones.allows(pair, search.label[point]) & ~search.held[point]
    return point[kept], pair[kept]
