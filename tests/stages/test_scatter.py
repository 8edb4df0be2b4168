"""The noise about surfaces is found, on flat and on bent ones, whatever the order of the points."""

import numpy as np
import pytest
from reference.device_grid import touching_leaves
from reference.surfaces import CYLINDER, PLANE, SPHERE, TORUS, patch_of

from octoseg_ti.stages.grid import build_grid
from octoseg_ti.stages.scatter import _neighborhoods, surface_noise


def noise_of(
    points: np.ndarray, normals: np.ndarray, view: np.ndarray | None = None
) -> float | None:
    """Return the noise of points that are all of one region."""
    grid = build_grid(points, normals, tolerance=0.15, min_cell=0.3, min_points=3)
    leaves = touching_leaves(grid).node
    one = np.zeros(len(points), np.int32)
    found = surface_noise(
        grid, leaves, np.zeros(len(leaves), np.int32), one if view is None else view
    )
    assert view is not None or found is None or found[1] == 0.0
    return None if found is None else found[0]


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


@pytest.mark.parametrize("shared", [1.0, 0.25])
def test_views_that_do_not_quite_meet_scatter_more(shared: float) -> None:
    """Two views, one of them 0.06 mm too high: half of that off their mean, where both were."""
    rng = np.random.default_rng(0)
    points, normals, _ = patch_of(PLANE, rng, 20000, size=12.0)
    low, high = np.quantile(points @ patch_axis(normals), [0.0, shared])
    view = rng.integers(0, 2, len(points)).astype(np.int32)
    place = points @ patch_axis(normals)
    view[(place < low) | (place > high)] = 0
    points += 0.005 * rng.normal(size=points.shape)
    apart = points + 0.06 * view[:, None] * normals
    np.testing.assert_allclose(noise_of(apart, normals, view), np.hypot(0.03, 0.005), rtol=0.1)
    np.testing.assert_allclose(noise_of(points, normals, view), 0.005, rtol=0.1)


def patch_axis(normals: np.ndarray) -> np.ndarray:
    """Return a direction in a plane."""
    axis = np.cross(normals[0], [1.0, 0.3, 0.2])
    return np.asarray(axis / np.linalg.norm(axis))


def test_the_order_of_the_points_does_not_matter() -> None:
    rng = np.random.default_rng(1)
    points, normals, _ = patch_of(TORUS, rng, 5000)
    points += 0.01 * rng.normal(size=points.shape)
    order = rng.permutation(len(points))
    assert noise_of(points, normals) == noise_of(points[order], normals[order])


def test_too_few_points_have_none() -> None:
    points, normals, _ = patch_of(PLANE, np.random.default_rng(0), 10)
    assert noise_of(points, normals) is None


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("many", [40, 3000, 200_000])
def test_neighbourhoods_equal_the_reference(seed: int, many: int) -> None:
    """A window of points, of these one region's, of these the first, with the rest of a box."""
    rng = np.random.default_rng(seed)
    key = np.sort(rng.integers(0, many // 2, many))
    first = np.flatnonzero(np.diff(key // 10, prepend=-1))
    of_leaf = np.append(0, rng.integers(-1, 3, len(first) - 1))
    region = np.repeat(of_leaf, np.diff(first, append=many))
    inside = np.flatnonzero(region >= 0)
    expected: list[np.ndarray] = []
    for begin in np.unique(np.searchsorted(key, key[inside[np.arange(256) * len(inside) // 256]])):
        last = np.searchsorted(key, key[min(begin + 512, many - 1)])
        mine = [i for i in range(begin, last) if region[i] == region[begin]]
        mine = [i for i in mine if key[i] <= key[mine[min(127, len(mine) - 1)]]]
        if len(mine) >= 24:
            expected.append(np.array(mine))
    index, start = _neighborhoods(key, first, of_leaf)
    np.testing.assert_array_equal(start, np.cumsum([0, *(len(mine) for mine in expected)]))
    np.testing.assert_array_equal(index, np.concatenate([np.zeros(0, np.int64), *expected]))
    assert many < 1000 or len(expected) > 2


def test_no_region_has_no_neighbourhoods() -> None:
    index, begin = _neighborhoods(np.arange(100), np.array([0, 50]), np.full(2, -1))
    assert len(index) == 0
    assert begin.tolist() == [0]
