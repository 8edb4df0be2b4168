"""Distances and normals of analytic surfaces against plain formulas."""

import numpy as np
import pytest
from reference.clouds import rotation
from reference.surfaces import CONE, TORUS, distance_of, patch_of, placed

from octoseg_ti.device import runtime
from octoseg_ti.device.surfaces import KINDS, distances_to_surfaces, evaluate_surfaces
from octoseg_ti.types import SurfaceKind


def surface(kind: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points, normals, parameters = patch_of(kind, rng, 10)
    return placed(points, normals, parameters, rotation(seed), rng.uniform(-50, 50, 3))[2]


def test_kinds_are_the_codes_below_free_form() -> None:
    assert [SurfaceKind(k).name for k in range(KINDS)] == [
        "PLANE",
        "CYLINDER",
        "CONE",
        "SPHERE",
        "TORUS",
    ]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", range(KINDS))
def test_equals_the_reference(kind: int, seed: int) -> None:
    parameters = surface(kind, seed)
    points = parameters[:3] + np.random.default_rng(seed).uniform(-20, 20, (500, 3))
    which = np.zeros(500, np.int32)
    distance, normal = evaluate_surfaces(points, which, np.array([kind]), parameters[None])
    what = f"kind {kind}, seed {seed}"
    np.testing.assert_allclose(
        distance, distance_of(points, kind, parameters), atol=1e-12, err_msg=what
    )
    # The normal is the gradient of the distance, and leads to the foot.
    small = 1e-6
    for k in range(3):
        shift = small * np.eye(3)[k]
        slope = distance_of(points + shift, kind, parameters) - distance_of(
            points - shift, kind, parameters
        )
        np.testing.assert_allclose(normal[:, k], slope / (2 * small), atol=1e-5, err_msg=what)
    foot = points - distance[:, None] * normal
    np.testing.assert_allclose(distance_of(foot, kind, parameters), 0.0, atol=1e-10, err_msg=what)


def test_every_point_has_its_own_surface() -> None:
    models = np.stack([surface(k, 7 + k) for k in range(KINDS)])
    rng = np.random.default_rng(0)
    which = rng.integers(0, KINDS, 300).astype(np.int32)
    points = rng.uniform(-60, 60, (300, 3))
    distance, _ = evaluate_surfaces(points, which, np.arange(KINDS), models)
    for k in range(KINDS):
        mine = which == k
        np.testing.assert_allclose(distance[mine], distance_of(points[mine], k, models[k]))


def test_on_the_axis_and_behind_the_apex() -> None:
    cone = np.array([0, 0, 0, 0, 0, 1, 0.5, np.nan])
    torus = np.array([0, 0, 0, 0, 0, 1, 5.0, 2.0])
    points = np.array([[0, 0, -3.0], [0, 0, 4.0], [0, 0, 0.0]])
    distance, normal = evaluate_surfaces(
        points, np.array([0, 0, 1]), np.array([CONE, TORUS]), np.stack((cone, torus))
    )
    np.testing.assert_allclose(distance, [3.0, -4.0 * np.sin(0.5), 3.0])
    assert np.isfinite(normal).all()
    np.testing.assert_allclose(normal[0], [0, 0, -1])


def test_no_parameters_no_distance_and_no_points() -> None:
    unknown = np.full((1, 8), np.nan)
    distance, _ = evaluate_surfaces(np.zeros((1, 3)), np.zeros(1), np.array([1]), unknown)
    assert np.isnan(distance).all()
    distance, normal = evaluate_surfaces(np.zeros((0, 3)), np.zeros(0), np.array([1]), unknown)
    assert (distance.shape, normal.shape) == ((0,), (0, 3))


def test_distances_alone_are_the_same_and_infinite_without_a_surface() -> None:
    models = np.stack([surface(k, 7 + k) for k in range(KINDS)])
    rng = np.random.default_rng(1)
    which = rng.integers(-1, KINDS, 300).astype(np.int32)
    points = rng.uniform(-60, 60, (300, 3))
    alone = distances_to_surfaces(runtime.upload(points), which, np.arange(KINDS), models)
    there = which >= 0
    distance, _ = evaluate_surfaces(points[there], which[there], np.arange(KINDS), models)
    np.testing.assert_array_equal(alone[there], distance)
    assert np.isinf(alone[~there]).all()
    none = np.zeros((0, 3))
    assert len(distances_to_surfaces(none, np.zeros(0, np.int32), np.arange(KINDS), models)) == 0
