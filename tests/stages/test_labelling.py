"""Points take the surface near their leaf that costs least; unchanged leaves keep their choice."""

import numpy as np
import pytest
from reference.device_grid import surface_leaves
from reference.labelling import choose, near_surfaces
from reference.surfaces import CONE, CYLINDER, PLANE, SPHERE, TORUS, patch_of

from octoseg_ti.device import runtime
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.labelling import (
    MOST,
    Labelling,
    Rule,
    common_label,
    label_lists,
    own_lists,
    surface_table,
)
from octoseg_ti.stages.leaves import Leaves


def random_surfaces(grid: Grid, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return surfaces of all kinds through points of a grid: kinds and parameters."""
    rng = np.random.default_rng(seed)
    point, normal = runtime.download(grid.point), runtime.download(grid.normal)
    kind = np.arange(count) % 5
    parameters = np.full((count, 8), np.nan)
    for s, k in enumerate(kind):
        parameters[s] = patch_of(int(k), rng, 1)[2]
        i = rng.integers(len(point))
        n = normal[i] if normal[i].any() else np.array([0.0, 0.0, 1.0])
        across = np.cross(n, rng.normal(size=3))
        across /= np.linalg.norm(across)
        a, b = parameters[s, 6:]
        back = {PLANE: 0.0, CYLINDER: a, CONE: 3.0, SPHERE: a, TORUS: a + b}[int(k)]
        parameters[s, :3] = point[i] - back * n
        parameters[s, 3:6] = n if k == PLANE else across
    return kind.astype(np.int32), parameters


def random_own(leaves: Leaves, seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    leaf = rng.integers(0, len(leaves), 3 * len(leaves))
    return own_lists(leaves, leaf, rng.integers(-1, count, len(leaf)))


def sets_of(own: np.ndarray) -> list[set[int]]:
    return [set(row[row >= 0].tolist()) for row in own]


@pytest.mark.parametrize(("seed", "tilt"), [(0, 0.3), (1, 0.3), (2, 0.03)])
def test_choices_equal_the_reference(seed: int, tilt: float) -> None:
    grid, leaves = surface_leaves(seed, 700)
    rng = np.random.default_rng(seed)
    count = 30
    kind, parameters = random_surfaces(grid, seed, count)
    handicap = rng.uniform(0.0, 2.0, count)
    closed = rng.random(len(leaves)) < 0.2
    own = random_own(leaves, seed, count)
    rule = Rule(0.3, tilt)
    labelling = Labelling(grid, leaves, rule)
    table = surface_table(kind, parameters, handicap)
    held = labelling.choose(own, table, closed=closed)
    label, second, off = (runtime.download(part) for part in labelling.choice)
    touching = [
        set(leaves.neighbor[leaves.start[c] : leaves.start[c + 1]].tolist())
        for c in range(len(leaves))
    ]
    near = near_surfaces(sets_of(own), closed, touching, MOST)
    point, normal = runtime.download(grid.point), runtime.download(grid.normal)
    leaf = np.repeat(np.arange(len(leaves)), leaves.count)
    turned_away = 0
    for i in range(len(point)):
        expected = choose(
            point[i], normal[i], near[leaf[i]], kind, parameters, handicap, tuple(rule)
        )
        where = f"seed {seed}, point {i}"
        assert label[i] == expected.label or expected.margin < 1e-6, where
        if min(expected.margin, expected.close) < 1e-6:
            continue
        assert second[i] == expected.second, where
        told = slice(3 if expected.label >= 0 else 2)  # by how much it costs more than none?
        np.testing.assert_allclose(
            off[i][told], expected.off[told], rtol=1e-5, atol=1e-3, err_msg=where
        )
        turned_away += int(expected.second >= 0 and expected.off[1] * tilt > rule.turn)
    assert (label >= 0).sum() > 100
    assert turned_away > 50
    for c, mine in enumerate(sets_of(held)):
        assert mine == {int(x) for x in label[leaf == c] if x >= 0}


def test_leaves_that_see_nothing_new_keep_what_they_chose() -> None:
    grid, leaves = surface_leaves(1, 700)
    kind, parameters = random_surfaces(grid, 1, 20)
    own, rule = random_own(leaves, 1, 20), Rule(0.3, 0.3)
    kept = Labelling(grid, leaves, rule)
    for turn in range(4):
        fresh = Labelling(grid, leaves, rule)
        table = surface_table(kind, parameters)
        held = kept.choose(own, table, passes=2)
        np.testing.assert_array_equal(held, fresh.choose(own, table, passes=2))
        for mine, theirs in zip(kept.choice, fresh.choice, strict=True):
            np.testing.assert_array_equal(runtime.download(mine), runtime.download(theirs))
        own, parameters = held.copy(), parameters.copy()
        parameters[turn, 0] += 0.1  # one surface moves
        own[own == turn + 5] = -1  # another one goes
        own = own_lists(leaves, np.repeat(np.arange(len(leaves)), MOST), own.ravel())


def test_the_nearest_of_two_planes_is_taken_and_the_other_comes_second() -> None:
    grid, leaves = surface_leaves(0, 700)
    point = runtime.download(grid.point)
    parameters = np.zeros((2, 8))
    parameters[:, 5] = 1.0
    parameters[:, 2] = np.quantile(point[:, 2], [0.4, 0.6])
    parameters[:, 6:] = np.nan
    own = own_lists(leaves, np.repeat(np.arange(len(leaves)), 2), np.tile([0, 1], len(leaves)))
    labelling = Labelling(grid, leaves, Rule(0.1, 10.0, reach=1e9, turn=4.0))
    labelling.choose(own, surface_table(np.zeros(2, np.int32), parameters))
    off = np.abs(point[:, 2, None] - parameters[:, 2])
    label, second, _ = (runtime.download(part) for part in labelling.choice)
    np.testing.assert_array_equal(label, (off[:, 1] < off[:, 0]).astype(int))
    np.testing.assert_array_equal(second, 1 - label)


@pytest.mark.parametrize("own", [0, 1, 2])
def test_what_comes_next_may_be_turned_away_or_anywhere_in_the_list(own: int) -> None:
    grid, leaves = surface_leaves(0, 700)
    point, normal = runtime.download(grid.point), runtime.download(grid.normal)
    i = int(np.flatnonzero(normal.any(axis=1))[0])
    across = np.cross(normal[i], [0.6, 0.0, 0.8])
    across /= np.linalg.norm(across)
    # One that the point takes, one that it is on but that faces elsewhere, one that is far off.
    planes = np.full((3, 8), np.nan)
    planes[:, :3], planes[:, 3:6] = point[i], normal[i]
    planes[own, :3] += 0.1 * normal[i]
    turned, far = (s for s in range(3) if s != own)
    planes[turned, 3:6] = across
    planes[far, :3] += 50.0 * normal[i]
    every = own_lists(leaves, np.repeat(np.arange(len(leaves)), 3), np.tile(range(3), len(leaves)))
    labelling = Labelling(grid, leaves, Rule(0.1, 0.1))
    labelling.choose(every, surface_table(np.zeros(3, np.int32), planes))
    label, second, off = (runtime.download(part)[i] for part in labelling.choice)
    assert (label, second) == (own, turned)
    tilts = np.pi / 2 / 0.1
    expected = 0.0, tilts, (6.0 + 0.1 * (tilts - 6.0)) ** 2 - 1.0
    np.testing.assert_allclose(off, expected, rtol=1e-5, atol=1e-3)


def test_labels_of_leaves() -> None:
    _, leaves = surface_leaves(2, 700)
    label = np.random.default_rng(2).integers(-1, 3, 700).astype(np.int32)
    label[: leaves.first[5]] = 1
    lists, common = label_lists(leaves, label), common_label(leaves, label)
    for c in range(len(leaves)):
        mine = set(label[leaves.first[c] : leaves.first[c] + leaves.count[c]].tolist())
        assert set(lists[c][lists[c] >= 0].tolist()) == mine - {-1}
        assert common[c] == (next(iter(mine)) if len(mine) == 1 else -1)


def test_of_too_many_surfaces_the_smaller_numbers_stay() -> None:
    _, leaves = surface_leaves(2, 700)
    own = own_lists(leaves, np.zeros(20, np.int64), np.arange(20)[::-1])
    np.testing.assert_array_equal(own[0], np.arange(MOST))
    assert (own[1:] == -1).all()
