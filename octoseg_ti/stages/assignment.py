"""Stage 7: edge points go back to the patch they fit, and cell labels to the points.

A point of an edge cell looks at the labelled cells around it and joins the one whose mean plane it
lies on. It looks one smallest cell away, then two, then three: an edge band is a cell or two wide.
"""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.morton import compacted
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, I64Array, ti
from octoseg_ti.stages.grid import Grid, find_node
from octoseg_ti.stages.moments import HI, LEVEL, LO, POINT
from octoseg_ti.types import NONE

_ROUNDS = 3
_BEND = -2  # the label of cells that have none and lie on a bend

ivec2: Any = ti.types.vector(2, ti.i32)
ivec3: Any = ti.types.vector(3, ti.i32)
ivec4: Any = ti.types.vector(4, ti.i32)
near_cells: Any = ti.types.vector(27, ti.i32)


@ti.func
def _collect(
    at: ivec3,
    level: ti.i32,
    reach: ti.i32,
    boxes: ivec4,
    root: ti.template(),
    child: ti.template(),
    cell_label: ti.template(),
    near: ti.template(),
) -> ti.i32:
    """List the cells with a label that hold the 27 smallest boxes at a distance, and count them.

    The cell of the box itself, so many levels above it, has none.
    """
    shape = ivec3(boxes[0], boxes[1], boxes[2])
    count = 0
    before = -1
    for o in range(27):
        box = at + reach * ivec3(o // 9 - 1, (o // 3) % 3 - 1, o % 3 - 1)
        if ((box ^ at) >> level).any():
            c = find_node(box[0], box[1], box[2], boxes[3], shape, boxes[3], root, child)
            if c >= 0 and c != before:
                if cell_label[c] >= 0:
                    near[count] = c
                    count += 1
            before = c
    return count


@ti.func
def _choose(
    p: vec3,
    bend: ti.i32,
    rule: vec3,
    count: ti.i32,
    near: ti.template(),
    mean: ti.template(),
    cell_label: ti.template(),
) -> ti.i32:
    """Return the label of the cell whose mean plane is nearest to a point, -1 if none is near.

    Ties go to the nearer cell, then to the smaller label, never to the order of the points.
    """
    best_off, best_far, best = ti.math.inf, ti.math.inf, -1
    for k in range(count):
        c = near[k]
        normal = row(mean, c)
        limit = rule[0]
        if bend >= 0:  # nested: `and` would read the row of node -1
            if ti.abs(row(mean, bend).dot(normal)) < rule[2]:
                limit = rule[1]
        d = p - vec3(mean[c, POINT], mean[c, POINT + 1], mean[c, POINT + 2])
        off = ti.abs(d.dot(normal))
        if off <= limit and off <= best_off:
            far = d.norm_sqr()
            nearer = far < best_far or (far == best_far and cell_label[c] < best)
            if off < best_off or nearer:
                best_off, best_far, best = off, far, cell_label[c]
    return best


@ti.kernel
def _join(
    loops: ivec2,
    rule: vec3,
    boxes: ivec4,
    # In:
    asked_in: I32Array,
    key_in: I64Array,
    point_in: F64Rows,
    node_in: I32Rows,
    child_in: I32Rows,
    root_in: I32Array,
    mean_in: F64Rows,
    cell_label_in: I32Array,
    # Out:
    label_inout: I32Array,
):
    """Label the points of some cells, run by run of points in one smallest box.

    The loops hold how many rounds of cells are looked at, and the stride over the cells asked for.
    The rule holds the largest distance from the plane, that distance on a bend where the normals
    differ, and the cosine from which they do not.
    """
    rounds, stride = loops[0], loops[1]
    for u in range(asked_in.shape[0] * stride):
        if u % stride == 0:
            own = asked_in[u // stride]
            level = boxes[3] - node_in[own, LEVEL]
            bend = ti.select(cell_label_in[own] == _BEND, own, -1)
            near = near_cells(-1)
            end = node_in[own, HI]
            lo = node_in[own, LO]
            while lo < end:
                key = key_in[lo]
                at = ivec3(compacted(key, 0), compacted(key, 1), compacted(key, 2))
                hi = lo
                left = 1
                reach = 1
                while left > 0 and reach <= rounds:
                    left = 0
                    count = _collect(
                        at, level, reach, boxes, root_in, child_in, cell_label_in, near
                    )
                    hi = lo
                    while hi < end and key_in[ti.min(hi, end - 1)] == key:
                        if label_inout[hi] < 0:
                            p = row(point_in, hi)
                            found = _choose(p, bend, rule, count, near, mean_in, cell_label_in)
                            label_inout[hi] = found
                            left += ti.cast(found < 0, ti.i32)
                        hi += 1
                    reach += 1
                lo = hi


def places_of_rows(grid: Grid, row: np.ndarray | None, rows: int) -> np.ndarray:
    """Return the sorted point of every row of the input, -1 for rows of no point; shape (N,).

    Args:
        grid: The sparse grid.
        row: Input row of every one of its points, as they were given, shape (n,); None = all rows
            in their order.
        rows: Number of rows N.
    """
    place: np.ndarray = runtime.download(grid.place).astype(np.intp)
    if row is None:
        return place
    of_row = np.full(rows, NONE, np.intp)
    of_row[row] = place
    return of_row


def in_rows(values: np.ndarray, place: np.ndarray, missing: int) -> np.ndarray:
    """Bring a value of every sorted point to the rows of the input.

    Args:
        values: The values, shape (n,).
        place: Sorted point of every row, -1 = none (`places_of_rows`), shape (N,).
        missing: Value of the rows of no point.

    Returns:
        A value of every row, shape (N,), of the same type.
    """
    return np.append(values, values.dtype.type(missing)).take(place)


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
    own = cell_label[leaves]
    label = np.ascontiguousarray(points_of_leaves(grid, leaves, own), np.int32)
    asked = own < 0 if only is None else (own < 0) & only[leaves]
    if not asked.any() or not np.any(own >= 0):
        return label
    label = runtime.upload(label)
    _join(
        (rounds, runtime.stride_of(int(np.count_nonzero(asked)))),
        (limit, tight, float(np.cos(angle))),
        (*grid.shape, grid.depth),
        runtime.upload(leaves[asked].astype(np.int32)),
        grid.key,
        grid.point,
        grid.node,
        grid.child,
        grid.root,
        grid.mean,
        runtime.upload(np.where(bend & (cell_label < 0), _BEND, cell_label).astype(np.int32)),
        label,
    )
    return runtime.download(label)


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
