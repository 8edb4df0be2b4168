"""How sure parameters of surfaces are, by numerical derivatives and pseudo-inverses."""

from __future__ import annotations

import numpy as np

from reference.surfaces import CONE, CYLINDER, PLANE, SPHERE, TORUS, distance_of

UNKNOWNS = {PLANE: 3, CYLINDER: 5, CONE: 6, SPHERE: 4, TORUS: 7}
HAS = {
    PLANE: [0, 1, 2, 3, 4, 5],
    CYLINDER: [0, 1, 2, 3, 4, 5, 6],
    CONE: [0, 1, 2, 3, 4, 5, 6],
    SPHERE: [0, 1, 2, 6],
    TORUS: [0, 1, 2, 3, 4, 5, 6, 7],
}


def ways_of(kind: int, parameters: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the changes that move a surface, shape (8, unknowns).

    Not among them: what the kind has not, another length of the axis, and shifts of the point
    that leave the surface where it is.
    """
    axis = parameters[3:6]
    fixed = [np.eye(8)[i] for i in range(8) if i not in HAS[kind]]
    fixed.append(np.concatenate([np.zeros(3), axis, np.zeros(2)]))
    if kind == CYLINDER:
        fixed.append(np.concatenate([axis, np.zeros(5)]))
    if kind == PLANE:
        fixed += [np.concatenate([e, np.zeros(5)]) for e in np.linalg.svd(axis[None])[2][1:]]
    size, vector = np.linalg.eigh(np.array(fixed).T @ np.array(fixed))
    return vector[:, size < 1e-9]


def gradient_of(points: np.ndarray, kind: int, parameters: np.ndarray) -> np.ndarray:
    """Return the change of the distances by central differences, shape (N, unknowns)."""
    small = 1e-6
    given = np.nan_to_num(parameters)
    columns = []
    for way in ways_of(kind, parameters).T:
        ahead, behind = given + small * way, given - small * way
        for moved in (ahead, behind):
            moved[3:6] /= np.linalg.norm(moved[3:6])
        columns.append(
            (distance_of(points, kind, ahead) - distance_of(points, kind, behind)) / (2 * small)
        )
    return np.stack(columns, axis=1)


def covariance_of(points: np.ndarray, kind: int, parameters: np.ndarray) -> np.ndarray:
    """Return the covariance of a surface fitted to points, shape (8, 8)."""
    ways, change = ways_of(kind, parameters), gradient_of(points, kind, parameters)
    far = distance_of(points, kind, np.nan_to_num(parameters))
    square = np.sum(far**2) / (len(points) - ways.shape[1])
    found = square * ways @ np.linalg.inv(change.T @ change) @ ways.T
    has = np.isin(np.arange(8), HAS[kind])
    return np.where(has & has[:, None], found, np.nan)


def nearest_form(kind: int, true: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Return the true parameters as near to those found as the same surface allows."""
    near = true.copy()
    if near[3:6] @ found[3:6] < 0.0:
        near[3:6] *= -1.0
    shift, axis = found[:3] - near[:3], near[3:6]
    if kind == CYLINDER:
        near[:3] += (shift @ axis) * axis
    if kind == PLANE:
        near[:3] += shift - (shift @ axis) * axis
    return near


def squared_error(kind: int, found: np.ndarray, true: np.ndarray, covariance: np.ndarray) -> float:
    """Return the square of the error of parameters in standard deviations (Mahalanobis).

    Its mean is the number of unknowns where the covariance tells the truth.
    """
    ways = ways_of(kind, found)
    error = ways.T @ np.nan_to_num(found - nearest_form(kind, true, found))
    return float(error @ np.linalg.solve(ways.T @ np.nan_to_num(covariance) @ ways, error))
