"""Balls along edges: what is looked at, what noise hides, what a ball too large for one means."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from reference import rolling
from reference.leaves import leaves_of
from reference.rounded import bend

from octoseg_ti import evaluate, segment
from octoseg_ti.borders.fillets import ON, Around, starts_of, tasks, without_support
from octoseg_ti.device import runtime
from octoseg_ti.evaluation import Scores
from octoseg_ti.types import NONE, EdgeClass, Segmentation, Truth
from scanner_sim import StripeScanner, simulate
from scanner_sim.random_blocks import random_block


def ridge(radius: float, turn: float, noise: float) -> tuple[Segmentation, Truth, Scores]:
    part = bend(radius, turn, fillet=radius <= 3.0, wide=11.0)
    scans, truth = simulate(part, StripeScanner(stripe_pitch=0.25, range_noise=noise), seed=3)
    result = segment(scans)
    return result, truth, evaluate(result, truth)


def test_tasks_are_the_ranges_of_pairs() -> None:
    pairs = np.array([[4, 7], [1, 2], [3, 9]])
    np.testing.assert_array_equal(
        tasks(pairs, starts_of(np.array([0, 0, 2, 2, 2]), 3)),
        [[4, 7, 0, 2], [1, 2, 2, 2], [3, 9, 2, 5]],
    )


def test_every_pair_keeps_about_so_many_points() -> None:
    none = np.zeros(4)
    around = Around(np.arange(124) * 2, np.array([0, 100, 100, 103, 124]), none, none, none)
    point, start = around.thinned(10)
    np.testing.assert_array_equal(np.diff(start), [10, 0, 3, 7])
    np.testing.assert_array_equal(point[:10], np.arange(0, 200, 20))
    np.testing.assert_array_equal(point[10:13], [200, 202, 204])
    np.testing.assert_array_equal(point[13:], np.arange(206, 248, 6))


@pytest.mark.parametrize("seed", range(3))
def test_weak_points_need_others_near_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 6, (600, 3)) * (1, 1, 0.3)
    leaves, order = leaves_of(points, 1.0)
    points = points[order]
    mark = rng.integers(-1, 3, 600).astype(np.int32)
    weak = np.flatnonzero((mark >= 0) & (rng.random(600) < 0.9))
    radius = rng.uniform(0.5, 2.0, len(weak))
    runtime.ensure_started()
    search = SimpleNamespace(
        noise=0.01,
        spacing=0.2,
        leaves=leaves,
        device=(runtime.upload(points),),
        leaf_of=lambda point: np.searchsorted(leaves.first, point, side="right") - 1,
    )
    before = mark.copy()
    lost = without_support(search, mark, weak, radius)  # type: ignore[arg-type]
    np.testing.assert_array_equal(mark, before)
    strong = mark.copy()
    strong[weak] = NONE
    reach = np.sqrt(2.0 * ON * 0.01 * radius) + 0.2
    expected = [
        math.isinf(rolling.nearest(points, strong, i, mark[i], r))
        for i, r in zip(weak, reach, strict=True)
    ]
    np.testing.assert_array_equal(np.isin(weak, lost), expected)
    assert 0 < len(lost) < len(weak)


def test_a_fillet_as_deep_as_the_noise_is_found_and_a_sharp_edge_is_none() -> None:
    # The ball leaves the planes by 0.07 mm at most.
    result, _, scores = ridge(1.0, 45.0, 0.05)
    assert result.fillets is not None and len(result.fillets) == 1
    assert abs(result.fillets.radius[0] - 1.0) < 0.15
    assert scores.edges["fillet"].recall > 0.95 and scores.edges["fillet"].precision > 0.95
    result, _, scores = ridge(0.0, 45.0, 0.05)
    assert result.fillets is not None and len(result.fillets) == 0
    assert not np.any(result.edge == EdgeClass.FILLET)
    assert scores.edges["sharp"].f1 > 0.97


def test_a_long_fillet_at_a_shallow_edge_is_found_and_none_where_it_is_sharp() -> None:
    # The ball leaves the planes by 0.06 mm at most, a third of the distance within which a point
    # may lie on either.
    scanner = StripeScanner(stripe_pitch=0.25, range_noise=0.05)
    for radius in (1.2, 0.0):
        scans, truth = simulate(bend(radius, 36.0, fillet=True, wide=16.0), scanner, seed=3)
        result = segment(scans)
        assert result.fillets is not None and len(result.fillets) == (radius > 0.0)
        scores = evaluate(result, truth)
        assert scores.edges["sharp"].f1 > 0.97
        if radius > 0.0:
            assert scores.edges["fillet"].f1 > 0.97


def test_two_planes_with_a_large_cylinder_between_them_meet_smoothly() -> None:
    # Noise hides the cylinder, whose points go to the planes.
    result, truth, scores = ridge(12.0, 14.0, 0.025)
    assert result.fillets is not None and len(result.fillets) == 0
    assert truth.position is not None
    middle = (np.abs(truth.position[:, :2]) < (8.0, 3.0)).all(axis=1)
    middle &= truth.position[:, 2] > -2.0
    assert not np.any(result.edge[middle] == EdgeClass.SHARP)
    assert scores.edges["sharp"].precision > 0.97


def test_a_fillet_without_points_is_none() -> None:
    # Small cylinders stand on a plane here, and nothing is rounded.
    part = random_block(48, "smooth")
    scans, _ = simulate(part, StripeScanner(stripe_pitch=0.5, range_noise=0.025), seed=48)
    result = segment(scans)
    assert result.fillets is not None and len(result.fillets) == 0
    assert not np.any(result.edge == EdgeClass.FILLET)
