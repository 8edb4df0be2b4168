"""A line of sight is blocked where it passes through a surface, and nowhere else."""

import numpy as np
import pytest
from reference import sight as plain
from reference.clouds import random_surface
from reference.device_grid import leaf_nodes, tables

from octoseg_ti.device import runtime
from octoseg_ti.stages.grid import Grid, build_grid
from octoseg_ti.stages.moments import HI, LEVEL, LO, NORMAL, POINT, X, Z
from octoseg_ti.stages.sight import blocked_lines


@pytest.mark.parametrize("seed", range(4))
def test_equals_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, normals = random_surface(seed, 900)
    grid = build_grid(points, normals, tolerance=0.2, min_cell=0.4, min_points=3)
    node, _, mean = tables(grid)
    leaves = leaf_nodes(grid)
    label = rng.integers(-1, 4, len(points)).astype(np.int32)
    weight = np.array([1, 0, 2, 3])
    heavy = np.append(weight, 0)[label]
    high = np.array(grid.shape) * grid.size
    start = rng.uniform(-2.0, 3.0, (80, 3)) * high
    end = rng.uniform(0.0, 1.0, (80, 3)) * high
    least = rng.integers(0, 4, 80).astype(np.int32)
    got = blocked_lines(grid, start, end, least, label, weight, clear=0.3, reach=0.4)
    side = grid.size / 2.0 ** node[:, LEVEL]
    leaves = [
        (
            node[c, X : Z + 1] * side[c], side[c], mean[c, POINT : POINT + 3],
            mean[c, NORMAL : NORMAL + 3], slice(node[c, LO], node[c, HI]),
        )
        for c in leaf_nodes(grid)
    ]  # fmt: skip
    box = (high, grid.size / 2.0**grid.depth)
    sorted_points = (runtime.download(grid.point), runtime.download(grid.normal))
    expected = [
        plain.blocked(leaves, *sorted_points, heavy > least[i], (start[i], end[i]), box, 0.3, 0.4)
        for i in range(80)
    ]
    np.testing.assert_array_equal(got, expected)
    assert got.any() and not got.all()


def floors() -> tuple[Grid, np.ndarray]:
    """Return a floor at z = 5 with a hole, and half of it at z = 0; labels 1 and 0."""
    x, y = np.meshgrid(np.arange(0.0, 20.0, 0.25), np.arange(0.0, 20.0, 0.25))
    upper = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 5.0)])
    lower = upper[upper[:, 0] < 10.0] * [1.0, 1.0, 0.0]
    hole = np.linalg.norm(upper[:, :2] - [6.0, 14.0], axis=1) < 2.0
    points = np.concatenate([upper[~hole], lower])
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    grid = build_grid(points, normals, tolerance=0.03, min_cell=0.5, min_points=3, flatness=0.25)
    high = runtime.download(grid.point)[:, 2] + grid.corner[2] > 2.5
    return grid, high.astype(np.int32)


def through(start: list[float], end: list[float], least: int, clear: float = 0.5) -> bool:
    """Say whether a line among the floors is blocked."""
    grid, label = floors()
    ends = [np.array([place]) - grid.corner for place in (start, end)]
    weights = (np.array([least]), label, np.array([1, 2]))
    return bool(blocked_lines(grid, *ends, *weights, clear=clear, reach=0.25)[0])


def test_a_floor_above_blocks() -> None:
    assert through([4.1, 7.2, 90.0], [4.1, 7.2, 0.0], 1)
    assert through([40.0, 30.0, 90.0], [4.1, 7.2, 0.0], 1)


def test_a_line_that_ends_on_the_floor_or_comes_from_below_is_free() -> None:
    assert not through([4.1, 7.2, 90.0], [4.1, 7.2, 5.0], 0)
    assert not through([4.1, 7.2, -90.0], [4.1, 7.2, 0.0], 1)


def test_a_line_through_a_hole_is_free() -> None:
    assert not through([6.1, 14.2, 90.0], [6.1, 14.2, 0.0], 1)
    assert not through([40.0, 14.2, 170.0], [5.9, 14.1, 0.0], 1)


def test_what_is_smaller_does_not_block() -> None:
    assert through([4.1, 7.2, -90.0], [4.1, 7.2, 5.0], 0)
    assert not through([4.1, 7.2, -90.0], [4.1, 7.2, 5.0], 1)


def test_what_is_near_the_end_does_not_block() -> None:
    assert not through([4.1, 7.2, 90.0], [4.1, 7.2, 4.0], 1, clear=1.5)
    assert through([4.1, 7.2, 90.0], [4.1, 7.2, 4.0], 1, clear=0.5)


def test_a_line_beside_the_floor_is_free_and_a_grazing_one_is_let_pass() -> None:
    assert not through([-60.0, 7.2, 62.0], [2.0, 7.2, 0.0], 1)
    assert not through([-90.0, 7.2, 7.0], [19.0, 7.2, 4.5], 1)


def test_no_lines_have_no_answers() -> None:
    grid, label = floors()
    none = np.zeros((0, 3))
    weights = (np.zeros(0, int), label, np.array([1, 2]))
    got = blocked_lines(grid, none, none, *weights, clear=1.0, reach=1.0)
    assert got.shape == (0,)
