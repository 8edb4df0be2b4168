"""The simplest kind that fits wins, planes stay planes, and doubt is told."""

import numpy as np
import pytest
from reference.clouds import rotation
from reference.surfaces import CONE, CYLINDER, PLANE, SPHERE, TORUS, patch_of, placed

from octoseg_ti.fitting.covariance import covariances
from octoseg_ti.fitting.primitives import fit_all
from octoseg_ti.fitting.selection import Choice, choose
from octoseg_ti.types import SurfaceKind


def measured(
    kind: int, seed: int, noise: float, n: int = 500, arc: float = 1.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return noisy points and normals of a patch anywhere, and its parameters."""
    rng = np.random.default_rng(100 * seed + kind)
    points, normals, parameters = patch_of(kind, rng, n, arc)
    points = points + noise * rng.standard_normal((n, 1)) * normals
    normals = normals + 0.05 * rng.standard_normal((n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return placed(points, normals, parameters, rotation(seed), rng.uniform(-200, 200, 3))


def chosen(
    groups: list[tuple[np.ndarray, np.ndarray]], noise: float, robust: bool = False
) -> Choice:
    start = np.concatenate(([0], np.cumsum([len(g[0]) for g in groups]))).astype(np.int32)
    points, normals = (np.concatenate([g[k] for g in groups]) for k in (0, 1))
    return choose(fit_all(points, normals, None, start, noise=noise, robust=robust), noise=noise)


@pytest.mark.parametrize("over", [1.0, 2.0])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.025])
def test_every_kind_is_told(noise: float, over: float) -> None:
    for arc in (0.8, 1.5, 3.0, 6.28):
        cases = [(k, *measured(k, s, noise, arc=arc)) for k in range(5) for s in range(6)]
        answer = chosen([c[1:3] for c in cases], over * noise)
        start = np.cumsum([0] + [len(c[1]) for c in cases])
        points = np.concatenate([c[1] for c in cases])
        spread = covariances(points, start, answer.kind, answer.parameters)
        np.testing.assert_array_equal(answer.kind, [c[0] for c in cases], err_msg=f"arc {arc}")
        assert np.all(answer.evidence > 0)
        for g, (kind, _, _, true) in enumerate(cases):
            if kind == PLANE:
                assert np.isnan(answer.parameters[g, 6])
                continue
            deviation = np.sqrt(spread[g, 6, 6])
            # Four standard deviations; half a percent of 72 would be beyond three.
            assert abs(answer.parameters[g, 6] - true[6]) < 4.5 * deviation + 1e-6
            assert answer.side[g] == 1.0


@pytest.mark.parametrize("shape", [(20.0, 20.0), (60.0, 1.0), (3.0, 3.0)])
def test_a_plane_is_no_huge_cylinder(shape: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    groups = []
    for _ in range(200):
        flat = rng.uniform(-0.5, 0.5, (400, 2)) * shape
        points = np.column_stack((flat, 0.02 * rng.standard_normal(400)))
        normals = np.array([0.0, 0.0, 1.0]) + 0.05 * rng.standard_normal((400, 3))
        groups.append((points, normals / np.linalg.norm(normals, axis=1, keepdims=True)))
    assert np.all(chosen(groups, 0.02).kind == PLANE)


def test_a_bow_below_the_noise_is_a_plane_and_a_clear_one_is_not() -> None:
    rng = np.random.default_rng(0)
    groups = []
    for radius in (100000.0, 50.0):
        flat = rng.uniform(-10, 10, (500, 2))
        z = -(flat[:, 0] ** 2) / (2 * radius) + 0.02 * rng.standard_normal(500)
        normals = np.column_stack((flat[:, 0] / radius, np.zeros(500), np.ones(500)))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        groups.append((np.column_stack((flat, z)), normals))
    assert chosen(groups, 0.02).kind.tolist() == [PLANE, CYLINDER]


def test_what_fits_nothing_is_a_free_form_and_few_points_are_nothing() -> None:
    rng = np.random.default_rng(0)
    flat = rng.uniform(-10, 10, (500, 2))
    wavy = np.column_stack((flat, np.sin(flat[:, 0]) * np.cos(flat[:, 1])))
    up = np.tile([0.0, 0.0, 1.0], (500, 1))
    answer = chosen([(wavy, up), (flat[:3] @ np.eye(2, 3), up[:3])], 0.02)
    assert answer.kind.tolist() == [SurfaceKind.FREE_FORM, SurfaceKind.NONE]
    assert np.isnan(answer.parameters).all()
    assert answer.rms[0] > 0.1 and np.isnan(answer.rms[1])
    assert answer.side.tolist() == [0.0, 0.0]


def test_a_hole_is_told_from_a_boss() -> None:
    cases = [measured(k, 1, 0.01) for k in (CYLINDER, CONE, SPHERE, TORUS)]
    inner = chosen([(p, -n) for p, n, _ in cases], 0.01)
    assert inner.kind.tolist() == [CYLINDER, CONE, SPHERE, TORUS]
    assert inner.side.tolist() == [-1.0] * 4


def test_both_sides_of_a_sheet_are_no_plane() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack((rng.uniform(-10, 10, (400, 2)), 0.02 * rng.standard_normal(400)))
    normals = np.tile([0.0, 0.0, 1.0], (400, 1)) * rng.choice([-1.0, 1.0], (400, 1))
    fits = fit_all(points, normals, None, np.array([0, 400]))
    assert choose(fits, noise=0.02).kind[0] == SurfaceKind.FREE_FORM
    assert choose(fits, noise=0.02, signed=False).kind[0] == PLANE


def test_points_of_the_neighbour_do_not_change_the_kind() -> None:
    rng = np.random.default_rng(0)
    cases, groups = [], []
    for kind in range(5):
        for seed in range(4):
            points, normals, _ = measured(kind, seed, 0.01)
            stray = rng.choice(500, 25, replace=False)
            points[stray] += rng.uniform(0.1, 2.0, (25, 1)) * normals[stray]
            cases.append(kind)
            groups.append((points, normals))
    np.testing.assert_array_equal(chosen(groups, 0.01, robust=True).kind, cases)
