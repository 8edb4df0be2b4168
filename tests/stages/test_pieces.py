"""Pieces of surfaces are connected over leaves that touch, where their points are near."""

import numpy as np
import pytest
from reference import meeting
from reference.device_grid import surface_leaves
from reference.leaves import leaves_of

from octoseg_ti.device import runtime
from octoseg_ti.stages.labelling import label_lists, own_lists
from octoseg_ti.stages.leaves import Leaves
from octoseg_ti.stages.pieces import entry_boxes, pieces


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
    box = entry_boxes(point, leaves, own, label)
    points = {
        (c, s): point[(leaf == c) & (label == s)] for c, m in enumerate(as_lists(own)) for s in m
    }
    expected = np.array([[*p.min(axis=0), *p.max(axis=0)] for p in points.values()])
    assert np.all(box[:, :3] <= expected[:, :3]) and np.all(box[:, 3:] >= expected[:, 3:])
    several = np.array([np.ptp(label[leaf == c]) > 0 for c, _ in points])
    np.testing.assert_array_equal(box[several], expected[several])
    found = as_lists(pieces(leaves, own, box, gap))
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
    near = pieces(leaves, own, entry_boxes(points, leaves, own, label), 1.0)
    assert len(np.unique(near[own == 0])) == 2


def test_without_surfaces_there_are_no_pieces() -> None:
    _, leaves = surface_leaves(0, 900)
    own = label_lists(leaves, np.full(900, -1, np.int32))
    assert np.all(pieces(leaves, own, no_boxes(own), 1.0) == -1)
