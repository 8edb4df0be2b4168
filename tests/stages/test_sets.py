"""Samples lie on surfaces; the simplest surface through a set is found."""

import numpy as np
import pytest
from reference.device_grid import samples_of
from reference.labelling import normal_at
from reference.surfaces import CONE, CYLINDER, PLANE, SPHERE, TORUS, distance_of, patch_of

from octoseg_ti.stages.sets import Surfaces, fit_sets, joined, lie_on, no_surfaces, spread

KINDS = (PLANE, CYLINDER, CONE, SPHERE, TORUS)


@pytest.mark.parametrize("seed", range(3))
def test_what_lies_on_surfaces_equals_the_reference(seed: int) -> None:
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
    found = lie_on(samples_of(points, normals), sets, which, surfaces, 1.0, 1.0)
    for s, on in enumerate(found):
        mine = sets[which[s]]
        far = np.abs(distance_of(points[mine], surfaces.kind[s], parameters[s]))
        slope = np.stack([normal_at(p, surfaces.kind[s], parameters[s]) for p in points[mine]])
        cosine = np.abs(np.sum(slope * normals[mine], axis=1))
        turned = (cosine < np.cos(1.0)) & normals[mine].any(axis=1)
        clear = (np.abs(far - 1.0) > 1e-6) & (np.abs(cosine - np.cos(1.0)) > 1e-6)
        np.testing.assert_array_equal(on[clear], ((far <= 1.0) & ~turned)[clear])


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
