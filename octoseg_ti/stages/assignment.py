"""Stage 7: edge points go back to the patch they fit, and cell labels to the points.

A point of an edge cell looks at the labelled cells around it and joins the one whose mean plane it
lies on. It looks one smallest cell away, then two, then three: an edge band is a cell or two wide.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, ti
from octoseg_ti.stages.grid import Grid, find_node
from octoseg_ti.stages.moments import HI, LO, POINT
from octoseg_ti.types import NONE

_ROUNDS = 3


@ti.kernel
def _join(
    rule: ti.types.vector(4, ti.f64),
    finest: ti.f64,
    depth: ti.i32,
    shape: ti.types.vector(3, ti.i32),
    # In:
    point_in: F64Rows,
    child_in: I32Rows,
    root_in: I32Array,
    mean_in: F64Rows,
    cell_label_in: I32Array,
    todo_in: I32Rows,
    # Out:
    label_inout: I32Array,
):
    """Give points without a label that of the nearest mean plane among the cells at a distance.

    The rule holds the reach, the largest distance from the plane, that distance on a bend where the
    normals differ, and the cosine from which they do not.
    """
    for t in range(todo_in.shape[0]):
        i = todo_in[t, 0]
        bend = todo_in[t, 1]
        p = row(point_in, i)
        best = rule[1]
        chosen = -1
        nearest = 0.0
        for o in range(27):
            q = p + rule[0] * vec3(o // 9 - 1, (o // 3) % 3 - 1, o % 3 - 1)
            x = ti.cast(ti.floor(q[0] * finest), ti.i32)
            y = ti.cast(ti.floor(q[1] * finest), ti.i32)
            z = ti.cast(ti.floor(q[2] * finest), ti.i32)
            c = find_node(x, y, z, depth, shape, depth, root_in, child_in)
            if c >= 0 and cell_label_in[c] >= 0:
                d = p - vec3(mean_in[c, POINT], mean_in[c, POINT + 1], mean_in[c, POINT + 2])
                off = ti.abs(d.dot(row(mean_in, c)))
                far = d.norm()
                if bend >= 0 and off > rule[2]:
                    if ti.abs(row(mean_in, bend).dot(row(mean_in, c))) < rule[3]:
                        off = rule[1]
                # Ties go to the nearer cell, then to the smaller label: never to the order.
                if off < best or (off == best and chosen >= 0 and far < nearest):
                    best = off
                    chosen = cell_label_in[c]
                    nearest = far
        if chosen >= 0:
            label_inout[i] = chosen


def points_of_leaves(grid: Grid, leaves: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Spread a value of every leaf over its points, in Morton order.

    Args:
        grid: The sparse grid.
        leaves: Nodes that are leaves, in Morton order, shape (C,).
        values: A value of every leaf, shape (C,).

    Returns:
        The value of every sorted point, shape (n,).
    """
    node = runtime.download(grid.node)
    return np.repeat(values, node[leaves, HI] - node[leaves, LO])


def assign_points(
    grid: Grid,
    leaves: np.ndarray,
    cell_label: np.ndarray,
    *,
    bend: np.ndarray,
    reach: float,
    limit: float,
    tight: float,
    angle: float,
    only: np.ndarray | None = None,
) -> np.ndarray:
    """Give the points without a label to the patch whose surface they lie on.

    Args:
        grid: The sparse grid.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        cell_label: Label of every node, -1 for edge cells and for those of no patch, shape (M,), i32.
        bend: Nodes on a bend, shape (M,), bool. Their points join a patch when they lie on its plane,
            or when they are near it and its normal agrees with that of their cell.
        reach: How far to look in the first round [mm], about the smallest cell.
        limit: Largest distance of a point from the mean plane of the cell whose patch it joins [mm].
        tight: Largest distance from the plane on a bend where the normals do not agree [mm].
        only: Nodes whose points are looked at, shape (M,), bool; None = all.
        angle: Largest angle between the normals of a bend and of the cell whose patch it joins [rad].

    Returns:
        Label of every sorted point, -1 where no patch fits, shape (n,), i32.
    """
    runtime.ensure_started()
    label = np.ascontiguousarray(points_of_leaves(grid, leaves, cell_label[leaves]), np.int32)
    if not np.any(cell_label >= 0):
        return label
    bend_of = points_of_leaves(grid, leaves, np.where(bend[leaves], leaves, NONE).astype(np.int32))
    device_cell = runtime.upload(cell_label.astype(np.int32))
    asked = label < 0
    if only is not None:
        asked &= points_of_leaves(grid, leaves, only[leaves])
    for r in range(1, _ROUNDS + 1):
        todo = np.flatnonzero(asked & (label < 0)).astype(np.int32)
        if len(todo) == 0:
            break
        device_label = runtime.upload(label)
        _join(
            ti.Vector([r * reach, limit, tight, float(np.cos(angle))]),
            2.0**grid.depth / grid.size,
            grid.depth,
            ti.Vector(grid.shape),
            grid.point,
            grid.child,
            grid.root,
            grid.mean,
            device_cell,
            runtime.upload(np.stack([todo, bend_of[todo]], axis=1)),
            device_label,
        )
        label = runtime.download(device_label)
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
    of_point = points_of_leaves(grid, leaves, group[leaves])
    groups = int(group.max(initial=NONE)) + 1
    total = np.bincount(of_point[of_point >= 0], minlength=groups)
    labelled = np.bincount(of_point[(of_point >= 0) & (label >= 0)], minlength=groups)
    return labelled / np.maximum(total, 1)
