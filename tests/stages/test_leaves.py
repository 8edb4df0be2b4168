"""Samples are the points with the smallest hashes; leaves whose boxes touch are a graph."""

from dataclasses import replace

import numpy as np
import pytest
from reference.clouds import random_surface
from reference.device_grid import leaves_of, surface_leaves, touching_leaves
from reference.graph import touching_pairs
from reference.labelling import pick

from octoseg_ti.device import runtime
from octoseg_ti.stages.grid import build_grid
from octoseg_ti.stages.leaves import joined_samples, sample_leaves, sizes_of


@pytest.mark.parametrize("seed", range(3))
def test_the_graph_is_that_of_touching_boxes(seed: int) -> None:
    grid, leaves = surface_leaves(seed)
    place = {int(n): i for i, n in enumerate(leaves.node)}
    expected = {
        frozenset((place[a.node], place[b.node]))
        for a, b in touching_pairs(leaves_of(grid), grid.depth)
    }
    found = [frozenset(pair) for pair in zip(leaves.a.tolist(), leaves.b.tolist(), strict=True)]
    assert set(found) == expected
    assert len(found) == len(expected)
    for c in range(len(leaves)):
        row = leaves.neighbor[leaves.start[c] : leaves.start[c + 1]].tolist()
        assert row == sorted(next(iter(p - {c})) for p in expected if c in p)
    np.testing.assert_array_equal(leaves.first + leaves.count, np.append(leaves.first[1:], 1500))


@pytest.mark.parametrize("seed", range(3))
def test_boxes_hold_the_points_of_leaves(seed: int) -> None:
    grid, leaves = surface_leaves(seed)
    point = runtime.download(grid.point)
    for f, n, box in zip(leaves.first, leaves.count, leaves.box, strict=True):
        np.testing.assert_array_equal(box[:3], point[f : f + n].min(axis=0))
        np.testing.assert_array_equal(box[3:], point[f : f + n].max(axis=0))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("most", [1, 4, 9])
def test_samples_equal_the_reference(seed: int, most: int) -> None:
    grid, leaves = surface_leaves(seed)
    rng = np.random.default_rng(seed)
    label = rng.integers(-1, 2, grid.order.shape[0]).astype(np.int32)
    samples = sample_leaves(grid, leaves, most, label=label)
    point = runtime.download(grid.point)
    fine = 1024.0 * 2.0**grid.depth / grid.size
    for c in range(len(leaves)):
        span = int(leaves.first[c]), int(leaves.first[c] + leaves.count[c])
        expected = pick(point, label < 0, span, most, fine)
        mine = samples.leaf == c
        assert samples.index[mine].tolist() == expected, f"seed {seed}, leaf {c}"
        free = int((label[span[0] : span[1]] < 0).sum())
        np.testing.assert_allclose(samples.weight[mine].sum(), free if expected else 0)
    np.testing.assert_array_equal(samples.point, point[samples.index])


def test_samples_do_not_depend_on_the_order_of_the_points() -> None:
    points, normals = random_surface(5, 900)
    order = np.random.default_rng(0).permutation(900)
    picked = []
    for p, n in ((points, normals), (points[order], normals[order])):
        grid = build_grid(p, n, tolerance=0.05, min_cell=0.7, min_points=3)
        picked.append(sample_leaves(grid, touching_leaves(grid), 3).point)
    np.testing.assert_array_equal(*picked)


def test_joined_samples_are_those_of_both() -> None:
    grid, leaves = surface_leaves(3)
    label = np.random.default_rng(3).integers(-1, 2, grid.order.shape[0]).astype(np.int32)
    one = sample_leaves(grid, leaves, 2, label=label)
    other = sample_leaves(grid, leaves, 5, label=-1 - label)
    both = joined_samples(one, other)
    assert len(both) == len(one) + len(other)
    for name in ("index", "leaf", "point", "normal", "weight"):
        first, second = np.split(getattr(both, name), [len(one)])
        np.testing.assert_array_equal(first, getattr(one, name))
        np.testing.assert_array_equal(second, getattr(other, name))
    assert both.signed == one.signed
    assert not joined_samples(replace(one, signed=False), other).signed


@pytest.mark.parametrize("seed", range(4))
def test_sizes_are_those_of_numpy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    label = np.repeat(rng.integers(-1, 5, 80), rng.integers(1, 9, 80)).astype(np.int32)
    expected = np.bincount(label + 1, minlength=8)[1:]
    np.testing.assert_array_equal(sizes_of(label, 7), expected, err_msg=f"seed {seed}")
    assert sizes_of(label, 7).dtype == np.int64


def test_no_points_have_no_labels() -> None:
    assert sizes_of(np.zeros(0, np.int32), 3).tolist() == [0, 0, 0]
    assert len(sizes_of(np.full(5, -1), 0)) == 0
