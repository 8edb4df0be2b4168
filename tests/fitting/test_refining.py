"""Surfaces that are nearly right are refined to where a whole fit would put them."""

import numpy as np
import pytest
from reference.surfaces import CONE, CYLINDER, PLANE, SPHERE, TORUS, distance_of, patch_of

from octoseg_ti.fitting.primitives import TUKEY
from octoseg_ti.fitting.refining import refine

KINDS = (PLANE, CYLINDER, CONE, SPHERE, TORUS)


def disturbed(parameters: np.ndarray, rng: np.random.Generator, size: float) -> np.ndarray:
    """Return parameters that are a little wrong."""
    wrong = parameters.copy()
    wrong[:3] += rng.normal(0.0, size, 3)
    wrong[3:6] += rng.normal(0.0, 0.1 * size, 3)
    wrong[3:6] /= np.linalg.norm(wrong[3:6])
    wrong[6:] += rng.normal(0.0, 0.1 * size, 2)
    return wrong


def loss(points: np.ndarray, kind: int, parameters: np.ndarray, noise: float) -> float:
    share = np.minimum((distance_of(points, kind, parameters) / (TUKEY * noise)) ** 2, 1.0)
    return float(np.sum(1.0 - (1.0 - share) ** 3))


@pytest.mark.parametrize("kind", KINDS)
def test_exact_points_give_the_surface_back(kind: int) -> None:
    rng = np.random.default_rng(kind)
    points, _, true = patch_of(kind, rng, 300)
    wrong = disturbed(true, rng, 0.1)
    start = np.array([0, 300])
    got = refine(points, start, np.array([kind]), wrong[None], noise=0.2, rounds=12)[0]
    assert np.abs(distance_of(points, kind, got)).max() < 1e-7
    has = np.isfinite(true)
    np.testing.assert_array_equal(np.isfinite(got), has)
    assert np.linalg.norm(got[3:6]) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(3))
def test_all_kinds_at_once_with_noise_and_with_outliers(seed: int) -> None:
    """Every group ends lower than it began, next to the truth, whatever the others do."""
    rng = np.random.default_rng(seed)
    groups, true = [], []
    for kind in KINDS:
        points, normals, parameters = patch_of(kind, rng, 400 + 30 * kind)
        points = points + rng.normal(0.0, 0.02, (len(points), 1)) * normals
        points[::12] += rng.normal(0.0, 3.0, points[::12].shape)
        groups.append(points)
        true.append(parameters)
    wrong = np.array([disturbed(p, rng, 0.05) for p in true])
    start = np.cumsum([0] + [len(g) for g in groups])
    got = refine(np.concatenate(groups), start, np.array(KINDS), wrong, noise=0.02, rounds=8)
    for k, kind in enumerate(KINDS):
        reached, best = (loss(groups[k], kind, p, 0.02) for p in (got[k], true[k]))
        assert reached <= loss(groups[k], kind, wrong[k], 0.02)
        assert reached <= best + 1e-6, f"seed {seed}, kind {kind}"
        alone = refine(groups[k], np.array([0, len(groups[k])]), np.array([kind]), wrong[k][None],
                       noise=0.02, rounds=8)[0]  # fmt: skip
        np.testing.assert_allclose(got[k], alone, atol=1e-9)


def test_what_cannot_be_fitted_stays() -> None:
    """Groups without points, or with fewer than unknowns, keep their parameters."""
    rng = np.random.default_rng(0)
    points, _, true = patch_of(CYLINDER, rng, 4)
    start, kind = np.array([0, 0, 4]), np.array([PLANE, CYLINDER])
    given = np.array([[0, 0, 0, 0, 0, 1, np.nan, np.nan], disturbed(true, rng, 0.1)])
    np.testing.assert_array_equal(refine(points, start, kind, given, noise=0.1), given)
    none = refine(np.zeros((0, 3)), np.zeros(1, int), np.zeros(0, int), np.zeros((0, 8)), noise=0.1)
    assert none.shape == (0, 8)
