"""Which kind of surface a group of points lies on: the simplest one that does not fit worse."""

from dataclasses import dataclass

import numpy as np

from octoseg_ti.fitting.primitives import FREEDOM, Fits
from octoseg_ti.fitting.quadrics import Quadrics
from octoseg_ti.types import SurfaceKind

# A parameter more has to gain this many times log(n) in log-likelihood (times 2). BIC asks for 1
# and takes the noise of points for independent; three times that holds where stripes or views share
# some of it, and is four standard deviations for a hundred points.
_PENALTY = 8.0
_COUNTED = 500  # points beyond these prove nothing more: then it is form, no noise, that is seen
_FORM = 0.1  # deviations of form, in noise, that no kind has to explain
_ROUNDING = 1e-5  # ... and in extents, for data without noise
_ROOM = 3.0  # a kind may be so many times the noise away, in rms
_NORMALS = 0.25  # what the normal of a point adds to its position: it was made of its neighbours
_SMOOTH = 0.02  # deviations of normals [rad] that no kind has to explain
_TILT = 2.0  # its normals may be so many times farther off than those of the best kind
_TILT_ALWAYS = 0.2  # ... and this far [rad] at any rate
_RIVAL = 4.0  # times the least loss: kinds that fit about as well
_ONE_SIDED = 0.5  # least part of the size of the mean cosine that its sign must account for


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Choice:
    """The surface of every one of ``G`` groups."""

    kind: np.ndarray
    """`SurfaceKind`, shape (G,), i8: FREE_FORM where no kind fits, NONE for too few points."""
    parameters: np.ndarray
    """As in `Segmentation.parameters`, shape (G, 8); NaN where there is no kind."""
    rms: np.ndarray
    """Root mean square distance to it [mm], shape (G,); for a free form, to the best kind."""
    side: np.ndarray
    """Sign of the agreement of the measured normals with the outward ones, shape (G,), f64: 1 for
    a boss, -1 for a hole; 0 where there is no kind."""
    evidence: np.ndarray
    """By how much the next best kind is worse, shape (G,): twice the difference in
    log-likelihood less the penalties; small = could be either."""


def choose(
    fits: Fits,
    *,
    noise: float | np.ndarray,
    room: float = _ROOM,
    signed: bool = True,
) -> Choice:
    """Choose the kind of every group.

    The scores of the kinds are n log(loss) plus a penalty for every unknown, so that each kind is
    judged by the noise that it leaves, and the noise given only says what is too much. More points
    do not make a plane with a trace of form into a huge cylinder: points count up to a few hundred,
    and a tenth of the noise is taken for form. Normals count too: a narrow ring of a cone lies on a
    sphere, and faces elsewhere.

    Args:
        fits: The fits of all kinds.
        noise: Standard deviation of a point about its surface [mm], of all or of every group, (G,).
        room: A kind fits up to this many times the noise, in rms.
        signed: Normals point to the probe, so that both sides of a sheet are no plane.

    Returns:
        The choice. Of a robust fit the loss counts, so that points out of reach speak for no kind.
    """
    groups = len(fits.count)
    sigma = np.broadcast_to(np.asarray(noise, np.float64), groups)[:, None]
    form = np.maximum(_FORM * sigma, _ROUNDING * fits.extent[:, None])
    counted = np.minimum(fits.count, _COUNTED)[:, None]
    possible = np.isfinite(fits.loss)
    loss = np.where(possible, fits.loss, np.inf)
    score = counted * np.log(loss + form**2) + _PENALTY * FREEDOM * np.log(np.maximum(counted, 2))
    score += _NORMALS * counted * np.log(np.nan_to_num(fits.tilt, nan=1.0) ** 2 + _SMOOTH**2)
    fitting = possible & (fits.rms <= np.maximum(room * sigma, form)) & _agrees(fits, loss, signed)
    score = np.where(fitting, score, np.inf)
    rows = np.arange(groups)
    best = np.argmin(score, axis=1)
    found = fitting[rows, best]
    ordered = np.sort(score, axis=1)
    with np.errstate(invalid="ignore"):
        evidence = np.where(found, ordered[:, 1] - ordered[:, 0], np.nan)
    nearest = np.argmin(np.where(possible, fits.rms, np.inf), axis=1)
    kind = np.where(found, best, int(SurfaceKind.FREE_FORM))
    kind[~possible.any(axis=1)] = int(SurfaceKind.NONE)
    return Choice(
        kind=kind.astype(np.int8),
        parameters=np.where(found[:, None], fits.parameters[rows, best], np.nan),
        rms=fits.rms[rows, np.where(found, best, nearest)],
        side=np.where(found, np.sign(np.nan_to_num(fits.side[rows, best])), 0.0),
        evidence=evidence,
    )


def plane_does(
    flat: Quadrics, count: np.ndarray, *, noise: float, room: float = _ROOM
) -> np.ndarray:
    """Say which groups `choose` would take for planes, whatever else were fitted to them.

    Args:
        flat: Planes and quadrics through the groups; the quadrics stand for all curved surfaces.
        count: Points of the groups, shape (G,).
        noise: As of `choose`.
        room: As of `choose`.

    Returns:
        Shape (G,), bool.
    """
    counted = np.clip(count, 2, _COUNTED)
    square = flat.rms**2 + (_FORM * noise) ** 2 + 1e-300
    turn = flat.tilt**2 + _SMOOTH**2
    gain = np.log(square[:, 0] / square[:, 1]) + _NORMALS * np.log(turn[:, 0] / turn[:, 1])
    sided = np.abs(flat.side) >= _ONE_SIDED * np.sqrt(np.maximum(1.0 - flat.tilt[:, 0] ** 2, 0.0))
    fitting = (flat.rms[:, 0] <= room * noise) & (flat.tilt[:, 0] <= _TILT_ALWAYS) & sided
    return fitting & (count > FREEDOM[0]) & (counted * gain <= _PENALTY * np.log(counted))


def _agrees(fits: Fits, loss: np.ndarray, signed: bool) -> np.ndarray:
    """Say where the measured normals are those of the surface, shape (G, 5).

    The best normals are looked for among the kinds that fit the points about as well as any.
    """
    tilt = np.where(np.isfinite(fits.tilt), fits.tilt, np.inf)
    rivals = loss <= _RIVAL * loss.min(axis=1, keepdims=True)
    least = np.where(rivals, tilt, np.inf).min(axis=1, keepdims=True)
    near = tilt <= np.maximum(_TILT * least, _TILT_ALWAYS)
    if not signed:
        return near
    cosine = np.sqrt(np.maximum(1.0 - tilt**2, 0.0))
    return near & (np.abs(np.nan_to_num(fits.side)) >= _ONE_SIDED * cosine)
