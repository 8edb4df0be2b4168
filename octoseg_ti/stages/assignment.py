"""Stage 7: edge points go back to the patch they fit, and cell labels to the points.

A point of an edge cell looks at the labelled cells around it and joins the one whose mean plane it
lies on. It looks one smallest cell away, then two, then three: an edge band is a cell or two wide.
"""

from typing import NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F32Rows, F64Rows, I32Array, I32Rows, ti
from octoseg_ti.stages.grid import Grid, find_node
from octoseg_ti.stages.moments import LEVEL, POINT
from octoseg_ti.types import NONE

_ROUNDS = 3


@ti.func
def _better(best: ti.template(), k: ti.i32, off: ti.f64, far: ti.f64, label: ti.f64) -> ti.i32:
    """Say whether a cell suits better: nearer plane, then nearer middle, then smaller label."""
    better = off < best[k, 0]
    if off == best[k, 0]:
        better = far < best[k, 1]
        if far == best[k, 1]:
            better = label < best[k, 2]
    return ti.cast(better, ti.i32)


@ti.kernel
def _join(
    reach: ti.i32,
    rule: ti.types.vector(3, ti.f64),
    finest: ti.f64,
    depth: ti.i32,
    shape: ti.types.vector(3, ti.i32),
    # In:
    point_in: F64Rows,
    child_in: I32Rows,
    root_in: I32Array,
    mean_in: F64Rows,
    cell_label_in: I32Array,
    run_in: I32Rows,
    # Out:
    best_inout: F64Rows,
):
    """Find, for runs of points in one box, the nearest mean plane among the cells at a distance.

    The rule holds the largest distance from the plane, that distance on a bend where the normals
    differ, and the cosine from which they do not. Ties go to the nearer cell, then to the smaller
    label, never to the order of the points.
    """
    for u in range(run_in.shape[0]):
        lo = run_in[u, 0]
        hi = run_in[u, 1]
        bend = run_in[u, 2]
        x = ti.min(ti.cast(point_in[lo, 0] * finest, ti.i32), (shape[0] << depth) - 1)
        y = ti.min(ti.cast(point_in[lo, 1] * finest, ti.i32), (shape[1] << depth) - 1)
        z = ti.min(ti.cast(point_in[lo, 2] * finest, ti.i32), (shape[2] << depth) - 1)
        before = -1
        for o in range(27):
            c = find_node(
                x + reach * (o // 9 - 1),
                y + reach * ((o // 3) % 3 - 1),
                z + reach * (o % 3 - 1),
                depth,
                shape,
                depth,
                root_in,
                child_in,
            )
            if c >= 0 and c != before and cell_label_in[c] >= 0:
                label = ti.cast(cell_label_in[c], ti.f64)
                normal = row(mean_in, c)
                middle = vec3(mean_in[c, POINT], mean_in[c, POINT + 1], mean_in[c, POINT + 2])
                limit = rule[0]
                if bend >= 0:  # nested: `and` would read the row of node -1
                    if ti.abs(row(mean_in, bend).dot(normal)) < rule[2]:
                        limit = rule[1]
                for i in range(lo, hi):
                    k = run_in[u, 3] + i - lo
                    d = row(point_in, i) - middle
                    off = ti.abs(d.dot(normal))
                    far = d.norm_sqr()
                    if off <= limit and _better(best_inout, k, off, far, label) == 1:
                        best_inout[k, 0] = off
                        best_inout[k, 1] = far
                        best_inout[k, 2] = label
            before = c


def _runs(grid: Grid, index: np.ndarray, bend: np.ndarray | None) -> np.ndarray:
    """Return the runs of points that lie in one smallest box.

    Args:
        grid: The sparse grid.
        index: Sorted points in question, ascending, shape (q,).
        bend: Node of the bend that each of them is on, -1 = none, shape (q,); None = none at all.

    Returns:
        First point, end, bend, and place of the first point in ``index``, shape (r, 4), i32.
    """
    box = runtime.download(grid.key)[index]
    new = np.ones(len(index), bool)
    new[1:] = (index[1:] - index[:-1] > 1) | (box[1:] != box[:-1])
    first = np.flatnonzero(new)
    last = np.append(first[1:], len(index)) - 1
    runs = np.empty((len(first), 4), np.int32)
    runs[:, 0], runs[:, 1], runs[:, 3] = index[first], index[last] + 1, first
    runs[:, 2] = NONE if bend is None else bend[first]
    return runs


@ti.kernel
def _scatter(
    # In:
    order_in: I32Array,
    row_in: I32Array,
    leaf_in: I32Rows,
    label_in: I32Array,
    name_in: I32Array,
    point_in: F64Rows,
    normal_in: F64Rows,
    # Out:
    label_out: I32Array,
    level_out: I32Array,
    edge_out: I32Array,
    point_out: F64Rows,
    normal_out: F32Rows,
):
    """Write label, level and edge class, position and normal of all points to their rows."""
    for c in range(leaf_in.shape[0]):
        for i in range(leaf_in[c, 0], leaf_in[c, 1]):
            r = row_in[order_in[i]]
            label = label_in[i]
            label_out[r] = name_in[label] if label >= 0 else -1
            level_out[r] = leaf_in[c, 2]
            edge_out[r] = leaf_in[c, 3]
    for i in row_in:
        r = row_in[i]
        for k in ti.static(range(3)):
            point_out[r, k] = point_in[i, k]
            normal_out[r, k] = ti.cast(normal_in[i, k], ti.f32)


class Rows(NamedTuple):
    """What is known of every row of the input; ``N`` rows."""

    points: np.ndarray
    """Positions [mm], shape (N, 3), f64; NaN for rows of no point."""
    normals: np.ndarray
    """Unit normals, shape (N, 3), f32; zero for rows of no point."""
    labels: np.ndarray
    """Patches, shape (N,), i32; -1 = none."""
    level: np.ndarray
    """Levels, shape (N,), i8; -1 = in no cell."""
    edge: np.ndarray
    """`EdgeClass`, shape (N,), u8."""


def to_rows(
    grid: Grid,
    leaves: np.ndarray,
    edge: np.ndarray,
    label: np.ndarray,
    name: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    row: np.ndarray,
    left_out: np.ndarray,
) -> Rows:
    """Bring what is known of the points into the order of the input.

    Args:
        grid: The sparse grid.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        edge: `EdgeClass` of every leaf, shape (C,).
        label: Label of every sorted point, shape (n,), i32.
        name: New name of every label, shape (K,), i32.
        points: Positions of the points of the grid as they were given [mm], shape (n, 3), f64.
        normals: Their unit normals, shape (n, 3), f64.
        row: Input row of every one of these points, shape (n,), i64.
        left_out: The other rows of the input, shape (N - n,), i64.

    Returns:
        The rows.
    """
    runtime.ensure_started()
    leaf = np.empty((len(leaves), 4), np.int32)
    leaf[:, 0] = grid.first[leaves]
    leaf[:, 1] = leaf[:, 0] + grid.holds[leaves]
    leaf[:, 2] = runtime.download(grid.node)[leaves, LEVEL]
    leaf[:, 3] = edge
    rows = len(row) + len(left_out)
    labels, levels, edges = (runtime.empty(rows, np.int32) for _ in range(3))
    placed = runtime.empty((rows, 3), np.float64)
    turned = runtime.empty((rows, 3), np.float32)
    _scatter(
        grid.order,
        runtime.upload(row.astype(np.int32)),
        runtime.upload(leaf),
        runtime.upload(label),
        runtime.upload(name if len(name) else np.full(1, NONE, np.int32)),
        runtime.upload(points),
        runtime.upload(normals),
        labels,
        levels,
        edges,
        placed,
        turned,
    )
    found = Rows(
        points=runtime.download(placed),
        normals=runtime.download(turned),
        labels=runtime.download(labels),
        level=runtime.download(levels).astype(np.int8),
        edge=runtime.download(edges).astype(np.uint8),
    )
    for array, value in zip(found, (np.nan, 0.0, NONE, -1, 0), strict=True):
        array[left_out] = value
    return found


def points_of_leaves(grid: Grid, leaves: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Spread a value of every leaf over its points, in Morton order.

    Args:
        grid: The sparse grid.
        leaves: Nodes that are leaves, in Morton order, shape (C,).
        values: A value of every leaf, shape (C,).

    Returns:
        The value of every sorted point, shape (n,).
    """
    return np.repeat(values, grid.holds[leaves])


def points_in(grid: Grid, cells: np.ndarray) -> np.ndarray:
    """Return the sorted points in some cells, cell after cell, i32."""
    holds = grid.holds[cells]
    ends = np.cumsum(holds, dtype=np.int32)
    offset = grid.first[cells] - (ends - holds)
    return np.arange(holds.sum(), dtype=np.int32) + np.repeat(offset, holds)


def assign_points(
    grid: Grid,
    leaves: np.ndarray,
    cell_label: np.ndarray,
    *,
    bend: np.ndarray,
    limit: float,
    tight: float,
    angle: float,
    only: np.ndarray | None = None,
    rounds: int = _ROUNDS,
) -> np.ndarray:
    """Give the points without a label to the patch whose surface they lie on.

    Args:
        grid: The sparse grid.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        cell_label: Label of every node, -1 for edge cells and for those of no patch, shape (M,),
            i32.
        bend: Nodes on a bend, shape (M,), bool. Their points join a patch when they lie on its
            plane, or when they are near it and its normal agrees with that of their cell.
        limit: Largest distance of a point from the mean plane of the cell whose patch it joins
            [mm].
        tight: Largest distance from the plane on a bend where the normals do not agree [mm].
        only: Nodes whose points are looked at, shape (M,), bool; None = all.
        rounds: How many smallest cells away to look at most.
        angle: Largest angle between the normals of a bend and of the cell whose patch it joins
            [rad].

    Returns:
        Label of every sorted point, -1 where no patch fits, shape (n,), i32.
    """
    runtime.ensure_started()
    label = np.ascontiguousarray(points_of_leaves(grid, leaves, cell_label[leaves]), np.int32)
    if not np.any(cell_label >= 0):
        return label
    asked = cell_label[leaves] < 0
    if only is not None:
        asked &= only[leaves]
    asked = leaves[asked]
    index = points_in(grid, asked)
    on_bend = None
    if bend.any():
        on_bend = np.repeat(np.where(bend[asked], asked, NONE).astype(np.int32), grid.holds[asked])
    device_cell = runtime.upload(cell_label.astype(np.int32))
    for r in range(1, rounds + 1):
        if len(index) == 0:
            break
        best = runtime.upload(np.full((len(index), 3), np.inf))
        _join(
            r,
            (limit, tight, float(np.cos(angle))),
            2.0**grid.depth / grid.size,
            grid.depth,
            grid.shape,
            grid.point,
            grid.child,
            grid.root,
            grid.mean,
            device_cell,
            runtime.upload(_runs(grid, index, on_bend)),
            best,
        )
        name = runtime.download(best)[:, 2]
        found = np.isfinite(name)
        label[index[found]] = name[found].astype(np.int32)
        index = index[~found]
        on_bend = None if on_bend is None else on_bend[~found]
    return label


def claimed_share(
    grid: Grid, leaves: np.ndarray, label: np.ndarray, group: np.ndarray
) -> np.ndarray:
    """Return the share of the points of every group that got a label.

    Args:
        grid: The sparse grid.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        label: Label of every sorted point, shape (n,), i32.
        group: Number of the group of every node, 0..G-1, -1 = none, shape (M,), i32.

    Returns:
        Share of labelled points, 0 for an empty group, shape (G,), f64.
    """
    groups = int(group.max(initial=NONE)) + 1
    inside = leaves[group[leaves] >= 0]
    if len(inside) == 0:
        return np.zeros(groups)
    count = grid.holds[inside]
    begin = np.cumsum(count) - count
    labelled = np.add.reduceat((label[points_in(grid, inside)] >= 0).astype(np.int32), begin)
    total = np.bincount(group[inside], weights=count, minlength=groups)
    found = np.bincount(group[inside], weights=labelled, minlength=groups)
    return found / np.maximum(total, 1)
