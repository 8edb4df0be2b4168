"""Rotation matrices to quaternions and back, and moving points by a pose."""

from __future__ import annotations

import numpy as np


def quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """Return (x, y, z, w) of a rotation matrix (3, 3), with w >= 0.

    The component of largest magnitude is taken from the diagonal, so that no angle is ill-
    conditioned (S. W. Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1(3),
    1978).
    """
    r = np.asarray(rotation, np.float64)
    diagonal = np.array([r[0, 0], r[1, 1], r[2, 2], r[0, 0] + r[1, 1] + r[2, 2]])
    i = int(diagonal.argmax())
    q = np.empty(4)
    if i == 3:
        q[:] = (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1.0 + diagonal[3])
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + r[i, i] - r[j, j] - r[k, k]
        q[j] = r[j, i] + r[i, j]
        q[k] = r[k, i] + r[i, k]
        q[3] = r[k, j] - r[j, k]
    q /= np.linalg.norm(q) * (-1.0 if q[3] < 0 else 1.0)
    x, y, z, w = (float(value) for value in q)
    return x, y, z, w


def rotation(q: tuple[float, float, float, float]) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a quaternion (x, y, z, w) of any length but zero.

    Raises:
        ValueError: The quaternion is zero or not finite.
    """
    x, y, z, w = q
    norm = x * x + y * y + z * z + w * w
    if not np.isfinite(norm) or norm == 0.0:
        raise ValueError(f"the quaternion {q} is not a rotation")
    s = 2.0 / norm
    return np.array(
        [
            [1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)],
        ]
    )


def pose(q: tuple[float, float, float, float], translation: np.ndarray) -> np.ndarray:
    """Return the 4x4 matrix of a quaternion (x, y, z, w) and a translation (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(q)
    matrix[:3, 3] = translation
    return matrix


def moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (N, 3) moved by a 4x4 pose."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]
