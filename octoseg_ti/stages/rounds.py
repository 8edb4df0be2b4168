"""Shallow rounds between planes, which noise hides: no point of them is beyond doubt, all are.

Where two planes meet at a small angle, a round between them leaves either by little more than the
noise, and the planes share its points. But these are on one side, by what the radius says: a
parabola, nearly, whose height and width hang together. Added up over the whole edge that is beyond
doubt.
"""

from typing import NamedTuple

import numpy as np

from octoseg_ti.stages.leaves import Samples
from octoseg_ti.stages.sets import Surfaces
from octoseg_ti.types import NONE, SurfaceKind

# Planes at angles between these [rad] may share a round.
_ANGLES = (0.1, 0.7)
# A round that is hidden leaves the edge by so many noises; more would not be shared.
_DEPTHS = (0.7, 4.0)
# Radii that are tried, and as many again between the neighbours of the best one.
_RADII = 16
# It gains so many squares of the noise, and of what it should gain this share.
_GAIN, _AGREES = 40.0, 0.75
# Points farther from the planes are of something else [noises].
_NEAR = 6.0


class Rounds(NamedTuple):
    """Rounds between planes."""

    surfaces: Surfaces
    """Cylinders that touch both planes."""
    sides: np.ndarray
    """These planes, shape (K, 2)."""
    label: np.ndarray
    """Round that every sample lies on, -1 = none, shape (A,), i32."""


def hidden_rounds(
    samples: Samples,
    label: np.ndarray,
    surfaces: Surfaces,
    pairs: np.ndarray,
    *,
    noise: float,
    limit: float,
) -> Rounds:
    """Find the rounds between planes that meet at small angles.

    Args:
        samples: The samples.
        label: Surface of every sample, -1 = none, shape (A,), i32.
        surfaces: The surfaces.
        pairs: Surfaces in contact, shape (P, 2).
        noise: Deviation of a point from its surface [mm].
        limit: Rounds with smaller radii are edges [mm].
    """
    on = np.full(len(samples), NONE, np.int32)
    n, m = (surfaces.parameters[pairs[:, k], 3:6] for k in (0, 1))
    cosine = np.abs(np.einsum("pi,pi->p", n, m))
    least, most = np.cos(_ANGLES)
    flat = (surfaces.kind[pairs] == SurfaceKind.PLANE).all(axis=1)
    rows: list[np.ndarray] = []
    sides: list[tuple[int, int]] = []
    for a, b in pairs[flat & (cosine < least) & (cosine > most)]:
        here = np.flatnonzero((label == a) | (label == b))
        side = np.where(label[here] == a, 0, 1)
        found = round_between(
            samples.point[here], side, surfaces.parameters[[a, b]], noise=noise, limit=limit
        )
        if found is not None:
            on[here[found[1]]] = len(rows)
            rows.append(found[0])
            sides.append((a, b))
    kind = np.full(len(rows), int(SurfaceKind.CYLINDER), np.int32)
    cylinders = Surfaces(kind=kind, parameters=np.reshape(rows, (-1, 8)))
    return Rounds(cylinders, np.reshape(sides, (-1, 2)).astype(np.int64), on)


def refitted_rounds(
    samples: Samples,
    label: np.ndarray,
    parameters: np.ndarray,
    sides: np.ndarray,
    *,
    noise: float,
    limit: float,
) -> np.ndarray:
    """Return the parameters of surfaces, of which the last are rounds, fitted to their planes.

    Args:
        samples: The samples.
        label: Surface of every sample, -1 = none, shape (A,), i32.
        parameters: As in `Segmentation.parameters`, shape (M, 8).
        sides: The planes beside the rounds, shape (K, 2).
        noise: Deviation of a point from its surface [mm].
        limit: Rounds with smaller radii are edges [mm].

    Returns:
        Shape (M, 8). Rounds that these planes and their points do not show stay as they are.
    """
    parameters = parameters.copy()
    for k, (a, b) in enumerate(sides, len(parameters) - len(sides)):
        here = np.flatnonzero((label == a) | (label == b) | (label == k))
        side = np.select([label[here] == a, label[here] == b], [0, 1], NONE)
        found = round_between(
            samples.point[here], side, parameters[[a, b]], noise=noise, limit=limit
        )
        if found is not None:
            parameters[k] = found[0]
    return parameters


def round_between(
    point: np.ndarray, side: np.ndarray, planes: np.ndarray, *, noise: float, limit: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the round between two planes, and which samples lie on it; None where there is none.

    Args:
        point: Samples of both, and of the round where it is known [mm], shape (k, 3).
        side: 0 and 1 for those of the first and of the second plane, else -1, shape (k,).
        planes: The planes, as in `Segmentation.parameters`, shape (2, 8).
        noise: Deviation of a point from its surface [mm].
        limit: Least radius [mm].

    Returns:
        A cylinder, as in `Segmentation.parameters`, shape (8,), and shape (k,), bool.
    """
    first, second = side == 0, side == 1
    if not first.any() or not second.any():
        return None
    n, m = planes[:, 3:6]
    m = m if n.dot(m) > 0.0 else -m
    up, across = n + m, m - n
    sine = np.sqrt(across.dot(across)) / 2.0  # of half the angle
    up, across = up / np.sqrt(up.dot(up)), across / np.sqrt(across.dot(across))
    cosine = np.sqrt(1.0 - sine**2)
    # The point of both planes that is nearest to the first one's.
    rise = m.dot(planes[1, :3] - planes[0, :3])
    side = m - n.dot(m) * n
    base = planes[0, :3] + side * (rise / side.dot(side))
    away = point - base
    x, z = np.einsum("ki,i->k", away, across), np.einsum("ki,i->k", away, up)
    hollow = 1.0 if np.median(x[first]) > np.median(x[second]) else -1.0
    inside = hollow * z - np.abs(x) * (sine / cosine)
    deep = 1.0 / cosine - 1.0
    low, high = (d * noise / deep for d in _DEPTHS)
    low = max(low, limit)
    if low >= high:
        return None
    near = np.flatnonzero((np.abs(x) <= high * sine) & (np.abs(inside) <= _NEAR * noise))
    radii = np.geomspace(low, high, _RADII)
    for _ in range(2):
        depth = _depth(x[near], radii[:, None], sine, cosine)
        product = np.einsum("rk,k->r", depth, inside[near])
        square = np.einsum("rk,rk->r", depth, depth)
        k = int(np.argmax(2.0 * product - square))
        best, gain, agrees = (
            radii[k],
            2.0 * product[k] - square[k],
            product[k] >= _AGREES * square[k],
        )
        radii = np.linspace(radii[max(k - 1, 0)], radii[min(k + 1, _RADII - 1)], _RADII)
    if gain < _GAIN * noise**2 or not agrees:
        return None
    there = np.zeros(len(point), bool)
    there[near] = np.abs(x[near]) <= best * sine
    axis = np.cross(n, m)
    axis /= np.sqrt(axis.dot(axis))
    middle = base + hollow * best / cosine * up
    middle = middle + axis * axis.dot(point[there].mean(axis=0) - middle)
    return np.concatenate([middle, axis, [best, np.nan]]), there


def _depth(x: np.ndarray, radius: np.ndarray, sine: float, cosine: float) -> np.ndarray:
    """Return by how much rounds are inside the sharp edge, at places across that [mm]."""
    within = np.minimum(np.abs(x), radius * sine)
    circle = radius / cosine - np.sqrt(radius**2 - within**2)
    depth: np.ndarray = circle - within * (sine / cosine)
    return depth
