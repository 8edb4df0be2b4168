"""Moments against plain means, and starts that are the surface itself where nothing is noisy."""

import itertools

import numpy as np
import pytest
from reference.clouds import rotation
from reference.surfaces import CONE, PLANE, SPHERE, TORUS, distance_of, patch_of, placed

from octoseg_ti.device import runtime
from octoseg_ti.device.surfaces import KINDS
from octoseg_ti.fitting.primitives import _Samples, to_parameters
from octoseg_ti.fitting.starts import _profile_means, gather_moments, starts


def cloud(seed: int, sizes: list[int]) -> tuple[np.ndarray, ...]:
    """Return points, normals (some of them zero), weights and starts of groups."""
    rng = np.random.default_rng(seed)
    n = sum(sizes)
    normals = rng.standard_normal((n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[rng.random(n) < 0.1] = 0.0
    start = np.concatenate(([0], np.cumsum(sizes))).astype(np.int32)
    return 50.0 + 7.0 * rng.standard_normal((n, 3)), normals, rng.uniform(0, 2, n), start


@pytest.mark.parametrize("seed", range(3))
def test_moments_are_plain_means(seed: int) -> None:
    points, normals, weight, start = cloud(seed, [1, 40, 333, 12])
    m = gather_moments(points, normals, weight, start)
    for g in range(1, 4):
        rows = slice(start[g], start[g + 1])
        w = weight[rows] / weight[rows].sum()
        centre = w @ points[rows]
        p = points[rows] - centre
        extent = np.sqrt(w @ np.sum(p**2, axis=1))
        q, n = p / extent, normals[rows]
        k, square = np.cross(q, n), np.sum(q**2, axis=1)
        expected = {
            "weight": weight[rows].sum(),
            "centre": centre,
            "extent": extent,
            "qq": np.einsum("i,ia,ib->ab", w, q, q),
            "nn": np.einsum("i,ia,ib->ab", w, n, n),
            "kk": np.einsum("i,ia,ib->ab", w, k, k),
            "nk": np.einsum("i,ia,ib->ab", w, n, k),
            "wq": (w * square) @ q,
            "n": w @ n,
            "nnq": (w * np.sum(n * q, axis=1)) @ n,
            "q": (w * np.sum(n * n, axis=1)) @ q,
            "ww": w @ square**2,
        }
        for name, value in expected.items():
            found = getattr(m, name)[g]
            np.testing.assert_allclose(found, value, atol=1e-10, err_msg=f"{name}, group {g}")


def test_profiles_are_plain_means() -> None:
    points, normals, weight, start = cloud(5, [60, 25])
    m = gather_moments(points, normals, weight, start)
    rng = np.random.default_rng(0)
    axes = np.zeros((2, 6, 6))
    for d in range(6):
        q = rotation(d)
        axes[:, d, :3], axes[:, d, 3:] = rng.uniform(0, 2) * q[:, 0], q[:, 2]
    found = _profile_means(points, normals, weight, start, m, axes)
    for g in range(2):
        rows = slice(start[g], start[g + 1])
        w, n = weight[rows] / weight[rows].sum(), normals[rows]
        for d in range(6):
            q = (points[rows] - m.centre[g]) / m.extent[g] - axes[g, d, :3]
            axis = axes[g, d, 3:]
            z = q @ axis
            away = q - z[:, None] * axis
            rho = np.linalg.norm(away, axis=1)
            x, nz = rho - np.linalg.norm(axes[g, d, :3]), n @ axis
            nx, c = np.sum(n * away, axis=1) / rho, x * x + z * z
            t = nx * z - nz * x
            rows_of = [x, z, c, x * x, x * z, z * z, c * x, c * z, c * c]
            rows_of += [nx * nx, nx * nz, nz * nz, -nz * t, nx * t]
            np.testing.assert_allclose(found[g, d], np.array(rows_of) @ w, atol=1e-10)


@pytest.mark.parametrize("kind", range(KINDS))
def test_exact_data_start_at_the_surface(kind: int) -> None:
    groups, truth = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        patch = patch_of(kind, rng, 400, arc=rng.uniform(1.0, 6.2))
        points, normals, true = placed(*patch, rotation(seed), rng.uniform(-99, 99, 3))
        groups.append((points, normals))
        truth.append(true)
    points, normals = (np.concatenate([g[k] for g in groups]) for k in (0, 1))
    start = np.arange(0, 2401, 400).astype(np.int32)
    m = gather_moments(points, normals, np.ones(2400), start)
    state = starts(points, normals, np.ones(2400), start, m)[0]
    parameters = to_parameters(state, m.centre, m.extent)[:, kind]
    for g in range(6):
        d = distance_of(groups[g][0], kind, parameters[g])
        assert np.sqrt(np.mean(d**2)) < 0.01, (kind, g)
        if kind in (CONE, SPHERE, TORUS):
            np.testing.assert_allclose(parameters[g, 6], truth[g][6], rtol=0.02)
        # u (of a sphere, the axis) points from the surface's point to the samples.
        out = state[g, kind, 3:6] if kind == SPHERE else state[g, kind, 6:9]
        if kind != PLANE:
            assert out @ -state[g, kind, :3] >= -1e-9


def test_the_spread_is_the_median_distance() -> None:
    runtime.ensure_started()
    rng = np.random.default_rng(0)
    points = rng.uniform(-5, 5, (900, 3)) * [1, 1, 0.02]
    start = np.array([0, 300, 900], np.int32)
    weight = (rng.random(900) < 0.8).astype(float)
    parameters = np.full((2, KINDS, 8), np.nan)
    parameters[:] = [0, 0, 0, 0, 0, 1, 3.0, 1.0]
    parameters[:, CONE, 6] = 0.5
    moved = parameters + np.array([0.3, 0.2, 0.5, 0, 0, 0, 0, 0])
    tries = np.stack([parameters, moved])
    both = _Samples(points, points, weight, start).spread(tries, np.full(2, 4.0))
    for (parameters, found), g in itertools.product(zip(tries, both, strict=True), range(2)):
        rows = np.arange(start[g], start[g + 1])
        rows = rows[weight[rows] > 0]
        for kind in range(KINDS):
            d = np.abs(distance_of(points[rows], kind, parameters[g, kind]))
            assert found[g, kind] == pytest.approx(1.4826 * np.median(d), rel=0.1)
