"""The sparse grid is the recursion of section 3.3, and its cells are what they say."""

import math

import numpy as np
import pytest
from reference.clouds import random_cloud, random_surface, rotation, unit
from reference.device_grid import leaf_nodes, members, tables
from reference.octree import build_tree, layout

from octoseg_ti.device import runtime
from octoseg_ti.errors import DataError
from octoseg_ti.stages.grid import Grid, build_grid
from octoseg_ti.stages.moments import (
    HI,
    LEVEL,
    LO,
    NORMAL,
    POINT,
    RESIDUAL,
    SIGMA,
    STOP,
    X,
    Z,
)
from octoseg_ti.types import StopReason

# Values are cut to steps of 2^-30.
STEP = 2.0**-30


def compare(points: np.ndarray, normals: np.ndarray, what: str, **options) -> Grid:
    """Build both grids and compare every cell."""
    grid = build_grid(points, normals, **options)
    tree = build_tree(points, normals, **options)
    assert tree.closest > 1e-7, f"{what}: a decision hangs on rounding, take another seed"
    assert (grid.size, grid.shape, grid.depth) == (tree.size, tree.shape, tree.depth), what
    assert grid.passes == tree.passes, what
    node, child, mean = tables(grid)
    assert grid.count == len(tree.cells), what
    inside = members(grid)
    for i in range(grid.count):
        cell = tree.cells[(int(node[i, LEVEL]), *node[i, X : Z + 1].tolist())]
        where = f"{what}: cell {cell.key}"
        np.testing.assert_array_equal(inside[i], np.sort(cell.members), err_msg=where)
        assert (child[i, 0] == -2) == cell.leaf, where
        if cell.leaf:
            assert node[i, STOP] == int(cell.stop), where  # type: ignore[arg-type]
        else:
            got = {tuple(node[c, X : Z + 1]) for c in child[i] if c >= 0}
            assert got == {d.place for d in cell.daughters}, where
            for octant, c in enumerate(child[i]):
                if c >= 0:
                    x, y, z = node[c, X : Z + 1] & 1
                    assert octant == 4 * x + 2 * y + z, where
        edge = grid.size / 2.0 ** cell.key[0]
        assert mean[i, SIGMA] ** 2 == pytest.approx(cell.sigma**2, abs=16 * STEP), where
        np.testing.assert_allclose(
            mean[i, POINT : POINT + 3] + tree.corner, cell.point, atol=edge * STEP, err_msg=where
        )
        # Where the normals all but cancel out, or spread all round, their mean is chance.
        if cell.sigma < (0.99 if grid.signed else 0.7):
            got_normal = mean[i, NORMAL : NORMAL + 3]
            if not grid.signed and got_normal @ cell.normal < 0:
                got_normal = -got_normal
            np.testing.assert_allclose(got_normal, cell.normal, atol=1e-6, err_msg=where)
            # The covariance is a difference of squares up to 1, in half cells.
            tolerance = 16 * STEP * (edge / 2) ** 2 / (1 - cell.sigma)
            assert mean[i, RESIDUAL] ** 2 == pytest.approx(cell.residual**2, abs=tolerance), where
    return grid


@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [3, 40, 700])
def test_random_normals_equal_the_reference(signed: bool, seed: int, n: int) -> None:
    points, normals = random_cloud(seed, n, missing=0.1)
    compare(
        points, normals, f"seed {seed}, n {n}",
        tolerance=0.3, divisions=3, min_cell=0.2, signed=signed,
    )  # fmt: skip


@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [50, 1500])
def test_surfaces_equal_the_reference(signed: bool, seed: int, n: int) -> None:
    """As the default builds it: cells from the spacing, three points, flatness and noise."""
    points, normals = random_surface(seed, n)
    rng = np.random.default_rng(seed)
    normals = unit(normals + 0.03 * rng.standard_normal(normals.shape))
    if not signed:
        normals *= rng.choice([-1.0, 1.0], (n, 1))
    compare(
        points, normals, f"seed {seed}, n {n}", tolerance=0.07, min_cell=0.9, min_points=3,
        flatness=0.25, noise=0.004, signed=signed, edge_tolerance=[None, 0.12, 0.03][seed],
    )  # fmt: skip


@pytest.mark.parametrize("tolerance", [0.01, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("seed", range(2))
def test_the_paper_settings_equal_the_reference(tolerance: float, seed: int) -> None:
    """Down to cells of one point, coincident points, and points far apart in a plane."""
    points, normals = random_surface(seed, 400)
    rng = np.random.default_rng(seed)
    normals = unit(normals + 0.02 * rng.standard_normal(normals.shape))
    points[:3], normals[:3] = points[3], normals[3]  # coincident, of one mind
    points[4] = points[5]  # coincident, of two minds: only the depth limit ends that
    normals[4:6] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]
    grid = compare(points, normals, f"seed {seed}", tolerance=tolerance, divisions=12, min_points=2)
    node, child, _ = tables(grid)
    stops = set(node[child[:, 0] == -2, STOP].tolist())
    assert int(StopReason.FEW_POINTS) not in stops  # a single normal has no deviation
    deepest = node[node[:, STOP] == int(StopReason.MAX_LEVEL)]
    if tolerance < 0.6:
        assert len(deepest) == 1 and deepest[0, LEVEL] == grid.depth
        assert deepest[0, HI] - deepest[0, LO] == 2
    else:
        assert len(deepest) == 0


def test_many_cells_grow_the_tables() -> None:
    # Every point its own normal and a cell of its own: nodes far outnumber the initial cells.
    points, normals = random_cloud(11, 2500)
    compare(points, normals, "seed 11", tolerance=0.01, divisions=1, min_points=2)


def test_every_point_is_in_one_leaf() -> None:
    points, normals = random_surface(5, 3000)
    grid = build_grid(points, normals, tolerance=0.05, divisions=6)
    node, _, _ = tables(grid)
    leaves = leaf_nodes(grid)
    assert node[leaves[0], LO] == 0 and node[leaves[-1], HI] == 3000
    np.testing.assert_array_equal(node[leaves[1:], LO], node[leaves[:-1], HI])
    order = runtime.download(grid.order)
    np.testing.assert_array_equal(np.sort(order), np.arange(3000))
    sorted_points = runtime.download(grid.point)
    np.testing.assert_array_equal(sorted_points, points[order] - grid.corner)
    for i in leaves:
        edge = grid.size / 2.0 ** node[i, LEVEL]
        low = node[i, X : Z + 1] * edge
        own = sorted_points[node[i, LO] : node[i, HI]]
        assert np.all(own >= low - 1e-9) and np.all(own <= low + edge + 1e-9)


@pytest.mark.parametrize("signed", [True, False])
def test_permuting_the_points_changes_no_bit(signed: bool) -> None:
    points, normals = random_surface(8, 2000)
    normals = unit(normals + 0.05 * np.random.default_rng(8).standard_normal(normals.shape))
    options = {"tolerance": 0.06, "min_cell": 0.5, "flatness": 0.25, "signed": signed}
    one = build_grid(points, normals, **options)
    order = np.random.default_rng(9).permutation(2000)
    other = build_grid(points[order], normals[order], **options)
    for a, b in zip(tables(one), tables(other), strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(members(one), members(other), strict=True):
        np.testing.assert_array_equal(a, np.sort(order[b]))


# Known answers (Eq. 4 on simple shapes).


def one_cell(points: np.ndarray, normals: np.ndarray, **options) -> tuple[float, np.ndarray]:
    """Return deviation and mean normal of the single cell that holds everything."""
    options = {"tolerance": 2.0, "min_cell": 10.0, **options}
    grid = build_grid(points, normals, **options)
    assert grid.count == 1
    _, _, mean = tables(grid)
    return float(mean[0, SIGMA]), mean[0, NORMAL : NORMAL + 3]


@pytest.mark.parametrize("signed", [True, False])
def test_a_plane_has_no_deviation(signed: bool) -> None:
    for seed in range(5):
        q = rotation(seed)
        rng = np.random.default_rng(seed)
        points = np.column_stack((rng.uniform(0, 5, (2000, 2)), np.zeros(2000))) @ q.T
        sigma, normal = one_cell(points, np.tile(q[:, 2], (2000, 1)), signed=signed)
        assert sigma < 1e-4  # the square root of the steps
        assert abs(normal @ q[:, 2]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("radius", [3.0, 12.0, 100.0])
def test_a_cylinder_of_radius_r(radius: float) -> None:
    """A cell of size s on a cylinder has the deviation s / (r sqrt 12), for s well below r."""
    s = 0.1 * radius
    angle = np.linspace(-0.5, 0.5, 4001) * s / radius
    normals = np.column_stack((0 * angle, np.sin(angle), np.cos(angle)))
    sigma, normal = one_cell(radius * normals, normals, min_cell=2 * s)
    assert sigma == pytest.approx(s / (radius * math.sqrt(12)), rel=1e-3)
    np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-9)


@pytest.mark.parametrize("radius", [3.0, 50.0])
def test_a_sphere_of_radius_r(radius: float) -> None:
    """A cell of size s on a sphere has the deviation s / (r sqrt 6), for s well below r."""
    s = 0.1 * radius
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-0.5, 0.5, 101) * s / radius] * 2))
    normals = np.column_stack((x, y, np.sqrt(1 - x * x - y * y)))
    sigma, _ = one_cell(radius * normals, normals, min_cell=2 * s)
    # The 101 places of a lattice spread by (1 + 2/100) more than a uniform density.
    assert sigma == pytest.approx(s / (radius * math.sqrt(6)), rel=2e-2)


@pytest.mark.parametrize("theta", np.radians([1.0, 10.0, 60.0, 90.0, 170.0]))
@pytest.mark.parametrize("share", [0.5, 0.2, 0.01])
def test_two_planes(theta: float, share: float) -> None:
    """Normals theta apart, shares p and 1 - p: 2 sin(theta / 2) sqrt(p (1 - p))."""
    n = 1000
    first = np.arange(n) < share * n
    normals = np.where(first[:, None], [math.sin(theta), 0.0, math.cos(theta)], [0.0, 0.0, 1.0])
    points = np.random.default_rng(1).uniform(0, 5, (n, 3))
    sigma, _ = one_cell(points, normals)
    p = first.mean()
    assert sigma == pytest.approx(2 * math.sin(theta / 2) * math.sqrt(p * (1 - p)), rel=1e-5)


def test_three_orthogonal_planes_and_opposite_sides() -> None:
    points = np.random.default_rng(1).uniform(0, 5, (600, 3))
    sigma, _ = one_cell(points, np.repeat(np.eye(3), 200, axis=0))
    assert sigma == pytest.approx(math.sqrt(2 / 3), rel=1e-6)
    up_and_down = np.repeat([[0.0, 0, 1], [0.0, 0, -1]], 300, axis=0)
    assert one_cell(points, up_and_down)[0] == pytest.approx(1.0, rel=1e-6)
    assert one_cell(points, up_and_down, signed=False)[0] < 1e-4


def test_many_points_do_not_wear_out_the_sums() -> None:
    """A true deviation of 0.0091 over 300,000 points, where sums of 32 bits give 0.037."""
    rng = np.random.default_rng(4)
    tilt = 0.0091 / math.sqrt(2) * rng.standard_normal((300_000, 2))
    normals = unit(np.column_stack((tilt, np.ones(300_000))))
    sigma, _ = one_cell(rng.uniform(0, 5, (300_000, 3)), normals)
    exact = math.sqrt(np.mean(np.sum((normals - normals.mean(axis=0)) ** 2, axis=1)))
    assert sigma == pytest.approx(exact, rel=1e-5)
    assert sigma == pytest.approx(0.0091, rel=5e-3)


def test_a_step_between_parallel_faces_is_seen_by_the_residual() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 8, (2000, 3))
    points[:, 2] = np.where(points[:, 0] < 4.3, 0.0, 0.5)
    normals = np.tile([0.0, 0.0, 1.0], (2000, 1))
    options = {"tolerance": 0.05, "min_cell": 0.5, "min_points": 3}
    blind = build_grid(points, normals, **options)
    assert blind.passes == 1
    seeing = compare(points, normals, "step", flatness=0.25, **options)
    assert seeing.passes == seeing.depth + 1


def test_leaves_of_a_cylinder_have_the_size_of_its_radius() -> None:
    """s = sqrt(12) tau r within a factor of two (method of stop at sigma <= tau)."""
    rng = np.random.default_rng(3)
    angle = rng.uniform(0, math.pi, 60_000)
    normals = np.column_stack((np.zeros(60_000), np.cos(angle), np.sin(angle)))
    points = np.column_stack((rng.uniform(0, 30, 60_000), 10 * normals[:, 1], 10 * normals[:, 2]))
    grid = build_grid(points, normals, tolerance=0.05, divisions=1)
    node, _, _ = tables(grid)
    leaves = leaf_nodes(grid)
    size = np.repeat(grid.size / 2.0 ** node[leaves, LEVEL], node[leaves, HI] - node[leaves, LO])
    law = math.sqrt(12) * 0.05 * 10.0
    # A cell on the slope holds up to sqrt(2) times its size of the arc, a corner of a cell less.
    assert np.all(size > law / 2 / math.sqrt(2))
    assert np.mean(size <= law) > 0.9


def test_passes_and_levels_grow_as_the_tolerance_falls() -> None:
    points, normals = random_surface(6, 3000)
    passes, levels = [], []
    for tolerance in (1.0, 0.5, 0.2, 0.1, 0.05, 0.01):
        grid = build_grid(points, normals, tolerance=tolerance, divisions=4)
        passes.append(grid.passes)
        levels.append(len(np.unique(tables(grid)[0][leaf_nodes(grid), LEVEL])))
    assert passes == sorted(passes) and levels == sorted(levels)
    assert passes[0] == 1 and passes[-1] > 4


# The layout of the cells, and what cannot be done.


@pytest.mark.parametrize("seed", range(5))
def test_cells_of_the_paper_are_cubes_from_the_shortest_side(seed: int) -> None:
    points, normals = random_cloud(seed, 300)
    grid = build_grid(points, normals, tolerance=1.0, divisions=7)
    extent = np.ptp(points, axis=0)
    assert grid.size == pytest.approx(extent.min() / 7)
    assert min(grid.shape) == 7
    assert all(c * grid.size >= e * (1 - 1e-12) for c, e in zip(grid.shape, extent, strict=True))


@pytest.mark.parametrize("divisions", [1, 3, 7, 11, 12, 13, 49])
def test_the_upper_side_of_the_box_gets_no_layer_of_its_own(divisions: int) -> None:
    """Sides of a cube are exactly so many cells long, however 1 / divisions is rounded."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = rng.uniform(0, 1, (200, 3))
        points[:2] = [[0, 0, 0], [1, 1, 1]]
        points = points * rng.uniform(1, 100) + rng.uniform(-1000, 1000, 3)
        points[1] = points[0] + (points[1] - points[0])[0]  # a cube but for the last bit
        normals = np.tile([0.0, 0.0, 1.0], (200, 1))
        grid = build_grid(points, normals, tolerance=0.5, divisions=divisions)
        assert grid.shape == (divisions,) * 3, f"seed {seed}"
        node, _, _ = tables(grid)
        assert node[:, X : Z + 1].max() == divisions - 1


def test_a_flat_box_takes_its_shortest_side_that_is_one() -> None:
    points, normals = random_cloud(1, 300)
    points[:, 1] = 2.5
    grid = build_grid(points, normals, tolerance=1.0, divisions=7)
    assert grid.size == pytest.approx(np.ptp(points, axis=0)[[0, 2]].min() / 7)
    assert grid.shape[1] == 1


@pytest.mark.parametrize("min_cell", [0.3, 0.01, 0.0007])
def test_the_smallest_cell_is_reached_and_not_passed(min_cell: float) -> None:
    points, normals = random_cloud(2, 2000)
    grid = build_grid(points, normals, tolerance=0.01, min_cell=min_cell)
    finest = grid.size / 2.0**grid.depth
    assert finest == pytest.approx(min_cell)
    assert np.prod(grid.shape) <= 2**21
    node, _, _ = tables(grid)
    assert np.all(grid.size / 2.0 ** node[:, LEVEL] >= min_cell * (1 - 1e-9))


def test_layout_of_the_reference_is_the_same() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        extent = rng.uniform(0.1, 300, 3)
        points = np.stack((np.zeros(3), extent, extent / 2))
        normals = np.tile([0.0, 0.0, 1.0], (3, 1))
        options = {"divisions": int(rng.integers(1, 9)), "min_cell": float(rng.choice([0.0, 0.01]))}
        grid = build_grid(points, normals, tolerance=1.0, **options)
        assert (grid.size, grid.shape, grid.depth) == layout(extent, **options), f"seed {seed}"


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (np.full((5, 3), 3.0), {"min_cell": 1.0}, "all points coincide"),
        (np.eye(3), {}, "no spacing of the points can be measured"),
        (np.array([[0.0, 0, 0], [1e9, 1, 1], [5, 5, 1]]), {"divisions": 50}, "fewer divisions"),
        (np.array([[0.0, 0, 0], [1e9, 1e9, 1], [5, 5, 1]]), {"min_cell": 1e-6}, "too small"),
    ],
)
def test_impossible_grids_are_refused(points: np.ndarray, options: dict, message: str) -> None:
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    with pytest.raises(DataError, match=message):
        build_grid(points, normals, tolerance=0.1, **options)
