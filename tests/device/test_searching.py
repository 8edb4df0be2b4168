"""Bisection finds what `numpy.searchsorted` finds."""

import numpy as np
import pytest

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import I32Array, I32Rows, ti
from octoseg_ti.device.searching import first_not_less


@ti.kernel
def _find(
    # In:
    keys_in: I32Array,
    asked_in: I32Rows,
    # Out:
    place_out: I32Array,
):
    """Look up every row (key, start, stop)."""
    for i in place_out:
        place_out[i] = first_not_less(keys_in, asked_in[i, 0], asked_in[i, 1], asked_in[i, 2])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("count", [1, 2, 7, 500])
def test_places_are_those_of_searchsorted(seed: int, count: int) -> None:
    runtime.ensure_started()
    rng = np.random.default_rng(seed)
    keys = np.sort(rng.integers(0, count, count)).astype(np.int32)
    ends = np.sort(rng.integers(0, count + 1, (300, 2)), axis=1)
    asked = np.column_stack([rng.integers(-2, count + 2, 300), ends]).astype(np.int32)
    place = runtime.empty(300, np.int32)
    _find(runtime.upload(keys), runtime.upload(asked), place)
    expected = [lo + np.searchsorted(keys[lo:hi], k) for k, lo, hi in asked]
    np.testing.assert_array_equal(runtime.download(place)[:300], expected)
