"""Stable sort of integer keys: by NumPy where it can be, else by least significant digits.

A pass of the latter is: count the digits of every chunk, scan the counts digit by digit over the
chunks, move every element to its place. The order of equal keys is kept, so the result does not
depend on the number of threads.
"""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import I32Array, I32Rows, I64Array, ti

_MOST_DIGIT_BITS = 12
# So many keys NumPy sorts faster on one core than the kernel on two.
_MOST_PACKED = 1 << 18


@ti.kernel
def _sort_by_digit(
    n: ti.i32,
    workers: ti.i32,
    stride: ti.i32,
    shift: ti.i32,
    radix: ti.i32,
    # In:
    key_in: I64Array,
    index_in: I32Array,
    # Out:
    place_out: I32Rows,
    key_out: I64Array,
    index_out: I32Array,
):
    """Sort by one digit: count it in every chunk, scan the counts, move the elements."""
    chunk = (n + workers - 1) // workers
    for u in range(workers * stride):
        if u % stride == 0:
            w = u // stride
            for d in range(radix):
                place_out[w, d] = 0
            for i in range(w * chunk, ti.min(n, (w + 1) * chunk)):
                d = ti.cast((key_in[i] >> shift) & (radix - 1), ti.i32)
                place_out[w, d] = place_out[w, d] + 1
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = 0
        for d in range(radix):
            for w in range(workers):  # by digit, then by chunk: equal keys keep their order
                here = place_out[w, d]
                place_out[w, d] = total
                total = total + here
    for u in range(workers * stride):
        if u % stride == 0:
            w = u // stride
            for i in range(w * chunk, ti.min(n, (w + 1) * chunk)):
                key = key_in[i]
                d = ti.cast((key >> shift) & (radix - 1), ti.i32)
                place = place_out[w, d]
                place_out[w, d] = place + 1
                key_out[place] = key
                index_out[place] = index_in[i]


def sort_pairs(key: Any, index: Any | None, bits: int) -> tuple[Any, Any]:
    """Sort keys, and an index with them, by the lowest bits; equal keys keep their order.

    Args:
        key: Non-negative keys, shape (n,), i64, a kernel array. Used as scratch.
        index: What travels with the keys, shape (n,), i32, a kernel array. Used as scratch. None =
            their places 0..n-1.
        bits: Number of low bits that can differ, 1..63.

    Returns:
        The sorted keys and the index in that order, kernel arrays.

    Raises:
        ValueError: ``bits`` is out of range, or the shapes differ.
    """
    runtime.ensure_started()
    n = key.shape[0]
    if not 1 <= bits <= 63:
        raise ValueError(f"bits must be 1..63, not {bits}")
    if index is not None and index.shape[0] != n:
        raise ValueError(f"key and index differ in length: {n} and {index.shape[0]}")
    if n == 0:
        return key, runtime.upload(np.zeros(0, np.int32))
    place_bits = (n - 1).bit_length()
    if n <= _MOST_PACKED and bits + place_bits <= 63 and runtime.on_cpu():
        # With the place in its low bits no key is twice there, so that NumPy's sort, which is not
        # stable but much faster, does.
        packed = key << place_bits
        packed |= np.arange(n)
        packed.sort()
        place = packed & ((1 << place_bits) - 1)
        return packed >> place_bits, place.astype(np.int32) if index is None else index.take(place)
    if index is None:
        index = runtime.upload(np.arange(n, dtype=np.int32))
    passes = -(-bits // _MOST_DIGIT_BITS)
    digit_bits = -(-bits // passes)
    workers, stride = runtime.workers()
    count = runtime.empty((workers, 1 << digit_bits), np.int32)
    other_key, other_index = runtime.empty(n, np.int64), runtime.empty(n, np.int32)
    for p in range(passes):
        shift, radix = p * digit_bits, 1 << digit_bits
        _sort_by_digit(n, workers, stride, shift, radix, key, index, count, other_key, other_index)
        key, other_key = other_key, key
        index, other_index = other_index, index
    return key, index
