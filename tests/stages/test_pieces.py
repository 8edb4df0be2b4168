"""Pieces of surfaces are connected over leaves that touch, where their points are near."""

import numpy as np
import pytest
from reference import meeting
from reference.device_grid import surface_leaves
from reference.leaves import leaves_of

from octoseg_ti.device import runtime
from octoseg_ti.stages.labelling import label_lists, own_lists
from octoseg_ti.stages.leaves import Leaves
from octoseg_ti.stages.pieces import measure_entries, pieces


def random_own(leaves: Leaves, seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    leaf = rng.integers(0, len(leaves), 2 * len(leaves))
    return own_lists(leaves, leaf, rng.integers(-1, count, len(leaf)))


def as_lists(own: np.ndarray) -> list[list[int]]:
    return [row[row >= 0].tolist() for row in own]


def pairs_of(leaves: Leaves) -> list[tuple[int, int]]:
    return list(zip(leaves.a.tolist(), leaves.b.tolist(), strict=True))


def no_boxes(own: np.ndarray) -> np.ndarray:
    """Return boxes for which no entry is too far from another."""
    return np.zeros((np.count_nonzero(own >= 0), 6))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("count", [1, 3, 40])
def test_pieces_equal_the_reference(seed: int, count: int) -> None:
    _, leaves = surface_leaves(seed, 900)
    own = random_own(leaves, seed, count)
    found = as_lists(pieces(leaves, own, no_boxes(own), np.inf))
    assert found == meeting.pieces(as_lists(own), pairs_of(leaves))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("gap", [0.02, 0.3, 1e3])
def test_points_of_one_piece_are_no_farther_apart_than_the_gap(seed: int, gap: float) -> None:
    grid, leaves = surface_leaves(seed, 900)
    point = runtime.download(grid.point)
    rng = np.random.default_rng(seed)
    leaf = np.repeat(np.arange(len(leaves)), leaves.count)
    label = rng.integers(-1, 2, len(leaves))[leaf]
    label = np.where(rng.random(900) < 0.2, rng.integers(-1, 3, 900), label).astype(np.int32)
    own = label_lists(leaves, label)
    off = rng.uniform(0.0, 6.0, 900).astype(np.float32)
    entries = measure_entries(grid.point, leaves, own, label, off, 4.0)
    points = {
        (c, s): point[(leaf == c) & (label == s)] for c, m in enumerate(as_lists(own)) for s in m
    }
    expected = np.array([[*p.min(axis=0), *p.max(axis=0)] for p in points.values()])
    np.testing.assert_array_equal(entries.box, expected)
    assert entries.size.tolist() == [len(p) for p in points.values()]
    capped = np.minimum(off.astype(float), 4.0)
    units = [np.floor(1024.0 * capped[(leaf == c) & (label == s)] ** 2 + 0.5) for c, s in points]
    assert entries.square.tolist() == [np.sum(u) / 1024.0 for u in units]
    entry = {key: e for e, key in enumerate(points)}
    assert entries.of_point.tolist() == [
        entry.get((c, s), -1) for c, s in zip(leaf.tolist(), label.tolist(), strict=True)
    ]
    found = as_lists(pieces(leaves, own, entries.box, gap))
    assert found == meeting.pieces(as_lists(own), pairs_of(leaves), points, gap)


def test_a_large_leaf_with_a_stray_point_links_nothing() -> None:
    # Two faces of one plane, three apart, and between them one leaf of something else.
    x, y = (a.ravel() for a in np.mgrid[0.05:9.0:0.1, 0.05:3.0:0.1])
    leaves, order = leaves_of(np.column_stack([x, y, 0.0 * x]), 3.0)
    points = np.column_stack([x, y, 0.0 * x])[order]
    label = np.where((points[:, 0] < 3.0) | (points[:, 0] > 6.0), 0, 1).astype(np.int32)
    label[np.flatnonzero(label == 1)[np.argmin(points[label == 1, 0])]] = 0
    own = label_lists(leaves, label)
    assert [row[row >= 0].tolist() for row in own] == [[0], [0, 1], [0]]
    assert len(np.unique(pieces(leaves, own, no_boxes(own), np.inf)[own == 0])) == 1
    off = np.zeros(len(points), np.float32)
    entries = measure_entries(runtime.upload(points), leaves, own, label, off, 1.0)
    near = pieces(leaves, own, entries.box, 1.0)
    assert len(np.unique(near[own == 0])) == 2


def test_without_surfaces_there_are_no_pieces() -> None:
    _, leaves = surface_leaves(0, 900)
    label = np.full(900, -1, np.int32)
    own = label_lists(leaves, label)
    assert np.all(pieces(leaves, own, no_boxes(own), 1.0) == -1)
    entries = measure_entries(runtime.zeros((900, 3), float), leaves, own, label, label, 1.0)
    assert len(entries.size) == 0
    assert np.all(entries.of_point == -1)


def test_what_a_full_list_leaves_out_is_of_no_entry() -> None:
    points = np.column_stack([np.linspace(0.1, 0.9, 40), np.zeros((40, 2))])
    leaves, _ = leaves_of(points, 1.0)
    label = (np.arange(40) % 20).astype(np.int32)
    own = label_lists(leaves, label)
    held = own[own >= 0]
    assert len(leaves) == 1 and len(held) < 20
    off = np.ones(40, np.float32)
    entries = measure_entries(runtime.upload(points), leaves, own, label, off, 4.0)
    assert entries.size.tolist() == [2] * len(held) and np.all(entries.square == 2.0)
    np.testing.assert_array_equal(entries.of_point, np.where(np.isin(label, held), label, -1))
