"""Plain distances, normals and points of the analytic surfaces."""

from __future__ import annotations

import numpy as np

PLANE, CYLINDER, CONE, SPHERE, TORUS = range(5)


def distance_of(points: np.ndarray, kind: int, parameters: np.ndarray) -> np.ndarray:
    """Return the signed orthogonal distance of every point (N, 3) to a surface (8,)."""
    q = points - parameters[:3]
    axis, a, b = parameters[3:6], parameters[6], parameters[7]
    z = q @ axis
    rho = np.linalg.norm(q - z[:, None] * axis, axis=1)
    if kind == PLANE:
        return z
    if kind == CYLINDER:
        return rho - a
    if kind == SPHERE:
        return np.linalg.norm(q, axis=1) - a
    if kind == TORUS:
        return np.hypot(rho - a, z) - b
    behind = z * np.cos(a) + rho * np.sin(a) < 0.0
    return np.where(behind, np.linalg.norm(q, axis=1), rho * np.cos(a) - z * np.sin(a))


def patch_of(
    kind: int, rng: np.random.Generator, n: int, arc: float = 1.5, size: float = 8.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points on a patch, their outward normals, and the parameters of the surface.

    The patch spans ``arc`` radians round the axis (and round the tube), or ``size`` on a plane;
    it stands on the z axis at the origin.
    """
    around, up = rng.uniform(0.0, arc, n), rng.uniform(0.0, 1.0, n)
    out = np.column_stack((np.cos(around), np.sin(around), np.zeros(n)))
    along = np.array([0.0, 0.0, 1.0])
    parameters = np.array([0, 0, 0, 0, 0, 1, np.nan, np.nan], float)
    if kind == PLANE:
        points = np.column_stack((rng.uniform(-size / 2, size / 2, (n, 2)), np.zeros(n)))
        return points, np.tile(along, (n, 1)), parameters
    if kind == CYLINDER:
        parameters[6] = 6.0
        return 6.0 * out + 8.0 * up[:, None] * along, out, parameters
    if kind == CONE:
        parameters[6] = 0.5
        z = 6.0 + 8.0 * up[:, None]
        normals = np.cos(0.5) * out - np.sin(0.5) * along
        return z * (np.tan(0.5) * out + along), normals, parameters
    round_tube = rng.uniform(0.0, arc, n)[:, None]
    normals = np.cos(round_tube) * out + np.sin(round_tube) * along
    if kind == SPHERE:
        parameters[6] = 7.0
        return 7.0 * normals, normals, parameters
    parameters[6:] = 9.0, 2.0
    return 9.0 * out + 2.0 * normals, normals, parameters


def placed(
    points: np.ndarray, normals: np.ndarray, parameters: np.ndarray, q: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a patch turned by ``q`` and shifted by ``t``."""
    moved = parameters.copy()
    moved[:3], moved[3:6] = q @ parameters[:3] + t, q @ parameters[3:6]
    return points @ q.T + t, normals @ q.T, moved
