"""Curved patches against surfaces that they must reproduce."""

from __future__ import annotations

import numpy as np
from reference.shapes import ball

from scanner_sim.curved import meet_patches, mixed, patch_points, shares


def test_shares_give_back_the_point() -> None:
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(50, 3, 3))
    weights = rng.dirichlet([1, 1, 1], 50)
    points = np.einsum("ij,ijk->ik", weights, corners)
    np.testing.assert_allclose(shares(corners, points), weights, atol=1e-9)


def test_patches_go_through_their_corners_and_are_flat_on_a_plane() -> None:
    rng = np.random.default_rng(1)
    corners = rng.normal(size=(20, 3, 3))
    normals = rng.normal(size=(20, 3, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    for k in range(3):
        share = np.tile(np.eye(3)[k], (20, 1))
        np.testing.assert_allclose(patch_points(corners, normals, share), corners[:, k])
    up = np.tile([0.0, 0.0, 1.0], (20, 3, 1))
    share = rng.dirichlet([1, 1, 1], 20)
    flat = corners * [1, 1, 0]
    expected = np.einsum("ij,ijk->ik", share, flat)
    np.testing.assert_allclose(patch_points(flat, up, share), expected, atol=1e-12)


def test_rays_meet_a_ball_far_closer_than_its_triangles() -> None:
    corners = ball(10.0, turns=60)
    normals = corners / 10.0
    rng = np.random.default_rng(2)
    chosen = rng.integers(len(corners), size=2000)
    share = rng.dirichlet([1, 1, 1], 2000)
    points = np.einsum("ij,ijk->ik", share, corners[chosen])
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    ahead = -outward + 0.6 * rng.normal(size=(2000, 3)).clip(-0.8, 0.8)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    into = (ahead * outward).sum(axis=1) < -0.5
    moved, normal = meet_patches(
        corners[chosen][into], normals[chosen][into], points[into], ahead[into]
    )
    place = points[into] + moved[:, None] * ahead[into]
    coarse = 10.0 - np.linalg.norm(points[into], axis=1)
    fine = np.abs(np.linalg.norm(place, axis=1) - 10.0)
    assert coarse.max() > 0.01 and fine.max() < 2e-4
    assert np.abs((normal * place).sum(axis=1) / 10.0 - 1.0).max() < 1e-4
    np.testing.assert_allclose(np.linalg.norm(mixed(share, normals[chosen]), axis=1), 1.0)
