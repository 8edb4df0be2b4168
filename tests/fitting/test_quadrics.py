"""Planes and quadrics through groups of points."""

import numpy as np
import pytest
from reference.clouds import rotation
from reference.quadrics import fit_quadric
from reference.surfaces import CYLINDER, PLANE, SPHERE, TORUS, patch_of

from octoseg_ti.fitting.primitives import fit_all
from octoseg_ti.fitting.quadrics import fit_quadrics
from octoseg_ti.fitting.selection import choose, plane_does


def bowls(seed: int, groups: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return random bowls and saddles with noise: points, normals, and where groups begin."""
    rng = np.random.default_rng(seed)
    points, normals, start = [], [], [0]
    for _ in range(groups):
        n = int(rng.integers(20, 200))
        u, v = rng.uniform(-2.0, 2.0, (2, n))
        a, b, c = rng.normal(0.0, 0.1, 3)
        w = a * u * u + b * u * v + c * v * v
        normal = np.stack([-2 * a * u - b * v, -b * u - 2 * c * v, np.ones(n)], axis=1)
        normal += rng.normal(0.0, 0.05, (n, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal[rng.random(n) < 0.1] = 0.0
        turn = rotation(int(rng.integers(1000)))
        point = np.stack([u, v, w], axis=1) + rng.normal(0.0, 0.01, (n, 3))
        points.append(point @ turn.T + rng.normal(0.0, 50.0, 3))
        normals.append(normal @ turn.T)
        start.append(start[-1] + n)
    return np.concatenate(points), np.concatenate(normals), np.array(start)


@pytest.mark.parametrize("seed", range(4))
def test_equals_the_reference(seed: int) -> None:
    points, normals, start = bowls(seed)
    found = fit_quadrics(points, normals, start)
    for g in range(len(start) - 1):
        mine = slice(start[g], start[g + 1])
        expected = fit_quadric(points[mine], normals[mine])
        for name in ("centre", "rms", "tilt", "bend"):
            np.testing.assert_allclose(
                getattr(found, name)[g], expected[name], rtol=1e-5, atol=1e-9, err_msg=name
            )
        np.testing.assert_allclose(abs(found.side[g]), expected["side"], rtol=1e-6)


def test_a_sphere_bends_by_its_curvature() -> None:
    rng = np.random.default_rng(0)
    at = rng.normal(0.0, 0.2, (500, 2))
    points = np.column_stack([at, np.sqrt(49.0 - np.sum(at**2, axis=1))])
    found = fit_quadrics(points, points / 7.0, np.array([0, 500]))
    size = np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))
    np.testing.assert_allclose(found.bend, size / 7.0, rtol=0.01)
    assert found.rms[0, 1] < 1e-5
    np.testing.assert_allclose(np.abs(found.normal[0, 2]), 1.0, atol=1e-3)


def test_points_on_a_line_do_no_harm() -> None:
    points = np.outer(np.arange(10.0), [1.0, 2.0, 3.0])
    found = fit_quadrics(points, np.zeros((10, 3)), np.array([0, 10]))
    assert np.isfinite(found.rms).all()
    np.testing.assert_allclose(found.rms, 0.0, atol=1e-6)


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_what_is_taken_for_a_plane_is_what_is_chosen_as_one(noise: float) -> None:
    rng = np.random.default_rng(3)
    points, normals, start = [], [], [0]
    for g in range(60):
        p, n, _ = patch_of(
            (PLANE, PLANE, CYLINDER, SPHERE, TORUS)[g % 5], rng, 80, size=3.0, arc=0.4
        )
        points.append(p + noise * rng.normal(size=p.shape))
        normals.append(n)
        start.append(start[-1] + len(p))
    points, normals, begin = np.concatenate(points), np.concatenate(normals), np.array(start)
    flat = fit_quadrics(points, normals, begin)
    found = plane_does(flat, np.diff(begin), noise=noise)
    fits = fit_all(points, normals, None, begin.astype(np.int32), noise=noise)
    chosen = choose(fits, noise=noise).kind == PLANE
    assert not np.any(found & ~chosen)
    assert found.sum() >= 0.8 * chosen.sum() > 0


def test_normals_to_both_sides_are_no_plane() -> None:
    rng = np.random.default_rng(4)
    points, normals, _ = patch_of(PLANE, rng, 100)
    start = np.array([0, 100])
    assert plane_does(fit_quadrics(points, normals, start), np.array([100]), noise=0.01)[0]
    normals[::2] *= -1.0
    assert not plane_does(fit_quadrics(points, normals, start), np.array([100]), noise=0.01)[0]
