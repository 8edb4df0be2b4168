"""Samples lie on surfaces; the simplest surface through a set is found."""

import numpy as np
import pytest
from reference.device_grid import samples_of
from reference.labelling import normal_at
from reference.surfaces import CONE, CYLINDER, PLANE, SPHERE, TORUS, distance_of, patch_of

from octoseg_ti.stages.sets import (
    Surfaces,
    fit_sets,
    joined,
    largest_gap,
    lie_on,
    nearness,
    no_surfaces,
    spread,
)

KINDS = (PLANE, CYLINDER, CONE, SPHERE, TORUS)


def near_plainly(
    points: np.ndarray, normals: np.ndarray, kind: int, parameters: np.ndarray,
    limit: float, turn: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return how near a surface samples lie, and how far that is from being otherwise."""
    far = np.abs(distance_of(points, kind, parameters))
    slope = np.stack([normal_at(p, kind, parameters) for p in points])
    there = normals.any(axis=1)
    facing = np.where(there, np.abs(np.sum(slope * normals, axis=1)), 1.0)
    near = np.where(far <= limit, 1.0 - (far / limit) ** 2, 0.0)
    near *= np.where(facing >= np.cos(turn), 1.0 - (1.0 - facing) / (1.0 - np.cos(turn)), 0.0)
    return near, np.minimum(np.abs(far - limit), np.abs(facing - np.cos(turn)))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("turn", [0.3, 1.0])
def test_how_near_samples_are_to_surfaces_equals_the_reference(seed: int, turn: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 5.0, (300, 3))
    normals = rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[rng.random(300) < 0.1] = 0.0
    parameters = np.stack([patch_of(k, rng, 1)[2] for k in KINDS for _ in range(2)])
    parameters[:, :3] += rng.normal(0.0, 2.0, (10, 3))
    surfaces = Surfaces(kind=np.repeat(KINDS, 2).astype(np.int32), parameters=parameters)
    sets = [np.flatnonzero(rng.random(300) < share) for share in (0.3, 0.8, 0.5)]
    which = rng.integers(0, 3, 10)
    samples = samples_of(points, normals)
    found = nearness(samples, sets, which, surfaces, 1.0, turn)
    there = lie_on(samples, sets, which, surfaces, 1.0, turn)
    some = 0
    for s, (near, on) in enumerate(zip(found, there, strict=True)):
        mine = sets[which[s]]
        expected, margin = near_plainly(
            points[mine], normals[mine], int(surfaces.kind[s]), parameters[s], 1.0, turn
        )
        clear = margin > 1e-6
        np.testing.assert_allclose(near[clear], expected[clear], atol=2e-6)
        np.testing.assert_array_equal(on[clear], expected[clear] > 0.0)
        assert near.dtype == np.float32 and on.dtype == bool
        some += np.count_nonzero(on)
    assert some > (10 if turn < 1.0 else 100)


def test_what_lies_at_a_limit_still_lies_on_the_surface() -> None:
    points = np.array([(0, 0, 0), (0, 0, 1), (0, 0, -2), (0, 0, 2), (0, 0, 2.001)], float)
    normals = np.zeros((5, 3))
    level = np.array([[0, 0, 0, 0, 0, 1, np.nan, np.nan]])
    plane = Surfaces(kind=np.zeros(1, np.int32), parameters=level)
    every, first = [np.arange(5)], np.zeros(1, int)
    samples = samples_of(points, normals)
    (near,) = nearness(samples, every, first, plane, 2.0, 0.5)
    np.testing.assert_allclose(near, [1.0, 0.75, 0.0, 0.0, 0.0], atol=2e-6)
    (on,) = lie_on(samples, every, first, plane, 2.0, 0.5)
    assert on.tolist() == [True, True, True, True, False]
    # A tilt counts by its cosine, of either side of the sample.
    tilted = np.array([(0, np.sin(a), np.cos(a)) for a in (0.0, np.arccos(0.75), 1.0, 1.1, np.pi)])
    (near,) = nearness(samples_of(0.0 * points, tilted), every, first, plane, 2.0, np.pi / 3)
    np.testing.assert_allclose(near, [1.0, 0.5, 2 * np.cos(1.0) - 1, 0.0, 1.0], atol=2e-6)


def test_nothing_lies_on_no_surface() -> None:
    samples = samples_of(np.zeros((3, 3)), np.zeros((3, 3)))
    assert lie_on(samples, [np.arange(3)], np.zeros(0, int), no_surfaces(), 1.0, 1.0) == []


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("noise", [0.005, 0.03])
def test_every_kind_is_found(noise: float, robust: bool) -> None:
    rng = np.random.default_rng(1)
    patches = [patch_of(k, rng, 150) for k in KINDS]
    points = np.concatenate([p for p, _, _ in patches])
    normals = np.concatenate([n for _, n, _ in patches])
    samples = samples_of(points + noise * rng.normal(size=points.shape), normals)
    sets = list(np.split(np.arange(len(points)), 5))
    fitted, surfaces = fit_sets(samples, sets, noise, robust=robust)
    np.testing.assert_array_equal(fitted, np.arange(5))
    np.testing.assert_array_equal(surfaces.kind, KINDS)
    for s, (p, _, _) in enumerate(patches):
        far = distance_of(p, KINDS[s], surfaces.parameters[s])
        assert np.sqrt(np.mean(far**2)) < noise


def test_what_no_surface_fits_has_none() -> None:
    rng = np.random.default_rng(2)
    points, normals, _ = patch_of(PLANE, rng, 200)
    points[:, 2] += np.sin(3.0 * points[:, 0])
    samples = samples_of(points, normals)
    fitted, surfaces = fit_sets(samples, [np.arange(200)], 0.01)
    assert len(fitted) == len(surfaces) == 0
    assert len(fit_sets(samples, [], 0.01)[0]) == 0


@pytest.mark.parametrize("seed", range(3))
def test_how_far_surfaces_are_apart_equals_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 5.0, (300, 3))
    samples = samples_of(points, np.zeros((300, 3)))
    parameters = np.stack([patch_of(k, rng, 1)[2] for k in KINDS])
    one = Surfaces(kind=np.array(KINDS, np.int32), parameters=parameters)
    moved = parameters.copy()
    moved[:, :3] += 0.1 * rng.normal(size=(5, 3))
    other = Surfaces(kind=one.kind, parameters=moved)
    sets = [np.flatnonzero(rng.random(300) < share) for share in (0.3, 0.0, 0.5)]
    which = np.array([2, 0, 1, 2, 0])
    found = largest_gap(samples, sets, which, one, other)
    for k, w in enumerate(which):
        far = [distance_of(points[sets[w]], int(KINDS[k]), p[k]) for p in (parameters, moved)]
        expected = np.max(np.abs(far[0] - far[1]), initial=0.0)
        np.testing.assert_allclose(found[k], expected, atol=1e-9)
    turned = Surfaces(kind=one.kind[:1], parameters=moved[:1].copy())
    turned.parameters[0, 3:6] *= -1.0  # the same plane, with its other side outside
    back = largest_gap(
        samples, sets, which[:1], Surfaces(kind=one.kind[:1], parameters=moved[:1]), turned
    )
    np.testing.assert_allclose(back, 0.0, atol=1e-9)


def test_members_are_spread_evenly() -> None:
    members = np.arange(10, 110)
    np.testing.assert_array_equal(spread(members, 200), members)
    np.testing.assert_array_equal(spread(members, 5), [20, 40, 60, 80, 100])


def test_surfaces_are_joined_in_order() -> None:
    parameters = np.arange(16.0).reshape(2, 8)
    two = Surfaces(kind=np.array([0, 1], np.int32), parameters=parameters)
    both = joined([two.at(np.array([1])), two])
    np.testing.assert_array_equal(both.kind, [1, 0, 1])
    np.testing.assert_array_equal(both.parameters, parameters[[1, 0, 1]])
    assert len(joined([])) == 0
