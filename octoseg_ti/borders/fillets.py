"""Fillets: balls that explain the points around an edge which neither side explains.

A ball that rolls along both sides of an edge is fitted to the points around it; its radius is the
only unknown. Balls that gain on the sharp edge are fillets, the best supported first: each claims
the points on it, and what is left has to support the next.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoseg_ti.borders.zones import (
    CAP,
    TURN,
    Search,
    Zones,
    listed,
    points_of,
    starts_of,
    tasks,
    thinned,
)
from octoseg_ti.stages.leaves import Samples
from octoseg_ti.stages.marking import marked_near
from octoseg_ti.stages.profiles import BALL
from octoseg_ti.stages.sets import fit_sets, spread
from octoseg_ti.types import NONE, SurfaceKind

ON = 3.5
"""A point lies on a ball within so many noises."""
WEAK = 2.0
"""A point so many noises from a surface may lie on that."""
SLACK = 1.05
"""The radius of a fillet may be above the limit by so much: it is not known exactly."""

FEWEST = 8
"""A fillet, a corner have so many points."""
WORSE, EVEN = 1.2, 0.3
"""Points on a ball are no farther from it than from the surfaces of their patches, times the first,
plus the second in noises."""
FOREIGN = 0.25
"""Beside the points of its sides, so large a share may be of patches that explain them better."""

# Points of the zone of an edge that are looked at, that the radius is fitted to, and that radii are
# tried on; each of these is larger than the last by the ratio.
_MANY, _SOME, _FEW = 3000, 600, 150
_RATIO = 1.15
# Where none explains enough, every fourth radius is tried again on more points; one that
# gains so many squares of the noise is fitted.
_SKIP, _SURE = 4, 4.0
_HOPE = 0.03  # share of the points that a radius has to explain beyond a sharp edge, to go on
_NEWTON = 6
# A fillet gains at least this much over a sharp edge: in all, in squares of the noise; and for each
# point on it, in squares of how far points are from their surfaces, if this share of the noise and
# more: more than errors of the sides do, but no more than this share of what a ball of its radius
# gains where the edge is shallow.
_GAIN, _EACH, _SCATTER, _EXPECTED = 40.0, (0.1, 0.25), 0.5, 0.5
_STEEP = 2.5  # turns beyond this [rad] count as this one
_ARC = 1.5  # a fillet is at least this wide [spacings]
_SHARED = 2.0  # neighbours share some of their noise, and the sides are not known exactly
# Where a ball explains all points they are no farther from it than points are from the surfaces of
# their patches, times this.
_ALIKE = 1.4
_FITS = 0.5  # so much of the weight of the support of a ball is left, if it lies on another fillet
_FRESH = 0.5  # ... and this share of its points is on no better one
_STRIP_SHARE = 0.5  # a patch is the strip of a fillet when so much of it is claimed
_REFIT = 300
_SMOOTH = 0.09  # surfaces that meet at a smaller angle [rad] meet smoothly, if one is curved


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
    large: np.ndarray
    """Whether there is a ball that is too large for a fillet, which explains all points."""


class Around(NamedTuple):
    """The points around the edges of all pairs, in the order of these."""

    point: np.ndarray
    """Some of the points, evenly, shape (E,)."""
    start: np.ndarray
    """First entry of every pair, and E at the end, shape (P + 1,)."""
    every: np.ndarray
    """About how many points there are, shape (P,)."""
    hollow: np.ndarray
    """1 where the edge is concave, -1 where it is convex."""
    turn: np.ndarray
    """Mean angle by which the surface turns over the edge [rad]."""

    def thinned(self, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Return at most about so many points for every pair, and the first of each pair."""
        kept, start = thinned(self.start, most)
        return self.point[kept], start


def look_around(search: Search, zones: Zones) -> Around:
    """Return the points around the edge of every pair."""
    pairs = len(zones.pairs)
    point, pair = points_of(search, zones, np.ones(pairs, bool))
    whole = starts_of(pair, pairs)
    kept, start = thinned(whole, _MANY)
    point, pair = point[kept], pair[kept]
    share = np.diff(start) / np.maximum(np.diff(whole), 1)
    at = search.place(zones.pairs, np.zeros(pairs), point, pair)
    near = np.flatnonzero(at.along <= search.reach(at.spread))
    point, pair = point[near], pair[near]
    start = starts_of(pair, pairs)
    total = np.diff(start)
    height = np.bincount(pair, np.sign(at.height[near]), pairs)
    return Around(
        point=point,
        start=start,
        every=total / np.maximum(share, 1e-9),
        hollow=np.where(height < 0.0, -1.0, 1.0),
        turn=np.bincount(pair, at.turn[near], pairs) / np.maximum(total, 1),
    )


def guess_radii(search: Search, zones: Zones, around: Around) -> tuple[np.ndarray, np.ndarray]:
    """Return about which radius every edge has, and whether it may have one, (P,) f64 and bool."""
    radii = search.radii(_RATIO)
    point, start = around.thinned(_FEW)
    task = tasks(zones.pairs, start)
    radius, gain = search.best(task, radii, around.hollow, point)
    total = np.diff(start)
    hope = gain > np.maximum(_HOPE * total, 1.0)
    # What the noise of few points hides may show among more.
    unsure = ~hope & (total >= FEWEST) & ~smooth_pairs(search, zones.pairs, around.turn)
    again = np.flatnonzero(unsure)
    point, start = around.thinned(_SOME)
    task, some = tasks(zones.pairs, start)[again], radii[_SKIP - 1 :: _SKIP]
    radius[again], gain = search.best(task, some, around.hollow[again], point)
    hope[again] = gain > _SURE
    return np.maximum(radius, 0.5 * search.spacing), hope


def fit_balls(
    search: Search,
    zones: Zones,
    around: Around,
    guess: tuple[np.ndarray, np.ndarray],
    *,
    last: bool,
) -> Fit:
    """Fit a ball to the points around the edge of every pair; to more of them at ``last``."""
    pairs, noise = len(zones.pairs), search.noise
    radius, hope = guess[0].copy(), guess[1]
    if not hope.any():
        none = np.zeros(pairs)
        return Fit(
            radius=radius * around.hollow, deviation=none, hollow=around.hollow, turn=around.turn,
            points=np.diff(around.start), good=none > 0.0, large=none > 0.0,
        )  # fmt: skip
    point, start = around.thinned(_SOME)
    task = tasks(zones.pairs, start)
    shape = np.stack([radius, around.hollow], axis=1)[hope]
    cap = CAP * noise
    # From the tolerance that radii were tried with down to that of the noise: where this is small
    # no point lies within it of a ball whose radius is only about right.
    tolerances = np.append(np.geomspace(search.coarse(), cap, _NEWTON - 2), cap)
    for turn, wide in enumerate(tolerances):
        if last and turn == len(tolerances) - 1:
            point, task = around.point, tasks(zones.pairs, around.start)
        now = search.sums(task[hope], shape[:, None], point, wide)[:, 0]
        step = -now[:, 1] / np.maximum(now[:, 2], 1e-12)
        least = 0.2 * shape[:, 0]
        shape[:, 0] = np.clip(shape[:, 0] + np.clip(step, -least, least), 0.02, 2.0 * search.limit)
    now, none = np.zeros((pairs, 4)), np.zeros((pairs, 4))
    both = np.stack([shape, shape * [0.0, 1.0]], axis=1)
    now[hope], none[hope] = search.sums(task[hope], both, point, cap).swapaxes(0, 1)
    radius[hope] = shape[:, 0]
    total = np.maximum(task[:, 3] - task[:, 2], 1)
    gain = (none[:, 0] - now[:, 0]) / noise**2
    # The mean square of the distances from a ball to the sharp edge within it.
    wide = radius * (1.0 / np.cos(np.minimum(around.turn, _STEEP) / 2.0) - 1.0)
    scatter = float(np.clip(search.usual, _SCATTER * noise, noise))
    each = np.clip(_EXPECTED * wide**2 / (5.0 * scatter**2), *_EACH)
    rms = np.sqrt(now[:, 0] / total)
    rounded = hope & (
        (gain * around.every >= _GAIN * total)
        & (gain * noise**2 >= each * scatter**2 * now[:, 3])
        & (radius * around.turn >= _ARC * search.spacing)
        & (now[:, 3] >= FEWEST)
    )
    small = radius <= SLACK * search.limit
    return Fit(
        radius=radius * around.hollow,
        deviation=_SHARED * np.maximum(rms, 0.3 * noise) / np.sqrt(np.maximum(now[:, 2], 1e-12)),
        hollow=around.hollow,
        turn=around.turn,
        points=np.diff(around.start),
        good=rounded & small,
        large=rounded & ~small & (rms <= _ALIKE * search.usual),
    )


def claim_points(search: Search, zones: Zones, fit: Fit) -> np.ndarray:
    """Let balls claim the points on them, the best supported first; say which remain, (P,) bool."""
    search.claim[:] = NONE
    if not fit.good.any():
        return fit.good
    point, pair = points_of(search, zones, fit.good)
    at = search.place(zones.pairs, fit.radius, point, pair)
    on = (at.region == BALL) & (np.abs(at.off) <= ON * search.noise)
    on &= at.cosine >= np.cos(TURN)
    point, pair = point[on], pair[on]
    # What the surface of a patch explains better is no fillet: a chamfer, the next fillet.
    _, of = np.unique(
        pair.astype(np.int64) * (search.count + 1) + search.label[point], return_inverse=True
    )
    number = np.bincount(of)
    ball, own = np.bincount(of, at.off[on] ** 2), np.bincount(of, search.off[point] ** 2)
    better = ball <= WORSE**2 * own + (EVEN * search.noise) ** 2 * number
    side = zones.holds(pair, search.label[point])
    kept = better[of] | side
    pairs = len(zones.pairs)
    spared, wrong = kept & ~side, ~kept
    agree = np.bincount(pair, wrong, pairs) <= np.maximum(
        np.bincount(pair, spared, pairs), FOREIGN * np.bincount(pair, side, pairs)
    )
    point, pair = point[kept], pair[kept]
    ends = starts_of(pair, pairs)
    support = np.diff(ends)
    # A ball that explains its points as well as surfaces do theirs goes before one that does not.
    square = np.bincount(pair, at.off[on][kept] ** 2, pairs) / np.maximum(support, 1)
    quality = np.clip(2.0 - square / max(search.usual**2, 1e-12), 0.1, 1.0)
    chosen, taken = np.zeros(pairs, bool), np.zeros(search.count, np.int64)
    for p in np.argsort(-support * quality, kind="stable"):
        if support[p] < FEWEST or not agree[p]:
            continue
        # The strip of another fillet is a side only of a ball that fits as well as surfaces do.
        strip = taken[zones.pairs[p]] >= _STRIP_SHARE * search.size[zones.pairs[p]]
        if strip.any() and quality[p] < _FITS:
            continue
        mine = point[ends[p] : ends[p + 1]]
        fresh = mine[search.claim[mine] < 0]
        if len(fresh) < max(_FRESH * len(mine), FEWEST):
            continue
        search.claim[fresh] = p
        taken += np.bincount(search.label[fresh] + 1, minlength=search.count + 1)[1:]
        chosen[p] = True
    claimed = np.flatnonzero(search.claim >= 0)
    had = np.bincount(search.claim[claimed], minlength=pairs)
    claimed = drop_weak_claims(search, zones, fit, claimed)
    left = np.bincount(search.claim[claimed], minlength=pairs)
    # Of a fillet that is none nothing is left but what the noise moved off the sides.
    lost = left < np.maximum(_FRESH * had, FEWEST)
    search.claim[claimed[lost[search.claim[claimed]]]] = NONE
    return chosen & ~lost


def drop_weak_claims(search: Search, zones: Zones, fit: Fit, claimed: np.ndarray) -> np.ndarray:
    """Give back points that lie on a side of the fillet as well, unless others are next to them.

    Near the line of contact the ball is as good as the surface; beyond the end of a fillet both go
    on, and there nothing else lies on the ball.

    Args:
        search: What is known.
        zones: The pairs of patches.
        fit: The balls of all pairs.
        claimed: Points that are claimed, ascending, shape (E,).

    Returns:
        Those of them that stay claimed.
    """
    pair = search.claim[claimed]
    side = zones.holds(pair, search.label[claimed])
    # Where no point of the ball is far from the sides that tells nothing.
    deep = np.abs(fit.radius) * (1.0 - np.cos(fit.turn / 2.0)) >= (WEAK + 1.0) * search.noise
    weak = side & deep[pair] & (search.off[claimed] <= WEAK * search.noise)
    radius = np.abs(fit.radius[pair[weak]])
    search.claim[without_support(search, search.claim, claimed[weak], radius)] = NONE
    return claimed[search.claim[claimed] >= 0]


def without_support(
    search: Search, mark: np.ndarray, weak: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """Return which weak points have no other one with the same mark near them.

    Args:
        search: What is known.
        mark: Mark of every point, shape (n,), i32.
        weak: Points that may as well lie on the surface beside, shape (E,).
        radius: Radius of the fillet that each may lie on [mm], shape (E,).
    """
    strong = mark.copy()
    strong[weak] = NONE
    leaf = search.leaf_of(weak)
    reach = np.sqrt(2.0 * ON * search.noise * radius) + search.spacing
    near = marked_near(search.device[0], strong, search.leaves, weak, leaf, mark[weak], reach)
    return weak[~near]


def refit_sides(search: Search) -> None:
    """Fit the surfaces of patches anew without the points that fillets claim."""
    label = search.label[search.claim >= 0]
    claimed = np.bincount(label[label >= 0], minlength=search.count)
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


def strips_of(search: Search, number: np.ndarray) -> np.ndarray:
    """Return the fillet that every patch is a strip of, -1 = none, shape (K,), i32."""
    fillets = int(number.max(initial=NONE)) + 1
    if fillets == 0:
        return np.full(search.count, NONE, np.int32)
    there = np.flatnonzero(search.claim >= 0)
    there = there[search.label[there] >= 0]
    key = search.label[there].astype(np.int64) * fillets + number[search.claim[there]]
    table = np.bincount(key, minlength=search.count * fillets).reshape(search.count, -1)
    most = table.sum(axis=1) >= np.maximum(_STRIP_SHARE * search.size, 1)
    return np.where(most, table.argmax(axis=1), NONE).astype(np.int32)


def strip_pairs(search: Search, zones: Zones, chosen: np.ndarray) -> np.ndarray:
    """Return the sides of the fillet that every patch is a strip of, -1 = none, shape (K, 2)."""
    sides = np.append(zones.pairs[chosen], [[NONE, NONE]], axis=0)
    return sides[strips_of(search, numbers_of(chosen))]


def numbers_of(chosen: np.ndarray) -> np.ndarray:
    """Return the fillet that every pair is, -1 = none, and -1 for no pair, shape (P + 1,), i32."""
    number = np.full(len(chosen) + 1, NONE, np.int32)
    number[:-1][chosen] = np.arange(np.count_nonzero(chosen), dtype=np.int32)
    return number


def smooth_pairs(search: Search, pairs: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Say which pairs of surfaces meet without an angle, as far as their errors tell, (P,) bool."""
    # An error of place as large as the noise opens a tangent joint by this angle.
    radius = np.maximum(search.ball_radii()[pairs].min(axis=1), 1e-9)
    open_ = np.maximum(_SMOOTH, np.sqrt(4.0 * search.noise / radius))
    flat = (search.table[pairs, 8] == int(SurfaceKind.PLANE)).all(axis=1)
    return ~flat & (turn < open_)
