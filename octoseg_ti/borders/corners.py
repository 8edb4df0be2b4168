"""Corners: where fillets of one ball meet, it touches all three sides.

What the ball leaves there is a triangle of a sphere, often of a hundred points. Next to the tubes
noise hides what such a patch is: with the ends of the tubes it passes as a cone, whose borders then
look sharp. But the sides and the radius of the fillets tell where the ball is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoseg_ti.borders.fillets import EVEN, FEWEST, FOREIGN, ON, WORSE, Fit
from octoseg_ti.borders.zones import EDGE, TURN, Search, Zones, listed
from octoseg_ti.device.surfaces import evaluate_surfaces
from octoseg_ti.stages.leaves import ranges
from octoseg_ti.stages.profiles import BALL
from octoseg_ti.stages.sets import spread
from octoseg_ti.types import EdgeClass

# Radii may be of one ball if they differ by this share, or by so many deviations.
_SAME, _DEVIATIONS = 0.15, 3.0
# The centre is looked for from so many points of each fillet, of so many, near the third side.
_STARTS, _SOME = 3, 200
_STEPS = 8
_CLOSE = 1e-4  # a centre is found when so near its distances [mm]
_FLAT = 0.05  # least volume that the normals of the sides span
_NEAR = 0.5  # what is so many radii from the ball, in front of or behind it, is something else
_MOSTLY = 0.5  # so large a share of what is near lies on the ball
_SAMPLE = 300
_EXPLAINED = 0.8  # a patch is part of corners when so much of it lies on their balls and tubes


class Corners(NamedTuple):
    """Balls that touch three sides, ``M`` of them, and the points on them."""

    sides: np.ndarray
    """The patches, ascending, shape (M, 3)."""
    centre: np.ndarray
    """Centre [mm], shape (M, 3)."""
    radius: np.ndarray
    """Radius [mm], above 0 = concave, shape (M,)."""
    toward: np.ndarray
    """Unit vectors from the centre to the contacts, shape (M, 3, 3), one a row."""
    point: np.ndarray
    """Sorted points on the balls, between the contacts, shape (E,)."""
    corner: np.ndarray
    """The corner of each, ascending, shape (E,)."""


class Parts(NamedTuple):
    """Patches that fillets and corners explain: they are no surfaces of their own."""

    patch: np.ndarray
    """Which patches, shape (K,), bool."""
    strip: np.ndarray
    """Those that lie on tubes too, and the sides of these, shape (S, 3)."""
    smooth: np.ndarray
    """Pairs of patches of which one is such a patch, and the other joins it smoothly, (P,) bool."""


def find_corners(search: Search, zones: Zones, fit: Fit, chosen: np.ndarray) -> Corners:
    """Find the corners between fillets.

    Args:
        search: What is known.
        zones: The pairs of patches.
        fit: The balls of all pairs.
        chosen: Which pairs are fillets, shape (P,), bool.
    """
    meeting = fillets_that_meet(zones.pairs, fit, chosen)
    if len(meeting) == 0:
        none = np.zeros(0, np.int64)
        return Corners(
            np.zeros((0, 3), np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3, 3)), none,
            none,
        )  # fmt: skip
    sides = np.sort(zones.pairs[meeting].reshape(-1, 4), axis=1)
    # Of four names one is there twice.
    twice = np.argmax(sides[:, 1:] == sides[:, :-1], axis=1)[:, None]
    sides = sides[np.arange(4) != twice].reshape(-1, 3)
    weight = 1.0 / np.maximum(fit.deviation[meeting], 1e-9) ** 2
    radius = (weight * fit.radius[meeting]).sum(axis=1) / weight.sum(axis=1)
    index, owner = _starts(search, meeting, sides, zones.pairs)
    found = _touching(search, search.points[index], sides[owner], radius[owner])
    return _supported(search, found)


def fillets_that_meet(pairs: np.ndarray, fit: Fit, chosen: np.ndarray) -> np.ndarray:
    """Return the pairs of fillets that share one side and may be of one ball, shape (M, 2)."""
    fillets = np.flatnonzero(chosen)
    if len(fillets) < 2:
        return np.zeros((0, 2), np.int64)
    i, j = (fillets[k] for k in np.triu_indices(len(fillets), 1))
    shared = (pairs[i][:, :, None] == pairs[j][:, None, :]).sum(axis=(1, 2)) == 1
    i, j = i[shared], j[shared]
    apart = np.abs(fit.radius[i] - fit.radius[j])
    size = np.minimum(np.abs(fit.radius[i]), np.abs(fit.radius[j]))
    loose = _DEVIATIONS * np.hypot(fit.deviation[i], fit.deviation[j])
    same = (fit.radius[i] * fit.radius[j] > 0.0) & (apart <= np.maximum(_SAME * size, loose))
    return np.column_stack([i[same], j[same]])


def _starts(
    search: Search, meeting: np.ndarray, sides: np.ndarray, pairs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return points on both fillets near the third side, and which entry each is for."""
    claimed = np.flatnonzero(search.claim >= 0)
    claimed = claimed[np.argsort(search.claim[claimed], kind="stable")]
    name = search.claim[claimed]
    first, last = np.searchsorted(name, meeting), np.searchsorted(name, meeting, "right")
    index, of = listed(
        [spread(claimed[a:b], _SOME) for a, b in zip(first.ravel(), last.ravel(), strict=True)]
    )
    third = sides.sum(axis=1)[:, None] - pairs[meeting].sum(axis=2)
    far, _ = _heights(search, search.points[index], third.ravel()[of])
    order = np.lexsort((np.abs(far), of))
    kept = np.arange(len(of)) - np.searchsorted(of, of) < _STARTS
    return index[order[kept]], of[order[kept]] // 2


def _heights(search: Search, point: np.ndarray, patch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return heights above surfaces, on the side of the air, and the normals there."""
    kind, parameters = search.table[:, 8].astype(np.int32), search.table[:, :8]
    far, normal = evaluate_surfaces(point, patch, kind, parameters)
    side = search.table[patch, 9]
    return side * far, side[:, None] * normal


def _touching(search: Search, start: np.ndarray, sides: np.ndarray, radius: np.ndarray) -> Corners:
    """Return the balls that touch three sides, each once."""
    centre, many = start.copy(), len(start)
    none = np.zeros(0, np.int64)
    for step in range(_STEPS + 1):
        high, normal = _heights(search, np.repeat(centre, 3, axis=0), sides.ravel())
        high, normal = radius[:, None] - high.reshape(many, 3), normal.reshape(many, 3, 3)
        steep = np.abs(np.linalg.det(normal)) > _FLAT
        if step < _STEPS and steep.any():
            centre[steep] += np.linalg.solve(normal[steep], high[steep, :, None])[..., 0]
    good = np.flatnonzero(steep & (np.abs(high).max(axis=1, initial=0.0) < _CLOSE))
    kept: list[int] = []
    alike: dict[tuple[int, ...], list[int]] = {}
    for k in good.tolist():
        same = alike.setdefault((*sides[k].tolist(), int(radius[k] > 0.0)), [])
        if all(np.linalg.norm(centre[j] - centre[k]) > abs(radius[k]) for j in same):
            same.append(k)
            kept.append(k)
    toward = -np.sign(radius[kept])[:, None, None] * normal[kept]
    return Corners(sides[kept], centre[kept], radius[kept], toward, none, none)


class _Around:
    """Finds the points around places, of which there are few."""

    def __init__(self, search: Search) -> None:
        """Sort the boxes of the leaves along one axis."""
        self.leaves = search.leaves
        self.order = np.argsort(search.leaves.box[:, 0], kind="stable")
        self.box = search.leaves.box[self.order]
        self.wide = float((self.box[:, 3] - self.box[:, 0]).max(initial=0.0))

    def points(self, place: np.ndarray, reach: float) -> np.ndarray:
        """Return the points of the leaves within reach of a place."""
        first = np.searchsorted(self.box[:, 0], place[0] - reach - self.wide)
        last = np.searchsorted(self.box[:, 0], place[0] + reach, side="right")
        box = self.box[first:last]
        gap = np.maximum(np.maximum(box[:, :3] - place, place - box[:, 3:]), 0.0)
        leaf = np.sort(self.order[first:last][np.einsum("ij,ij->i", gap, gap) <= reach**2])
        return ranges(self.leaves.first[leaf], self.leaves.count[leaf])


def _supported(search: Search, found: Corners) -> Corners:
    """Return the corners that points lie on, with these."""
    around, noise = _Around(search), search.noise
    points, kept = [np.zeros(0, np.int64)], []
    for k, (sides, centre, radius, toward) in enumerate(zip(*found[:4], strict=True)):
        size = abs(radius)
        front = max(_NEAR * size, ON * noise)
        point = around.points(centre, size + front)
        away = search.points[point] - centre
        far = np.linalg.norm(away, axis=1)
        off = np.abs(far - size)
        cosine = -np.sign(radius) * np.einsum("ij,ij->i", search.normals[point], away)
        cosine /= np.maximum(far, 1e-12)
        # No product of matrices: its sums may depend on the threads.
        share = np.einsum("ij,jk->ik", away, np.linalg.inv(toward))
        near = (share >= 0.0).all(axis=1) & (cosine > 0.0)
        near &= off <= front
        on = near & (off <= ON * noise) & (cosine >= np.cos(TURN))
        total, point, off = np.count_nonzero(near), point[on], off[on]
        if len(point) < max(FEWEST, _MOSTLY * total):
            continue
        # What the surface of a patch explains better is none of the ball.
        names, of = np.unique(search.label[point], return_inverse=True)
        number = np.bincount(of)
        ball, own = np.bincount(of, off**2), np.bincount(of, search.off[point] ** 2)
        side = np.isin(names, sides)
        better = ball <= WORSE**2 * own + (EVEN * noise) ** 2 * number
        spared, wrong = number[better & ~side].sum(), number[~better & ~side].sum()
        if wrong <= max(spared, FOREIGN * number[side].sum()):
            kept.append(k)
            points.append(point[(better | side)[of]])
    point, corner = listed(points[1:])
    return Corners(
        found.sides[kept], found.centre[kept], found.radius[kept], found.toward[kept], point, corner
    )


def parts_of(search: Search, zones: Zones, corners: Corners, strip_of: np.ndarray) -> Parts:
    """Return the patches that corners and the fillets that meet there explain.

    Args:
        search: What is known.
        zones: The pairs of patches.
        corners: The corners.
        strip_of: Sides of the fillet that every patch is a strip of, -1 = none, shape (K, 2).
    """
    count = search.count
    if len(corners.sides) == 0:
        return Parts(
            np.zeros(count, bool), np.zeros((0, 3), np.int64), np.zeros(len(zones.pairs), bool)
        )
    strips = [np.zeros((0, 3), np.int64)]
    on = np.zeros(len(search.label), bool)
    on[corners.point] = True
    table = np.zeros((len(corners.sides), count + 1), np.int64)
    np.add.at(table, (corners.corner, search.label[corners.point]), 1)
    of, patch = np.nonzero(table[:, :-1] >= FEWEST)
    free = ~(corners.sides[of] == patch[:, None]).any(axis=1)
    of, patch = of[free], patch[free]
    sample, owner = listed([spread(search.members[p], _SAMPLE) for p in patch])
    explained, tube = on[sample], np.zeros((len(sample), 3), bool)
    for k, two in enumerate(([0, 1], [0, 2], [1, 2])):
        at = search.place(corners.sides[of][:, two], corners.radius[of], sample, owner)
        tube[:, k] = (at.region == BALL) & (np.abs(at.off) <= ON * search.noise)
        tube[:, k] &= (at.cosine >= np.cos(TURN)) & ~on[sample]
    # A patch may lie between two corners.
    explained |= tube.any(axis=1)
    share = np.zeros(len(search.label), bool)
    share[sample[explained]] = True
    many = np.maximum(np.bincount(owner, minlength=len(patch)), 1)
    mine = np.bincount(owner, share[sample], len(patch)) >= _EXPLAINED * many
    parts = np.zeros(count, bool)
    parts[patch[mine]] = True
    tubes = np.stack([np.bincount(owner, tube[:, k], len(patch)) for k in range(3)], axis=1)
    of, patch, tubes = of[mine], patch[mine], tubes[mine]
    for k, two in enumerate(([0, 1], [0, 2], [1, 2])):
        there = tubes[:, k] >= FEWEST
        strips.append(np.column_stack([patch[there], corners.sides[of[there]][:, two]]))
    # A patch of a corner joins its sides smoothly, its other patches and the tubes.
    pairs = zones.pairs
    joined = np.zeros(len(pairs), bool)
    for corner in np.unique(of):
        around = np.zeros(count, bool)
        around[corners.sides[corner]] = True
        tubes_here = (strip_of[:, 0] >= 0) & around[strip_of].all(axis=1)
        here = np.zeros(count, bool)
        here[patch[of == corner]] = True
        around |= tubes_here | here
        joined |= (here[pairs[:, 0]] & around[pairs[:, 1]]) | (
            here[pairs[:, 1]] & around[pairs[:, 0]]
        )
    return Parts(parts, np.unique(np.concatenate(strips), axis=0), joined)


def mark_corners(search: Search, corners: Corners, edge: np.ndarray) -> None:
    """Mark the points of corners, and those of their sides beside them, as fillets, in place."""
    if len(corners.radius) == 0:
        return
    reach = EDGE * search.spacing
    touch = corners.centre[:, None] + np.abs(corners.radius)[:, None, None] * corners.toward
    around = _Around(search)
    for side, place in zip(corners.sides.ravel(), touch.reshape(-1, 3), strict=True):
        point = around.points(place, reach)
        point = point[search.label[point] == side]
        far = np.linalg.norm(search.points[point] - place, axis=1)
        edge[point[far <= reach]] = int(EdgeClass.FILLET)
    edge[corners.point] = int(EdgeClass.FILLET)
