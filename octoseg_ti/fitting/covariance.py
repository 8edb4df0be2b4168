"""How sure the parameters of surfaces are: covariances by the points that they were fitted to."""

import numpy as np

from octoseg_ti.device.surfaces import (
    CONE,
    CYLINDER,
    KINDS,
    PLANE,
    SPHERE,
    TORUS,
    evaluate_surfaces,
)
from octoseg_ti.fitting.starts import across

PARAMETERS = 8
"""Point (3), axis or normal (3), a and b."""

# What a surface of every kind can do, in the order of `ways_of`: its point moves along the axis or
# across it in two directions, its axis turns towards these two, a and b grow. A plane stays the
# same where its point moves within it, a cylinder where that moves along the axis.
_CAN = np.zeros((KINDS, 7), bool)
_CAN[PLANE, [0, 3, 4]] = True
_CAN[CYLINDER, 1:6] = True
_CAN[CONE, 0:6] = True
_CAN[SPHERE, [0, 1, 2, 5]] = True
_CAN[TORUS] = True
# The parameters that a kind has: a point, and what can change.
_HAS = np.hstack([np.ones((KINDS, 3), bool), _CAN[:, [3, 3, 3, 5, 6]]])
# What of a column other columns leave is rounding below this share of it: what no point holds gets
# a large, finite deviation.
_ROUNDING = 1e-12


def covariances(
    points: np.ndarray, start: np.ndarray, kind: np.ndarray, parameters: np.ndarray
) -> np.ndarray:
    """Return the covariances of the parameters of surfaces fitted by least orthogonal distances.

    To first order, for independent noise: s^2 (J'J)^-1, with J the change of the distances by what
    the surface can do, and s^2 the sum of the squares of the distances over the points less the
    unknowns.

    Args:
        points: The points that every surface was fitted to, one group after the other [mm], shape
            (S, 3), f64.
        start: First point of every surface, and S at the end, shape (M + 1,).
        kind: `SurfaceKind` of every surface, shape (M,), one of the five analytic kinds.
        parameters: As in `Segmentation.parameters`, shape (M, 8).

    Returns:
        As in `Segmentation.covariance`, shape (M, 8, 8), f64; NaN where there are no more points
        than unknowns.
    """
    kind, start = np.asarray(kind, np.int32), np.asarray(start, np.int64)
    count = np.diff(start)
    found = np.full((len(kind), PARAMETERS, PARAMETERS), np.nan)
    spare = count - _CAN[kind].sum(axis=1)
    which = np.flatnonzero(spare > 0)
    if len(which) == 0:
        return found
    far, normal = evaluate_surfaces(
        points, np.repeat(np.arange(len(kind)), count), kind, parameters
    )
    place, there = padded(start, which)
    kind, parameters = kind[which], parameters[which]
    frame = frames_of(parameters[:, 3:6])
    change = distance_changes(
        points.T.take(place, 1), normal.T.take(place, 1), frame, kind, parameters
    )
    change *= _CAN[kind].T[:, :, None] & there
    root = ways_of(frame, kind) @ np.linalg.inv(_triangles(change))
    square = np.sum((far[place] * there) ** 2, axis=1) / spare[which]
    whole = square[:, None, None] * np.einsum("mik,mjk->mij", root, root)
    has = _HAS[kind]
    found[which] = np.where(has[:, :, None] & has[:, None, :], whole, np.nan)
    return found


def frames_of(axis: np.ndarray) -> np.ndarray:
    """Return every axis and two directions across it, by rows, shape (M, 3, 3)."""
    u = across(axis)
    return np.stack([axis, u, np.cross(axis, u)], axis=1)


def ways_of(frame: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return the seven ways in which parameters can change, by columns, shape (M, 8, 7).

    Args:
        frame: As `frames_of` returns them, shape (M, 3, 3).
        kind: `SurfaceKind`, shape (M,); a way in which a kind cannot change is 0.
    """
    columns = np.swapaxes(frame, 1, 2)
    ways = np.zeros((len(kind), PARAMETERS, 7))
    ways[:, :3, :3], ways[:, 3:6, 3:5] = columns, columns[:, :, 1:]
    ways[:, 6, 5] = ways[:, 7, 6] = 1.0
    return ways * _CAN[kind][:, None, :]


def distance_changes(
    points: np.ndarray,
    normal: np.ndarray,
    frame: np.ndarray,
    kind: np.ndarray,
    parameters: np.ndarray,
) -> np.ndarray:
    """Return how the distances of points change as surfaces change in each of seven ways.

    Args:
        points: Coordinates of the points of every surface [mm], shape (3, M, k).
        normal: Outward normal of the surface at the foot of every point, shape (3, M, k).
        frame: As `frames_of` returns them, shape (M, 3, 3).
        kind: `SurfaceKind`, shape (M,).
        parameters: As in `Segmentation.parameters`, shape (M, 8).

    Returns:
        Shape (7, M, k), for the ways of `ways_of`; of no meaning where a kind cannot change so.
    """
    z, x, y = np.einsum("imk,mji->jmk", points - parameters.T[:3, :, None], frame)
    nz, nx, ny = np.einsum("imk,mji->jmk", normal, frame)
    change = np.full((7, *z.shape), -1.0)
    for k, n in enumerate((nz, nx, ny)):
        np.negative(n, out=change[k])
    change[3], change[4] = nz * x - z * nx, nz * y - z * ny
    cone, ring = kind == CONE, kind == TORUS
    half = parameters[cone, 6, None]
    rho = np.sqrt(x * x + y * y)
    # Behind the apex of a cone its angle changes nothing.
    change[5, cone] = -np.maximum(rho[cone] * np.sin(half) + z[cone] * np.cos(half), 0.0)
    change[5, ring] = -(nx * x + ny * y)[ring] / np.maximum(rho[ring], 1e-300)
    return change


def padded(start: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of some groups in a table, and which entries are points and no padding.

    Args:
        start: First point of every group, and S at the end, shape (M + 1,).
        which: The groups, at least one, shape (m,).
    """
    place = start[which, None] + np.arange((start[which + 1] - start[which]).max())
    there = place < start[which + 1, None]
    return np.where(there, place, 0), there


def _triangles(columns: np.ndarray) -> np.ndarray:
    """Return R of J = QR, by the modified Gram-Schmidt process.

    Radius and centre of a shallow piece of a sphere change the distances almost alike. R tells what
    is left of that to half as many digits as J'J would lose.

    Args:
        columns: J of every surface, shape (unknowns, M, points); used up.

    Returns:
        Upper triangles, shape (M, unknowns, unknowns).
    """
    unknowns, many, _ = columns.shape
    triangle = np.zeros((many, unknowns, unknowns))
    whole = np.sqrt(np.einsum("kmn,kmn->km", columns, columns))
    for k in range(unknowns):
        left = np.sqrt(np.einsum("mn,mn->m", columns[k], columns[k]))
        least = _ROUNDING * np.where(whole[k] > 0.0, whole[k], 1.0)
        triangle[:, k, k] = np.maximum(left, least)
        unit = columns[k] / triangle[:, k, k, None]
        later = columns[k + 1 :]
        share = np.einsum("mn,jmn->jm", unit, later)
        later -= share[:, :, None] * unit
        triangle[:, k, k + 1 :] = share.T
    return triangle
