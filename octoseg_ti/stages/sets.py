"""Sets of samples: the simplest surface through each, and which samples lie on a surface."""

from dataclasses import dataclass

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row
from octoseg_ti.device.runtime import F32Array, F64Rows, I32Array, I32Rows, ti
from octoseg_ti.device.surfaces import KINDS, evaluate_surfaces, surface_in_row
from octoseg_ti.fitting.primitives import fit_all
from octoseg_ti.fitting.quadrics import fit_quadrics
from octoseg_ti.fitting.selection import choose, plane_does
from octoseg_ti.stages.leaves import Leaves, Samples, members_of
from octoseg_ti.types import NONE, SurfaceKind

# A surface fits when its residual is below this many noises.
_FIT = 1.5
# Distances beyond this many noises count as this many.
_CAP = 4.0
# What a sample at the limit counts.
_LEAST = 1e-6


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


def joined(surfaces: list[Surfaces]) -> Surfaces:
    """Return surfaces in one list."""
    whole = [no_surfaces(), *surfaces]
    return Surfaces(
        kind=np.concatenate([s.kind for s in whole]),
        parameters=np.concatenate([s.parameters for s in whole]),
    )


@ti.kernel
def _measure_nearness(
    limit: ti.f64,
    cosine: ti.f64,
    # In:
    point_in: F64Rows,
    normal_in: F64Rows,
    sample_in: I32Array,
    surface_in: F64Rows,
    range_in: I32Rows,
    # Out:
    near_out: F32Array,
):
    """Say for every surface how near it the samples of its range lie, 0 where they do not."""
    for s in range(range_in.shape[0]):
        kind = ti.cast(surface_in[s, 8], ti.i32)
        for j in range(range_in[s, 0], range_in[s, 1]):
            i = sample_in[j]
            d, n = surface_in_row(surface_in, s, kind, row(point_in, i))
            m = row(normal_in, i)
            share = d / limit
            near = ti.select(ti.abs(d) <= limit, ti.max(1.0 - share * share, _LEAST), 0.0)
            if m.norm_sqr() > 0.0:
                facing = ti.abs(n.dot(m))
                turned = (1.0 - facing) / ti.max(1.0 - cosine, _LEAST)
                near *= ti.select(facing >= cosine, ti.max(1.0 - turned, _LEAST), 0.0)
            near_out[range_in[s, 2] + j - range_in[s, 0]] = ti.cast(near, ti.f32)


def lie_on(
    samples: Samples,
    sets: list[np.ndarray],
    which: np.ndarray,
    surfaces: Surfaces,
    limit: float,
    turn: float,
) -> list[np.ndarray]:
    """Return for every surface which samples of a set lie on it, as `nearness` does, but bool."""
    return [near > 0.0 for near in nearness(samples, sets, which, surfaces, limit, turn)]


def nearness(
    samples: Samples,
    sets: list[np.ndarray],
    which: np.ndarray,
    surfaces: Surfaces,
    limit: float,
    turn: float,
) -> list[np.ndarray]:
    """Return for every surface how near it the samples of a set lie.

    Samples of the surface are mostly much nearer than the limit. What a surface merely cuts through
    is anywhere within it, so that the sum tells more than the number (MSAC, Torr and Zisserman
    2000).

    Args:
        samples: The samples.
        sets: Sets of samples.
        which: The set that every surface is compared with, shape (M,).
        surfaces: The surfaces.
        limit: Largest distance [mm].
        turn: Largest angle between the normals [rad].

    Returns:
        An array of f32 for every surface: 1 less the square of the distance in limits, times 1 less
        the share that the angle between the normals has of the largest one (by their cosines; 1
        without a normal); and 0 where a sample does not lie on the surface.
    """
    runtime.ensure_started()
    if len(surfaces) == 0:
        return []
    length = np.array([len(s) for s in sets], np.int64)
    begin = np.cumsum(length) - length
    out = np.cumsum(length[which]) - length[which]
    ranges = np.stack([begin[which], begin[which] + length[which], out], axis=1).astype(np.int32)
    near = runtime.empty(int(length[which].sum()), np.float32)
    _measure_nearness(
        limit,
        float(np.cos(min(turn, np.pi / 2))),
        runtime.upload(samples.point),
        runtime.upload(samples.normal),
        runtime.upload(np.concatenate(sets).astype(np.int32)),
        runtime.upload(np.column_stack([surfaces.parameters, surfaces.kind])),
        runtime.upload(ranges),
        near,
    )
    found = runtime.download(near)
    return [found[o : o + n] for o, n in zip(out, length[which], strict=True)]


def spread(members: np.ndarray, most: int) -> np.ndarray:
    """Return at most so many members, evenly spaced."""
    if len(members) <= most:
        return members
    return members.take(np.arange(1, 2 * most, 2) * len(members) // (2 * most))


def sets_of(samples: Samples, leaves: Leaves, group: np.ndarray, least: float) -> list[np.ndarray]:
    """Return the samples of every group of leaves that has enough points.

    Args:
        samples: The samples.
        leaves: The leaves.
        group: Group of every leaf, -1 = none, shape (C,), i32.
        least: Fewest points.
    """
    size = np.bincount(group + 1, leaves.count, minlength=2)[1:]
    # Most groups are small: only the others are numbered.
    large = np.flatnonzero(size >= least)
    number = np.full(len(size) + 1, NONE, np.int32)
    number[large] = np.arange(len(large))
    return [s for s in members_of(number[group][samples.leaf], len(large)) if len(s)]


def rms_of(samples: Samples, label: np.ndarray, surfaces: Surfaces) -> float:
    """Return how far samples are from the surfaces that they lie on [mm]; 0 where none does.

    Args:
        samples: The samples.
        label: Surface of every sample, -1 = none, shape (A,), i32.
        surfaces: The surfaces.
    """
    there = label >= 0
    far, _ = evaluate_surfaces(
        samples.point[there], label[there], surfaces.kind, surfaces.parameters
    )
    return float(np.sqrt(np.mean(far**2))) if len(far) else 0.0


def capped_rms(
    samples: Samples, sets: list[np.ndarray], which: np.ndarray, surfaces: Surfaces, noise: float
) -> np.ndarray:
    """Return the residual of a set of samples from every surface, far samples capped [mm].

    Args:
        samples: The samples.
        sets: Sets of samples.
        which: The set that every surface is compared with, shape (M,).
        surfaces: The surfaces.
        noise: Deviation of a point from its surface [mm]; distances count as 4 of it at most.

    Returns:
        Shape (M,); 0 of an empty set.
    """
    owner, far = _distances(samples, sets, which, surfaces)
    square = np.minimum(far**2, (_CAP * noise) ** 2)
    length = np.bincount(owner, minlength=len(which))
    return np.sqrt(np.bincount(owner, square, len(which)) / np.maximum(length, 1))


def largest_gap(
    samples: Samples, sets: list[np.ndarray], which: np.ndarray, one: Surfaces, other: Surfaces
) -> np.ndarray:
    """Return how far two surfaces of every set are apart, at most, at its samples [mm].

    Args:
        samples: The samples.
        sets: Sets of samples.
        which: The set of every two surfaces, shape (M,).
        one: The first of them.
        other: The second ones.

    Returns:
        Shape (M,); 0 of an empty set.
    """
    owner, off_one = _distances(samples, sets, which, one)
    _, off_other = _distances(samples, sets, which, other)
    far = np.zeros((2, len(which)))
    # Which side is outside does not matter.
    np.maximum.at(far[0], owner, np.abs(off_one - off_other))
    np.maximum.at(far[1], owner, np.abs(off_one + off_other))
    return far.min(axis=0)


def _distances(
    samples: Samples, sets: list[np.ndarray], which: np.ndarray, surfaces: Surfaces
) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface and the signed distance [mm] of every sample of the set of every surface.

    Both shape (S,), set after set.
    """
    length = np.array([len(sets[w]) for w in which], np.int64)
    index = np.concatenate([np.zeros(0, np.int64), *(sets[w] for w in which)])
    owner = np.repeat(np.arange(len(which)), length)
    far, _ = evaluate_surfaces(
        samples.point.take(index, axis=0), owner, surfaces.kind, surfaces.parameters
    )
    return owner, far


def fit_sets(
    samples: Samples, sets: list[np.ndarray], noise: float, *, robust: bool = False
) -> tuple[np.ndarray, Surfaces]:
    """Fit the simplest surface to every set of samples.

    Planes come first: a set on which no curved surface could do better is fitted by no other.

    Args:
        samples: The samples.
        sets: Sets of samples.
        noise: Deviation of a point from its surface [mm].
        robust: Some samples may belong to something else.

    Returns:
        Which sets have a surface, ascending, shape (M,), and these surfaces.
    """
    if not sets:
        return np.zeros(0, np.int64), no_surfaces()
    flat, parameters = flat_sets(samples, sets, noise)
    kind = np.where(flat, int(SurfaceKind.PLANE), int(SurfaceKind.FREE_FORM)).astype(np.int32)
    curved = np.flatnonzero(kind >= KINDS)
    if len(curved):
        index, start = _in_a_row([sets[s] for s in curved])
        fits = fit_all(
            samples.point[index], samples.normal[index], None, start, noise=noise, robust=robust
        )
        chosen = choose(fits, noise=noise, room=_FIT, signed=samples.signed)
        kind[curved], parameters[curved] = chosen.kind, chosen.parameters
    fitted = np.flatnonzero((kind >= 0) & (kind < KINDS))
    return fitted, Surfaces(kind=kind[fitted], parameters=parameters[fitted])


def flat_sets(
    samples: Samples, sets: list[np.ndarray], noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """Say which sets lie on planes that no curved surface could better.

    Args:
        samples: The samples.
        sets: Sets of samples.
        noise: Deviation of a point from its surface [mm].

    Returns:
        Shape (len(sets),), bool; and the planes, as in `Segmentation.parameters`, of all sets.
    """
    parameters = np.full((len(sets), 8), np.nan)
    if not sets:
        return np.zeros(0, bool), parameters
    index, start = _in_a_row(sets)
    flat = fit_quadrics(samples.point[index], samples.normal[index], start)
    parameters[:, :6] = np.column_stack([flat.centre, flat.normal])
    return plane_does(flat, np.diff(start), noise=noise, room=_FIT), parameters


def _in_a_row(sets: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return sets one after the other, and where each begins, with the end."""
    return np.concatenate(sets), np.cumsum([0] + [len(s) for s in sets]).astype(np.int32)
