"""Points take the label of the surface that they fit best, among those found near their leaf.

The cost of a surface is the square of the point's distance, in standard deviations of the noise,
plus the square of the angle between the normals, in deviations of theirs. Only surfaces that have
points in the leaf itself or in a leaf that touches it take part.
"""

from typing import Any, NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F32Rows, F64Rows, I32Array, I32Rows, ti
from octoseg_ti.device.surfaces import surface_at
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.leaves import Leaves
from octoseg_ti.types import NONE

MOST = 12
"""Surfaces that a leaf can choose among; of more, those with the smaller numbers."""


class Rule(NamedTuple):
    """What a point may differ from its surface, and how that is weighed."""

    noise: float
    """Deviation of a point from its surface [mm]."""
    tilt: float
    """Deviation of its normal [rad]."""
    reach: float = 2.5
    """Farthest point of a surface, in noises."""
    turn: float = 0.4
    """Largest angle between the normals of a point and of its surface [rad]."""


class Choice(NamedTuple):
    """What the points chose."""

    label: Any
    """Surface of every sorted point, -1 = none fits, shape (n,), i32 (kernel array)."""
    second: Any
    """Surface that would come next, -1 = none near, shape (n,), i32 (kernel array)."""
    off: Any
    """Distance of every point from its second [noises], and the angle between their normals
    [tilts], shape (n, 2), f32 (kernel array)."""


@ti.func
def _insert(list_inout: ti.template(), c: ti.i32, value: ti.i32):
    """Put a value into an ascending row without doubles; -1 ends it, the largest drop out."""
    at = 0
    while at < MOST and list_inout[c, at] >= 0 and list_inout[c, at] < value:
        at += 1
    if at < MOST and list_inout[c, at] != value:
        k = MOST - 1
        while k > at:
            list_inout[c, k] = list_inout[c, k - 1]
            k -= 1
        list_inout[c, at] = value


@ti.kernel
def _gather(
    # In:
    own_in: I32Rows,
    closed_in: I32Array,
    start_in: I32Array,
    neighbor_in: I32Array,
    # Out:
    near_inout: I32Rows,
):
    """Collect the surfaces of every leaf that is not closed, and of the leaves that touch it."""
    for c in range(own_in.shape[0]):
        for k in range(MOST):
            near_inout[c, k] = -1
        if closed_in[c] == 0:
            for k in range(MOST):
                if own_in[c, k] >= 0:
                    _insert(near_inout, c, own_in[c, k])
            for e in range(start_in[c], start_in[c + 1]):
                b = neighbor_in[e]
                k = 0
                while k < MOST and own_in[b, k] >= 0:
                    _insert(near_inout, c, own_in[b, k])
                    k += 1


@ti.kernel
def _choose(
    rule: ti.types.vector(4, ti.f64),
    # In:
    point_in: F64Rows,
    normal_in: F64Rows,
    leaf_in: I32Rows,
    near_in: I32Rows,
    surface_in: F64Rows,
    # Out:
    own_out: I32Rows,
    label_out: I32Array,
    second_out: I32Array,
    off_out: F32Rows,
):
    """Find the two best surfaces of every point, and the surfaces that each leaf ends up with."""
    for c in range(leaf_in.shape[0]):
        for k in range(MOST):
            own_out[c, k] = -1
        for i in range(leaf_in[c, 0], leaf_in[c, 0] + leaf_in[c, 1]):
            p = row(point_in, i)
            m = row(normal_in, i)
            best = 1e30
            next_best = 1e30
            label_out[i] = -1
            second_out[i] = -1
            for j in ti.static(range(2)):
                off_out[i, j] = ti.f32(1e30)
            best_off = 1e30
            best_turn = 1e30
            k = 0
            while k < MOST and near_in[c, k] >= 0:
                s = near_in[c, k]
                kind = ti.cast(surface_in[s, 8], ti.i32)
                origin = row(surface_in, s)
                axis = vec3(surface_in[s, 3], surface_in[s, 4], surface_in[s, 5])
                d, n = surface_at(kind, p, origin, axis, surface_in[s, 6], surface_in[s, 7])
                angle = ti.acos(ti.min(1.0, ti.abs(n.dot(m))))
                if m.norm_sqr() == 0.0:
                    angle = 0.0
                off = ti.abs(d) / rule[0]
                if angle <= rule[3]:
                    tilt = angle / rule[1]
                    tilt = ti.min(tilt, 6.0 + 0.1 * ti.max(tilt - 6.0, 0.0))
                    cost = off * off + tilt * tilt + surface_in[s, 9]
                    if off <= rule[2] and cost < best:
                        next_best = best
                        second_out[i] = label_out[i]
                        off_out[i, 0] = ti.cast(best_off, ti.f32)
                        off_out[i, 1] = ti.cast(best_turn, ti.f32)
                        best = cost
                        label_out[i] = s
                        best_off = off
                        best_turn = angle / rule[1]
                    elif cost < next_best:
                        next_best = cost
                        second_out[i] = s
                        off_out[i, 0] = ti.cast(off, ti.f32)
                        off_out[i, 1] = ti.cast(angle / rule[1], ti.f32)
                k += 1
            if label_out[i] >= 0:
                _insert(own_out, c, label_out[i])


def own_lists(leaves: Leaves, leaf: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Return which surfaces are known to have points in every leaf.

    Args:
        leaves: The leaves.
        leaf: A leaf, shape (k,).
        label: A surface that has points there, shape (k,); -1 = none.

    Returns:
        Surfaces of every leaf, ascending, then -1; shape (C, MOST), i32.
    """
    own = np.full((len(leaves), MOST), NONE, np.int32)
    there = label >= 0
    width = int(label.max(initial=0)) + 1
    key = np.unique(leaf[there].astype(np.int64) * width + label[there])
    cell, name = key // width, key % width
    new = np.ones(len(cell), bool)
    new[1:] = cell[1:] != cell[:-1]
    rank = np.arange(len(cell)) - np.maximum.accumulate(np.where(new, np.arange(len(cell)), 0))
    kept = rank < MOST
    own[cell[kept], rank[kept]] = name[kept]
    return own


def common_label(leaves: Leaves, label: np.ndarray) -> np.ndarray:
    """Return the label that all points of a leaf have, -1 where they differ; shape (C,), i32."""
    low = np.minimum.reduceat(label, leaves.first)
    high = np.maximum.reduceat(label, leaves.first)
    return np.where(low == high, low, NONE).astype(np.int32)


def label_lists(leaves: Leaves, label: np.ndarray) -> np.ndarray:
    """Return which labels the points of every leaf have.

    Args:
        leaves: The leaves.
        label: Label of every sorted point, -1 = none, shape (n,), i32.

    Returns:
        Labels of every leaf, ascending, then -1; shape (C, MOST), i32.
    """
    one = common_label(leaves, label)
    mixed = np.flatnonzero(one < 0)
    count = leaves.count[mixed]
    ends = np.cumsum(count)
    point = np.arange(ends[-1] if len(ends) else 0)
    point = point + np.repeat(leaves.first[mixed] - (ends - count), count)
    return own_lists(
        leaves,
        np.concatenate([np.flatnonzero(one >= 0), np.repeat(mixed, count)]),
        np.concatenate([one[one >= 0], label[point]]),
    )


def surface_table(
    kind: np.ndarray, parameters: np.ndarray, handicap: np.ndarray | None = None
) -> np.ndarray:
    """Return surfaces as rows for kernels: parameters (8), kind, and handicap, shape (M, 10).

    Args:
        kind: `SurfaceKind` of every surface, analytic, shape (M,).
        parameters: As in `Segmentation.parameters`, shape (M, 8).
        handicap: What is added to the cost of every surface, shape (M,); None = nothing.
    """
    return np.column_stack(
        [parameters, kind, np.zeros(len(kind)) if handicap is None else handicap]
    )


def label_points(
    grid: Grid,
    leaves: Leaves,
    own: np.ndarray,
    surfaces: np.ndarray,
    rule: Rule,
    *,
    passes: int = 1,
    closed: np.ndarray | None = None,
) -> tuple[Choice, np.ndarray]:
    """Let every point choose its surface.

    Args:
        grid: The sparse grid.
        leaves: Its leaves.
        own: Surfaces with points in every leaf, shape (C, MOST), i32 (`own_lists`).
        surfaces: The surfaces (`surface_table`), shape (M, 10).
        rule: What a point may differ from its surface.
        passes: How many leaves beyond those in ``own`` a surface may reach.
        closed: Leaves whose points choose nothing, shape (C,), bool; None = no leaf.

    Returns:
        The choice, and the surfaces that each leaf ended up with, as ``own``.
    """
    runtime.ensure_started()
    n = grid.order.shape[0]
    label, second = runtime.empty(n, np.int32), runtime.empty(n, np.int32)
    off = runtime.empty((n, 2), np.float32)
    held = runtime.upload(own)
    near = runtime.empty(own.shape, np.int32)
    shut = runtime.upload(
        np.zeros(len(leaves), np.int32) if closed is None else closed.astype(np.int32)
    )
    start, neighbor = runtime.upload(leaves.start), runtime.upload(leaves.neighbor)
    table = runtime.upload(np.stack([leaves.first, leaves.count], axis=1))
    device_surfaces = runtime.upload(surfaces)
    for _ in range(passes):
        _gather(held, shut, start, neighbor, near)
        held = runtime.empty(own.shape, np.int32)
        _choose(
            tuple(rule), grid.point, grid.normal, table, near, device_surfaces,
            held, label, second, off,
        )  # fmt: skip
    return Choice(label, second, off), runtime.download(held)
