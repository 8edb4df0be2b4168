"""The grid of the kernels as plain cells, to compare it with the plain one."""

from __future__ import annotations

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.stages.adjacency import find_touching
from octoseg_ti.stages.grid import Grid, build_grid
from octoseg_ti.stages.leaves import Leaves, Samples, leaf_graph
from octoseg_ti.stages.moments import HI, LEVEL, LO, NORMAL, POINT, X, Z
from reference.clouds import random_surface
from reference.graph import Leaf


def tables(grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tables of the nodes: integers, daughters, means."""
    return tuple(
        runtime.download(table)[: grid.count] for table in (grid.node, grid.child, grid.mean)
    )  # type: ignore[return-value]


def members(grid: Grid) -> list[np.ndarray]:
    """Return the points of every node, as sorted rows of the input."""
    node, _, _ = tables(grid)
    order = runtime.download(grid.order)
    return [np.sort(order[lo:hi]) for lo, hi in node[:, [LO, HI]]]


def leaf_nodes(grid: Grid) -> np.ndarray:
    """Return the nodes that are leaves, in Morton order."""
    node, child, _ = tables(grid)
    leaves = np.flatnonzero(child[:, 0] == -2)
    return leaves[np.argsort(node[leaves, LO], kind="stable")]


def leaves_of(grid: Grid) -> list[Leaf]:
    """Return the leaves with their means."""
    node, _, mean = tables(grid)
    return [
        Leaf(
            node=int(i),
            level=int(node[i, LEVEL]),
            place=node[i, X : Z + 1].astype(np.int64),
            count=int(node[i, HI] - node[i, LO]),
            normal=mean[i, NORMAL : NORMAL + 3],
            point=mean[i, POINT : POINT + 3],
        )
        for i in leaf_nodes(grid)
    ]


def as_array(values: dict[int, int], count: int) -> np.ndarray:
    """Return a value of every node, -1 where there is none."""
    array = np.full(count, -1, np.int32)
    for node, value in values.items():
        array[node] = value
    return array


def touching_leaves(grid: Grid) -> Leaves:
    """Return the graph of the leaves of a grid."""
    node = leaf_nodes(grid)
    node = node[np.argsort(grid.first[node], kind="stable")]
    return leaf_graph(grid, node.astype(np.int32), find_touching(grid))


def surface_leaves(seed: int, n: int = 1500) -> tuple[Grid, Leaves]:
    """Return the grid of a random surface, and its leaves."""
    points, normals = random_surface(seed, n)
    grid = build_grid(points, normals, tolerance=0.05, min_cell=0.7, min_points=3)
    return grid, touching_leaves(grid)


def samples_of(points: np.ndarray, normals: np.ndarray) -> Samples:
    """Return points as samples, each of a leaf of its own."""
    n = len(points)
    return Samples(
        index=np.arange(n, dtype=np.int32),
        leaf=np.arange(n, dtype=np.int32),
        point=points,
        normal=normals,
        weight=np.ones(n),
    )
