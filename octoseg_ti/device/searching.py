"""Bisection in kernels."""

from octoseg_ti.device.runtime import ti


@ti.func
def first_not_less(keys: ti.template(), key, start: ti.i32, stop: ti.i32) -> ti.i32:
    """Return the first place from start on whose key is not less, or stop; keys ascend.

    Args:
        keys: A kernel array.
        key: What is looked for, of the type of the keys.
        start: First place.
        stop: One past the last place.
    """
    low = start
    high = stop
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low
