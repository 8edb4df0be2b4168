"""Surfaces that are one are merged; surfaces that others explain are given up."""

import numpy as np
import pytest
from reference import meeting
from reference.device_grid import samples_of
from reference.surfaces import CYLINDER, PLANE, patch_of

from octoseg_ti.stages.contacts import Contacts
from octoseg_ti.stages.leaves import members_of
from octoseg_ti.stages.merging import cut_out, explained_by_others, merge_surfaces
from octoseg_ti.stages.sets import Surfaces

NOISE = 0.02


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
    touching = Contacts(np.array([[0, 1], [0, 2]]), np.zeros(2), np.zeros(2))
    name, merged = merge_surfaces(samples, label.astype(np.int32), surfaces, touching, NOISE)
    assert name[0] == name[1]
    assert name[2] == 2
    kept = int(name[0])
    assert merged.kind[kept] == CYLINDER
    np.testing.assert_allclose(merged.parameters[kept, 6], 6.0, atol=0.02)


@pytest.mark.parametrize(("turn", "step", "one"), [(0.0, 0.0, 1), (0.2, 0.0, 2), (0.0, 0.5, 2)])
def test_pieces_with_an_edge_or_a_step_between_them_are_not_merged(
    turn: float, step: float, one: int
) -> None:
    rng = np.random.default_rng(0)
    points, normals, parameters = patch_of(PLANE, rng, 400)
    points += rng.normal(0.0, NOISE, (400, 3))
    label = (np.arange(400) % 2).astype(np.int32)
    surfaces = Surfaces(kind=np.full(2, PLANE, np.int32), parameters=np.tile(parameters, (2, 1)))
    touching = Contacts(np.array([[0, 1]]), np.array([turn]), np.array([step]))
    name, _ = merge_surfaces(samples_of(points, normals), label, surfaces, touching, NOISE)
    assert len(set(name.tolist())) == one


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
