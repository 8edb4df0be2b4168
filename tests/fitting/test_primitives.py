"""Surfaces through groups of points: exact data, SciPy's answer, outliers, and nothing at all."""

import numpy as np
import pytest
from reference.clouds import rotation
from reference.surfaces import CYLINDER, PLANE, SPHERE, TORUS, distance_of, patch_of, placed
from scipy.optimize import least_squares

from octoseg_ti.device.surfaces import KINDS
from octoseg_ti.fitting.primitives import FREEDOM, Fits, fit_all


def measured(
    kind: int, seed: int, n: int = 300, noise: float = 0.01, tilt: float = 0.05, arc: float = 1.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return noisy points and normals of a patch anywhere, and its true parameters."""
    rng = np.random.default_rng(100 * seed + kind)
    points, normals, parameters = patch_of(kind, rng, n, arc)
    points = points + noise * rng.standard_normal((n, 1)) * normals
    normals = normals + tilt * rng.standard_normal((n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return placed(points, normals, parameters, rotation(seed), rng.uniform(-200, 200, 3))


def fit(groups: list[tuple[np.ndarray, np.ndarray]], **options: float | bool) -> Fits:
    start = np.concatenate(([0], np.cumsum([len(g[0]) for g in groups]))).astype(np.int32)
    points = np.concatenate([g[0] for g in groups]) if groups else np.zeros((0, 3))
    normals = np.concatenate([g[1] for g in groups]) if groups else np.zeros((0, 3))
    return fit_all(points, normals, None, start, **options)  # type: ignore[arg-type]


def close(found: np.ndarray, true: np.ndarray, kind: int, atol: float) -> None:
    """Compare what defines a surface: a point of the axis or plane is free to slide."""
    shape = slice(6, 8) if kind == TORUS else slice(6, 6 if kind == PLANE else 7)
    np.testing.assert_allclose(found[shape], true[shape], atol=atol)
    off = found[:3] - true[:3]
    if kind != SPHERE:
        assert abs(abs(found[3:6] @ true[3:6]) - 1.0) < atol
    if kind == PLANE:
        off = np.array([off @ true[3:6]])
    elif kind == CYLINDER:
        off = off - (off @ true[3:6]) * true[3:6]
    np.testing.assert_allclose(off, 0.0, atol=10 * atol)


@pytest.mark.parametrize("arc", [0.4, 1.5, 6.28])
def test_exact_points_give_the_surface(arc: float) -> None:
    cases = [(k, *measured(k, s, noise=0.0, tilt=0.0, arc=arc)) for k in range(5) for s in range(3)]
    fits = fit([(p, n) for _, p, n, _ in cases])
    for g, (kind, _, _, true) in enumerate(cases):
        assert fits.rms[g, kind] < 1e-7, (kind, arc)
        close(fits.parameters[g, kind], true, kind, 1e-5)
        assert fits.side[g, kind] == pytest.approx(1.0, abs=1e-6) or kind == PLANE
        assert fits.tilt[g, kind] < 1e-4


def through_scipy(points: np.ndarray, kind: int, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Return parameters and rms of SciPy's least-squares surface; axis by two angles."""
    centre = points.mean(axis=0)
    q = np.linalg.qr(np.column_stack((start[3:6], np.eye(3))))[0]
    q[:, 0] = start[3:6]

    def build(x: np.ndarray) -> np.ndarray:
        axis = q[:, 0] + x[3] * q[:, 1] + x[4] * q[:, 2]
        shape = np.nan_to_num(start[6:8]) + x[5:7]
        return np.concatenate((start[:3] + x[:3], axis / np.linalg.norm(axis), shape))

    def residual(x: np.ndarray) -> np.ndarray:
        return distance_of(points - centre, kind, build(x) - np.append(centre, np.zeros(5)))

    answer = least_squares(residual, np.zeros(7), method="lm", xtol=1e-14, ftol=1e-14)
    return build(answer.x), float(np.sqrt(np.mean(answer.fun**2)))


@pytest.mark.parametrize("noise", [0.005, 0.05])
@pytest.mark.parametrize("kind", range(KINDS))
def test_no_better_surface_is_known_to_scipy(kind: int, noise: float) -> None:
    cases = [measured(kind, seed, noise=noise) for seed in range(5)]
    fits = fit([c[:2] for c in cases])
    for g, (points, _, true) in enumerate(cases):
        best, rms = through_scipy(points, kind, true)
        assert fits.rms[g, kind] <= rms * (1 + 1e-4)
        d = distance_of(points, kind, fits.parameters[g, kind])
        assert fits.rms[g, kind] == pytest.approx(np.sqrt(np.mean(d**2)), rel=1e-9)
        close(fits.parameters[g, kind], best, kind, 0.2 * noise)


def test_unsigned_normals_do_as_well() -> None:
    rng = np.random.default_rng(0)
    cases = [(k, *measured(k, s)) for k in range(5) for s in range(3)]
    turned = [(p, n * rng.choice([-1.0, 1.0], (len(n), 1))) for _, p, n, _ in cases]
    fits, signed = fit(turned), fit([c[1:3] for c in cases])
    for g, case in enumerate(cases):
        assert fits.rms[g, case[0]] == pytest.approx(signed.rms[g, case[0]], rel=1e-3)
        assert abs(fits.side[g, case[0]]) < 0.3
    inner = fit([(p, -n) for _, p, n, _ in cases])
    own = np.arange(len(cases)), np.array([c[0] for c in cases])
    np.testing.assert_allclose(inner.side[own], -signed.side[own], atol=1e-3)


@pytest.mark.parametrize("kind", range(KINDS))
def test_a_fifth_of_outliers_is_left_out(kind: int) -> None:
    groups, truth = [], []
    for seed in range(4):
        points, normals, true = measured(kind, seed, n=400)
        rng = np.random.default_rng(seed)
        stray = rng.choice(400, 80, replace=False)
        points[stray] += (
            rng.uniform(0.1, 3.0, (80, 1)) * rng.choice([-1, 1], (80, 1)) * normals[stray]
        )
        groups.append((points, normals))
        truth.append((np.delete(points, stray, axis=0), true))
    fits = fit(groups, robust=True, noise=0.01)
    for g, (clean, _) in enumerate(truth):
        d = distance_of(clean, kind, fits.parameters[g, kind])
        assert np.sqrt(np.mean(d**2)) < 0.0125, (kind, g)
        assert 0.75 < fits.inside[g, kind] < 0.87
        assert fits.rms[g, kind] == pytest.approx(0.01, rel=0.2)


def test_weights_count_as_copies() -> None:
    points, normals, _ = measured(CYLINDER, 3, n=90)  # few enough to be looked at all at once
    copies = np.random.default_rng(0).integers(0, 3, 90)
    start = np.array([0, 90], np.int32)
    weighed = fit_all(points, normals, copies.astype(float), start)
    repeated = fit([(np.repeat(points, copies, axis=0), np.repeat(normals, copies, axis=0))])
    np.testing.assert_allclose(
        weighed.parameters[0, CYLINDER], repeated.parameters[0, CYLINDER], rtol=1e-3, atol=1e-3
    )
    assert weighed.rms[0, CYLINDER] == pytest.approx(repeated.rms[0, CYLINDER], rel=1e-5)


def test_groups_know_nothing_of_each_other() -> None:
    cases = [measured(k, s, n=150 + 17 * k)[:2] for k in range(5) for s in range(4)]
    together = fit(cases)
    order = np.random.default_rng(0).permutation(len(cases))
    shuffled = fit([cases[i] for i in order])
    np.testing.assert_array_equal(shuffled.parameters, together.parameters[order])
    alone = fit([cases[7]])
    np.testing.assert_array_equal(alone.parameters[0], together.parameters[7])


@pytest.mark.parametrize("robust", [False, True])
def test_degenerate_groups_end_well(robust: bool) -> None:
    rng = np.random.default_rng(0)
    up = np.tile([0.0, 0.0, 1.0], (40, 1))
    line = np.column_stack((np.linspace(0, 9, 40), np.zeros(40), np.zeros(40)))
    flat = np.column_stack((rng.uniform(0, 9, (40, 2)), np.zeros(40)))
    groups = [
        (np.zeros((0, 3)), np.zeros((0, 3))),
        (np.ones((1, 3)), up[:1]),
        (np.ones((40, 3)), up),
        (line, up),
        (flat, up),
        (flat, np.zeros((40, 3))),
        (flat[:5], up[:5]),
        (flat + 1e6, up),
    ]
    fits = fit(groups, robust=robust, noise=1e-3)
    few = fits.count[:, None] <= FREEDOM[None, :]
    assert np.isnan(fits.rms[few]).all() and np.isnan(fits.parameters[few]).all()
    for g in (4, 5, 7):
        assert fits.rms[g, PLANE] < 1e-9
        assert abs(fits.parameters[g, PLANE, 5]) == pytest.approx(1.0)
    assert np.nanmax(np.abs(fits.rms)) < 1e3


def test_no_groups() -> None:
    fits = fit([])
    assert fits.parameters.shape == (0, KINDS, 8)
