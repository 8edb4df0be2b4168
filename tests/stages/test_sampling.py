"""Samples by the place in the stripe, and means that outliers do not move."""

import numpy as np
import pytest

from octoseg_ti.stages.sampling import ascending, median, sample_stripes, trimmed_mean


def test_small_clouds_are_taken_whole() -> None:
    np.testing.assert_array_equal(sample_stripes(np.array([0, 3, 4, 9], np.int32)), np.arange(9))


def test_every_stripe_is_sampled_evenly_from_its_first_point() -> None:
    start = np.array([0, 7, 100_000, 100_001], np.int32)
    sample = sample_stripes(start)
    expected = [*range(0, 7, 4), *range(7, 100_000, 4), 100_000]
    np.testing.assert_array_equal(sample, expected)


def test_the_order_of_stripes_changes_the_order_of_samples_only() -> None:
    lengths = np.random.default_rng(1).integers(1, 4000, 60)
    starts = [np.concatenate(([0], np.cumsum(order))) for order in (lengths, lengths[::-1])]
    one, other = (sample_stripes(start.astype(np.int32)) for start in starts)
    places = [
        sorted((int(lengths_[r]), int(i - start[r])) for i, r in zip(sample, runs, strict=True))
        for sample, start, lengths_ in zip(
            (one, other), starts, (lengths, lengths[::-1]), strict=True
        )
        for runs in [np.searchsorted(start, sample, side="right") - 1]
    ]
    assert places[0] == places[1]


@pytest.mark.parametrize("outlier", [5.0, 1e9])
def test_the_largest_quarter_does_not_count(outlier: float) -> None:
    values = np.array([outlier, 1.0, 2.0, 3.0])
    assert trimmed_mean(values) == 2.0


@pytest.mark.parametrize("n", range(8))
def test_medians_are_those_of_numpy(n: int) -> None:
    rng = np.random.default_rng(n)
    values = rng.uniform(0.0, 9.0, n).astype(np.float32)
    mixed = rng.permutation(np.append(values, [-1.0, np.nan]).astype(np.float32))
    np.testing.assert_array_equal(ascending(mixed), np.sort(values))
    assert median(mixed) == (float(np.median(values)) if n else 0.0)


def test_negative_values_are_no_values() -> None:
    assert trimmed_mean(np.array([-1.0, 4.0, -1.0])) == 4.0
    assert trimmed_mean(np.array([-1.0])) == trimmed_mean(np.empty(0)) == 0.0
