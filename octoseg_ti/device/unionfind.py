"""Union-find without compare-and-swap: the larger root is hooked under the smaller by `atomic_min`.

The root of a set is its smallest member, whatever the order of the unions and the threads.
"""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import I32Array, ti


@ti.func
def find(parent: ti.template(), start: ti.i32) -> ti.i32:
    """Return the root of a member, halving the path on the way."""
    x = start
    while parent[x] != x:
        above = parent[parent[x]]
        parent[x] = above
        x = above
    return x


@ti.func
def unite(parent: ti.template(), a: ti.i32, b: ti.i32):
    """Join the sets of two members."""
    x = find(parent, a)
    y = find(parent, b)
    while x != y:
        high = ti.max(x, y)
        low = ti.min(x, y)
        old = ti.atomic_min(parent[high], low)
        if old == high:
            x = y
        else:
            x = find(parent, old)
            y = find(parent, low)


@ti.kernel
def _join(
    # In:
    a_in: I32Array,
    b_in: I32Array,
    # Out:
    parent_inout: I32Array,
):
    """Join the two members of every pair."""
    for i in a_in:
        unite(parent_inout, a_in[i], b_in[i])


@ti.kernel
def _find_roots(
    # Out:
    parent_inout: I32Array,
):
    """Let every member point to its root."""
    for i in parent_inout:
        parent_inout[i] = find(parent_inout, i)


def roots(parent: Any) -> np.ndarray:
    """Return the smallest member of the set of every member.

    Args:
        parent: What `unite` made of 0, 1, ..., shape (n,), i32 (kernel array); afterwards every
            member points to its root.
    """
    runtime.ensure_started()
    _find_roots(parent)
    return runtime.download(parent)


def components(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the connected component of every member of a graph, by its smallest member.

    Args:
        count: Number of members.
        a: One end of every edge, shape (e,), i32.
        b: Its other end, shape (e,), i32.

    Returns:
        Smallest member of the component of every member, shape (count,), i32.
    """
    runtime.ensure_started()
    parent = runtime.upload(np.arange(count, dtype=np.int32))
    if len(a) == 0:
        return np.arange(count, dtype=np.int32)
    _join(runtime.upload(np.asarray(a, np.int32)), runtime.upload(np.asarray(b, np.int32)), parent)
    return roots(parent)
