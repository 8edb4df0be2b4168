"""Stage 6: flood fill over touching cells whose mean normals agree (section 3.4).

The homogeneity test is symmetric, so growing from seeds gives the connected components of the
graph of cells. They are found with union-find, in parallel and independent of any order.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, ti
from octoseg_ti.device.unionfind import find, unite
from octoseg_ti.stages.adjacency import Adjacency
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.moments import POINT
from octoseg_ti.types import NONE

# A face has at least this share of its area in cells that touch no larger face.
_CORE = 0.5


@ti.func
def _agree(
    a: ti.i32,
    b: ti.i32,
    signed: ti.i32,
    mean: ti.template(),
    cosine: ti.f64,
    chord: ti.f64,
    slack: ti.f64,
) -> ti.i32:
    """Say whether two cells belong together: normals within the angle, chord along the surface."""
    na = row(mean, a)
    nb = row(mean, b)
    if signed == 0 and na.dot(nb) < 0.0:
        nb = -nb
    between = vec3(
        mean[b, POINT] - mean[a, POINT],
        mean[b, POINT + 1] - mean[a, POINT + 1],
        mean[b, POINT + 2] - mean[a, POINT + 2],
    )
    # On a smooth surface the chord is perpendicular to the mean of the two normals, whatever the
    # curvature; across a step it is not.
    lift = 0.5 * ti.abs(between.dot(na + nb))
    return ti.cast(na.dot(nb) >= cosine and lift <= chord * between.norm() + slack, ti.i32)


@ti.kernel
def _flood(
    cosine: ti.f64,
    chord: ti.f64,
    slack: ti.f64,
    signed: ti.i32,
    # In:
    count_in: I32Array,
    neighbor_in: I32Rows,
    mean_in: F64Rows,
    # Out:
    parent_inout: I32Array,
    group_out: I32Array,
):
    """Unite every leaf with the touching leaves that agree with it, then write its root."""
    for c in parent_inout:
        if parent_inout[c] >= 0:
            for k in range(count_in[c]):
                b = neighbor_in[c, k]
                if parent_inout[b] >= 0:
                    if _agree(c, b, signed, mean_in, cosine, chord, slack) == 1:
                        unite(parent_inout, c, b)
    for c in parent_inout:
        group_out[c] = parent_inout[c]
        if parent_inout[c] >= 0:
            group_out[c] = find(parent_inout, c)


@ti.kernel
def _mark_borders(
    # In:
    count_in: I32Array,
    neighbor_in: I32Rows,
    group_in: I32Array,
    size_in: I32Array,
    # Out:
    border_inout: I32Array,
):
    """Mark the leaves that touch a leaf of a larger group."""
    for c in group_in:
        if group_in[c] >= 0:
            for k in range(count_in[c]):
                b = neighbor_in[c, k]
                if group_in[b] >= 0 and group_in[b] != group_in[c]:
                    mine, other = size_in[group_in[c]], size_in[group_in[b]]
                    if other > mine:
                        border_inout[c] = 1
                    elif other < mine:
                        border_inout[b] = 1


def flood_fill(
    grid: Grid,
    touching: Adjacency,
    leaf: np.ndarray,
    *,
    homogeneity: float,
    chord: float = float("inf"),
    slack: float = 0.0,
) -> np.ndarray:
    """Merge touching cells whose mean normals agree (S4-S7).

    Cells touch when their closed boxes share a corner, an edge or a face, whatever their sizes.

    Args:
        grid: The sparse grid.
        touching: Its touching pairs of leaves.
        leaf: Which nodes take part (leaves that are no edge cells), shape (M,), bool.
        homogeneity: Largest angle between the mean normals of merged cells [rad].
        chord: Largest sine of the angle between the line through the mean points of two cells and
            the surface; infinite = off (the paper).
        slack: What the noise adds to that distance [mm].

    Returns:
        Group of every node, named by the first of its nodes, -1 for nodes that take no part;
        shape (M,), i32.
    """
    runtime.ensure_started()
    parent = np.where(leaf, np.arange(grid.count, dtype=np.int32), NONE).astype(np.int32)
    group = runtime.empty(grid.count, np.int32)
    _flood(
        float(np.cos(homogeneity)),
        min(chord, 1e300),
        slack,
        int(grid.signed),
        touching.count,
        touching.neighbor,
        grid.mean,
        runtime.upload(parent),
        group,
    )
    return runtime.download(group)


def inner_cells(touching: Adjacency, group: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the leaves of groups that touch no leaf of a larger group, shape (M,), bool.

    Args:
        touching: Touching pairs of leaves.
        group: Group of every node, -1 = none, shape (M,), i32; only leaves have one.
        size: Points of every group, by its name, shape (M,).
    """
    runtime.ensure_started()
    border = runtime.zeros(len(group), np.int32)
    _mark_borders(
        touching.count,
        touching.neighbor,
        runtime.upload(group),
        runtime.upload(size.astype(np.int32)),
        border,
    )
    return (group >= 0) & (runtime.download(border) == 0)


def number_groups(grid: Grid, group: np.ndarray, min_points: int) -> np.ndarray:
    """Number the groups by size, largest first; small groups get -1.

    Args:
        grid: The sparse grid.
        group: Group of every node, named by its first node, -1 = none, shape (M,), i32.
        min_points: A group with fewer points is no patch.

    Returns:
        Label of every node, shape (M,), i32. Groups of equal size are ordered by their first node,
        which depends on where they are, not on the order of the points.
    """
    size = group_sizes(grid, group)
    names = np.flatnonzero(size >= max(1, min_points))
    names = names[np.argsort(-size[names], kind="stable")]
    label = np.full(grid.count + 1, NONE, np.int32)
    label[names] = np.arange(len(names), dtype=np.int32)
    return label[group]


def group_sizes(grid: Grid, group: np.ndarray) -> np.ndarray:
    """Return the points of every group, by its name, shape (M,), f64 (whole numbers)."""
    return np.bincount(group + 1, weights=grid.holds, minlength=grid.count + 1)[1:]


def strips(grid: Grid, touching: Adjacency, group: np.ndarray) -> np.ndarray:
    """Return the nodes of groups that may be strips along a larger one, shape (M,), bool.

    Along an edge the normals of two faces are averaged; cells that hold only such points agree with
    each other and form a group of their own. Nearly all its cells touch a larger group.

    Args:
        grid: The sparse grid.
        touching: Its touching pairs of leaves.
        group: Group of every node, named by its first node, -1 = none, shape (M,), i32.
    """
    inner = inner_cells(touching, group, group_sizes(grid, group))
    area = grid.edge_length**2
    inside = group >= 0
    whole = np.bincount(group[inside], weights=area[inside], minlength=grid.count)
    core = np.bincount(group[inner], weights=area[inner], minlength=grid.count)
    return inside & (core < _CORE * whole)[np.where(inside, group, 0)]
