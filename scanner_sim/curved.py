"""Curved patches over triangles, for free-form surfaces whose normals at the corners are known.

The patch is the cubic of Vlachos, Peters, Boyd and Mitchell ("Curved PN triangles", Symposium on
Interactive 3D Graphics 2001): it ends at the corners at right angles to their normals, and is exact
where the surface is quadratic. So it follows the surface far more closely than its triangle does.
"""

from __future__ import annotations

import numpy as np

_STEPS = 3


def shares(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the weights of the three corners whose mean lies below every point, shape (N, 3).

    Args:
        corners: Corners of a triangle for every point [mm], shape (N, 3, 3).
        points: Positions [mm], shape (N, 3).
    """
    a, b, c = corners.transpose(1, 0, 2)
    whole = np.cross(b - a, c - a)
    squared = np.maximum(np.einsum("ij,ij->i", whole, whole), 1e-300)
    first = np.einsum("ij,ij->i", np.cross(c - b, points - b), whole) / squared
    second = np.einsum("ij,ij->i", np.cross(a - c, points - c), whole) / squared
    return np.stack([first, second, 1.0 - first - second], axis=1)


def mixed(share: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the unit normal between those at the corners, shape (N, 3)."""
    normal = np.einsum("ij,ijk->ik", np.clip(share, 0.0, 1.0), normals)
    length: np.ndarray = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.where(length > 1e-12, normal / np.maximum(length, 1e-300), normals[:, 0])


def patch_points(corners: np.ndarray, normals: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return points of the curved patches [mm], shape (N, 3).

    Args:
        corners: Corners of the triangles [mm], shape (N, 3, 3).
        normals: Unit normals of the surface there, shape (N, 3, 3).
        share: Weights of the corners, shape (N, 3).
    """
    found = np.einsum("ij,ijk->ik", share**3, corners)
    rim = np.zeros_like(found)
    for i in range(3):
        for j in ((i + 1) % 3, (i + 2) % 3):
            step = corners[:, j] - corners[:, i]
            rise = np.einsum("ij,ij->i", step, normals[:, i])[:, None]
            control = corners[:, i] + (step - rise * normals[:, i]) / 3.0
            rim += control / 6.0
            found += (3.0 * share[:, i] ** 2 * share[:, j])[:, None] * control
    middle = rim + 0.5 * (rim - corners.mean(axis=1))
    return found + (6.0 * share.prod(axis=1))[:, None] * middle


def meet_patches(
    corners: np.ndarray, normals: np.ndarray, points: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far along their rays points of triangles meet the curved patches.

    Args:
        corners: Corners of the triangles [mm], shape (N, 3, 3).
        normals: Unit normals of the surface there, shape (N, 3, 3).
        points: Where the rays meet the triangles [mm], shape (N, 3).
        directions: Unit vectors of the rays, shape (N, 3).

    Returns:
        Steps along the rays [mm], shape (N,), and unit normals at the places, shape (N, 3). A ray
        that runs along the surface stays on the triangle.
    """
    moved = np.zeros(len(points))
    normal = normals[:, 0]
    for _ in range(_STEPS):
        place = points + moved[:, None] * directions
        share = shares(corners, place)
        normal = mixed(share, normals)
        gap = np.einsum("ij,ij->i", patch_points(corners, normals, share) - place, normal)
        slope = np.einsum("ij,ij->i", directions, normal)
        steep = np.abs(slope) > 0.02
        moved += np.where(steep, gap / np.where(steep, slope, 1.0), 0.0)
    return moved, normal
