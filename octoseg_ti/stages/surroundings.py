"""Sorted points and what is around them: sectors without neighbours, and points near marked ones.

Few points are asked about, those at the borders of what was scanned. Leaves on flat faces hold
thousands of points, so these are bounded in blocks, which are small because the points are in
Morton order.
"""

import math
from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import box_gap, row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, ti
from octoseg_ti.stages.leaves import Leaves, boxes_of

SECTORS = 24
"""Sectors around a point that hold neighbours or are free."""
FREE = SECTORS // 3
"""A point is at a border when so many sectors beside each other are free: a third of a turn."""
BLOCK = 32
"""Sorted points that are bounded together."""


_STEEPER = tuple(math.tan(2.0 * math.pi * k / SECTORS) for k in range(1, SECTORS // 4))
"""Tangents of the angles between the sectors of a quarter."""


@ti.func
def _sector(x: ti.f64, y: ti.f64) -> ti.i32:
    """Return the sector in which a direction lies, counted from x towards y."""
    sector = 0
    if x <= 0.0 and y > 0.0:
        x, y = y, -x
        sector = SECTORS // 4
    elif x < 0.0 and y <= 0.0:
        x, y = -x, -y
        sector = SECTORS // 2
    elif x >= 0.0 and y < 0.0:
        x, y = -y, x
        sector = 3 * SECTORS // 4
    for k in ti.static(range(len(_STEEPER))):
        sector += ti.cast(x > 0.0 and y >= _STEEPER[k] * x, ti.i32)
    return sector


@ti.func
def _at_border(held: ti.i32) -> ti.i32:
    """Say whether enough sectors beside each other are free."""
    free = ti.cast(~held & ((1 << SECTORS) - 1), ti.i64)
    free |= free << SECTORS
    for _ in ti.static(range(FREE - 1)):
        free &= free >> 1
    return ti.cast(free != 0, ti.i32)


@ti.func
def _occupied(
    point_in: ti.template(), leaf_in: ti.template(), block_in: ti.template(), c: ti.i32, p: vec3,
    u: vec3, v: vec3, square: ti.f64,
) -> ti.i32:  # fmt: skip
    """Return the sectors around place p that hold points of leaf c, as bits."""
    held = 0
    begin = leaf_in[c, 0]
    end = begin + leaf_in[c, 1]
    for b in range(begin // BLOCK, (end - 1) // BLOCK + 1):
        if box_gap(block_in, b, p) <= square:
            for j in range(ti.max(begin, b * BLOCK), ti.min(end, (b + 1) * BLOCK)):
                step = row(point_in, j) - p
                far = step.norm_sqr()
                if far <= square and far > 0.0:
                    held |= 1 << _sector(step.dot(u), step.dot(v))
    return held


@ti.func
def _widest(held: ti.i32):
    """Return (how many sectors the widest run of free ones has, the last of them)."""
    widest = 0
    last = 0
    free = 0
    for k in range(2 * SECTORS):
        free = ti.select((held >> (k % SECTORS)) & 1 == 1, 0, ti.min(free + 1, SECTORS))
        if free > widest:
            widest = free
            last = k
    return widest, last


@ti.kernel
def _free_sectors(
    radius: ti.f64,
    # In:
    point_in: F64Rows,
    normal_in: F64Rows,
    leaf_in: I32Rows,
    box_in: F64Rows,
    block_in: F64Rows,
    start_in: I32Array,
    neighbor_in: I32Array,
    entry_in: I32Rows,
    # Out:
    outward_out: F64Rows,
    free_out: I32Array,
):
    """Write the middle of the widest run of free sectors around a point, and how many these are.

    Where they are fewer than make a border, others may be taken as well.
    """
    square = radius * radius
    for e in free_out:
        c = entry_in[e, 1]
        p = row(point_in, entry_in[e, 0])
        n = row(normal_in, entry_in[e, 0])
        u = vec3(1.0, 0.0, 0.0)
        if ti.abs(n[0]) > 0.7:
            u = vec3(0.0, 1.0, 0.0)
        u = (u - u.dot(n) * n).normalized()
        v = n.cross(u)
        held = _occupied(point_in, leaf_in, block_in, c, p, u, v, square)
        # Small leaves end within the radius: those beyond count too. Few points get that far.
        for ring in range(2):
            for k in range(start_in[c], start_in[c + 1]):
                b = neighbor_in[k]
                if _at_border(held) == 1 and box_gap(box_in, b, p) <= square:
                    if ring == 0:
                        held |= _occupied(point_in, leaf_in, block_in, b, p, u, v, square)
                    elif leaf_in[b, 2] == 1:
                        for j in range(start_in[b], start_in[b + 1]):
                            if box_gap(box_in, neighbor_in[j], p) <= square:
                                held |= _occupied(
                                    point_in, leaf_in, block_in, neighbor_in[j], p, u, v, square
                                )
        widest, last = _widest(held)
        angle = 2.0 * ti.math.pi * (last + 1 - 0.5 * widest) / SECTORS
        outward = ti.cos(angle) * u + ti.sin(angle) * v
        for k in ti.static(range(3)):
            outward_out[e, k] = outward[k]
        free_out[e] = widest


@ti.func
def _mark_leaf(
    point_in: ti.template(), label_in: ti.template(), leaf_in: ti.template(),
    block_in: ti.template(), c: ti.i32, i: ti.i32, square: ti.f64, near_out: ti.template(),
):  # fmt: skip
    """Mark the points of leaf c that are near point i and have its label."""
    p = row(point_in, i)
    begin = leaf_in[c, 0]
    end = begin + leaf_in[c, 1]
    for b in range(begin // BLOCK, (end - 1) // BLOCK + 1):
        if box_gap(block_in, b, p) <= square:
            for j in range(ti.max(begin, b * BLOCK), ti.min(end, (b + 1) * BLOCK)):
                if (row(point_in, j) - p).norm_sqr() <= square and label_in[j] == label_in[i]:
                    near_out[j] = 1


@ti.kernel
def _spread(
    reach: ti.f64,
    # In:
    point_in: F64Rows,
    label_in: I32Array,
    leaf_in: I32Rows,
    box_in: F64Rows,
    block_in: F64Rows,
    start_in: I32Array,
    neighbor_in: I32Array,
    entry_in: I32Rows,
    # Out:
    near_out: I32Array,
):
    """Mark the points within reach of those of the entries that have the same label."""
    square = reach * reach
    for e in range(entry_in.shape[0]):
        i = entry_in[e, 0]
        c = entry_in[e, 1]
        p = row(point_in, i)
        _mark_leaf(point_in, label_in, leaf_in, block_in, c, i, square, near_out)
        for k in range(start_in[c], start_in[c + 1]):
            b = neighbor_in[k]
            if box_gap(box_in, b, p) <= square:
                _mark_leaf(point_in, label_in, leaf_in, block_in, b, i, square, near_out)
                for j in range(start_in[b], start_in[b + 1]):
                    if leaf_in[b, 2] == 1 and box_gap(box_in, neighbor_in[j], p) <= square:
                        _mark_leaf(
                            point_in, label_in, leaf_in, block_in, neighbor_in[j], i, square,
                            near_out,
                        )  # fmt: skip


class Surroundings:
    """Sorted points in their leaves, to look for those around some of them."""

    def __init__(self, points: Any, leaves: Leaves, radius: float) -> None:
        """Bound blocks of points.

        Args:
            points: Sorted positions [mm], shape (n, 3) (kernel array).
            leaves: The leaves.
            radius: Largest distance that will be asked for [mm].
        """
        runtime.ensure_started()
        blocks = boxes_of(points, np.arange(0, points.shape[0], BLOCK, dtype=np.int32))
        small = leaves.size < radius
        self._points = points
        self._leaves = (
            runtime.upload(np.stack([leaves.first, leaves.count, small], axis=1).astype(np.int32)),
            runtime.upload(leaves.box), blocks, runtime.upload(leaves.start),
            runtime.upload(leaves.neighbor),
        )  # fmt: skip

    def free_sectors(
        self, normals: Any, point: np.ndarray, leaf: np.ndarray, radius: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the direction in which no others lie around some points, and how wide that is.

        Args:
            normals: Unit normals, shape (n, 3) (kernel array).
            point: Point of every entry, shape (E,).
            leaf: Its leaf, shape (E,).
            radius: Points farther than this do not count [mm].

        Returns:
            Unit vector in the tangent plane, shape (E, 3); free sectors of `SECTORS`, shape (E,):
            what is less than `FREE` need not be the least.
        """
        entries = len(point)
        if entries == 0:
            return np.zeros((0, 3)), np.zeros(0, np.int32)
        outward, free = runtime.empty((entries, 3), np.float64), runtime.empty(entries, np.int32)
        entry = runtime.upload(np.stack([point, leaf], axis=1).astype(np.int32))
        _free_sectors(radius, self._points, normals, *self._leaves, entry, outward, free)
        return runtime.download(outward), runtime.download(free)

    def near(
        self, label: np.ndarray, point: np.ndarray, leaf: np.ndarray, reach: float
    ) -> np.ndarray:
        """Return which points are near some points of the same label, these included, (n,) bool.

        Args:
            label: Label of every point, shape (n,), i32.
            point: Point of every entry, shape (E,).
            leaf: Its leaf, shape (E,).
            reach: Largest distance [mm].
        """
        near = runtime.zeros(len(label), np.int32)
        if len(point):
            entry = runtime.upload(np.stack([point, leaf], axis=1).astype(np.int32))
            _spread(reach, self._points, runtime.upload(label), *self._leaves, entry, near)
        return runtime.download(near) > 0
