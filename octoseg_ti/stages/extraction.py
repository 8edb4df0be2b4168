"""Analytic surfaces are found in sets of samples: one that explains all, or several one by one.

A set that one surface explains is done. Every other set is taken apart: surfaces through small
neighbourhoods of many samples are candidates; the one that explains most of what is left grows, as
long as fitting it anew lets it explain more (Besl and Jain 1988), and takes what it explains.
"""

from dataclasses import dataclass
from itertools import compress
from typing import NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, ti
from octoseg_ti.device.surfaces import KINDS, evaluate_surfaces, surface_at
from octoseg_ti.device.unionfind import components
from octoseg_ti.stages.leaves import Leaves, Samples
from octoseg_ti.stages.primitives import Fits, fit_all
from octoseg_ti.stages.selection import choose
from octoseg_ti.types import NONE

# A surface fits when its residual is below this many noises.
_FIT = 1.5
# A sample lies on a surface within this many noises.
_ON = 3.0
# A surface explains a set when this share of it lies on it.
_WHOLE = 0.85
# ... and for sure when it leaves no more than this many noises there.
_SURE = 0.9
# Samples for one fit of a set, and of a growing surface.
_MANY, _SOME = 200, 150
# Neighbourhoods of a seed, in samples.
_NEAR = (20, 60, 150)
# Samples of a set that tell how much a candidate explains.
_SCORED = 3000
_SEED_EVERY, _LEAST_SEEDS, _MOST_SEEDS = 40, 8, 200
# A surface grows until it gains less than this, at most so often.
_GAIN, _GROWTHS = 1.02, 4
_LEFT = 0.005
# Surfaces that a set was taken apart into are real when they explain so much of it, and leave no
# more than this many noises, fewer the less they explain: pieces of a free form are cut out as far
# as they just fit, and leave gaps.
_COVERED, _REAL = 0.6, 1.15
# ... and at any rate when they leave no more than this many: what is cut out as far as it just fits
# leaves half of its reach.
_EXACT = 0.5


class Tolerance(NamedTuple):
    """What counts as lying on a surface."""

    noise: float
    """Deviation of a point from its surface [mm]."""
    turn: float
    """Largest angle between the normals of a sample and of its surface [rad]."""
    points: float
    """Fewest points of a surface."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surfaces:
    """Analytic surfaces, ``M`` of them."""

    kind: np.ndarray
    """`SurfaceKind`, shape (M,), i32."""
    parameters: np.ndarray
    """As in `Segmentation.parameters`, but relative to the corner of the grid, shape (M, 8)."""

    def __len__(self) -> int:
        """Return the number of surfaces."""
        return len(self.kind)

    def joined(self, other: "Surfaces") -> "Surfaces":
        """Return these and other surfaces."""
        return Surfaces(
            kind=np.concatenate([self.kind, other.kind]),
            parameters=np.concatenate([self.parameters, other.parameters]),
        )

    def at(self, which: np.ndarray) -> "Surfaces":
        """Return some of the surfaces."""
        return Surfaces(kind=self.kind[which], parameters=self.parameters[which])


def no_surfaces() -> Surfaces:
    """Return no surface."""
    return Surfaces(kind=np.zeros(0, np.int32), parameters=np.zeros((0, 8)))


@ti.kernel
def _lie_on(
    limit: ti.f64,
    cosine: ti.f64,
    # In:
    point_in: F64Rows,
    normal_in: F64Rows,
    sample_in: I32Array,
    surface_in: F64Rows,
    range_in: I32Rows,
    # Out:
    on_out: I32Array,
):
    """Say for every surface which samples of its range lie on it."""
    for s in range(range_in.shape[0]):
        kind = ti.cast(surface_in[s, 8], ti.i32)
        origin = row(surface_in, s)
        axis = vec3(surface_in[s, 3], surface_in[s, 4], surface_in[s, 5])
        for j in range(range_in[s, 0], range_in[s, 1]):
            i = sample_in[j]
            d, n = surface_at(
                kind, row(point_in, i), origin, axis, surface_in[s, 6], surface_in[s, 7]
            )
            m = row(normal_in, i)
            on = ti.cast(ti.abs(d) <= limit, ti.i32)
            if ti.abs(n.dot(m)) < cosine and m.norm_sqr() > 0.0:
                on = 0
            on_out[range_in[s, 2] + j - range_in[s, 0]] = on


def lie_on(
    samples: Samples,
    sets: list[np.ndarray],
    which: np.ndarray,
    surfaces: Surfaces,
    limit: float,
    turn: float,
) -> list[np.ndarray]:
    """Return for every surface which samples of a set lie on it.

    Args:
        samples: The samples.
        sets: Sets of samples.
        which: The set that every surface is compared with, shape (M,).
        surfaces: The surfaces.
        limit: Largest distance [mm].
        turn: Largest angle between the normals [rad].

    Returns:
        Whether each sample of the set lies on the surface, an array of bool for every surface.
    """
    runtime.ensure_started()
    if len(surfaces) == 0:
        return []
    length = np.array([len(s) for s in sets], np.int64)
    begin = np.cumsum(length) - length
    out = np.cumsum(length[which]) - length[which]
    ranges = np.stack([begin[which], begin[which] + length[which], out], axis=1).astype(np.int32)
    on = runtime.empty(int(length[which].sum()), np.int32)
    _lie_on(
        limit,
        float(np.cos(min(turn, np.pi / 2))),
        runtime.upload(samples.point),
        runtime.upload(samples.normal),
        runtime.upload(np.concatenate(sets).astype(np.int32)),
        runtime.upload(np.column_stack([surfaces.parameters, surfaces.kind])),
        runtime.upload(ranges),
        on,
    )
    found = runtime.download(on).astype(bool)
    return [found[o : o + n] for o, n in zip(out, length[which], strict=True)]


def spread(members: np.ndarray, most: int) -> np.ndarray:
    """Return at most so many members, evenly spaced."""
    if len(members) <= most:
        return members
    return members[(2 * np.arange(most) + 1) * len(members) // (2 * most)]


def fit_sets(
    samples: Samples, sets: list[np.ndarray], noise: float, *, robust: bool = False
) -> tuple[np.ndarray, Surfaces]:
    """Fit the simplest surface to every set of samples.

    Returns:
        Which sets have one, indices, shape (M,), and these surfaces.
    """
    if not sets:
        return np.zeros(0, np.int64), no_surfaces()
    return _simplest_of(_fit(samples, sets, noise, robust=robust), noise, samples.signed)


def _fit(samples: Samples, sets: list[np.ndarray], noise: float, *, robust: bool = False) -> Fits:
    """Fit all kinds of surfaces to every set of samples."""
    start = np.cumsum([0] + [len(s) for s in sets])
    index = np.concatenate(sets)
    return fit_all(
        samples.point[index], samples.normal[index], None, start, noise=noise, robust=robust
    )


def _simplest_of(fits: Fits, noise: float, signed: bool) -> tuple[np.ndarray, Surfaces]:
    """Return which fits give a surface, and the simplest of each."""
    chosen = choose(fits, noise=noise, room=_FIT, signed=signed)
    fitted = np.flatnonzero((chosen.kind >= 0) & (chosen.kind < KINDS))
    return fitted, Surfaces(
        kind=chosen.kind[fitted].astype(np.int32), parameters=chosen.parameters[fitted]
    )


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
    fits = _fit(samples, [spread(s, _MANY) for s in sets], noise, robust=True)
    fitted, whole = _simplest_of(fits, noise, samples.signed)
    turn = max(tolerance.turn, 0.5)
    on = lie_on(samples, sets, fitted, whole, (_ON + 0.5) * noise, turn)
    likely, sure = np.zeros(len(sets), bool), np.zeros(len(sets), bool)
    for s, there, rms in zip(fitted, on, _rms_on(samples, sets, fitted, whole, on), strict=True):
        weight = samples.weight[sets[s]]
        likely[s] = weight[there].sum() >= _WHOLE * weight.sum()
        sure[s] = likely[s] and rms <= _SURE * noise
    rest = list(compress(sets, ~sure)) if apart else []
    more, found = _take_apart(samples, leaves, rest, tolerance)
    kept: list[int] = []
    for m, (s, there) in enumerate(zip(fitted, on, strict=True)):
        if likely[s] and not np.any(found[sets[s]] >= 0):
            label[sets[s][there]] = len(kept)
            kept.append(m)
    label[found >= 0] = found[found >= 0] + len(kept)
    return whole.at(np.array(kept, np.int64)).joined(more), label


def _rms_on(
    samples: Samples,
    sets: list[np.ndarray],
    which: np.ndarray,
    surfaces: Surfaces,
    on: list[np.ndarray],
) -> np.ndarray:
    """Return the residual of the samples that lie on every surface [mm], shape (M,)."""
    lying = [sets[s][there] for s, there in zip(which, on, strict=True)]
    count = np.array([len(i) for i in lying], np.int64)
    if count.sum() == 0:
        return np.full(len(count), np.inf)
    owner = np.repeat(np.arange(len(count)), count)
    far, _ = evaluate_surfaces(
        samples.point[np.concatenate(lying)], owner, surfaces.kind, surfaces.parameters
    )
    return np.sqrt(np.bincount(owner, far**2, len(count)) / np.maximum(count, 1))


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


def _candidates(
    samples: Samples, sets: list[np.ndarray], noise: float
) -> tuple[Surfaces, np.ndarray]:
    """Return surfaces through neighbourhoods of seeds, and the set of each."""
    groups, owner = [], []
    for s, members in enumerate(sets):
        most = int(np.clip(len(members) // _SEED_EVERY, _LEAST_SEEDS, _MOST_SEEDS))
        seeds = spread(np.arange(len(members)), most)
        place = samples.point[members]
        for count in _NEAR:
            near = _neighborhoods(place, seeds, min(count, len(members)))
            groups += list(members[near])
            owner += [s] * len(near)
            if count >= len(members):
                break
    fitted, surfaces = fit_sets(samples, groups, noise)
    return surfaces, np.array(owner, np.int64)[fitted]


class _Set:
    """A set that is taken apart: what is left of it, and its candidates."""

    def __init__(self, samples: Samples, leaves: Leaves, members: np.ndarray) -> None:
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
        self.scored = spread(np.arange(len(members)), _SCORED)
        self.on = np.zeros((0, len(self.scored)), np.float32)
        self.surfaces = no_surfaces()

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

    def best(self, least: float) -> tuple[int, np.ndarray] | None:
        """Return the candidate that explains most of what is left, and what it explains."""
        weight = (self.weight * self.free)[self.scored].astype(np.float32)
        weight *= np.float32(self.weight.sum() / max(self.weight[self.scored].sum(), 1e-300))
        support = np.einsum("cs,s->c", self.on, weight)  # no BLAS: its sums depend on threads
        if len(support) == 0:
            return None
        c = int(np.argmax(support))
        if support[c] < least:
            return None
        return c, self.on[c] > 0


def _take_apart(
    samples: Samples, leaves: Leaves, sets: list[np.ndarray], tolerance: Tolerance
) -> tuple[Surfaces, np.ndarray]:
    """Find the surfaces of sets that no single one explains."""
    label = np.full(len(samples), NONE, np.int32)
    found = no_surfaces()
    if not sets:
        return found, label
    noise, limit = tolerance.noise, _ON * tolerance.noise
    surfaces, owner = _candidates(samples, sets, noise)
    work = [_Set(samples, leaves, members) for members in sets]
    scored = [w.members[w.scored] for w in work]
    on = lie_on(samples, scored, owner, surfaces, limit, tolerance.turn)
    for s, w in enumerate(work):
        mine = np.flatnonzero(owner == s)
        w.surfaces = surfaces.at(mine)
        w.on = np.array([on[c] for c in mine], np.float32).reshape(len(mine), len(w.scored))
    active = list(range(len(sets)))
    while active:
        chosen = {s: work[s].best(tolerance.points) for s in active}
        active = [s for s in active if chosen[s] is not None]
        if not active:
            break
        start = [work[s].surfaces.at(np.array([chosen[s][0]])) for s in active]  # type: ignore[index]
        grown = _grow(samples, [work[s] for s in active], start, tolerance)
        for s, (surface, part) in zip(list(active), grown, strict=True):
            w = work[s]
            if w.weight[part].sum() < tolerance.points:
                w.on[chosen[s][0]] = 0.0  # type: ignore[index]
                continue
            label[w.members[part]] = len(found)
            found = found.joined(surface)
            w.free &= ~part
            w.on[:, ~w.free[w.scored]] = 0.0
            if w.weight[w.free].sum() < max(_LEFT * w.weight.sum(), tolerance.points):
                active.remove(s)
    return _real_ones(samples, sets, found, label, noise)


def _real_ones(
    samples: Samples, sets: list[np.ndarray], found: Surfaces, label: np.ndarray, noise: float
) -> tuple[Surfaces, np.ndarray]:
    """Drop the surfaces of sets that are free forms."""
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
        real[name] = covered >= _COVERED and rms <= covered * _REAL * noise
        ids, rank = np.unique(name, return_inverse=True)
        each = np.sqrt(np.bincount(rank, weight * far**2) / np.bincount(rank, weight))
        real[ids[each <= _EXACT * noise]] = True
    kept = np.flatnonzero(real[:-1])
    number = np.full(len(real), NONE, np.int32)
    number[kept] = np.arange(len(kept), dtype=np.int32)
    return found.at(kept), number[label]


def _grow(
    samples: Samples, work: list[_Set], start: list[Surfaces], tolerance: Tolerance
) -> list[tuple[Surfaces, np.ndarray]]:
    """Grow a surface in every set while fitting it anew lets it explain more."""

    def explained(which: list[int], surfaces: list[Surfaces]) -> list[np.ndarray]:
        members = [work[i].members for i in which]
        all_surfaces = no_surfaces()
        for one in surfaces:
            all_surfaces = all_surfaces.joined(one)
        on = lie_on(
            samples, members, np.arange(len(which)), all_surfaces, _ON * tolerance.noise,
            tolerance.turn,
        )  # fmt: skip
        return [work[i].connected(o & work[i].free) for i, o in zip(which, on, strict=True)]

    surface = list(start)
    part = explained(list(range(len(work))), surface)
    growing = [i for i, p in enumerate(part) if p.any()]
    for _ in range(_GROWTHS):
        if not growing:
            break
        groups = [spread(work[i].members[part[i]], _SOME) for i in growing]
        fitted, fits = fit_sets(samples, groups, tolerance.noise, robust=True)
        which = [growing[f] for f in fitted]
        wider = explained(which, [fits.at(np.array([k])) for k in range(len(fitted))])
        growing = []
        for k, i in enumerate(which):
            before = work[i].weight[part[i]].sum()
            after = work[i].weight[wider[k]].sum()
            if after >= 0.9 * before:
                surface[i], part[i] = fits.at(np.array([k])), wider[k]
                if after > _GAIN * before:
                    growing.append(i)
    return list(zip(surface, part, strict=True))
