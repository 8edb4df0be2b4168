"""Cleaning marks what stands off from the surfaces around it, and nothing else."""

import numpy as np
import pytest
from reference import stripes as plain
from reference import support as surroundings
from reference.clouds import lattice_stripes, ragged_stripes

from octoseg_ti.stages.cleaning import mark_outliers


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("stripes", "length"), [(1, 3), (3, 6), (10, 30)])
def test_equals_the_reference(seed: int, stripes: int, length: int) -> None:
    points, start, run, view = ragged_stripes(seed, stripes, length, views=2, gaps=0.2)
    rng = np.random.default_rng(seed)
    hit = rng.random(len(points)) < 0.1
    points[hit] += rng.standard_normal((int(hit.sum()), 3))
    for spike, isolation, detached in ((0.1, 1.5, 20), (0.05, 0.5, 5), (0.3, 2.0, 80)):
        rule = {"isolation": isolation, "detached": detached, "along": 0.4, "across": 0.5}
        got = mark_outliers(points, start, run, view, None, spike=spike, **rule)
        doubt = plain.doubtful(points, start, off=spike, step=0.6, far=2 * isolation, short=16)
        backing = 0.15 * np.pi * isolation**2 / (0.4 * 0.5) / 3
        true = surroundings.find_support(
            points, view, doubt, radius=isolation, off=spike, backing=backing, detached=detached
        )
        expected = np.zeros(len(points), int)
        expected[np.array(doubt, int)[~true.astype(bool)]] = 1
        if 2 * expected.sum() > len(points):
            expected[:] = 0
        np.testing.assert_array_equal(got, expected, err_msg=f"seed {seed}")


def flat(rows: int = 9, columns: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = np.arange(rows)[:, None] * 1.0, np.arange(columns)[None, :] * 1.0
    points, start, run, _ = lattice_stripes(x, y, np.zeros((rows, columns)))
    return points, start, run


def marked(points: np.ndarray, start: np.ndarray, run: np.ndarray) -> list[int]:
    got = mark_outliers(
        points, start, run, np.zeros(len(run), np.int32), None,
        spike=0.1, isolation=2.5, detached=40, along=1.0, across=1.0,
    )  # fmt: skip
    return np.flatnonzero(got).tolist()


def test_a_clean_plane_has_none() -> None:
    assert marked(*flat()) == []


def test_single_spikes_are_found() -> None:
    points, start, run = flat()
    points[[7, 95, 180, 260], 2] += [3.0, -4.0, 20.0, 0.6]
    assert marked(points, start, run) == [7, 95, 180, 260]


def test_runs_of_spikes_are_found() -> None:
    points, start, run = flat()
    wrong = [*range(84, 92), *range(205, 208), *range(245, 248)]  # the last two side by side
    points[wrong, 2] += 4.0
    assert marked(points, start, run) == wrong


def test_missing_points_make_none() -> None:
    points, _, run = flat()
    keep = np.random.default_rng(0).random(len(points)) > 0.2
    counts = np.bincount(run[keep])
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    assert marked(points[keep], start, run[keep]) == []


def test_a_step_has_none() -> None:
    points, start, run = flat()
    points[points[:, 1] > 20.5, 2] += 8.0
    assert marked(points, start, run) == []


@pytest.mark.parametrize("slope", [0.3, 0.5, 1.0, 2.0])
def test_a_sharp_corner_has_none(slope: float) -> None:
    points, start, run = flat()
    points[:, 2] = -slope * np.abs(points[:, 1] - 20.0)
    assert marked(points, start, run) == []
    points[:, 2] = -slope * np.abs(points[:, 1] - 20.3)
    assert marked(points, start, run) == []


def test_a_thin_rib_and_a_groove_have_none() -> None:
    points, start, run = flat(rows=24)
    points[np.isin(points[:, 1], [10.0, 11.0, 12.0]), 2] += 3.0
    points[np.isin(points[:, 1], [25.0, 26.0]), 2] -= 5.0
    assert marked(points, start, run) == []


def test_isolated_points_are_found() -> None:
    points, start, run = flat()
    points[39, 1] += 6.0  # the end of the first stripe flies off
    points[40, 1] -= 6.0  # and the beginning of the second
    assert marked(points, start, run) == [39, 40]


def test_a_rule_that_most_points_break_marks_none() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    assert marked(points, np.array([0, 1, 3], np.int32), np.array([0, 1, 1], np.int32)) == []


def test_without_a_spacing_there_is_no_measure() -> None:
    points, start, run = flat()
    none = mark_outliers(
        points * 0.0, start, run, np.zeros(len(run), np.int32), None,
        spike=0.0, isolation=0.0, detached=3, along=0.0, across=0.0,
    )  # fmt: skip
    assert not none.any()
