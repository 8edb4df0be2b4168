"""Which cells of the sparse grid touch: found once, used by every stage that walks over the cells.

Two cells touch when their closed boxes share a corner, an edge or a face, whatever their sizes.
Nodes are numbered level by level, so a smaller number is a coarser cell or one of the same size:
the finer (or later) cell of a pair finds the other by looking up the 26 boxes of its own size
around it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import I32Array, I32Rows, ti
from octoseg_ti.stages.grid import Grid, find_node
from octoseg_ti.stages.moments import LEVEL, X, Y, Z

_MOST = 26


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Adjacency:
    """The touching leaves of every leaf that have a smaller number (kernel arrays)."""

    count: Any
    """How many there are, shape (M,), i32; 0 for nodes that are no leaves."""
    neighbor: Any
    """Their numbers, the first ``count`` of a row, shape (M, 26), i32."""


@ti.kernel
def _find_touching(
    depth: ti.i32,
    shape: ti.types.vector(3, ti.i32),
    # In:
    node_in: I32Rows,
    child_in: I32Rows,
    root_in: I32Array,
    # Out:
    count_out: I32Array,
    neighbor_out: I32Rows,
):
    """Write the earlier leaves that touch each leaf, each of them once."""
    for c in count_out:
        found = 0
        if child_in[c, 0] == -2:
            level = node_in[c, LEVEL]
            at = ti.Vector([node_in[c, X], node_in[c, Y], node_in[c, Z]])
            # The boxes around a cell lie in its parent and in seven boxes of the parent's size, on
            # the side where the cell is: these are looked up, the rest is one step in the table.
            side = 2 * (at & 1) - 1
            above = ti.max(level - 1, 0)
            up = at >> ti.min(level, 1)
            parents = ti.Vector([-1] * 8)
            for o in range(8):
                p = up + side * ti.Vector([o >> 2, (o >> 1) & 1, o & 1])
                if level > 0:
                    parents[o] = find_node(p[0], p[1], p[2], above, shape, depth, root_in, child_in)
            for o in range(27):
                step = ti.Vector([o // 9 - 1, (o // 3) % 3 - 1, o % 3 - 1])
                box = at + step
                b = -1
                if level == 0:
                    if (
                        box[0] >= 0
                        and box[1] >= 0
                        and box[2] >= 0
                        and box[0] < shape[0]
                        and box[1] < shape[1]
                        and box[2] < shape[2]
                    ):
                        b = root_in[(box[0] * shape[1] + box[1]) * shape[2] + box[2]]
                else:
                    beyond = ti.cast(step == side, ti.i32)
                    b = parents[(beyond[0] << 2) | (beyond[1] << 1) | beyond[2]]
                    if b >= 0 and child_in[b, 0] != -2:
                        low = box & 1
                        b = child_in[b, (low[0] << 2) | (low[1] << 1) | low[2]]
                if b >= 0 and b < c and child_in[b, 0] == -2:
                    known = 0
                    if node_in[b, LEVEL] < level:  # a coarse cell covers several of the boxes
                        for k in range(found):
                            if neighbor_out[c, k] == b:
                                known = 1
                    if known == 0:
                        neighbor_out[c, found] = b
                        found += 1
        count_out[c] = found


def find_touching(grid: Grid) -> Adjacency:
    """Return the touching pairs of leaves of a grid."""
    runtime.ensure_started()
    count = runtime.empty(grid.count, np.int32)
    neighbor = runtime.empty((grid.count, _MOST), np.int32)
    _find_touching(grid.depth, grid.shape, grid.node, grid.child, grid.root, count, neighbor)
    return Adjacency(count=count, neighbor=neighbor)
