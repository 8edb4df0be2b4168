"""Surfaces that meet, that are one, that others explain; and their connected pieces."""

import numpy as np
import pytest
from reference import meeting
from reference.device_grid import samples_of, surface_leaves
from reference.leaves import leaves_of
from reference.surfaces import CYLINDER, PLANE, patch_of

from octoseg_ti.device import runtime
from octoseg_ti.stages.labelling import label_lists, own_lists
from octoseg_ti.stages.leaves import Leaves, members_of, sample_leaves
from octoseg_ti.stages.merging import (
    contacts,
    cut_out,
    entry_boxes,
    explained_by_others,
    merge_surfaces,
    pieces,
    smooth_contacts,
)
from octoseg_ti.stages.sets import Surfaces

NOISE = 0.02


def random_own(leaves: Leaves, seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    leaf = rng.integers(0, len(leaves), 2 * len(leaves))
    return own_lists(leaves, leaf, rng.integers(-1, count, len(leaf)))


def as_lists(own: np.ndarray) -> list[list[int]]:
    return [row[row >= 0].tolist() for row in own]


def pairs_of(leaves: Leaves) -> list[tuple[int, int]]:
    return list(zip(leaves.a.tolist(), leaves.b.tolist(), strict=True))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("count", [1, 3, 40])
def test_contacts_equal_the_reference(seed: int, count: int) -> None:
    _, leaves = surface_leaves(seed, 900)
    own = random_own(leaves, seed, count)
    pairs, places = contacts(leaves, own)
    expected = meeting.contacts(as_lists(own), pairs_of(leaves))
    found = {(int(a), int(b)): int(n) for (a, b), n in zip(pairs, places, strict=True)}
    assert found == expected
    assert list(found) == sorted(found)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("count", [1, 3, 40])
def test_pieces_equal_the_reference(seed: int, count: int) -> None:
    _, leaves = surface_leaves(seed, 900)
    own = random_own(leaves, seed, count)
    assert as_lists(pieces(leaves, own)) == meeting.pieces(as_lists(own), pairs_of(leaves))


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
    assert len(np.unique(pieces(leaves, own)[own == 0])) == 1
    near = pieces(leaves, own, entry_boxes(points, leaves, own, label), 1.0)
    assert len(np.unique(near[own == 0])) == 2


def test_surfaces_that_meet_at_an_edge_are_no_smooth_contact() -> None:
    grid, leaves = surface_leaves(0, 900)
    own = own_lists(leaves, np.repeat(np.arange(len(leaves)), 3), np.tile([0, 1, 2], len(leaves)))
    parameters = np.full((3, 8), np.nan)
    parameters[:, :3] = 0.0
    for s, angle in enumerate((0.0, 0.3, 1.2)):
        parameters[s, 3:6] = 0.0, np.sin(angle), np.cos(angle)
    surfaces = Surfaces(kind=np.zeros(3, np.int32), parameters=parameters)
    smooth = smooth_contacts(leaves, own, sample_leaves(grid, leaves, 2), surfaces)
    np.testing.assert_array_equal(smooth, [[0, 1]])
    assert len(contacts(leaves, own)[0]) == 3


def test_members_of_labels() -> None:
    label = np.array([2, -1, 0, 2, 0, 2], np.int32)
    assert [m.tolist() for m in members_of(label, 4)] == [[2, 4], [], [0, 3, 5], []]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("count", [4, 200])
def test_surfaces_explained_by_others_equal_the_reference(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    n = 3000
    label = rng.integers(-1, count, n).astype(np.int32)
    second = np.where(rng.random(n) < 0.02, -1, (label + rng.integers(1, 4, n)) % count)
    second[label < 0] = -1
    calm = rng.random(count) < 0.5
    off = np.abs(rng.normal(0.0, np.where(calm[label], 0.7, 3.0))).astype(np.float32)
    off = np.stack([off, np.full(n, 9.0, np.float32)], axis=1)
    off[second < 0] = np.float32(1e30)
    gone = explained_by_others(label, second.astype(np.int32), off, count, 2.0)
    assert set(np.flatnonzero(gone).tolist()) == set(
        meeting.explained_by_others(label, second, off, count, 2.0)
    )
    assert gone.any() == calm.any()
    assert not gone.all()


@pytest.mark.parametrize("seed", range(4))
def test_errors_of_form_equal_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, count = 6000, 24
    # Three large surfaces; what is small leans mostly on one of these, on two, or on none.
    label = rng.choice(count, n, p=np.repeat([0.25, 0.25 / 21], [3, 21])).astype(np.int32)
    leans = rng.uniform(0.5, 1.0, count)
    second = np.where(rng.random(n) < leans[label], label % 3, (label + 1) % 3)
    second = np.where(label < 3, (label + 1) % 3, second)
    second[rng.random(n) < 0.02] = -1
    far, turned = rng.uniform(1.0, 6.0, count), rng.uniform(0.5, 5.0, count)
    off = np.stack([rng.normal(spread[label]) for spread in (far, turned)], axis=1)
    off = np.abs(off).astype(np.float32)
    off[label < 3] = 30.0
    gone = np.flatnonzero(explained_by_others(label, second.astype(np.int32), off, count, 2.0))
    assert set(gone.tolist()) == set(meeting.explained_by_others(label, second, off, count, 2.0))
    calm = [np.mean(np.minimum(off[label == m, 0], 4.0) ** 2) <= 2.0 for m in gone]
    assert 0 < len(gone) < 21 and not all(calm)


def test_a_shallow_round_between_two_planes_is_no_error_of_form() -> None:
    label = np.repeat([0, 1, 2], [1000, 900, 100]).astype(np.int32)
    off = np.full((2000, 2), 30.0, np.float32)
    off[label == 2] = 2.5, 1.0

    def given_up(share: float) -> list[bool]:
        second = np.where(label == 0, 1, 0)
        second[1900 + round(100 * share) :] = 1
        return explained_by_others(label, second.astype(np.int32), off, 3, 2.0).tolist()

    for share in (0.5, 0.3, 0.75, 0.21):
        assert not any(given_up(share))
    for share in (1.0, 0.85, 0.15):
        assert given_up(share) == [False, False, True]
    # What both of them explain goes wherever it leans.
    off[label == 2] = 1.2, 1.0
    assert given_up(0.5) == [False, False, True]


def test_a_small_smooth_error_of_form_is_given_up() -> None:
    label = np.repeat([0, 1], [1000, 60]).astype(np.int32)
    second = 1 - label
    off = np.full((1060, 2), 30.0, np.float32)
    off[label == 1] = 2.5, 1.0  # a little off, and with the same normals
    np.testing.assert_array_equal(explained_by_others(label, second, off, 2, 2.0), [False, True])
    off[label == 1, 1] = 8.0
    assert not explained_by_others(label, second, off, 2, 2.0).any()


def test_halves_of_a_cylinder_are_merged_and_a_plane_is_not() -> None:
    rng = np.random.default_rng(0)
    points, normals, parameters = patch_of(CYLINDER, rng, 400)
    flat, up, level = patch_of(PLANE, rng, 200)
    points = np.concatenate([points, flat - [0, 0, 2.0]]) + rng.normal(0.0, NOISE, (600, 3))
    samples = samples_of(points, np.concatenate([normals, up]))
    label = np.concatenate([np.where(points[:400, 2] > 4.0, 1, 0), np.full(200, 2)])
    surfaces = Surfaces(
        kind=np.array([CYLINDER, CYLINDER, PLANE], np.int32),
        parameters=np.stack([parameters, parameters, level - [0, 0, 2.0, 0, 0, 0, 0, 0]]),
    )
    pairs = np.array([[0, 1], [0, 2]])
    name, merged = merge_surfaces(samples, label.astype(np.int32), surfaces, pairs, NOISE)
    assert name[0] == name[1]
    assert name[2] == 2
    kept = int(name[0])
    assert merged.kind[kept] == CYLINDER
    np.testing.assert_allclose(merged.parameters[kept, 6], 6.0, atol=0.02)


@pytest.mark.parametrize("seed", range(5))
def test_what_was_cut_out_leaves_more_than_noise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(2, 60))
    cut = rng.uniform(-2.5, 2.5, size=(2, 60))  # as far as it just fits
    far = np.concatenate([noise[0], cut[0], 0.67 * noise[1], cut[1]])
    label = np.repeat([0, 1, 3, 4], 60).astype(np.int32)
    order = rng.permutation(len(far))
    limited = np.where(np.abs(far) <= 2.5, far, 0.0)
    found, square = cut_out(label[order], limited[order], 6)
    assert found.tolist() == [False, True, False, False, True, False]
    plain = [np.mean(limited[label == m] ** 2) if np.any(label == m) else 0.0 for m in range(6)]
    np.testing.assert_allclose(square, plain, atol=1e-3)


def test_each_surface_may_have_a_limit_of_its_own() -> None:
    label = np.repeat([0, 1, 2], [400, 40, 40]).astype(np.int32)
    second = np.where(label == 0, -1, 0).astype(np.int32)
    off = np.tile(np.float32([1.0, 9.0]), (480, 1))  # near, but facing another way
    gone = explained_by_others(label, second, off, 3, np.array([0.0, 0.9, 1.1]))
    assert gone.tolist() == [False, False, True]
