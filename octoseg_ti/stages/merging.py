"""Surfaces that are one are merged; surfaces that their neighbours explain are given up."""

import numpy as np

from octoseg_ti.stages.contacts import Contacts
from octoseg_ti.stages.leaves import Samples, members_of, sizes_of
from octoseg_ti.stages.sets import Surfaces, capped_rms, fit_sets, spread

# Samples of each surface in a common fit.
_SAMPLES = 150
# Two surfaces are one when the residual of neither grows by more than this.
_WORSE = 1.15
# ... or within so many noises all the same.
_ALIKE = 1.1
# ... and stays within this many noises.
_FIT = 1.2
# Distances beyond this many noises count as this many.
_CAP = 4.0
# A surface with fewer samples says nothing about another.
_FEW = 10
# One surface has one tangent plane where two pieces of it touch. What the noise hides bends a piece
# by four times the noise, over its width, at its rim; twice that, and so many noises, are no edge.
_TURN, _STEP = 8.0, 6.0
_UNIT = 1024.0
# What deviates by no more than this many noises and tilts, and is no larger than this share of the
# surface beside it, is an error of its form: of that one, and no round between it and the next.
_FORM, _SMOOTH, _SMALL, _LEANS = 4.0, 3.0, 0.25, 0.8
# What is cut out of something else as far as it just fits leaves 1.44 noises, evenly spread within
# 2.5; a surface leaves 1 at most, and two thirds where the noise is taken large to be safe.
_CUT_OUT = 1.1


def merge_surfaces(
    samples: Samples, label: np.ndarray, surfaces: Surfaces, touching: Contacts, noise: float
) -> tuple[np.ndarray, Surfaces]:
    """Merge surfaces in contact that one surface explains as well.

    Args:
        samples: The samples.
        label: Surface of every sample, -1 = none, shape (A,), i32.
        surfaces: The surfaces.
        touching: Surfaces in contact.
        noise: Deviation of a point from its surface [mm].

    Returns:
        The surface that each one becomes, shape (M,), i32; and the surfaces, of which those that
        stay have been fitted anew where they were merged.
    """
    name = np.arange(len(surfaces), dtype=np.int32)
    members = members_of(label, len(surfaces))
    size = np.array([len(m) for m in members], np.int64)
    touching = touching.some((size[touching.pairs] >= _FEW).all(axis=1))
    parts = [spread(m, _SAMPLES) for m in members]
    pairs = _without_edges(samples, parts, touching, noise)
    if len(pairs) == 0:
        return name, surfaces
    groups = [np.concatenate([parts[a], parts[b]]) for a, b in pairs]
    fitted, common = fit_sets(samples, groups, noise)
    if len(fitted) == 0:
        return name, surfaces
    pairs = pairs[fitted]
    mixed, own = _residuals(samples, parts, pairs, common, surfaces, noise)
    fine = (mixed <= np.maximum(_WORSE * own, _ALIKE * noise)) & (mixed <= _FIT * noise)
    order = np.argsort(mixed.max(axis=1, initial=0.0), kind="stable")
    parameters, kind = surfaces.parameters.copy(), surfaces.kind.copy()
    used = np.zeros(len(surfaces), bool)
    for p in order[fine[order].all(axis=1)]:
        a, b = pairs[p]
        if used[a] or used[b]:
            continue
        used[[a, b]] = True
        keep, drop = (a, b) if size[a] >= size[b] else (b, a)
        name[drop] = keep
        parameters[keep], kind[keep] = common.parameters[p], common.kind[p]
    return name, Surfaces(kind=kind, parameters=parameters)


def _without_edges(
    samples: Samples, parts: list[np.ndarray], touching: Contacts, noise: float
) -> np.ndarray:
    """Return the pairs without those that meet at an edge or a step, shape (P, 2)."""
    used = np.unique(touching.pairs)
    width = np.zeros(len(parts))
    width[used] = _widths([samples.point.take(parts[m], axis=0) for m in used])
    bend = noise / np.maximum(width[touching.pairs], 1e-300)
    smooth = (touching.turn <= _TURN * bend.sum(axis=1)) & (touching.step <= _STEP * noise)
    return touching.pairs[smooth]


def _widths(points: list[np.ndarray]) -> np.ndarray:
    """Return how wide pieces of surfaces are, where they are longer than wide [mm].

    Args:
        points: Points all over every piece, shapes (k, 3).
    """
    square = np.empty((len(points), 3, 3))
    for m, p in enumerate(points):
        q = p - p.sum(axis=0) / len(p)
        square[m] = np.einsum("ki,kj->ij", q, q) / len(q)
    return np.sqrt(12.0 * np.maximum(np.linalg.eigvalsh(square)[:, 1], 0.0))


def _residuals(
    samples: Samples,
    parts: list[np.ndarray],
    pairs: np.ndarray,
    common: Surfaces,
    surfaces: Surfaces,
    noise: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the residual of either part of a pair, from the common surface and from its own."""
    which = pairs.ravel()
    twice = np.repeat(np.arange(len(pairs)), 2)
    mixed = capped_rms(samples, parts, which, common.at(twice), noise)
    own = capped_rms(samples, parts, np.arange(len(surfaces)), surfaces, noise)
    return mixed.reshape(-1, 2), own[pairs]


def explained_by_others(
    label: np.ndarray, second: np.ndarray, off: np.ndarray, count: int, limit: float | np.ndarray
) -> np.ndarray:
    """Return which surfaces their neighbours explain nearly as well.

    A surface goes when its points are within the noise of those that they would choose next. A
    small one at the side of a large one also goes when it deviates as an error of form would: a
    little, and smoothly.

    Args:
        label: Surface of every point, -1 = none, shape (n,), i32.
        second: The surface that each point would choose next, -1 = none, shape (n,), i32.
        off: Distance from that surface [noises], and angle to its normal [tilts], shape (n, 2) or
            more.
        count: Number of surfaces M.
        limit: Largest mean square of these distances; one for all, or one each, shape (M,).

    Returns:
        Which surfaces to give up, shape (M,), bool: the smallest first, and none that one given up
        leans on.
    """
    # What is beyond the largest cap leans on nothing.
    here = np.flatnonzero((off[:, 0] < 2.0 * _FORM) & (label >= 0) & (second >= 0))
    mine, other, near = label[here], second[here], off.take(here, axis=0)
    size = sizes_of(label, count)
    alone = size - np.bincount(mine, minlength=count)
    far, deviation = mean_squares(mine, near[:, 0], (_CAP, 2.0 * _FORM), size, alone)
    (turn,) = mean_squares(mine, near[:, 1], (2.0 * _SMOOTH,), size, alone)
    near_enough = far <= limit
    given_up = np.zeros(count, bool)
    leaned_on = np.zeros(count, bool)
    pair, points = _pairs(mine, other, alone, count)
    for m in np.argsort(size, kind="stable"):
        if size[m] == 0 or leaned_on[m]:
            continue
        lo, hi = np.searchsorted(pair, [m * count, (m + 1) * count])
        heir = pair[lo:hi] % count
        main = int(heir[np.argmax(points[lo:hi])])
        form = (
            main != m
            and points[lo:hi].max() >= _LEANS * size[m]
            and deviation[m] <= _FORM**2
            and turn[m] <= _SMOOTH**2
            and size[m] <= _SMALL * size[main]
        )
        heirs = heir[points[lo:hi] * 5 >= size[m]]
        if not (near_enough[m] or form) or given_up[heirs].any():
            continue
        given_up[m] = True
        leaned_on[heirs] = True
    return given_up


def cut_out(label: np.ndarray, far: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which surfaces were cut out of something else as far as that just fitted.

    Args:
        label: Surface of every point, shape (k,), i32.
        far: Its distance from it [noises], shape (k,).
        count: Number of surfaces M.

    Returns:
        Shape (M,), bool: those whose points leave more than noise does; and the mean squares that
        all leave, shape (M,).
    """
    size = np.bincount(label, minlength=count)
    (square,) = mean_squares(label, far, (_CAP,), size, np.zeros_like(size))
    return square > _CUT_OUT**2, square


def _pairs(
    mine: np.ndarray, other: np.ndarray, alone: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the keys of surfaces and those next to them, ascending, and the points of each.

    Points with nothing near, ``alone``, count for their own surface.
    """
    key = np.concatenate([mine.astype(np.int64) * count + other, np.arange(count) * (count + 1)])
    points = np.concatenate([np.ones(len(mine)), alone])
    if count * count <= 4 * len(key):
        total = np.bincount(key, points, count * count).astype(np.int64)
        pair = np.flatnonzero(total)
        return pair, total[pair]
    pair, place = np.unique(key, return_inverse=True)
    total = np.bincount(place, points).astype(np.int64)
    return pair[total > 0], total[total > 0]


def mean_squares(
    owner: np.ndarray,
    value: np.ndarray,
    caps: tuple[float, ...],
    size: np.ndarray,
    alone: np.ndarray,
) -> list[np.ndarray]:
    """Return the mean square of the values of every owner, no value above the cap, for every cap.

    Args:
        owner: Owner of every value, shape (k,), i32.
        value: The values, shape (k,).
        caps: The caps.
        size: How many every owner has, those that are ``alone`` with them, shape (M,).
        alone: How many of these have no value, and count with the cap, shape (M,).

    Returns:
        Shape (M,) for every cap; the same in whatever order the values come.
    """
    square = np.rint(_UNIT * value.astype(np.float64) ** 2)  # whole units add up alike in any order
    means = []
    for cap in caps:
        limit = np.rint(_UNIT * cap**2)
        total = np.bincount(owner, np.minimum(square, limit), len(size)) + alone * limit
        means.append(total / _UNIT / np.maximum(size, 1))
    return means
