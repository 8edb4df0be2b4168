"""The noise about surfaces is found, on flat and on bent ones, whatever the order of the points."""

import numpy as np
import pytest
from reference.device_grid import touching_leaves
from reference.surfaces import CYLINDER, PLANE, SPHERE, TORUS, patch_of

from octoseg_ti.stages.grid import build_grid
from octoseg_ti.stages.scatter import surface_noise


def noise_of(points: np.ndarray, normals: np.ndarray) -> float | None:
    """Return the noise of points that are all of one region."""
    grid = build_grid(points, normals, tolerance=0.15, min_cell=0.3, min_points=3)
    leaves = touching_leaves(grid).node
    return surface_noise(grid, leaves, np.zeros(len(leaves), np.int32))


@pytest.mark.parametrize("noise", [0.005, 0.03])
@pytest.mark.parametrize("kind", [PLANE, CYLINDER, SPHERE, TORUS])
def test_noise_is_found(kind: int, noise: float) -> None:
    rng = np.random.default_rng(kind)
    points, normals, _ = patch_of(kind, rng, 20000, size=12.0)
    found = noise_of(points + noise * rng.normal(size=points.shape), normals)
    np.testing.assert_allclose(found, noise, rtol=0.1)


def test_perfect_data_have_next_to_none() -> None:
    points, normals, _ = patch_of(CYLINDER, np.random.default_rng(0), 3000)  # strongly bent
    found = noise_of(points, normals)
    assert found is not None
    assert found < 1e-4


def test_the_order_of_the_points_does_not_matter() -> None:
    rng = np.random.default_rng(1)
    points, normals, _ = patch_of(TORUS, rng, 5000)
    points += 0.01 * rng.normal(size=points.shape)
    order = rng.permutation(len(points))
    assert noise_of(points, normals) == noise_of(points[order], normals[order])


def test_too_few_points_have_none() -> None:
    points, normals, _ = patch_of(PLANE, np.random.default_rng(0), 10)
    assert noise_of(points, normals) is None
