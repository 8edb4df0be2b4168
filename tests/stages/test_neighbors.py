"""Normals without stripes: planes through neighbourhoods that do not depend on the order."""

import numpy as np
import pytest
from reference.clouds import random_surface, rotation
from reference.neighborhoods import neighbor_normals as plain

from octoseg_ti.stages.neighbors import neighbor_normals


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("passes", [0, 1, 3])
@pytest.mark.parametrize(("n", "neighbors"), [(4, 3), (5, 12), (13, 12), (400, 8), (900, 12)])
def test_equals_the_reference(seed: int, n: int, neighbors: int, passes: int) -> None:
    rng = np.random.default_rng(seed)
    points, _ = random_surface(seed, n)
    points += 0.03 * rng.standard_normal(points.shape)
    outward = points - [15.0, 0.0, -20.0]
    got, measured = neighbor_normals(points, outward, neighbors, passes=passes)
    expected, spacing, noise, tilt = plain(points, outward, neighbors, passes)
    assert np.array_equal(got.any(axis=1), expected.any(axis=1)), f"seed {seed}"
    # Round neighbourhoods, and normals across the outward direction, leave the choice open.
    clear = np.abs(np.einsum("ni,ni->n", expected, outward)) > 1e-6
    np.testing.assert_allclose(got[clear], expected[clear], atol=1e-6, err_msg=f"seed {seed}")
    assert clear.mean() > 0.9
    assert measured.spacing_along == measured.spacing_across == pytest.approx(spacing, rel=1e-9)
    # The kernel's squares are in steps of 2^-40 of the radius squared.
    assert measured.noise == pytest.approx(noise, rel=1e-5, abs=1e-5)
    assert measured.normal_noise == pytest.approx(tilt, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("passes", [0, 3])
def test_permuting_the_points_permutes_the_normals(seed: int, passes: int) -> None:
    # A lattice: many neighbours at equal distances, the hard case.
    x, y = (a.ravel() for a in np.mgrid[0:30, 0:30] * 0.5)
    points = np.column_stack((x, y, np.sin(0.4 * x) + 0.1 * y))
    outward = np.tile([0.0, 0.0, 1.0], (900, 1))
    before, measured = neighbor_normals(points, outward, 12, passes=passes)
    order = np.random.default_rng(seed).permutation(900)
    after, measured_after = neighbor_normals(points[order], outward, 12, passes=passes)
    np.testing.assert_array_equal(after, before[order], err_msg=f"seed {seed}")
    assert measured_after == measured


def test_a_plane_gives_its_normal() -> None:
    rng = np.random.default_rng(3)
    q = rotation(4)
    points = np.column_stack((rng.uniform(0, 20, (500, 2)), np.zeros(500))) @ q.T
    got, measured = neighbor_normals(points, np.tile(q[:, 2], (500, 1)), 12)
    np.testing.assert_allclose(got, np.tile(q[:, 2], (500, 1)), atol=1e-6)
    assert measured.noise < 1e-5 and measured.normal_noise < 1e-5


@pytest.mark.parametrize("passes", [0, 1, 2, 3])
@pytest.mark.parametrize("noise", [0.01, 0.05])
def test_noise_of_a_plane_is_found(noise: float, passes: int) -> None:
    rng = np.random.default_rng(5)
    points = np.column_stack((rng.uniform(0, 40, (4000, 2)), noise * rng.standard_normal(4000)))
    got, measured = neighbor_normals(points, np.tile([0.0, 0, 1], (4000, 1)), 12, passes=passes)
    # The lower three quarters of a spread-out rms lie below its mean, so an estimate, not a match.
    assert measured.noise == pytest.approx(noise, rel=0.35)
    rms = np.sqrt(np.mean(np.sum((got - [0.0, 0, 1]) ** 2, axis=1)))
    assert measured.normal_noise == pytest.approx(rms, rel=0.3)


@pytest.mark.parametrize(("noise", "limit"), [(0.0, 1.0), (0.01, 6.0)])
def test_points_beside_a_crease_have_the_normal_of_their_face(noise: float, limit: float) -> None:
    rng = np.random.default_rng(1)
    across, along = rng.uniform(-10, 10, 6000), rng.uniform(0, 10, 6000)
    left = across < 0
    # A right angle: one face goes up from the crease, the other goes sideways.
    points = np.column_stack((np.where(left, 0, across), along, np.where(left, -across, 0)))
    true = np.where(left[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    points += noise * rng.standard_normal((6000, 1)) * true
    outward = np.tile([1.0, 0.0, 1.0], (6000, 1))
    spacing = np.sqrt(200 / 6000)
    beside = (np.abs(across) > 0.25 * spacing) & (np.abs(across) < 2 * spacing)
    error = [
        np.degrees(np.arccos(np.clip(np.einsum("ni,ni->n", n, true), -1, 1)))[beside]
        for n in (neighbor_normals(points, outward, 12, passes=k)[0] for k in (0, 3))
    ]
    assert np.median(error[0]) > 5 and np.percentile(error[1], 90) < limit


@pytest.mark.parametrize("passes", [0, 3])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_points_on_a_line_have_no_normal(passes: int) -> None:
    points = np.column_stack((np.arange(20.0), np.zeros((20, 2))))
    got, measured = neighbor_normals(points, np.ones((20, 3)), 6, passes=passes)
    np.testing.assert_array_equal(got, 0.0)
    assert (measured.noise, measured.normal_noise) == (0.0, 0.0)
    assert measured.spacing_along == 1.0


@pytest.mark.parametrize("passes", [0, 3])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_coincident_points_have_no_normal(passes: int) -> None:
    got, measured = neighbor_normals(np.full((20, 3), 7.0), np.ones((20, 3)), 6, passes=passes)
    np.testing.assert_array_equal(got, 0.0)
    assert measured.spacing_along == 0.0


@pytest.mark.parametrize("times", [2, 3])
def test_spacing_of_points_that_are_all_there_several_times(times: int) -> None:
    points, _ = random_surface(2, 300)
    outward = np.tile([0.0, 0.0, 1.0], (300, 1))
    _, once = neighbor_normals(points, outward, 12)
    _, several = neighbor_normals(
        np.repeat(points, times, axis=0), np.repeat(outward, times, 0), 12
    )
    assert several.spacing_along == once.spacing_along > 0


def test_too_few_neighbors_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 3, not 2"):
        neighbor_normals(np.zeros((9, 3)), np.ones((9, 3)), 2)
