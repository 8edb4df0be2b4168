"""Surfaces are fitted anew to what they have now, where that is something else than before."""

import numpy as np

from octoseg_ti.stages.leaves import Samples
from octoseg_ti.stages.sets import Surfaces, fit_sets, largest_gap, lie_on, spread
from octoseg_ti.types import NONE

FEWEST = 10
"""Fewest samples that are worth a fit."""

# Samples for a fit.
_MOST = 300
# What a surface was fitted to tells as much as what it has now when it has kept this share of that,
# and has no more than so many times that.
_SAME, _MORE = 0.95, 1.25
# A surface that moves by less, in noises, stays where it is.
_MOVED = 0.2
# Samples lie on a surface within so many noises, and with normals turned by no more [rad].
_ON, _TURN = 3.0, 0.5
# A new surface may lose this share of the samples of the one before.
_LOST = 0.01


def fitted_to_others(fitted: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    """Return which surfaces have other samples than they were fitted to, shape (M,), bool.

    Args:
        fitted: Surface that every sample was fitted by, -1 = none, shape (A,), i32.
        label: Surface of every sample now, -1 = none, shape (A,), i32.
        count: Number of surfaces M.
    """
    before, now, both = (
        np.bincount(of + 1, minlength=count + 1)[1:]
        for of in (fitted, label, np.where(fitted == label, label, NONE))
    )
    changed: np.ndarray = (both < _SAME * before) | (now > _MORE * before)
    return changed


def refitted(
    samples: Samples,
    members: list[np.ndarray],
    asked: np.ndarray,
    surfaces: Surfaces,
    noise: float,
) -> Surfaces:
    """Return the surfaces, some of them fitted anew where that explains as much.

    Args:
        samples: The samples.
        members: Samples of every surface.
        asked: Which surfaces to fit anew, shape (M,), bool.
        surfaces: The surfaces.
        noise: Deviation of a point from its surface [mm].
    """
    many = np.array([len(m) >= FEWEST for m in members], bool)
    which = np.flatnonzero(many & asked)
    sets = [spread(members[m], _MOST) for m in which]
    fitted, fits = fit_sets(samples, sets, noise, robust=True)
    before = surfaces.at(which[fitted])
    new = lie_on(samples, sets, fitted, fits, _ON * noise, _TURN)
    old = lie_on(samples, sets, fitted, before, _ON * noise, _TURN)
    # What has hardly moved stays: nothing near it has to choose again.
    moved = largest_gap(samples, sets, fitted, before, fits) > _MOVED * noise
    moved |= before.kind != fits.kind
    kind, parameters = surfaces.kind.copy(), surfaces.parameters.copy()
    for k, f in enumerate(fitted):
        if moved[k] and new[k].mean() >= old[k].mean() - _LOST:
            kind[which[f]], parameters[which[f]] = fits.kind[k], fits.parameters[k]
    return Surfaces(kind=kind, parameters=parameters)
