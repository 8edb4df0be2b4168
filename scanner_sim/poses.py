"""What the scanner believes about its poses: the true ones, and an error of its own each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scanner_sim.scanner import StripeScanner

_CHILD = 1_000_000  # child of the seed that draws the poses: beyond the numbers of all views


def pose_errors(count: int, noise: float, angle: float, seed: int) -> np.ndarray:
    """Return random rigid motions, one for each view; that of the first view is the identity.

    Every motion turns about the origin of its view and then shifts: three components of a rotation
    vector and three of a shift, all Gaussian and independent. The first view is the datum: the
    world is the frame in which its pose is right.

    Args:
        count: Number of views.
        noise: Standard deviation of the shift along each axis [mm].
        angle: Standard deviation of the rotation about each axis [rad].
        seed: Seed of the scan; the errors draw from a child of their own, so that they change
            nothing else.

    Returns:
        Motions in the frames of the views, shape (count, 4, 4), f64.
    """
    from scipy.spatial.transform import Rotation

    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_CHILD,)))
    drawn = generator.standard_normal((count, 6))
    drawn[:1] = 0.0
    motions = np.tile(np.eye(4), (count, 1, 1))
    motions[:, :3, :3] = Rotation.from_rotvec(angle * drawn[:, :3]).as_matrix()
    motions[:, :3, 3] = noise * drawn[:, 3:]
    return motions


def recorded_poses(true: np.ndarray, scanner: StripeScanner, seed: int) -> np.ndarray:
    """Return the poses that the scanner records, shape (V, 4, 4): the true ones with its errors.

    Args:
        true: True poses, view to world, shape (V, 4, 4).
        scanner: Tells the size of the errors; without any the poses come back as they are.
        seed: Seed of the scan.
    """
    if scanner.pose_noise == 0.0 and scanner.pose_angle_noise == 0.0:
        return true
    errors = pose_errors(len(true), scanner.pose_noise, scanner.pose_angle_noise, seed)
    recorded: np.ndarray = np.einsum("vij,vjk->vik", true, errors)
    return recorded


def as_recorded(points: np.ndarray, true: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """Return true world positions (N, 3) where a view of this recorded pose believes them."""
    if np.array_equal(true, recorded):
        return points
    shift = recorded @ np.linalg.inv(true)
    moved: np.ndarray = np.einsum("ij,nj->ni", shift[:3, :3], points) + shift[:3, 3]
    return moved
