"""Spacing and noise are those that the data were made with."""

import numpy as np
import pytest
from reference import stripes as plain
from reference.clouds import lattice_stripes, ragged_stripes, unit
from reference.device_normals import edge_pair_normals

from octoseg_ti.stages.measure import stripe_noise, stripe_roughness, stripe_spacing


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("stripes", "length"), [(2, 3), (5, 20), (25, 80)])
def test_spacing_equals_the_reference(seed: int, stripes: int, length: int) -> None:
    points, start, run, view = ragged_stripes(seed, stripes, length, views=2, noise=0.0)
    # Without the step of the surface: downhill to the nearest point has one bottom only.
    points[:, 2] = 0.1 * points[:, 1]
    got = stripe_spacing(points, start, run, view)
    assert got == pytest.approx(plain.stripe_spacing(points, start, view), rel=1e-6), f"seed {seed}"


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("stripes", "length", "lag"), [(2, 3, 3), (5, 20, 3), (25, 80, 6)])
def test_noise_equals_the_reference(seed: int, stripes: int, length: int, lag: int) -> None:
    points, start, run, _ = ragged_stripes(seed, stripes, length)
    normals = unit(np.random.default_rng(seed).standard_normal(points.shape))
    normals[::7] = 0.0
    got = stripe_noise(points, normals, start, run, 0.8, lag=lag)
    expected = plain.stripe_noise(points, normals, start, 0.8, lag)
    # The kernel's constants have four digits.
    assert got == pytest.approx(expected, rel=3e-4), f"seed {seed}"


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("stripes", "length"), [(2, 3), (5, 20), (25, 80)])
def test_roughness_equals_the_reference(seed: int, stripes: int, length: int) -> None:
    points, start, run, _ = ragged_stripes(seed, stripes, length)
    got = stripe_roughness(points, start, run)
    assert got == pytest.approx(plain.stripe_roughness(points, start), rel=1e-3), f"seed {seed}"


@pytest.mark.parametrize("step", [0.0, 0.1])
def test_roughness_is_the_noise_also_in_coarse_steps(step: float) -> None:
    rng = np.random.default_rng(2)
    x, y = 0.5 * np.arange(60)[:, None], 0.5 * np.arange(150)[None, :]
    z = 0.05 * x + 0.03 * y + 0.05 * rng.standard_normal((60, 150))
    points, start, run, _ = lattice_stripes(x, y, np.rint(z / step) * step if step else z)
    # In coarse steps a quantile is one of few values.
    assert stripe_roughness(points, start, run) == pytest.approx(0.05, rel=0.6 if step else 0.05)


@pytest.mark.parametrize("noise", [0.002, 0.02, 0.1])
def test_noise_of_a_tilted_plane_is_found(noise: float) -> None:
    rng = np.random.default_rng(1)
    x, y = 0.4 * np.arange(80)[:, None], 0.4 * np.arange(150)[None, :]
    z = 0.3 * x + 0.2 * y
    points, start, run, view = lattice_stripes(x, y, z)
    true = np.array([-0.3, -0.2, 1.0]) / np.linalg.norm([-0.3, -0.2, 1.0])
    points += noise * rng.standard_normal((len(points), 1)) * true
    normals = edge_pair_normals(points, start, view, gap=3.0)
    found, tilt = stripe_noise(points, normals, start, run, 3.0)
    assert found == pytest.approx(noise, rel=0.04)
    # What the normals really do: root mean square of their distance from the true one.
    inner = ((run > 0) & (run < 79)).nonzero()[0]
    sign = np.sign(normals[inner] @ true)[:, None]
    rms = np.sqrt(np.mean(np.sum((sign * normals[inner] - true) ** 2, axis=1)))
    assert tilt == pytest.approx(rms, rel=0.1)


def test_spacing_of_a_lattice() -> None:
    x, y = 0.7 * np.arange(9)[:, None], 0.3 * np.arange(31)[None, :]
    points, start, run, view = lattice_stripes(x, y, np.zeros((9, 31)))
    assert stripe_spacing(points, start, run, view) == pytest.approx((0.3, 0.7), rel=1e-6)


@pytest.mark.parametrize("lag", [3, 12])
def test_constant_curvature_is_no_noise(lag: int) -> None:
    # The middle of two normals of a cylinder points the same way as the normal between them.
    x, a = 0.5 * np.arange(20)[:, None], 0.02 * np.arange(-40, 41)[None, :]
    points, start, run, view = lattice_stripes(x, 20 * np.sin(a), 20 * np.cos(a) + 0 * x)
    normals = edge_pair_normals(points, start, view, gap=3.0)
    assert stripe_noise(points, normals, start, run, 3.0, lag=lag)[1] < 1e-9


def test_what_cannot_be_measured_is_zero() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0]])
    start, run = np.array([0, 1, 2], np.int32), np.array([0, 1], np.int32)
    assert stripe_spacing(points, start, run, np.array([0, 1], np.int32)) == (0.0, 0.0)
    assert stripe_noise(points, np.zeros((2, 3)), start, run, 1.0) == (0.0, 0.0)
    assert stripe_roughness(points, start, run) == 0.0


def test_the_order_of_views_changes_nothing() -> None:
    points, start, run, view = ragged_stripes(3, 12, 40, views=2)
    n = int(np.flatnonzero(view == 1)[0])
    half = int(run[n])
    swapped = np.concatenate((points[n:], points[:n]))
    starts = np.concatenate((start[half:] - n, start[1 : half + 1] + len(points) - n))
    runs = np.concatenate((run[n:] - half, run[:n] + run[-1] - half + 1)).astype(np.int32)
    views = np.concatenate((view[n:] * 0, view[:n] + 1)).astype(np.int32)
    assert stripe_spacing(swapped, starts.astype(np.int32), runs, views) == stripe_spacing(
        points, start, run, view
    )
    assert stripe_roughness(swapped, starts.astype(np.int32), runs) == stripe_roughness(
        points, start, run
    )
    normals = unit(np.random.default_rng(0).standard_normal(points.shape))
    moved = np.concatenate((normals[n:], normals[:n]))
    assert stripe_noise(swapped, moved, starts.astype(np.int32), runs, 0.8) == stripe_noise(
        points, normals, start, run, 0.8
    )
