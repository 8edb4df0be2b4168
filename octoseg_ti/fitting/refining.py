"""Surfaces fitted anew from where they are: their kinds are known, and they are nearly right."""

import numpy as np

from octoseg_ti.device.surfaces import KINDS, SPHERE
from octoseg_ti.fitting.descent import iterate
from octoseg_ti.fitting.primitives import FREEDOM, TUKEY, to_parameters, to_states


def refine(
    points: np.ndarray,
    start: np.ndarray,
    kind: np.ndarray,
    parameters: np.ndarray,
    *,
    noise: float,
    rounds: int = 5,
) -> np.ndarray:
    """Return the parameters of surfaces after some steps of Levenberg and Marquardt.

    The sum of Tukey's loss of the orthogonal distances falls with every step that is taken; a
    surface whose steps do not lower it stays, and so does one of fewer points than unknowns.

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
    kind, start = np.asarray(kind, np.int32), np.asarray(start, np.int32)
    count = np.diff(start)
    which = np.flatnonzero(count > FREEDOM[kind])
    if len(which) == 0:
        return parameters.copy()
    owner = np.repeat(np.arange(len(kind)), count)
    total = np.maximum(count, 1)
    centre = np.column_stack([np.bincount(owner, x, len(kind)) for x in points.T]) / total[:, None]
    away = points - np.repeat(centre, count, axis=0)
    square = np.einsum("si,si->s", away, away)
    extent = np.sqrt(np.bincount(owner, square, len(kind)) / total)
    extent[extent == 0.0] = 1.0
    state = to_states(kind, parameters, centre, extent)
    state[count <= FREEDOM[kind]] = np.nan
    reach = np.repeat(TUKEY * noise / extent[:, None], KINDS, axis=1)
    frame = np.column_stack([centre, 1.0 / extent])
    state = iterate(
        points, np.ones(len(points)), start, frame, reach, state[None],
        rounds=rounds, thin=False, leave=False,
    )  # fmt: skip
    found = to_parameters(state, centre, extent)[which, kind[which]]
    ball = kind[which] == SPHERE  # whose axis means nothing
    found[ball, 3:6] = parameters[which[ball], 3:6]
    refined = parameters.copy()
    refined[which] = found
    return refined
