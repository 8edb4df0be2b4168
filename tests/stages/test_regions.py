"""The flood fill is the connected components of touching cells that agree."""

import math

import numpy as np
import pytest
from reference import graph as plain
from reference.clouds import random_cloud, random_surface, unit
from reference.device_grid import as_array, leaf_nodes, leaves_of, tables

from octoseg_ti.stages.adjacency import find_touching
from octoseg_ti.stages.grid import Grid, build_grid
from octoseg_ti.stages.moments import HI, LEVEL, LO, STOP
from octoseg_ti.stages.regions import (
    flood_fill,
    group_sizes,
    inner_cells,
    number_groups,
    strips,
)


def made(seed: int, n: int, signed: bool = True) -> Grid:
    """Return a grid of many cell sizes."""
    if seed % 2:
        points, normals = random_cloud(seed, n)
        return build_grid(points, normals, tolerance=0.6, divisions=2, min_cell=0.2, signed=signed)
    points, normals = random_surface(seed, n)
    normals = unit(normals + 0.05 * np.random.default_rng(seed).standard_normal(normals.shape))
    if not signed:
        normals *= np.random.default_rng(seed).choice([-1.0, 1.0], (n, 1))
    return build_grid(points, normals, tolerance=0.08, min_cell=0.9, min_points=3, signed=signed)


def taking_part(grid: Grid, seed: int, share: float = 0.9) -> np.ndarray:
    """Return some of the leaves, as the edge cells leave them."""
    part = np.zeros(grid.count, bool)
    leaves = leaf_nodes(grid)
    part[leaves[np.random.default_rng(seed).random(len(leaves)) < share]] = True
    return part


@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n", [3, 60, 900])
def test_equals_the_reference(signed: bool, seed: int, n: int) -> None:
    grid = made(seed, n, signed)
    leaves = leaves_of(grid)
    pairs = plain.touching_pairs(leaves, grid.depth)
    part = taking_part(grid, seed)
    for homogeneity, chord, slack in ((0.3, math.inf, 0.0), (0.5, 0.1, 0.01), (1.2, 0.4, 0.0)):
        got = flood_fill(
            grid, find_touching(grid), part, homogeneity=homogeneity, chord=chord, slack=slack
        )
        expected, closest = plain.flood_fill(
            leaves, pairs, lambda c: bool(part[c.node]),
            homogeneity=homogeneity, chord=chord, slack=slack, signed=signed,
        )  # fmt: skip
        what = f"seed {seed}, n {n}, {homogeneity} rad"
        assert closest > 1e-12, f"{what}: a decision hangs on rounding, take another seed"
        np.testing.assert_array_equal(got, as_array(expected, grid.count), err_msg=what)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n", [3, 60, 900])
def test_inner_cells_strips_and_numbers_equal_the_reference(seed: int, n: int) -> None:
    grid = made(seed, n)
    leaves = leaves_of(grid)
    pairs = plain.touching_pairs(leaves, grid.depth)
    group = flood_fill(grid, find_touching(grid), taking_part(grid, seed), homogeneity=0.4)
    named = {c.node: int(group[c.node]) for c in leaves if group[c.node] >= 0}
    size = plain.group_sizes(leaves, named)
    what = f"seed {seed}, n {n}"

    sizes = group_sizes(grid, group)
    assert {g: int(s) for g, s in enumerate(sizes) if s} == size, what
    inner = inner_cells(find_touching(grid), group, sizes)
    assert set(np.flatnonzero(inner)) == plain.inner_cells(leaves, pairs, named, size), what
    found = strips(grid, find_touching(grid), group)
    assert set(np.flatnonzero(found)) == plain.strips(leaves, pairs, named), what
    for least in (1, 5, 40, 10**6):
        expected = as_array(plain.number_groups(leaves, named, least), grid.count)
        np.testing.assert_array_equal(number_groups(grid, group, least), expected, err_msg=what)


def test_among_groups_of_equal_size_none_is_larger() -> None:
    grid = made(1, 900)
    group = flood_fill(grid, find_touching(grid), taking_part(grid, 1), homogeneity=0.4)
    assert len(np.unique(group)) > 50
    inner = inner_cells(find_touching(grid), group, np.full(grid.count, 7.0))
    np.testing.assert_array_equal(inner, group >= 0)


def plane_and_wall(angle: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, normals and face of two planes that meet at an angle of their normals."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-10, 10, (4000, 2))
    face = (u[:, 0] > 0).astype(int)
    side = np.array([math.cos(angle), 0.0, -math.sin(angle)])
    points = np.where(
        face[:, None] == 0, np.column_stack((u, 0 * u[:, 0])),
        u[:, :1] * side + np.column_stack((0 * u[:, 0], u[:, 1], 0 * u[:, 0])),
    )  # fmt: skip
    normals = np.where(face[:, None] == 0, [0.0, 0.0, 1.0], [math.sin(angle), 0.0, math.cos(angle)])
    return points, normals, face


@pytest.mark.parametrize("degrees", [12.0, 45.0, 90.0])
def test_two_planes_are_two_groups(degrees: float) -> None:
    points, normals, face = plane_and_wall(math.radians(degrees))
    grid = build_grid(points, normals, tolerance=0.02, min_cell=0.8, min_points=3)
    node, child, _ = tables(grid)
    part = (child[:, 0] == -2) & (node[:, STOP] == 0)
    group = flood_fill(grid, find_touching(grid), part, homogeneity=math.radians(degrees) / 2)
    label = number_groups(grid, group, 100)
    assert label.max() == 1
    leaves = leaf_nodes(grid)
    of_point = np.empty(len(points), int)
    order = np.asarray(grid.order)
    for c in leaves:
        of_point[order[node[c, LO] : node[c, HI]]] = label[c]
    # Every labelled point lies on the face that its group stands for.
    for k in (0, 1):
        assert len(set(face[of_point == k])) == 1
    assert np.mean(of_point >= 0) > 0.8
    # With a tolerance above the angle the two run into one.
    joined = number_groups(
        grid,
        flood_fill(grid, find_touching(grid), part, homogeneity=math.radians(degrees) * 1.1),
        100,
    )
    assert joined.max() == 0


def test_the_chord_tells_parallel_faces_apart() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 10, (4000, 3))
    points[:, 2] = np.where(points[:, 0] < 5.0, 0.0, 0.7)
    normals = np.tile([0.0, 0.0, 1.0], (4000, 1))
    grid = build_grid(points, normals, tolerance=0.05, min_cell=0.6, min_points=3, flatness=0.25)
    node, child, _ = tables(grid)
    part = (child[:, 0] == -2) & (node[:, STOP] == 0)
    literal = number_groups(grid, flood_fill(grid, find_touching(grid), part, homogeneity=0.3), 50)
    assert literal.max() == 0
    told = number_groups(
        grid, flood_fill(grid, find_touching(grid), part, homogeneity=0.3, chord=0.03), 50
    )
    assert told.max() == 1


def test_cells_that_touch_at_a_corner_are_neighbours() -> None:
    """S5: a shared vertex is enough; here two cells meet in one corner only."""
    points = np.array([[0.0, 0, 0], [0.9, 0.9, 0.9], [1.1, 1.1, 1.1], [2.0, 2.0, 2.0]])
    grid = build_grid(points, np.tile([0.0, 0, 1], (4, 1)), tolerance=1.0, divisions=2)
    assert grid.count == 2
    assert flood_fill(grid, find_touching(grid), np.ones(2, bool), homogeneity=0.1).tolist() == [
        0,
        0,
    ]


def test_a_gap_of_one_cell_parts() -> None:
    points = np.array([[0.0, 0, 0], [0.5, 0, 0], [2.5, 0, 0], [3.0, 1.0, 0]])
    grid = build_grid(points, np.tile([0.0, 0, 1], (4, 1)), tolerance=1.0, divisions=1)
    assert grid.count == 2 and grid.size == 1.0
    assert flood_fill(grid, find_touching(grid), np.ones(2, bool), homogeneity=0.1).tolist() == [
        0,
        1,
    ]


def test_cells_of_very_different_size_touch() -> None:
    """A7: closed boxes, any ratio of sizes, where shared vertices would miss neighbours."""
    rng = np.random.default_rng(0)
    wide = np.column_stack((rng.uniform(0, 8, (800, 2)), np.zeros(800)))
    normals = np.tile([0.0, 0, 1], (800, 1))
    corner = np.array([[8.01, y, 0.0] for y in np.linspace(0.1, 0.4, 8)])
    bent = unit(np.column_stack((np.linspace(-0.05, 0.05, 8), np.zeros(8), np.ones(8))))
    grid = build_grid(
        np.concatenate((wide, corner)), np.concatenate((normals, bent)),
        tolerance=0.008, min_cell=0.03, min_points=2,
    )  # fmt: skip
    node, child, _ = tables(grid)
    part = child[:, 0] == -2
    levels = set(node[part, LEVEL])
    assert max(levels) - min(levels) >= 2
    leaves = leaves_of(grid)
    expected, _ = plain.flood_fill(
        leaves, plain.touching_pairs(leaves, grid.depth), lambda c: True,
        homogeneity=0.1, chord=math.inf, slack=0.0, signed=True,
    )  # fmt: skip
    group = flood_fill(grid, find_touching(grid), part, homogeneity=0.1)
    np.testing.assert_array_equal(group, as_array(expected, grid.count))


def test_nothing_takes_part() -> None:
    grid = made(0, 60)
    group = flood_fill(grid, find_touching(grid), np.zeros(grid.count, bool), homogeneity=0.3)
    assert np.all(group == -1)
    assert np.all(number_groups(grid, group, 1) == -1)
    assert not strips(grid, find_touching(grid), group).any()
