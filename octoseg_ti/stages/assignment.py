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
    reach: ti.f64,
    limit: ti.f64,
    cosine: ti.f64,
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
    """Give points without a label that of the nearest mean plane among the cells at a distance."""
    for t in range(todo_in.shape[0]):
        i = todo_in[t, 0]
        bend = todo_in[t, 1]
        p = row(point_in, i)
        best = limit
        chosen = -1
        nearest = 0.0
        for o in range(27):
            q = p + reach * vec3(o // 9 - 1, (o // 3) % 3 - 1, o % 3 - 1)
            x = ti.cast(ti.floor(q[0] * finest), ti.i32)
            y = ti.cast(ti.floor(q[1] * finest), ti.i32)
            z = ti.cast(ti.floor(q[2] * finest), ti.i32)
            c = find_node(x, y, z, depth, shape, depth, root_in, child_in)
            if c >= 0 and cell_label_in[c] >= 0:
                d = p - vec3(mean_in[c, POINT], mean_in[c, POINT + 1], mean_in[c, POINT + 2])
                off = ti.abs(d.dot(row(mean_in, c)))
                far = d.norm()
                if bend >= 0 and ti.abs(row(mean_in, bend).dot(row(mean_in, c))) < cosine:
                    off = limit
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
    angle: float,
) -> np.ndarray:
    """Give the points without a label to the patch whose surface they lie on.

    Args:
        grid: The sparse grid.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        cell_label: Label of every node, -1 for edge cells and for those of no patch, shape (M,), i32.
        bend: Nodes on a bend, shape (M,), bool: their normals are good, so they must agree too.
        reach: How far to look in the first round [mm], about the smallest cell.
        limit: Largest distance of a point from the mean plane of the cell whose patch it joins [mm].
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
    for r in range(1, _ROUNDS + 1):
        todo = np.flatnonzero(label < 0).astype(np.int32)
        if len(todo) == 0:
            break
        device_label = runtime.upload(label)
        _join(
            r * reach,
            limit,
            float(np.cos(angle)),
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


def unclaimed_cells(grid: Grid, leaves: np.ndarray, label: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Say which nodes kept most of their points without a label.

    Args:
        grid: The sparse grid.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        label: Label of every sorted point, shape (n,), i32.
        nodes: The nodes in question, shape (M,), bool.

    Returns:
        Nodes in question whose points are mostly unlabelled, shape (M,), bool.
    """
    node = runtime.download(grid.node)
    free = np.add.reduceat((label < 0).astype(np.int32), node[leaves, LO])
    mostly = np.zeros(grid.count, bool)
    mostly[leaves] = 2 * free > node[leaves, HI] - node[leaves, LO]
    return mostly & nodes
