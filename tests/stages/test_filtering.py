"""Filtered normals: smooth within faces, sharp at edges, round where the surface is round."""

import numpy as np
import pytest
from reference import filtering as plain
from reference.clouds import lattice_stripes, ragged_stripes, unit
from reference.device_normals import edge_pair_normals

from octoseg_ti.stages.filtering import filter_normals, independent_lag, square_lag
from octoseg_ti.stages.measure import stripe_noise

ABOVE = np.array([[0.0, 0.0, 500.0]])


def off(normals: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the angle between normals [degrees]."""
    return np.degrees(2 * np.arcsin(np.minimum(1, np.linalg.norm(normals - true, axis=1) / 2)))


def ridge(angle: float, noise: float, seed: int) -> tuple[np.ndarray, ...]:
    """Return two planes at an angle [rad], their ridge oblique to the stripes, with raw normals.

    Points, start, run, view, normals, true normals, distance from the ridge [mm]; 0.25 mm between
    stripes, 0.2 mm along them, every stripe shifted.
    """
    rng = np.random.default_rng(seed)
    x = 0.25 * np.arange(-30, 30)[:, None]
    y = 0.2 * np.arange(-50, 50)[None, :] + rng.uniform(-0.1, 0.1, (60, 1))
    across = np.sin(0.35) * x + np.cos(0.35) * y
    slope = np.tan(angle / 2)
    points, start, run, view = lattice_stripes(x, y, -slope * np.abs(across))
    distance = across.ravel()
    side = slope * np.sign(distance)
    true = unit(np.column_stack((side * np.sin(0.35), side * np.cos(0.35), np.ones(len(side)))))
    points[:, 2] += noise * rng.standard_normal(len(points))
    normals = edge_pair_normals(points, start, view, gap=0.75, weight="area", origin=ABOVE)
    return points, start, run, view, normals, true, distance


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("stripes", "length", "passes", "lag"),
    [(2, 3, 2, 1), (5, 20, 1, 1), (12, 40, 2, 1), (9, 60, 3, 4)],
)
def test_equals_the_reference(seed: int, stripes: int, length: int, passes: int, lag: int) -> None:
    points, start, run, view = ragged_stripes(seed, stripes, length, views=2, gaps=0.02)
    # Without the step of the surface: going along finds the nearest partner for sure.
    points[:, 2] = 0.1 * points[:, 1]
    rng = np.random.default_rng(seed)
    normals = unit(np.array([0.0, 0.1, 1.0]) + 0.2 * rng.standard_normal(points.shape))
    normals[::11] = 0.0
    how = {"passes": passes, "gap": 2.2, "noise": 0.25, "lag": lag}
    got = filter_normals(points, normals, start, run, view, **how)
    expected = plain.filter_normals(points, normals, start, view, **how)
    np.testing.assert_allclose(got, expected, atol=2e-5, err_msg=f"seed {seed}")
    np.testing.assert_array_equal(got.any(axis=1), normals.any(axis=1))


def test_no_pass_changes_nothing() -> None:
    points, start, run, view, normals, *_ = ridge(0.2, 0.02, 0)
    got = filter_normals(points, normals, start, run, view, passes=0, gap=0.75, noise=0.05)
    assert got is normals


@pytest.mark.parametrize(
    ("noise", "passes", "times"), [(0.01, 2, 5.0), (0.025, 2, 5.0), (0.05, 4, 7.0)]
)
def test_noise_falls_within_a_face_and_the_rest_is_measured(
    noise: float, passes: int, times: float
) -> None:
    points, start, run, view, normals, true, _ = ridge(0.0, noise, 1)
    _, before = stripe_noise(points, normals, start, run, 0.75)
    got = filter_normals(points, normals, start, run, view, passes=passes, gap=0.75, noise=before)
    inner = (run > 6) & (run < 53) & (np.abs(points[:, 1]) < 8)
    raw = np.sqrt(np.mean(np.sum((normals - true)[inner] ** 2, axis=1)))
    left = np.sqrt(np.mean(np.sum((got - true)[inner] ** 2, axis=1)))
    assert raw / left > times
    _, found = stripe_noise(points, got, start, run, 0.75, lag=independent_lag(passes))
    assert found == pytest.approx(left, rel=0.2)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("degrees", "noise"), [(5, 0.01), (10, 0.01), (20, 0.025), (45, 0.05), (90, 0.05)]
)
def test_an_edge_stays_where_it_is(degrees: float, noise: float, seed: int) -> None:
    points, start, run, view, normals, true, distance = ridge(np.radians(degrees), noise, seed)
    tilt = 0.75 * noise / 0.2
    got = filter_normals(points, normals, start, run, view, passes=2, gap=0.75, noise=tilt)
    inner = (run > 5) & (run < 54) & (np.abs(points[:, 1]) < 8)
    error = off(got, true)
    # One spacing away from the edge the normal is nearer to its own face than to the middle, and
    # two spacings away it is as good as anywhere.
    one = inner & (np.abs(distance) > 0.25) & (np.abs(distance) < 0.5)
    two = inner & (np.abs(distance) > 0.5) & (np.abs(distance) < 0.75)
    far = inner & (np.abs(distance) > 1.5)
    assert np.mean(error[one] > degrees / 4) < 0.1
    assert np.median(error[two]) < 1.5 * np.median(error[far])


@pytest.mark.parametrize(("radius", "noise"), [(2.0, 0.01), (2.0, 0.05), (3.0, 0.025)])
def test_a_thin_cylinder_stays_round(radius: float, noise: float) -> None:
    rng = np.random.default_rng(4)
    step = 0.2 / radius
    angle = step * (np.arange(-int(1 / step), int(1 / step))[None, :] + rng.uniform(0, 1, (60, 1)))
    depth = radius + noise * rng.standard_normal(angle.shape)
    x = 0.25 * np.arange(60)[:, None]
    points, start, run, view = lattice_stripes(x, depth * np.sin(angle), depth * np.cos(angle))
    normals = edge_pair_normals(points, start, view, gap=0.75, weight="area", origin=ABOVE)
    tilt = 0.75 * noise / 0.2
    got = filter_normals(points, normals, start, run, view, passes=2, gap=0.75, noise=tilt)
    turn = angle.ravel()
    inner = (run > 5) & (run < 54) & (np.abs(turn) < 0.6)
    found = np.arctan2(got[:, 1], got[:, 2])
    # Neither flattened nor in steps: the normal turns as the cylinder does, everywhere.
    slope = np.polyfit(turn[inner], found[inner], 1)[0]
    assert slope == pytest.approx(1.0, abs=0.06)
    raw = np.arctan2(normals[:, 1], normals[:, 2])
    assert np.std((found - turn)[inner]) < np.std((raw - turn)[inner]) / 1.5


def test_points_without_a_normal_keep_none_and_give_none() -> None:
    points, start, run, view, _, true, _ = ridge(0.0, 0.0, 0)
    spoilt = true.copy()
    spoilt[::7] = 0.0
    got = filter_normals(points, spoilt, start, run, view, passes=2, gap=0.75, noise=0.05)
    np.testing.assert_array_equal(got[::7], 0.0)
    there = spoilt.any(axis=1)
    np.testing.assert_allclose(got[there], true[there], atol=1e-6)


def test_views_do_not_see_each_other_and_their_order_changes_no_bit() -> None:
    points, start, run, view = ragged_stripes(2, 14, 50, views=2)
    normals = edge_pair_normals(points, start, view, gap=1.5, origin=np.full((2, 3), 500.0))
    how = {"passes": 2, "gap": 1.5, "noise": 0.1}
    got = filter_normals(points, normals, start, run, view, **how)
    n = int(np.flatnonzero(view)[0])
    half = int(run[n])
    swapped = np.concatenate((points[n:], points[:n]))
    starts = np.concatenate((start[half:] - n, start[1 : half + 1] + len(points) - n))
    runs = np.concatenate((run[n:] - half, run[:n] + run[-1] - half + 1)).astype(np.int32)
    views = np.concatenate((view[n:] * 0, view[:n] + 1)).astype(np.int32)
    other = filter_normals(
        swapped,
        np.concatenate((normals[n:], normals[:n])),
        starts.astype(np.int32),
        runs,
        views,
        **how,
    )
    np.testing.assert_array_equal(other, np.concatenate((got[n:], got[:n])))


@pytest.mark.parametrize(
    ("along", "across", "lag"),
    [(0.2, 0.25, 1), (0.2, 0.41, 2), (0.05, 0.5, 8), (0.5, 0.1, 1), (0.0, 0.3, 1)],
)
def test_square_lag(along: float, across: float, lag: int) -> None:
    assert square_lag(along, across) == lag


def test_independent_lag() -> None:
    assert independent_lag(0) == 3
    assert independent_lag(2) < independent_lag(4) <= 2 * independent_lag(2)
    assert independent_lag(2, 4) == 4 * independent_lag(2)
