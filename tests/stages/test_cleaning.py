"""Cleaning marks what stands off from neighbours that agree, and nothing else."""

import numpy as np
import pytest
from reference import stripes as plain
from reference.clouds import lattice_stripes, ragged_stripes

from octoseg_ti.stages.cleaning import mark_outliers


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("stripes", "length"), [(1, 3), (3, 6), (12, 40), (30, 80)])
def test_equals_the_reference(seed: int, stripes: int, length: int) -> None:
    points, start, run, _ = ragged_stripes(seed, stripes, length, views=2, gaps=0.2)
    rng = np.random.default_rng(seed)
    hit = rng.random(len(points)) < 0.1
    points[hit] += rng.standard_normal((int(hit.sum()), 3))
    for spike, isolation in ((0.3, 0.9), (0.05, 0.5), (1.0, 5.0)):
        got = mark_outliers(points, start, run, spike=spike, isolation=isolation)
        expected = plain.mark_outliers(points, start, spike=spike, isolation=isolation)
        np.testing.assert_array_equal(got, expected, err_msg=f"seed {seed}")


def flat(rows: int = 3, columns: int = 21) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = np.arange(rows)[:, None] * 1.0, np.arange(columns)[None, :] * 1.0
    points, start, run, _ = lattice_stripes(x, y, np.zeros((rows, columns)))
    return points, start, run


def marked(points: np.ndarray, start: np.ndarray, run: np.ndarray) -> list[int]:
    return np.flatnonzero(mark_outliers(points, start, run, spike=2.0, isolation=5.0)).tolist()


def test_a_clean_plane_has_none() -> None:
    assert marked(*flat()) == []


def test_single_spikes_are_found() -> None:
    points, start, run = flat()
    points[[7, 30, 55], 2] += [3.0, -4.0, 20.0]
    assert marked(points, start, run) == [7, 30, 55]


def test_a_step_has_none() -> None:
    points, start, run = flat()
    points[points[:, 1] > 10.5, 2] += 8.0
    assert marked(points, start, run) == []


@pytest.mark.parametrize("slope", [0.5, 1.0, 3.0, 20.0])
def test_a_sharp_corner_has_none(slope: float) -> None:
    """The default asks for two spacings; the point of a ridge stands off by one at most."""
    points, start, run = flat()
    points[:, 2] = -slope * np.abs(points[:, 1] - 10.0)
    spacing = np.hypot(1.0, slope)
    got = mark_outliers(points, start, run, spike=2 * spacing, isolation=5 * spacing)
    assert not got.any()


def test_isolated_points_are_found() -> None:
    points, start, run = flat()
    points[20, 1] += 6.0  # the end of the first stripe flies off
    points[21, 1] -= 6.0  # and the beginning of the second
    assert marked(points, start, run) == [20, 21]


def test_a_stripe_of_one_point_is_isolated() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    assert marked(points, np.array([0, 1, 3], np.int32), np.array([0, 1, 1], np.int32)) == [0]
