"""The leaves of the sparse grid as a graph: which touch, and a few points to speak for each.

A few points of every leaf (samples) stand for all of them where surfaces are sought: where a
surface is curved the leaves are small, so that the samples are dense exactly where they have to be.
The points of a leaf are picked by a hash of their coordinates: which ones does not depend on the
order in which they were scanned.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, I64Rows, ti
from octoseg_ti.stages.adjacency import Adjacency
from octoseg_ti.stages.grid import Grid

_FINE = 1024.0  # steps of the rounding in a smallest cell
# Odd numbers with well mixed bits (the first digits of the roots of 2, 3 and 5, times 2^63).
_MIX = (0x6A09E667F3BCC909, 0x5DB3D742C265539D, 0x1E3779B97F4A7C15)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Leaves:
    """The ``C`` leaves of a grid in Morton order, and the pairs of them that touch."""

    node: np.ndarray
    """Their nodes, shape (C,), i32."""
    first: np.ndarray
    """First sorted point of every leaf, shape (C,), i32."""
    count: np.ndarray
    """Points of every leaf, shape (C,), i32."""
    size: np.ndarray
    """Edge length of every leaf [mm], shape (C,), f64."""
    box: np.ndarray
    """Lower and upper corner of the points of every leaf, as these are [mm], shape (C, 6), f64."""
    a: np.ndarray
    """One leaf of every pair that touches, shape (E,), i32."""
    b: np.ndarray
    """The other one, shape (E,), i32."""
    start: np.ndarray
    """First entry of every leaf in ``neighbor``, and 2 E at the end, shape (C + 1,), i32."""
    neighbor: np.ndarray
    """The leaves that touch each leaf, ascending, shape (2 E,), i32."""

    def __len__(self) -> int:
        """Return the number of leaves."""
        return len(self.node)

    @property
    def points(self) -> np.ndarray:
        """First point and number of points of every leaf, shape (C, 2), i32, as kernels take it."""
        return np.stack([self.first, self.count], axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Samples:
    """Some points of every leaf, leaf after leaf, ``A`` in all."""

    index: np.ndarray
    """The sorted points that they are, shape (A,), i32."""
    leaf: np.ndarray
    """Leaf of every sample, shape (A,), i32."""
    point: np.ndarray
    """Position relative to the corner of the grid [mm], shape (A, 3), f64."""
    normal: np.ndarray
    """Unit normal, shape (A, 3), f64."""
    weight: np.ndarray
    """How many points a sample stands for, shape (A,), f64."""
    signed: bool = True
    """Normals have a side; without one only their axes count."""

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.leaf)


@ti.func
def _hash(p: ti.template(), i: ti.i32, fine: ti.f64) -> ti.i64:
    """Return a number that looks random and depends on nothing but the coordinates, finely rounded.

    Rounded, because a part far from the origin has lost its last digits.
    """
    h = ti.i64(0)
    for k in ti.static(range(3)):
        h = (h ^ ti.cast(p[i, k] * fine, ti.i64)) * ti.i64(_MIX[k])
        h = h ^ (h >> 29)
    return h


@ti.kernel
def _pick(
    most: ti.i32,
    fine: ti.f64,
    # In:
    point_in: F64Rows,
    taken_in: I32Array,
    leaf_in: I32Rows,
    # Out:
    hash_out: I64Rows,
    index_out: I32Rows,
    count_out: I32Array,
):
    """Write the points of every leaf with the smallest hashes, of those not taken; count these."""
    for c in count_out:
        free = 0
        held = 0
        for k in range(most):
            index_out[c, k] = -1
        for i in range(leaf_in[c, 0], leaf_in[c, 0] + leaf_in[c, 1]):
            if taken_in[i] < 0:
                free += 1
                h = _hash(point_in, i, fine)
                at = held  # of equal hashes the first point counts
                while at > 0 and hash_out[c, at - 1] >= h:
                    at -= 1
                if at < most and (at == held or hash_out[c, at] != h):
                    held = ti.min(held + 1, most)
                    k = held - 1
                    while k > at:
                        hash_out[c, k] = hash_out[c, k - 1]
                        index_out[c, k] = index_out[c, k - 1]
                        k -= 1
                    hash_out[c, at] = h
                    index_out[c, at] = i
        count_out[c] = free


@ti.kernel
def _bound(
    # In:
    point_in: F64Rows,
    first_in: I32Array,
    # Out:
    box_out: F64Rows,
):
    """Write the lower and upper corner of the points of every range."""
    ranges = first_in.shape[0]
    for r in range(ranges):
        low = row(point_in, first_in[r])
        high = low
        end = point_in.shape[0]
        if r + 1 < ranges:
            end = first_in[r + 1]
        for i in range(first_in[r] + 1, end):
            low = ti.min(low, row(point_in, i))
            high = ti.max(high, row(point_in, i))
        for k in ti.static(range(3)):
            box_out[r, k] = low[k]
            box_out[r, 3 + k] = high[k]


def leaf_graph(grid: Grid, node: np.ndarray, touching: Adjacency) -> Leaves:
    """Return the leaves of a grid and the pairs of them that touch.

    Args:
        grid: The sparse grid.
        node: The nodes that are leaves, in Morton order, shape (C,).
        touching: The touching pairs of leaves.
    """
    place = np.zeros(grid.count, np.int32)
    place[node] = np.arange(len(node), dtype=np.int32)
    count = runtime.download(touching.count)[: grid.count]
    neighbor = runtime.download(touching.neighbor)[: grid.count]
    held = np.arange(neighbor.shape[1], dtype=np.int32) < count[:, None]
    a = place[np.repeat(np.arange(grid.count), count)]
    b = place[neighbor[held]]
    start, neighbor = _linked(len(node), a, b)
    return Leaves(
        node=node,
        first=grid.first[node],
        count=grid.holds[node],
        size=grid.edge_length[node],
        box=runtime.download(boxes_of(grid.point, grid.first[node]))[: len(node)],
        a=a,
        b=b,
        start=start,
        neighbor=neighbor,
    )


def _linked(count: int, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what pairs say of each of so many leaves, as `Leaves.start` and its ``neighbor``."""
    one, other = np.concatenate([a, b]), np.concatenate([b, a])
    # All keys differ: to sort them is faster than to sort places by them.
    key = np.sort(one.astype(np.int64) * max(count, 1) + other)
    start = np.searchsorted(key, np.arange(count + 1, dtype=np.int64) * count)
    return start.astype(np.int32), (key % max(count, 1)).astype(np.int32)


def boxes_of(points: Any, first: np.ndarray) -> Any:
    """Return the lower and upper corner of the points of every range [mm], shape (R, 6).

    Args:
        points: Sorted positions [mm], shape (n, 3), f64 (kernel array).
        first: First point of every range, ascending, shape (R,), i32; each ends where the next one
            begins.

    Returns:
        A kernel array.
    """
    runtime.ensure_started()
    box = runtime.empty((len(first), 6), np.float64)
    if len(first):
        _bound(points, runtime.upload(first), box)
    return box


def sample_leaves(
    grid: Grid, leaves: Leaves, most: int, *, label: np.ndarray | None = None
) -> Samples:
    """Return up to ``most`` points of every leaf.

    Args:
        grid: The sparse grid.
        leaves: Its leaves.
        most: Largest number of points of a leaf.
        label: Label of every sorted point, shape (n,), i32: only points without one (-1) are
            picked and counted; None = all.
    """
    runtime.ensure_started()
    n = grid.order.shape[0]
    taken = np.full(n, -1, np.int32) if label is None else label
    index = runtime.empty((len(leaves), most), np.int32)
    free = runtime.empty(len(leaves), np.int32)
    fine = _FINE * 2.0**grid.depth / grid.size
    scratch = runtime.empty((len(leaves), most), np.int64)
    _pick(
        most, fine, grid.point, runtime.upload(taken), runtime.upload(leaves.points),
        scratch, index, free,
    )  # fmt: skip
    picked, there = runtime.download(index), runtime.download(free)
    found = picked >= 0
    each = found.sum(axis=1)
    leaf = np.repeat(np.arange(len(leaves), dtype=np.int32), each)
    picked = picked[found]
    return Samples(
        index=picked,
        leaf=leaf,
        point=runtime.download(grid.point).take(picked, axis=0),
        normal=runtime.download(grid.normal).take(picked, axis=0),
        weight=np.repeat(there / np.maximum(each, 1), each),
        signed=grid.signed,
    )


def joined_samples(one: Samples, other: Samples) -> Samples:
    """Return samples of the same leaves in one list."""
    return Samples(
        index=np.concatenate([one.index, other.index]),
        leaf=np.concatenate([one.leaf, other.leaf]),
        point=np.concatenate([one.point, other.point]),
        normal=np.concatenate([one.normal, other.normal]),
        weight=np.concatenate([one.weight, other.weight]),
        signed=one.signed,
    )


def distinct(key: np.ndarray) -> np.ndarray:
    """Return the different keys, ascending: faster than `numpy.unique`, which hashes them."""
    key = np.sort(key)
    new = np.ones(len(key), bool)
    new[1:] = key[1:] != key[:-1]
    return key[new]


def ranges(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the numbers from every first on, so many each, one range after the other."""
    ends = np.cumsum(count, dtype=np.int64)
    total = int(ends[-1]) if len(ends) else 0
    return np.arange(total) + np.repeat(first - (ends - count), count)


def members_of(label: np.ndarray, count: int) -> list[np.ndarray]:
    """Return the members of every label 0..count-1, ascending, an array of indices for each."""
    # All keys differ: to sort them is faster than to sort places by them.
    bits = len(label).bit_length()
    kind = np.int32 if bits + count.bit_length() < 31 else np.int64
    key = np.sort((label.astype(kind) << bits) | np.arange(len(label), dtype=kind))
    ends = np.searchsorted(key, np.arange(count + 1, dtype=kind) << bits)
    order = (key & ((1 << bits) - 1)).astype(np.int64)
    return [order[lo:hi] for lo, hi in pairwise(ends)]


def sizes_of(label: np.ndarray, count: int) -> np.ndarray:
    """Return how many points have each of the labels 0..count-1, -1 = none; shape (count,), i64.

    Neighbours mostly have the same one: their runs are counted, faster than `numpy.bincount` does.
    """
    if count == 0 or len(label) == 0:
        return np.zeros(count, np.int64)
    first = np.append(0, np.flatnonzero(label[1:] != label[:-1]) + 1)
    length = np.diff(first, append=len(label))
    return np.bincount(label[first] + 1, length, count + 1)[1:].astype(np.int64)
