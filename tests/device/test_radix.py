"""The sort of keys is numpy's stable sort, for any number of keys, bits and threads' chunks."""

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from octoseg_ti.device import radix, runtime


def sorted_pairs(
    key: np.ndarray, index: np.ndarray | None, bits: int
) -> tuple[np.ndarray, np.ndarray]:
    out_key, out_index = radix.sort_pairs(
        runtime.upload(key.copy()), None if index is None else runtime.upload(index.copy()), bits
    )
    return runtime.download(out_key)[: len(key)], runtime.download(out_index)[: len(key)]


def check(key: np.ndarray, bits: int, seed: int) -> None:
    order = np.argsort(key, kind="stable")
    index = np.random.default_rng(seed + 1).permutation(len(key)).astype(np.int32)
    runtime.ensure_started()
    for packed in (len(key), 0):  # by NumPy where it can be, and by digits
        with patch.object(radix, "_MOST_PACKED", packed):
            out_key, out_index = sorted_pairs(key, index, bits)
            _, places = sorted_pairs(key, None, bits)
        what = f"seed {seed}, {bits} bits, {packed} packed"
        np.testing.assert_array_equal(out_key, key[order], err_msg=what)
        np.testing.assert_array_equal(out_index, index[order], err_msg=what)
        np.testing.assert_array_equal(places, order, err_msg=what)


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(0, 3000),
    bits=st.integers(1, 63),
    distinct=st.integers(1, 3000),
    seed=st.integers(0, 2**20),
)
@example(n=0, bits=1, distinct=1, seed=0)
@example(n=1, bits=63, distinct=1, seed=0)
@example(n=33, bits=12, distinct=2, seed=1)
@example(n=2000, bits=13, distinct=3, seed=1)
def test_sorts_as_numpy_does(n: int, bits: int, distinct: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pool = rng.integers(0, 2**bits, distinct, dtype=np.int64)  # repeated keys show the stability
    check(rng.choice(pool, n) if n else np.empty(0, np.int64), bits, seed)


@pytest.mark.parametrize("bits", [1, 11, 12, 13, 24, 25, 36, 42, 63])
def test_extreme_keys(bits: int) -> None:
    top = 2**bits - 1
    check(np.array([top, 0, top, top // 2, 1, top, 0], np.int64), bits, seed=0)


@pytest.mark.parametrize("shape", ["sorted", "reversed", "equal"])
def test_special_orders(shape: str) -> None:
    key = {
        "sorted": np.arange(5000),
        "reversed": np.arange(5000)[::-1],
        "equal": np.full(5000, 1234),
    }[shape]
    check(np.ascontiguousarray(key, np.int64), 13, seed=3)


@pytest.mark.parametrize("bits", [0, 64, -1])
def test_wrong_bits_are_refused(bits: int) -> None:
    runtime.ensure_started()
    with pytest.raises(ValueError, match=r"bits must be 1\.\.63"):
        radix.sort_pairs(np.zeros(3, np.int64), np.zeros(3, np.int32), bits)


def test_unequal_lengths_are_refused() -> None:
    runtime.ensure_started()
    with pytest.raises(ValueError, match="differ in length: 3 and 2"):
        radix.sort_pairs(np.zeros(3, np.int64), np.zeros(2, np.int32), 4)
