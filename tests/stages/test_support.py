"""A point in doubt is held by a surface around it, of its own view or another, or it is not."""

import numpy as np
import pytest
from reference import support as plain

from octoseg_ti.stages.support import find_support

RULE = {"radius": 2.5, "off": 0.1, "backing": 1.5, "detached": 40}


def sheet(seed: int, view: int, count: int = 160, size: float = 10.0) -> np.ndarray:
    """Return points on a bent sheet, one a place, with a little noise."""
    rng = np.random.default_rng([seed, view])
    xy = rng.uniform(0.0, size, (count, 2))
    z = np.where(xy[:, 0] > 0.6 * size, xy[:, 0] - 0.6 * size, 0.0) + rng.normal(0, 0.02, count)
    return np.column_stack([xy, z])


def scene(seed: int, views: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return sheets with points thrown off them and small groups aside, and what is in doubt."""
    rng = np.random.default_rng(seed)
    pieces = [sheet(seed, v) for v in range(views)]
    view = np.repeat(np.arange(views, dtype=np.int32), [len(p) for p in pieces])
    world = np.concatenate(pieces)
    world[::11, 2] += rng.normal(0, 1.0, len(world[::11]))
    world[view == 0] = np.where(world[view == 0, :1] < 4.0, [[0, 0, 6.0]], 0.0) + world[view == 0]
    doubt = rng.random(len(world)) < 0.3
    doubt[::11] = True
    doubt |= (view == 0) & (world[:, 2] > 4.0)
    return world, view, np.flatnonzero(doubt).astype(np.int32)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("views", [1, 3])
def test_equals_the_reference(seed: int, views: int) -> None:
    world, view, doubt = scene(seed, views)
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :3, 3] = rng.normal(0, 50, (views, 3))
    poses[:, :3, :3] = np.linalg.qr(rng.normal(size=(views, 3, 3)))[0]
    local = np.einsum("nji,nj->ni", poses[view][:, :3, :3], world - poses[view][:, :3, 3])
    rule = RULE | {"detached": (0, 20, 40, 500)[seed]}
    got = find_support(local, view, poses, doubt, **rule)
    expected = plain.find_support(world, view, doubt.tolist(), **rule)
    np.testing.assert_array_equal(got, expected)
    assert got.any() and not got.all()


def up(points: np.ndarray, height: float) -> np.ndarray:
    return points + np.array([0.0, 0.0, height])


def lattice(rows: int, columns: int, z: float = 0.0, at: float = 0.0) -> np.ndarray:
    y, x = np.meshgrid(np.arange(columns) * 0.8 + at, np.arange(rows) * 1.0 + at)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def held(pieces: list[np.ndarray], views: list[int], doubt: int, **rule: float) -> np.ndarray:
    """Ask about all points of one piece."""
    view = np.repeat(np.array(views, np.int32), [len(p) for p in pieces])
    first = sum(len(p) for p in pieces[:doubt])
    rows = np.arange(first, first + len(pieces[doubt]), dtype=np.int32)
    poses = np.tile(np.eye(4), (max(views) + 1, 1, 1))
    return find_support(np.concatenate(pieces), view, poses, rows, **(RULE | rule))


def test_a_point_on_the_plane_is_held_and_one_off_it_is_not() -> None:
    plane = lattice(9, 9)
    for height, expected in ((0.0, True), (0.05, True), (0.5, False), (1.5, False), (9.0, False)):
        point = np.array([[3.4, 3.3, height]])
        assert held([plane, point], [0, 0], 1).tolist() == [expected], height


def test_a_small_group_is_an_outlier_and_a_large_one_is_not() -> None:
    plane, small, large = lattice(9, 9), lattice(4, 5, 5.0), lattice(8, 8, 5.0)
    assert not held([plane, small], [0, 0], 1).any()
    assert held([plane, large], [0, 0], 1).all()


def test_another_view_holds_a_small_group() -> None:
    small, same = lattice(4, 5, 5.0), lattice(9, 9, 5.02, at=-1.3)
    assert held([lattice(9, 9), small, same], [0, 0, 1], 1).all()
    assert not held([lattice(9, 9), small, up(same, 0.6)], [0, 0, 1], 1).any()


def test_a_line_of_points_is_no_surface() -> None:
    line = lattice(1, 30, 3.0)
    assert not held([lattice(9, 30), line], [0, 0], 1, detached=10).any()
    # One point a stripe on a narrow chamfer: close to the faces beside it.
    near = lattice(1, 30, 0.3, at=-0.5)
    assert held([lattice(9, 30), near], [0, 0], 1).mean() > 0.9


@pytest.mark.parametrize("height", [0.0, 3.0])
def test_the_corner_of_a_box_is_held(height: float) -> None:
    """Three faces meet; a point of each, right at the corner."""
    top, side = lattice(8, 10), lattice(8, 10)[:, [0, 2, 1]] * [1, 1, -1]
    end = lattice(8, 10)[:, [2, 0, 1]] * [1, 1, -1]
    box = up(np.concatenate([top, side, end]), height)
    corner = up(np.array([[0.1, 0.1, 0.0], [0.1, 0.0, -0.1], [0.0, 0.1, -0.1]]), height)
    assert held([box, corner], [0, 0], 1).all()


def test_far_places_and_shared_buckets() -> None:
    """A million millimetres away, and more cubes than buckets."""
    plane = lattice(9, 9)
    point = np.array([[3.4, 3.3, 0.0], [3.4, 3.3, 1.0]])
    assert held([plane + 1e6, point + 1e6], [0, 0], 1).tolist() == [True, False]
    wide = lattice(60, 60) * [40.0, 40.0, 1.0]
    assert held([plane, point, wide], [0, 0, 0], 1).tolist() == [True, False]
    assert held([plane, up(point, 1e300)], [0, 0], 1).tolist() == [False, False]
