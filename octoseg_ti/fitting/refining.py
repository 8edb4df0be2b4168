"""Surfaces fitted anew from where they are: their kinds are known, and they are nearly right."""

import numpy as np

from octoseg_ti.device.surfaces import KINDS, evaluate_surfaces
from octoseg_ti.fitting.covariance import WAYS, distance_gradient, padded, ways_of
from octoseg_ti.fitting.primitives import TUKEY

_DAMPING = 1e-9  # of the squares of the columns: what no point holds stays where it is
_LEAST = 1e-12


def refine(
    points: np.ndarray,
    start: np.ndarray,
    kind: np.ndarray,
    parameters: np.ndarray,
    *,
    noise: float,
    rounds: int = 4,
) -> np.ndarray:
    """Return the parameters of surfaces after some steps of Gauss and Newton.

    The sum of Tukey's loss of the orthogonal distances falls with every step that is taken; a
    surface whose next step does not lower it stays.

    Args:
        points: The points of every surface, one group after the other [mm], shape (S, 3), f64.
        start: First point of every surface, and S at the end, shape (M + 1,).
        kind: `SurfaceKind` of every surface, shape (M,), one of the five analytic kinds.
        parameters: As in `Segmentation.parameters`, shape (M, 8).
        noise: Deviation of a point from its surface [mm].
        rounds: Most steps.

    Returns:
        Shape (M, 8).
    """
    kind, start = np.asarray(kind, np.int32), np.asarray(start, np.int64)
    count = np.diff(start)
    owner = np.repeat(np.arange(len(kind), dtype=np.int32), count)
    reach = TUKEY * noise
    best, tried = parameters.copy(), parameters.copy()
    least = np.full(len(kind), np.inf)
    for turn in range(rounds + 1):
        far, normal = evaluate_surfaces(points, owner, kind, tried)
        share = np.minimum((far / reach) ** 2, 1.0)
        loss = np.bincount(owner, 1.0 - (1.0 - share) ** 3, len(kind))
        better = loss < least
        best[better], least[better] = tried[better], loss[better]
        if turn == rounds or not better.any():
            break
        weight = (1.0 - share) * better[owner]
        change = distance_gradient(points, normal, kind[owner], best[owner])
        tried = _stepped(start, kind, best, change * weight[:, None], far * weight)
    return best


def _stepped(
    start: np.ndarray, kind: np.ndarray, parameters: np.ndarray, change: np.ndarray, far: np.ndarray
) -> np.ndarray:
    """Return the parameters after a step that takes weighted distances away, (M, 8)."""
    stepped, count = parameters.copy(), np.diff(start)
    for code in range(KINDS):
        which = np.flatnonzero((kind == code) & (count > len(WAYS[code])))
        if len(which) == 0:
            continue
        place, there = padded(start, which)
        ways = ways_of(parameters[which, 3:6])[:, :, WAYS[code]]
        columns = np.einsum("mni,mik->kmn", change[place], ways) * there
        # No product of matrices: its sums may depend on the threads.
        square = np.einsum("kmn,lmn->mkl", columns, columns)
        side = np.einsum("kmn,mn->mk", columns, far[place] * there)
        diagonal = np.einsum("mkk->mk", square)
        diagonal += _DAMPING * diagonal + _LEAST
        step = -np.einsum("mik,mk->mi", ways, np.linalg.solve(square, side[..., None])[..., 0])
        stepped[which] += np.where(np.isfinite(parameters[which]), step, 0.0)
    axis = stepped[:, 3:6]
    stepped[:, 3:6] = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), _LEAST)
    return stepped
