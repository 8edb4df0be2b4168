"""Free sectors around points, and points near others: the same as by looking at all points."""

import numpy as np
import pytest
from reference import rims as plain
from reference.leaves import leaves_of

from octoseg_ti.device import runtime
from octoseg_ti.stages.surroundings import FREE, SECTORS, Surroundings


def surroundings(
    points: np.ndarray, size: float, radius: float
) -> tuple[Surroundings, np.ndarray, np.ndarray]:
    """The points in leaves: what to ask, the sorted points, and the leaf of each."""
    leaves, order = leaves_of(points, size)
    points = points[order]
    leaf = np.repeat(np.arange(len(leaves)), leaves.count)
    runtime.ensure_started()
    return Surroundings(runtime.upload(points), leaves, radius), points, leaf


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", [0.6, 2.5])
def test_equal_the_reference(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 6, (900, 3)) * (1, 1, 0.02)
    points = points[np.hypot(points[:, 0] - 3, points[:, 1] - 3) > 1.2]
    around, points, leaf = surroundings(points, size, 0.9)
    normal = np.array([0.0, 0.0, 1.0]) + rng.normal(0, 0.05, points.shape)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    asked = np.arange(len(points))
    outward, free = around.free_sectors(runtime.upload(normal), asked, leaf, 0.9)
    expected = np.array(
        [plain.free_sectors(points, i, n, 0.9, SECTORS) for i, n in enumerate(normal)]
    )
    border = expected >= FREE
    np.testing.assert_array_equal(free[border], expected[border])
    assert (free[~border] < FREE).all() and 20 < border.sum() < len(points) // 2
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1.0)
    # Within the run of free sectors, less a half sector at each end, there is nothing.
    for i in np.flatnonzero(border & (expected < SECTORS)):
        step = points - points[i]
        near = (np.linalg.norm(step, axis=1) <= 0.9) & (np.arange(len(points)) != i)
        flat = step[near] - np.outer(step[near] @ normal[i], normal[i])
        cosine = flat @ outward[i] / np.linalg.norm(flat, axis=1)
        assert cosine.max() <= np.cos(np.pi * (free[i] - 0.01) / SECTORS)
    label = rng.integers(0, 2, len(points)).astype(np.int32)
    some = rng.choice(len(points), 30, replace=False)
    far = np.linalg.norm(points[:, None] - points[some], axis=2)
    far[label[:, None] != label[some]] = np.inf
    np.testing.assert_array_equal(around.near(label, some, leaf[some], 0.8), (far <= 0.8).any(1))


def test_the_border_of_a_lattice_points_outwards() -> None:
    x, y = np.meshgrid(np.arange(12.0), np.arange(12.0))
    points = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    around, points, leaf = surroundings(points, 3.0, 2.5)
    normal = runtime.upload(np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    outward, free = around.free_sectors(normal, np.arange(len(points)), leaf, 2.5)
    inner = ((points[:, :2] > 0) & (points[:, :2] < 11)).all(axis=1)
    assert (free[inner] < FREE).all() and (free[~inner] >= FREE).all()
    right = (points[:, 0] == 11) & (points[:, 1] > 1) & (points[:, 1] < 10)
    assert (outward[right, 0] > 0.97).all()


def test_nothing_asked_nothing_found() -> None:
    around, points, _ = surroundings(np.random.default_rng(0).uniform(0, 3, (50, 3)), 1.0, 0.5)
    none = np.zeros(0, np.int64)
    assert len(around.free_sectors(runtime.upload(points), none, none, 0.5)[1]) == 0
    assert not around.near(np.zeros(50, np.int32), none, none, 0.5).any()
