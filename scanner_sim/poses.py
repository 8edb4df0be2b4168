"""What the scanner believes about its poses: the true ones, and an error of its own each."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from octoseg_ti.types import Scans
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
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_CHILD,)))
    drawn = generator.standard_normal((count, 6))
    drawn[:1] = 0.0
    motions = np.tile(np.eye(4), (count, 1, 1))
    motions[:, :3, :3] = _rotations(angle * drawn[:, :3])
    motions[:, :3, 3] = noise * drawn[:, 3:]
    return motions


def with_pose_errors(scans: Scans, scanner: StripeScanner, seed: int) -> Scans:
    """Return scans whose recorded poses, and probe positions with them, are a little wrong.

    Args:
        scans: Scans in the frames of their views, with true poses.
        scanner: Tells the size of the errors; without any the scans come back as they are.
        seed: Seed of the scan.
    """
    if scanner.pose_noise == 0.0 and scanner.pose_angle_noise == 0.0:
        return scans
    true, stripe, view = scans.T_world_view, scans.stripe, scans.view
    assert true is not None and stripe is not None and view is not None
    errors = pose_errors(len(true), scanner.pose_noise, scanner.pose_angle_noise, seed)
    recorded = true @ errors
    shift = recorded @ np.linalg.inv(true)
    origin, stripe_origin = scans.origin, scans.stripe_origin
    if origin is not None:
        origin = _moved(shift, origin)
    if stripe_origin is not None:
        # The view of a stripe, also of one that has lost all its points.
        last = np.full(len(true), -1)
        np.maximum.at(last, view, stripe)
        owner = np.searchsorted(np.maximum.accumulate(last), np.arange(len(stripe_origin)))
        stripe_origin = _moved(shift[np.minimum(owner, len(true) - 1)], stripe_origin)
    return replace(scans, T_world_view=recorded, origin=origin, stripe_origin=stripe_origin)


def _moved(motions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (N, 3), each moved by its own motion (N, 4, 4)."""
    turned: np.ndarray = np.einsum("nij,nj->ni", motions[:, :3, :3], points)
    return turned + motions[:, :3, 3]


def _rotations(vectors: np.ndarray) -> np.ndarray:
    """Return the rotations of rotation vectors [rad] by Rodrigues' formula, shape (V, 3, 3)."""
    angle = np.linalg.norm(vectors, axis=1)
    axis = vectors / np.where(angle > 0.0, angle, 1.0)[:, None]
    cross = np.zeros((len(vectors), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = axis
    cross[:, [1, 2, 0], [2, 0, 1]] = -axis
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    rotations: np.ndarray = np.eye(3) + s * cross + (1.0 - c) * (cross @ cross)
    return rotations
