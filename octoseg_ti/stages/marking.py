"""Which points have others near them with a certain mark: a label, or the number of an edge."""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import box_gap, row
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, I32Rows, ti
from octoseg_ti.stages.leaves import Leaves

# What is near is not reached by way of a leaf that is farther off than this share of the reach,
# squared: its box is that of its points, which leave some of its cell free.
_ASIDE = 2.25


@ti.func
def _in_leaf(
    point_in: ti.template(), mark_in: ti.template(), leaf_in: ti.template(), box_in: ti.template(),
    c: ti.i32, i: ti.i32, wanted: ti.i32, limit: ti.f64,
):  # fmt: skip
    """Return the least squared distance from point i to a point of leaf c with the mark."""
    least = limit
    held = leaf_in[c, 2] <= wanted and wanted <= leaf_in[c, 3]
    if held and box_gap(box_in, c, row(point_in, i)) < limit:
        for j in range(leaf_in[c, 0], leaf_in[c, 0] + leaf_in[c, 1]):
            if mark_in[j] == wanted and j != i:
                least = ti.min(least, (row(point_in, j) - row(point_in, i)).norm_sqr())
    return least


@ti.kernel
def _nearest(
    entries: ti.i32,
    enough: ti.f64,
    # In:
    point_in: F64Rows,
    mark_in: I32Array,
    leaf_in: I32Rows,
    box_in: F64Rows,
    start_in: I32Array,
    neighbor_in: I32Array,
    entry_in: I32Rows,
    # Out:
    distance_inout: F64Array,
):
    """Look for the nearest marked point in the leaf of every entry and those that touch it.

    What is nearer than a share of the reach is near enough: then the search stops.
    """
    for e in range(entries):
        i = entry_in[e, 0]
        c = entry_in[e, 1]
        wanted = entry_in[e, 2]
        reach = distance_inout[e] * distance_inout[e]
        least = _in_leaf(point_in, mark_in, leaf_in, box_in, c, i, wanted, reach)
        k = start_in[c]
        while k < start_in[c + 1] and least >= enough * reach:
            least = _in_leaf(point_in, mark_in, leaf_in, box_in, neighbor_in[k], i, wanted, least)
            k += 1
        k = start_in[c]
        # The leaves beyond matter where those that touch are smaller than the reach.
        while k < start_in[c + 1] and least >= reach:
            b = neighbor_in[k]
            j = start_in[b]
            if box_gap(box_in, b, row(point_in, i)) > _ASIDE * reach:
                j = start_in[b + 1]
            while j < start_in[b + 1] and least >= reach:
                least = _in_leaf(
                    point_in, mark_in, leaf_in, box_in, neighbor_in[j], i, wanted, least
                )
                j += 1
            k += 1
        distance_inout[e] = ti.select(least < reach, ti.sqrt(least), ti.math.inf)


def nearest_marked(
    points: object,
    mark: np.ndarray,
    leaves: Leaves,
    point: np.ndarray,
    leaf: np.ndarray,
    wanted: np.ndarray,
    reach: np.ndarray,
    *,
    exact: bool = False,
) -> np.ndarray:
    """Return the distance to a point near by that carries a mark [mm], infinite if there is none.

    Leaves that touch that of a point are searched, and those that touch these while nothing was
    found.

    Args:
        points: Positions [mm], shape (n, 3) (kernel array).
        mark: Mark of every point, shape (n,), i32.
        leaves: The leaves.
        point: Point of every entry, shape (E,).
        leaf: Its leaf, shape (E,).
        wanted: The mark that is looked for, shape (E,).
        reach: Largest distance [mm], shape (E,).
        exact: Return the least distance, not just one within reach.
    """
    runtime.ensure_started()
    entries = len(point)
    if entries == 0:
        return np.zeros(0)
    distance = runtime.upload(reach.astype(np.float64))
    marks = mark.astype(np.int32)
    low, high = np.minimum.reduceat(marks, leaves.first), np.maximum.reduceat(marks, leaves.first)
    _nearest(
        entries,
        0.0 if exact else 1.0,
        points,
        runtime.upload(marks),
        runtime.upload(np.stack([leaves.first, leaves.count, low, high], axis=1)),
        runtime.upload(leaves.box),
        runtime.upload(leaves.start),
        runtime.upload(leaves.neighbor),
        runtime.upload(np.stack([point, leaf, wanted], axis=1).astype(np.int32)),
        distance,
    )
    return runtime.download(distance)[:entries]
