"""The turning from cell to cell, and cuts where flat faces are joined by bends."""

import math

import numpy as np
import pytest
from reference import graph as plain
from reference.clouds import random_cloud, random_surface, rotation, unit
from reference.device_grid import leaf_nodes, leaves_of, tables

from octoseg_ti.stages.adjacency import find_touching
from octoseg_ti.stages.bends import split_at_bends, turning
from octoseg_ti.stages.grid import Grid, build_grid
from octoseg_ti.stages.moments import STOP
from octoseg_ti.stages.regions import flood_fill, group_sizes

UNIT = 2.0**-20  # of the sums


@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n", [3, 60, 900])
def test_turning_equals_the_reference(signed: bool, seed: int, n: int) -> None:
    if seed % 2:
        points, normals = random_cloud(seed, n)
        grid = build_grid(points, normals, tolerance=0.6, divisions=2, min_cell=0.2, signed=signed)
    else:
        points, normals = random_surface(seed, n)
        grid = build_grid(points, normals, tolerance=0.08, min_cell=0.9, signed=signed)
    part = np.zeros(grid.count, bool)
    part[leaf_nodes(grid)] = True
    group = flood_fill(grid, find_touching(grid), part, homogeneity=0.5)
    leaves = leaves_of(grid)
    named = {c.node: int(group[c.node]) for c in leaves}
    pairs = plain.touching_pairs(leaves, grid.depth)
    finest = grid.size / 2.0**grid.depth
    for noise in (0.0, 0.1):
        got = turning(grid, find_touching(grid), group, noise)
        expected, neighbours = plain.turning(leaves, pairs, named, noise, finest)
        what = f"seed {seed}, n {n}, noise {noise}"
        for node, value in expected.items():
            # Each pair rounds both sums by half a unit; far apart, the second one is about one.
            allowed = 2 * UNIT * max(1, neighbours[node]) * (1 + value**2)
            assert got[node] ** 2 == pytest.approx(value**2, abs=10 * allowed), what
        assert not got[~part].any()


@pytest.mark.parametrize("radius", [10.0, 40.0])
def test_turning_of_a_cylinder_is_its_curvature(radius: float) -> None:
    """Over one smallest cell, across the axis, the normal turns by cell / radius; along it, not."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0.3, math.pi - 0.3, 30_000)
    normals = np.column_stack((0 * angle, np.cos(angle), np.sin(angle)))
    points = radius * normals + np.column_stack(
        (rng.uniform(0, 3 * radius, 30_000), 0 * angle, 0 * angle)
    )
    cell = radius / 12
    grid = build_grid(points, normals, tolerance=0.01, edge_tolerance=0.9, min_cell=cell)
    part = np.zeros(grid.count, bool)
    part[leaf_nodes(grid)] = True
    turn = turning(grid, find_touching(grid), np.where(part, 0, -1).astype(np.int32), 0.0)[part]
    assert np.median(turn) == pytest.approx(cell / radius / math.sqrt(2), rel=0.2)


def regions(
    points: np.ndarray, normals: np.ndarray, cell: float, noise: float = 0.0
) -> tuple[Grid, np.ndarray, np.ndarray, dict]:
    """Return the grid, its groups, the groups after the cuts, and the options of both."""
    tolerance = max(0.055, 2 * noise)
    grid = build_grid(
        points, normals, tolerance=0.03, edge_tolerance=tolerance, min_cell=cell, min_points=3,
        flatness=0.25,
    )  # fmt: skip
    node, child, _ = tables(grid)
    rule = {"homogeneity": min(0.35, 7 * tolerance), "chord": 0.5 * tolerance, "slack": 0.0}
    whole = flood_fill(
        grid, find_touching(grid), (child[:, 0] == -2) & (node[:, STOP] == 0), **rule
    )
    cut = split_at_bends(
        grid, find_touching(grid), whole, min_points=60, flat=tolerance, noise=noise, **rule
    )
    return grid, whole, cut, rule


def large(grid: Grid, group: np.ndarray, share: float = 0.02) -> np.ndarray:
    """Return the sizes of the groups that hold more than a share of the points, largest first."""
    sizes = np.sort(group_sizes(grid, group))[::-1]
    return sizes[sizes > share * sizes.sum()]


def prism(sides: int, flat: float, bend: float, length: float, spacing: float) -> tuple:
    """Return points, normals and face (-1 on a bend) of a prism with rounded edges, unrolled."""
    rng = np.random.default_rng(sides)
    turn = 2 * math.pi / sides
    arc = bend * turn
    n = int(sides * (flat + arc) * length / spacing**2)
    s = rng.uniform(0, sides * (flat + arc), n)
    side, along = np.divmod(s, flat + arc)
    on_bend = along > flat
    angle = turn * side + np.where(on_bend, (along - flat) / bend, 0.0)
    # Walk round: corner after corner of the inner polygon, offset by the radius of the bends.
    corner = np.zeros((sides + 1, 2))
    for k in range(sides):
        corner[k + 1] = corner[k] + flat * np.array([-math.sin(turn * k), math.cos(turn * k)])
    normal = np.column_stack((np.cos(angle), np.sin(angle)))
    base = corner[side.astype(int)]
    step = np.minimum(along, flat)[:, None]
    direction = np.column_stack((-np.sin(turn * side), np.cos(turn * side)))
    points = np.column_stack((base + step * direction + bend * normal, rng.uniform(0, length, n)))
    normals = np.column_stack((normal, np.zeros(n)))
    return points, normals, np.where(on_bend, -1, side.astype(int))


@pytest.mark.parametrize("sides", [6, 8])
@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_a_prism_with_rounded_edges_is_cut_into_its_faces(sides: int, noise: float) -> None:
    points, normals, face = prism(sides, flat=40.0, bend=10.0, length=60.0, spacing=0.6)
    q = rotation(sides)
    rng = np.random.default_rng(1)
    normals = unit(normals + noise / math.sqrt(2) * rng.standard_normal(normals.shape))
    grid, whole, cut, _ = regions(points @ q.T, normals @ q.T, cell=1.2, noise=noise)
    assert len(large(grid, whole)) == 1  # the flood passes the bends
    assert len(large(grid, cut)) == sides
    # The points of a piece lie on one face, but for the rim of its bends.
    node, _, _ = tables(grid)
    order = np.asarray(grid.order)
    for name in np.flatnonzero(group_sizes(grid, cut) > 0.02 * len(points)):
        cells = np.flatnonzero(cut == name)
        rows = np.concatenate([order[node[c, 0] : node[c, 1]] for c in cells])
        own = np.bincount(face[rows] + 1, minlength=sides + 1)
        assert own[1:].max() > 0.85 * len(rows)
        assert np.count_nonzero(own[1:]) == 1


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_a_cylinder_is_not_cut(noise: float) -> None:
    rng = np.random.default_rng(2)
    n = 60_000
    angle = rng.uniform(0, 2 * math.pi, n)
    normals = np.column_stack((np.cos(angle), np.sin(angle), np.zeros(n)))
    points = 25 * normals + np.column_stack((np.zeros((n, 2)), rng.uniform(0, 100, n)))
    normals = unit(normals + noise / math.sqrt(2) * rng.standard_normal(normals.shape))
    q = rotation(3)
    grid, whole, cut, _ = regions(points @ q.T, normals @ q.T, cell=1.1, noise=noise)
    assert len(large(grid, whole)) == 1
    np.testing.assert_array_equal(cut, whole)


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_a_sphere_is_not_cut(noise: float) -> None:
    rng = np.random.default_rng(4)
    normals = unit(rng.standard_normal((60_000, 3)))
    points = 30 * normals
    normals = unit(normals + noise / math.sqrt(2) * rng.standard_normal(normals.shape))
    grid, whole, cut, _ = regions(points, normals, cell=1.1, noise=noise)
    assert len(large(grid, whole)) == 1
    np.testing.assert_array_equal(cut, whole)


def test_a_cone_is_not_cut() -> None:
    rng = np.random.default_rng(5)
    n = 60_000
    angle, height = rng.uniform(0, 2 * math.pi, n), 60 * np.sqrt(rng.uniform(0.2, 1, n))
    c, s = math.cos(0.4), math.sin(0.4)
    points = np.column_stack((height * s * np.cos(angle), height * s * np.sin(angle), height * c))
    normals = np.column_stack((c * np.cos(angle), c * np.sin(angle), np.full(n, -s)))
    grid, whole, cut, _ = regions(points, normals, cell=0.9)
    assert len(large(grid, whole)) == 1
    np.testing.assert_array_equal(cut, whole)


def test_a_wave_is_not_cut() -> None:
    """Free-form: no flat face anywhere."""
    rng = np.random.default_rng(6)
    x, y = rng.uniform(0, 100, (2, 60_000))
    points = np.column_stack((x, y, 3 * np.sin(x / 10) * np.cos(y / 14)))
    slope_x = 0.3 * np.cos(x / 10) * np.cos(y / 14)
    slope_y = -3 / 14 * np.sin(x / 10) * np.sin(y / 14)
    normals = unit(np.column_stack((-slope_x, -slope_y, np.ones_like(x))))
    grid, whole, cut, _ = regions(points, normals, cell=0.8)
    assert len(large(grid, whole)) == 1
    np.testing.assert_array_equal(cut, whole)


def test_flat_groups_are_left_alone() -> None:
    rng = np.random.default_rng(7)
    points = np.column_stack((rng.uniform(0, 30, (5000, 2)), np.zeros(5000)))
    _, whole, cut, _ = regions(points, np.tile([0.0, 0.0, 1.0], (5000, 1)), cell=0.8)
    np.testing.assert_array_equal(cut, whole)
