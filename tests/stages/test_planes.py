"""A patch is a plane when its points lie on one, and the plane is the least-squares one."""

import numpy as np
import pytest
from reference.clouds import random_cloud, rotation
from reference.covariances import covariance_of, squared_error
from reference.patches import plane_of
from reference.surfaces import PLANE

from octoseg_ti.device import runtime
from octoseg_ti.stages.grid import Grid, build_grid
from octoseg_ti.stages.moments import POINT
from octoseg_ti.stages.planes import fit_planes
from octoseg_ti.types import SurfaceKind


def leaves_of(grid: Grid) -> np.ndarray:
    """Return the leaves in Morton order."""
    leaves = np.flatnonzero(runtime.download(grid.child)[: grid.count, 0] == -2)
    return leaves[np.argsort(grid.first[leaves], kind="stable")]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n", [3, 100, 3000])
def test_equals_the_reference(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    points, normals = random_cloud(seed, n)
    slab = rng.integers(0, 4, n)
    for k in range(4):  # the thinner, the flatter
        q = rotation(4 * seed + k)
        mine = slab == k
        points[mine] = (points[mine] * [1, 1, 0.01 * 10.0 ** (k - 1)]) @ q.T + [40.0 * k, 0, 0]
    points += 1e5  # far from the origin
    grid = build_grid(points, normals, tolerance=0.5, divisions=3, min_cell=0.2)
    leaves = leaves_of(grid)
    # The patch of a leaf is the slab of its first point; a few leaves belong to none.
    order = runtime.download(grid.order)
    of_leaf = slab[order[grid.first[leaves]]].astype(np.int32)
    of_leaf[rng.random(len(leaves)) < 0.1] = -1
    label = np.empty(n, np.int32)
    label[order] = np.repeat(of_leaf, grid.holds[leaves])
    kind, parameters, covariance, residual = fit_planes(grid, leaves, of_leaf, 5, limit=0.1)
    half = grid.size / 2
    for k in range(5):
        what = f"seed {seed}, n {n}, patch {k}"
        if not np.any(label == k):
            continue
        middle, normal, rms = plane_of(points[label == k])
        if abs(rms - 0.1) < 1e-4:
            continue
        assert kind[k] == (SurfaceKind.PLANE if rms < 0.1 else SurfaceKind.NONE), what
        if rms < 0.1:
            # Sums are rounded to steps of 2^-30 of half a cell, and of its square.
            assert residual[k] ** 2 == pytest.approx(rms**2, abs=99 * half**2 * 2.0**-30), what
            np.testing.assert_allclose(parameters[k, :3], middle, atol=half * 1e-8, err_msg=what)
            if np.count_nonzero(label == k) > 20:
                assert abs(parameters[k, 3:6] @ normal) == pytest.approx(1, abs=1e-8), what
            assert np.isnan(parameters[k, 6:]).all(), what
        else:
            assert np.isnan(parameters[k]).all() and np.isnan(residual[k]), what
            assert np.isnan(covariance[k]).all(), what


@pytest.mark.parametrize("seed", range(3))
def test_a_plane_is_found_to_its_noise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = rotation(seed)
    flat = np.column_stack((rng.uniform(0, 50, (3000, 2)), 0.02 * rng.standard_normal(3000)))
    points = flat @ q.T + [700.0, -200.0, 50.0]
    grid = build_grid(points, np.tile(q[:, 2], (3000, 1)), tolerance=1.0, divisions=1)
    leaves = leaves_of(grid)
    label = np.zeros(len(leaves), np.int32)
    kind, parameters, covariance, residual = fit_planes(grid, leaves, label, 1, limit=0.03)
    assert kind.tolist() == [SurfaceKind.PLANE]
    assert residual[0] == pytest.approx(0.02, rel=0.05)
    assert abs(parameters[0, 3:6] @ q[:, 2]) > 1 - 1e-8
    assert abs((parameters[0, :3] - [700.0, -200.0, 50.0]) @ q[:, 2]) < 2e-3
    expected = covariance_of(points, PLANE, parameters[0])
    np.testing.assert_allclose(covariance[0], expected, rtol=1e-3, atol=1e-5 * expected[0, 0])
    true = np.array([700.0, -200.0, 50.0, *q[:, 2], np.nan, np.nan])
    assert squared_error(PLANE, parameters[0], true, covariance[0]) < 3 * 16.0
    assert fit_planes(grid, leaves, label, 1, limit=0.01)[0].tolist() == [-1]


def test_points_on_a_line_leave_a_plane_open() -> None:
    rng = np.random.default_rng(0)
    line = np.column_stack((np.linspace(0, 9, 200), 1e-2 * rng.standard_normal((200, 2))))
    deviations = []
    for points in (line, line[:3]):
        normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        grid = build_grid(points, normals, tolerance=1.0, min_cell=20.0)
        leaves = leaves_of(grid)
        label = np.zeros(len(leaves), np.int32)
        kind, _, covariance, _ = fit_planes(grid, leaves, label, 1, limit=1.0)
        assert kind.tolist() == [SurfaceKind.PLANE]
        deviations.append(np.sqrt(np.diag(covariance[0])))
    assert deviations[0][3] < 1e-3 and 0.03 < np.linalg.norm(deviations[0][4:6]) < 0.2
    assert np.isnan(deviations[1]).all()  # three points are on a plane anyway


def test_no_patches() -> None:
    points, normals = random_cloud(0, 20)
    grid = build_grid(points, normals, tolerance=1.0, divisions=1)
    leaves = leaves_of(grid)
    label = np.full(len(leaves), -1, np.int32)
    found = fit_planes(grid, leaves, label, 0, limit=1.0)
    assert [array.shape for array in found] == [(0,), (0, 8), (0, 8, 8), (0,)]
    kind, parameters, _, residual = fit_planes(grid, leaves, label, 2, limit=1.0)
    assert np.all(kind == int(SurfaceKind.NONE))
    assert np.isnan(parameters).all() and np.isnan(residual).all()


def test_permuting_the_points_changes_no_bit() -> None:
    points, normals = random_cloud(5, 2000)
    order = np.random.default_rng(0).permutation(2000)
    answers = []
    for rows in (np.arange(2000), order):
        grid = build_grid(points[rows], normals[rows], tolerance=0.4, divisions=2, min_cell=0.3)
        leaves = leaves_of(grid)
        label = (runtime.download(grid.mean)[leaves, POINT] > 5).astype(np.int32)
        answers.append(fit_planes(grid, leaves, label, 2, limit=99.0))
    for a, b in zip(*answers, strict=True):
        np.testing.assert_array_equal(a, b)
