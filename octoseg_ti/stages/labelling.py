"""Points take the label of the surface that they fit best, among those found near their leaf.

The cost of a surface is the square of the point's distance, in standard deviations of the noise,
plus the square of the angle between the normals, in deviations of theirs. Only surfaces that have
points in the leaf itself or in a leaf that touches it take part.
"""

from typing import Any, NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import angle_of, row, vec3
from octoseg_ti.device.runtime import F32Rows, F64Rows, I32Array, I32Rows, ti
from octoseg_ti.device.surfaces import surface_in_row
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.leaves import Leaves, distinct
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
    """Surface that would come next, however far off or turned, -1 = none near, shape (n,), i32
    (kernel array)."""
    off: Any
    """Distance of every point from its second [noises], the angle between their normals [tilts],
    and by how much that costs more than its own, shape (n, 3), f32 (kernel array)."""


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
    before_in: I32Rows,
    changed_in: I32Array,
    # Out:
    near_inout: I32Rows,
    stale_out: I32Array,
):
    """Collect the surfaces of every leaf that is not closed, and of the leaves that touch it.

    A leaf is stale that sees others than before, or one that has changed.
    """
    for c in range(own_in.shape[0]):
        for k in range(MOST):
            near_inout[c, k] = ti.select(closed_in[c] == 0, own_in[c, k], -1)
        if closed_in[c] == 0:
            for e in range(start_in[c], start_in[c + 1]):
                b = neighbor_in[e]
                k = 0
                while k < MOST and own_in[b, k] >= 0:
                    _insert(near_inout, c, own_in[b, k])
                    k += 1
        stale = 0
        for k in range(MOST):
            s = near_inout[c, k]
            if s != before_in[c, k]:
                stale = 1
            elif s >= 0 and changed_in[s] != 0:
                stale = 1
        stale_out[c] = stale


@ti.kernel
def _list_labels(
    # In:
    label_in: I32Array,
    leaf_in: I32Rows,
    # Out:
    own_inout: I32Rows,
    common_out: I32Array,
):
    """List the labels of the points of every leaf; write the one that all have, -1 for others."""
    for c in common_out:
        for k in range(MOST):
            own_inout[c, k] = -1
        first = leaf_in[c, 0]
        last = label_in[first]
        common = last
        if last >= 0:
            own_inout[c, 0] = last
        for i in range(first + 1, first + leaf_in[c, 1]):
            if label_in[i] != last:
                last = label_in[i]
                common = -1
                if last >= 0:
                    _insert(own_inout, c, last)
        common_out[c] = common


@ti.kernel
def _choose(
    rule: ti.types.vector(4, ti.f64),
    # In:
    todo_in: I32Array,
    point_in: F64Rows,
    normal_in: F64Rows,
    leaf_in: I32Rows,
    near_in: I32Rows,
    surface_in: F64Rows,
    # Out:
    own_inout: I32Rows,
    label_inout: I32Array,
    second_inout: I32Array,
    off_inout: F32Rows,
):
    """Find the two best surfaces of every point of some leaves, and those these end up with."""
    for e in todo_in:
        c = todo_in[e]
        for k in range(MOST):
            own_inout[c, k] = -1
        for i in range(leaf_in[c, 0], leaf_in[c, 0] + leaf_in[c, 1]):
            p = row(point_in, i)
            m = row(normal_in, i)
            best = vec3(1e30, 1e30, 1e30)  # cost, distance and angle
            after = best
            label = -1
            second = -1
            k = 0
            while k < MOST and near_in[c, k] >= 0:
                s = near_in[c, k]
                d, n = surface_in_row(surface_in, s, ti.cast(surface_in[s, 8], ti.i32), p)
                off = ti.abs(d) * rule[0]  # of the rule's deviations the inverses
                least = off * off + surface_in[s, 9]
                if least < after[0] or (off <= rule[2] and least < best[0]):
                    facing = ti.select(m.norm_sqr() > 0.0, ti.abs(n.dot(m)), 1.0)
                    angle = angle_of(ti.min(1.0, facing))
                    turn = angle * rule[1]
                    # Beyond six deviations hardly more: of two surfaces through a point of an edge
                    # the one that it faces a little.
                    tilt = ti.min(turn, 6.0 + 0.1 * ti.max(turn - 6.0, 0.0))
                    this = vec3(least + tilt * tilt, off, turn)
                    if angle <= rule[3] and off <= rule[2] and this[0] < best[0]:
                        if best[0] < after[0]:
                            after = best
                            second = label
                        best = this
                        label = s
                    elif this[0] < after[0]:
                        after = this
                        second = s
                k += 1
            label_inout[i] = label
            second_inout[i] = second
            off_inout[i, 0] = ti.cast(after[1], ti.f32)
            off_inout[i, 1] = ti.cast(after[2], ti.f32)
            off_inout[i, 2] = ti.cast(after[0] - best[0], ti.f32)
            if label >= 0:
                _insert(own_inout, c, label)


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
    key = distinct(leaf[there].astype(np.int64) * width + label[there])
    cell, name = key // width, key % width
    new = np.ones(len(cell), bool)
    new[1:] = cell[1:] != cell[:-1]
    rank = np.arange(len(cell)) - np.maximum.accumulate(np.where(new, np.arange(len(cell)), 0))
    kept = rank < MOST
    own[cell[kept], rank[kept]] = name[kept]
    return own


def common_label(leaves: Leaves, label: np.ndarray) -> np.ndarray:
    """Return the label that all points of a leaf have, -1 where they differ; shape (C,), i32."""
    return leaf_labels(leaves, label)[1]


def label_lists(leaves: Leaves, label: np.ndarray) -> np.ndarray:
    """Return which labels the points of every leaf have, as `leaf_labels` does."""
    return leaf_labels(leaves, label)[0]


def leaf_labels(leaves: Leaves, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which labels the points of every leaf have.

    Args:
        leaves: The leaves.
        label: Label of every sorted point, -1 = none, shape (n,), i32.

    Returns:
        Labels of every leaf, ascending, then -1, shape (C, MOST), i32; and the label that all of
        its points have, -1 where they differ, shape (C,), i32.
    """
    runtime.ensure_started()
    count = len(leaves)
    own, common = runtime.empty((count, MOST), np.int32), runtime.empty(count, np.int32)
    if count:
        _list_labels(runtime.upload(label), runtime.upload(leaves.points), own, common)
    return runtime.download(own)[:count], runtime.download(common)[:count]


def near_lists(leaves: Leaves, own: np.ndarray) -> np.ndarray:
    """Return which labels have points in every leaf or in a leaf that touches it.

    Args:
        leaves: The leaves.
        own: Labels of every leaf (`label_lists`), shape (C, MOST), i32.

    Returns:
        As ``own``.
    """
    runtime.ensure_started()
    near = runtime.empty(own.shape, np.int32)
    # Which leaves are stale does not matter here: nothing was seen before.
    _gather(
        runtime.upload(own),
        runtime.zeros(len(own), np.int32),
        runtime.upload(leaves.start),
        runtime.upload(leaves.neighbor),
        runtime.upload(own),
        runtime.zeros(int(own.max(initial=NONE)) + 1, np.int32),
        near,
        runtime.empty(len(own), np.int32),
    )
    return runtime.download(near)


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


class Labelling:
    """The choices of all points, kept from one time to the next: most leaves see nothing new."""

    def __init__(self, grid: Grid, leaves: Leaves, rule: Rule) -> None:
        runtime.ensure_started()
        n = grid.order.shape[0]
        self.grid, self.rule, self.count = grid, rule, len(leaves)
        # Where nothing is near, nothing is chosen.
        off = np.full((n, 3), 1e30, np.float32)
        off[:, 2] = 0.0
        self.choice = Choice(
            runtime.upload(np.full(n, NONE, np.int32)),
            runtime.upload(np.full(n, NONE, np.int32)),
            runtime.upload(off),
        )
        self._start, self._neighbor = runtime.upload(leaves.start), runtime.upload(leaves.neighbor)
        self._leaf = runtime.upload(leaves.points)
        self._surfaces = np.zeros((0, 10))
        # What every leaf saw the last time.
        self._near = runtime.upload(np.full((len(leaves), MOST), NONE, np.int32))
        self._own = np.full((len(leaves), MOST), NONE, np.int32)

    def choose(
        self,
        own: np.ndarray,
        surfaces: np.ndarray,
        *,
        passes: int = 1,
        closed: np.ndarray | None = None,
    ) -> np.ndarray:
        """Let every point choose its surface.

        Args:
            own: Surfaces with points in every leaf, shape (C, MOST), i32 (`own_lists`).
            surfaces: The surfaces (`surface_table`), shape (M, 10).
            passes: How many leaves beyond those in ``own`` a surface may reach.
            closed: Leaves whose points choose nothing, shape (C,), bool; None = no leaf.

        Returns:
            The surfaces that each leaf ended up with, as ``own``.
        """
        shut = np.zeros(self.count, np.int32) if closed is None else closed.astype(np.int32)
        device_shut, device_surfaces = runtime.upload(shut), runtime.upload(surfaces)
        changed = self._changed(surfaces)
        weights = self.rule._replace(noise=1.0 / self.rule.noise, tilt=1.0 / self.rule.tilt)
        for _ in range(passes):
            near, flag = runtime.empty(own.shape, np.int32), runtime.empty(len(own), np.int32)
            _gather(
                runtime.upload(own), device_shut, self._start, self._neighbor,
                self._near, runtime.upload(changed), near, flag,
            )  # fmt: skip
            self._near, changed = near, np.zeros_like(changed)
            stale = np.flatnonzero(runtime.download(flag)[: len(own)]).astype(np.int32)
            own = self._own.copy()
            if len(stale):
                held = runtime.upload(own)
                _choose(
                    tuple(weights), runtime.upload(stale), self.grid.point, self.grid.normal,
                    self._leaf, near, device_surfaces, held, *self.choice,
                )  # fmt: skip
                own = runtime.download(held)
            self._own = own
        return own

    def _changed(self, surfaces: np.ndarray) -> np.ndarray:
        """Return which surfaces are others than the last time, shape (M,), i32."""
        both = min(len(surfaces), len(self._surfaces))
        changed = np.ones(len(surfaces), np.int32)
        same = (surfaces[:both] == self._surfaces[:both]) | np.isnan(surfaces[:both])
        changed[:both] = ~same.all(axis=1)
        self._surfaces = surfaces
        return changed
