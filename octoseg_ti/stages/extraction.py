"""Analytic surfaces are found in sets of samples: one that explains all, or several one by one.

A set that one surface explains is done. Every other set is taken apart: surfaces through small
neighbourhoods of many samples are candidates; the one that explains most of what is left grows, as
long as fitting it anew lets it explain more (Besl and Jain 1988), and takes what it explains.
"""

from itertools import compress
from typing import NamedTuple

import numpy as np

from octoseg_ti.device.surfaces import evaluate_surfaces
from octoseg_ti.device.unionfind import components
from octoseg_ti.stages.leaves import Leaves, Samples
from octoseg_ti.stages.sets import (
    Surfaces,
    capped_rms,
    fit_sets,
    joined,
    lie_on,
    nearness,
    no_surfaces,
    spread,
)
from octoseg_ti.types import NONE, SurfaceKind

# A sample lies on a surface within this many noises.
_ON = 3.0
# A surface explains a set when this share of it lies on it.
_WHOLE = 0.85
# ... and for sure when it leaves no more than this many noises there.
_SURE = 0.9
# Samples for one fit of a set, and of a growing surface.
_MANY, _SOME = 200, 150
# Neighbourhoods of a seed, in samples; and one of less, down to this share of the smallest surface,
# where small ones count.
_NEAR, _LEAST_NEAR, _SHARE_NEAR = (20, 60, 150), 12, 0.6
# Samples of a set that tell how much a candidate explains.
_SCORED = 3000
# Seeds of a set, two for the smallest surface at least, and into how many looks they are divided:
# each looks at what is left.
_SEED_EVERY, _LEAST_SEEDS, _MOST_SEEDS, _LOOKS = 40, 8, 200, 2
# A surface grows until it gains less than this, at most so often.
_GAIN, _GROWTHS = 1.02, 4
_LEFT = 0.005
# Candidates that explain this share of what the best one does grow together with it, and are
# taken together when so much of them is left by the larger ones.
_TOGETHER, _KEPT = 0.5, 0.8
# Surfaces that a set was taken apart into are real when they explain so much of it, and leave no
# more than so many noises, fewer the less they explain and the more of it neighbours share: pieces
# of a free form are cut out as far as they just fit, and leave gaps and waves.
_COVERED, _REAL = 0.6, 1.75
# ... and, where positions are exact, when this share of them is nearer than so many noises: of
# noise that is half, of what is cut out as far as it just fits a sixth.
_EXACT, _MOSTLY = 0.5, 0.75
# ... or, whatever lies beside them, when so many times the smallest number of points are no farther
# from one than from other surfaces, but for the chance in so few, and its neighbours share nothing.
_CLEAR, _ALIKE, _SHARED = 2.0, 1.15, 0.2


class Tolerance(NamedTuple):
    """What counts as lying on a surface."""

    noise: float
    """Deviation of a point from its surface [mm]."""
    turn: float
    """Largest angle between the normals of a sample and of its surface [rad]."""
    points: float
    """Fewest points of a surface."""
    exact: bool = False
    """Positions are exact, next to their spacing: a surface that they lie on is real, whatever lies
    beside it."""
    scatter: float = 0.0
    """How far points are from the surfaces that were found so far [mm]; 0 = there are none."""


def explain(
    samples: Samples,
    leaves: Leaves,
    sets: list[np.ndarray],
    tolerance: Tolerance,
    *,
    apart: bool = True,
) -> tuple[Surfaces, np.ndarray]:
    """Find the surfaces that explain sets of samples.

    Args:
        samples: The samples.
        leaves: The leaves.
        sets: Samples that belong together, ascending, an array of indices for every set.
        tolerance: What counts as lying on a surface.
        apart: Take sets apart that no single surface explains.

    Returns:
        The surfaces, and the one that every sample lies on, -1 = none, shape (A,), i32.
    """
    label = np.full(len(samples), NONE, np.int32)
    noise = tolerance.noise
    if not sets:
        return no_surfaces(), label
    fitted, whole = fit_sets(samples, [spread(s, _MANY) for s in sets], noise, robust=True)
    turn = max(tolerance.turn, 0.5)
    on = lie_on(samples, sets, fitted, whole, (_ON + 0.5) * noise, turn)
    likely, sure = np.zeros(len(sets), bool), np.zeros(len(sets), bool)
    lying = [sets[s][there] for s, there in zip(fitted, on, strict=True)]
    left = capped_rms(samples, lying, np.arange(len(fitted)), whole, noise)
    for s, there, rms in zip(fitted, on, left, strict=True):
        weight = samples.weight[sets[s]]
        likely[s] = weight[there].sum() >= _WHOLE * weight.sum()
        sure[s] = likely[s] and rms <= _SURE * noise
    rest = list(compress(sets, ~sure)) if apart else []
    more, found = _take_apart(samples, leaves, rest, tolerance)
    # Where that gave nothing real, curved surfaces may have cut through facets.
    again = [s for s in rest if not np.any(found[s] >= 0)]
    if again:
        finer, there = _take_apart(samples, leaves, again, tolerance, flat=True)
        found = np.where(there >= 0, there + len(more), found)
        more = more.joined(finer)
    kept: list[int] = []
    for m, (s, there) in enumerate(zip(fitted, on, strict=True)):
        if likely[s] and not (len(more) and np.any(found[sets[s]] >= 0)):
            label[sets[s][there]] = len(kept)
            kept.append(m)
    label[found >= 0] = found[found >= 0] + len(kept)
    return whole.at(np.array(kept, np.int64)).joined(more), label


def _neighborhoods(point: np.ndarray, seeds: np.ndarray, count: int) -> np.ndarray:
    """Return the nearest points of every seed, ascending, shape (len(seeds), count)."""
    near = np.empty((len(seeds), count), np.int64)
    x, y, z = np.ascontiguousarray(point.T)
    for lo in range(0, len(seeds), 64):
        part = seeds[lo : lo + 64, None]
        # No product of matrices: its sums may depend on the threads.
        far = (x - x[part]) ** 2 + (y - y[part]) ** 2 + (z - z[part]) ** 2
        near[lo : lo + 64] = np.argpartition(far, count - 1, axis=1)[:, :count]
    return np.sort(near, axis=1)


class _Set:
    """A set that is taken apart: what is left of it, and its candidates."""

    def __init__(
        self, samples: Samples, leaves: Leaves, members: np.ndarray, fewest: float
    ) -> None:
        self.members = members
        self.weight = samples.weight[members]
        self.free = np.ones(len(members), bool)
        self.leaf, self.place = np.unique(samples.leaf[members], return_inverse=True)
        inside = np.full(len(leaves), NONE, np.int32)
        inside[self.leaf] = np.arange(len(self.leaf), dtype=np.int32)
        a, b = inside[leaves.a], inside[leaves.b]
        both = (a >= 0) & (b >= 0)
        self.a, self.b = a[both], b[both]
        self.total = np.bincount(self.place, weights=self.weight, minlength=len(self.leaf))
        self.seeds = int(
            np.clip(len(members) / min(_SEED_EVERY, fewest / 2.0), _LEAST_SEEDS, _MOST_SEEDS)
        )
        self.each = max(self.seeds // _LOOKS, _LEAST_SEEDS)
        least = int(max(_LEAST_NEAR, _SHARE_NEAR * fewest))
        self.near = (least, *_NEAR) if least < _NEAR[0] else _NEAR
        self.scored = np.zeros(0, np.int64)
        self.on = np.zeros((0, 0), np.float32)
        self.surfaces = no_surfaces()

    def neighborhoods(self, point: np.ndarray) -> list[np.ndarray]:
        """Return samples around some that are left, in several sizes."""
        left = self.members[self.free]
        seeds = spread(np.arange(len(left)), min(self.each, self.seeds))
        self.seeds -= self.each
        near: list[np.ndarray] = []
        for count in self.near:
            near += list(left[_neighborhoods(point[left], seeds, min(count, len(left)))])
            if count >= len(left):
                break
        return near

    def connected(self, on: np.ndarray) -> np.ndarray:
        """Return the largest connected part of some members, bool."""
        share = np.bincount(self.place, weights=on * self.weight, minlength=len(self.leaf))
        there = 2 * share >= self.total
        joined = there[self.a] & there[self.b]
        root = components(len(self.leaf), self.a[joined], self.b[joined])
        part = np.where(there, root, NONE)[self.place]
        part[~on] = NONE
        if not np.any(part >= 0):
            return np.zeros(len(on), bool)
        size = np.bincount(part[part >= 0], weights=self.weight[part >= 0])
        return part == int(np.argmax(size))

    def best(self, least: float) -> list[int]:
        """Return the candidates that explain most of what is left, each without the others."""
        weight = (self.weight * self.free)[self.scored]
        share = self.weight[self.free].sum() / max(weight.sum(), 1e-300)
        weight = (share * weight).astype(np.float32)
        chosen: list[int] = []
        while len(self.on):
            support = np.einsum("cs,s->c", self.on, weight)  # no BLAS: its sums depend on threads
            c = int(np.argmax(support))
            if support[c] < least:
                break
            if not chosen:
                least = max(least, _TOGETHER * float(support[c]))
            chosen.append(c)
            weight *= 1.0 - self.on[c]
        return chosen

    def take(self, part: np.ndarray) -> None:
        """Take away what a surface explains."""
        self.free &= ~part
        self.on[:, ~self.free[self.scored]] = 0.0

    def ended(self, least: float) -> bool:
        """Return whether too little is left for another surface."""
        left = self.weight[self.free].sum()
        return bool(left < max(_LEFT * self.weight.sum(), least))


def _find_candidates(samples: Samples, work: list[_Set], tolerance: Tolerance) -> None:
    """Give sets the surfaces through neighbourhoods of what is left of them for candidates."""
    groups = [w.neighborhoods(samples.point) for w in work]
    owner = np.repeat(np.arange(len(work)), [len(g) for g in groups])
    fitted, surfaces = fit_sets(samples, [near for g in groups for near in g], tolerance.noise)
    owner = owner[fitted]
    for w in work:
        w.scored = spread(np.flatnonzero(w.free), _SCORED)
    scored = [w.members[w.scored] for w in work]
    limit = _ON * tolerance.noise
    on = nearness(samples, scored, owner, surfaces, limit, tolerance.turn)
    for s, w in enumerate(work):
        mine = np.flatnonzero(owner == s)
        w.surfaces = surfaces.at(mine)
        w.on = np.array([on[c] for c in mine], np.float32).reshape(len(mine), len(w.scored))


def _take_apart(
    samples: Samples,
    leaves: Leaves,
    sets: list[np.ndarray],
    tolerance: Tolerance,
    *,
    flat: bool = False,
) -> tuple[Surfaces, np.ndarray]:
    """Find the surfaces, or just the planes, of sets that no single one explains."""
    label = np.full(len(samples), NONE, np.int32)
    found = no_surfaces()
    active = [_Set(samples, leaves, members, tolerance.points) for members in sets]
    while active:
        _find_candidates(samples, active, tolerance)
        if flat:
            for w in active:
                w.on[w.surfaces.kind != SurfaceKind.PLANE] = 0.0
        gained: dict[_Set, None] = {}
        going = active
        while going:
            wave = [(w, c) for w in going for c in w.best(tolerance.points)]
            start = [w.surfaces.at(np.array([c])) for w, c in wave]
            taken: dict[_Set, None] = {}
            again: dict[_Set, None] = {}
            for k, surface, part in _grow(samples, [w for w, _ in wave], start, tolerance):
                w, size = wave[k][0], wave[k][0].weight[part].sum()
                left = part & w.free
                if w.weight[left].sum() < max(_KEPT * size, tolerance.points):
                    continue
                again[w] = None
                if flat and surface.kind[0] != SurfaceKind.PLANE:
                    w.on[wave[k][1]] = 0.0
                    continue
                label[w.members[left]] = len(found)
                found = found.joined(surface)
                w.take(left)
                taken[w] = None
            going = [w for w in again if not w.ended(tolerance.points)]
            gained |= taken
        active = [w for w in gained if w.seeds > 0 and not w.ended(tolerance.points)]
    return _real_ones(samples, sets, found, label, tolerance)


def _real_ones(
    samples: Samples,
    sets: list[np.ndarray],
    found: Surfaces,
    label: np.ndarray,
    tolerance: Tolerance,
) -> tuple[Surfaces, np.ndarray]:
    """Drop the surfaces of sets that are free forms."""
    noise, most = tolerance.noise, len(found)
    real = np.zeros(len(found) + 1, bool)
    for members in sets:
        name, weight = label[members], samples.weight[members]
        on = name >= 0
        if not on.any():
            continue
        name, weight, total = name[on], weight[on], weight.sum()
        far, _ = evaluate_surfaces(samples.point[members[on]], name, found.kind, found.parameters)
        covered = weight.sum() / total
        rms = np.sqrt(np.average(far**2, weights=weight))
        pair = name[1:] == name[:-1]
        product, square = far[1:][pair] * far[:-1][pair], far[1:][pair] ** 2
        shared = max(0.0, float(product.sum()) / max(float(square.sum()), 1e-300))
        real[name] = covered >= _COVERED and (1.0 + shared) * rms <= covered * _REAL * noise
        size = np.maximum(np.bincount(name, weight, most), 1e-300)
        if tolerance.exact:
            near = np.bincount(name, weight * (np.abs(far) <= _EXACT * noise), most)
            real[:-1] |= near > _MOSTLY * size
        alone = np.sqrt(np.bincount(name, weight * far**2, most) / size)
        whole = np.maximum(np.bincount(name[1:][pair], square, most), 1e-300)
        both = np.bincount(name[1:][pair], product, most) / whole
        real[:-1] |= (
            (size >= _CLEAR * tolerance.points)
            & (alone <= _ALIKE * tolerance.scatter)
            & (both <= _SHARED)
        )
    kept = np.flatnonzero(real[:-1])
    number = np.full(len(real), NONE, np.int32)
    number[kept] = np.arange(len(kept), dtype=np.int32)
    return found.at(kept), number[label]


def _grow(
    samples: Samples, work: list[_Set], start: list[Surfaces], tolerance: Tolerance
) -> list[tuple[int, Surfaces, np.ndarray]]:
    """Grow surfaces in their sets while fitting them anew lets them explain more.

    Returns:
        Number, surface and what it explains, of those that explain enough; the largest first.
    """

    def explained(which: list[int], surfaces: Surfaces) -> list[np.ndarray]:
        sets = list(dict.fromkeys(work[i] for i in which))
        place = {w: s for s, w in enumerate(sets)}
        on = lie_on(
            samples, [w.members for w in sets], np.array([place[work[i]] for i in which], np.int64),
            surfaces, _ON * tolerance.noise, tolerance.turn,
        )  # fmt: skip
        return [work[i].connected(o & work[i].free) for i, o in zip(which, on, strict=True)]

    surface, part = list(start), explained(list(range(len(work))), joined(start))
    size = [w.weight[p].sum() for w, p in zip(work, part, strict=True)]
    growing = [i for i in range(len(work)) if size[i] >= tolerance.points]
    for _ in range(_GROWTHS):
        if not growing:
            break
        groups = [spread(work[i].members[part[i]], _SOME) for i in growing]
        fitted, fits = fit_sets(samples, groups, tolerance.noise, robust=True)
        which = [growing[f] for f in fitted]
        growing = []
        for k, (i, wider) in enumerate(zip(which, explained(which, fits), strict=True)):
            before, after = size[i], work[i].weight[wider].sum()
            if after >= 0.9 * before:
                surface[i], part[i], size[i] = fits.at(np.array([k])), wider, after
                if after > _GAIN * before:
                    growing.append(i)
    order = np.argsort([-s for s in size], kind="stable")
    return [(int(i), surface[i], part[i]) for i in order if size[i] >= tolerance.points]
