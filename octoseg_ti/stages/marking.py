"""Which points have others near them with a certain mark: a label, or the number of an edge."""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import box_gap, row
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, I32Rows, I64Rows, ti
from octoseg_ti.stages.leaves import Leaves

# What is near is not reached by way of a leaf that is farther off than this share of the reach,
# squared: its box is that of its points, which leave some of its cell free.
_ASIDE = 2.25


@ti.func
def _as_set(mark: ti.i32) -> ti.i64:
    """Return a set of one mark, as bits; marks that differ by 64 are one to it."""
    return ti.i64(1) << ti.cast(mark & 63, ti.i64)


@ti.func
def _holds(marks: ti.i64, wanted: ti.i32) -> ti.i32:
    """Say whether a mark may be in a set."""
    return ti.cast((marks & _as_set(wanted)) != 0, ti.i32)


@ti.func
def _in_leaf(
    point_in: ti.template(), mark_in: ti.template(), leaf_in: ti.template(), box_in: ti.template(),
    set_in: ti.template(), c: ti.i32, i: ti.i32, wanted: ti.i32, square: ti.f64,
) -> ti.i32:  # fmt: skip
    """Say whether leaf c has a point with the mark that is nearer to point i than the reach."""
    found = 0
    if _holds(set_in[c, 0], wanted) == 1:
        p = row(point_in, i)
        if box_gap(box_in, c, p) < square:
            for j in range(leaf_in[c, 0], leaf_in[c, 0] + leaf_in[c, 1]):
                if mark_in[j] == wanted and j != i:
                    if (row(point_in, j) - p).norm_sqr() < square:
                        found = 1
                        break
    return found


@ti.kernel
def _look_for_marked(
    # In:
    point_in: F64Rows,
    mark_in: I32Array,
    leaf_in: I32Rows,
    box_in: F64Rows,
    start_in: I32Array,
    neighbor_in: I32Array,
    entry_in: I32Rows,
    reach_in: F64Array,
    # Out:
    set_out: I64Rows,
    found_out: I32Array,
):
    """Look for a marked point in the leaf of every entry and those that touch it.

    The marks in every leaf, and in it and those that touch it, come first: where one is not among
    them nobody has to look for it.
    """
    for c in range(leaf_in.shape[0]):
        marks = ti.i64(0)
        for j in range(leaf_in[c, 0], leaf_in[c, 0] + leaf_in[c, 1]):
            marks |= _as_set(mark_in[j])
        set_out[c, 0] = marks
    for c in range(leaf_in.shape[0]):
        marks = set_out[c, 0]
        for k in range(start_in[c], start_in[c + 1]):
            marks |= set_out[neighbor_in[k], 0]
        set_out[c, 1] = marks
    for e in range(entry_in.shape[0]):
        i = entry_in[e, 0]
        c = entry_in[e, 1]
        wanted = entry_in[e, 2]
        square = reach_in[e] * reach_in[e]
        found = _in_leaf(point_in, mark_in, leaf_in, box_in, set_out, c, i, wanted, square)
        k = ti.select(_holds(set_out[c, 1], wanted) == 1, start_in[c], start_in[c + 1])
        while k < start_in[c + 1] and found == 0:
            b = neighbor_in[k]
            found = _in_leaf(point_in, mark_in, leaf_in, box_in, set_out, b, i, wanted, square)
            k += 1
        k = start_in[c]
        # The leaves beyond matter where those that touch are smaller than the reach.
        while k < start_in[c + 1] and found == 0:
            b = neighbor_in[k]
            j = start_in[b + 1]
            if _holds(set_out[b, 1], wanted) == 1:
                if box_gap(box_in, b, row(point_in, i)) <= _ASIDE * square:
                    j = start_in[b]
            while j < start_in[b + 1] and found == 0:
                a = neighbor_in[j]
                found = _in_leaf(point_in, mark_in, leaf_in, box_in, set_out, a, i, wanted, square)
                j += 1
            k += 1
        found_out[e] = found


def marked_near(
    points: object,
    mark: np.ndarray,
    leaves: Leaves,
    point: np.ndarray,
    leaf: np.ndarray,
    wanted: np.ndarray,
    reach: np.ndarray,
) -> np.ndarray:
    """Say which points have another one near them that carries a mark, shape (E,), bool.

    Leaves that touch that of a point are searched, and those that touch these while nothing was
    found.

    Args:
        points: Positions [mm], shape (n, 3) (kernel array).
        mark: Mark of every point, shape (n,), i32.
        leaves: The leaves.
        point: Point of every entry, shape (E,).
        leaf: Its leaf, shape (E,).
        wanted: The mark that is looked for, shape (E,).
        reach: The other point is nearer than this [mm], shape (E,).
    """
    runtime.ensure_started()
    entries = len(point)
    if entries == 0:
        return np.zeros(0, bool)
    entry = np.empty((entries, 3), np.int32)
    entry[:, 0], entry[:, 1], entry[:, 2] = point, leaf, wanted
    found = runtime.empty(entries, np.int32)
    _look_for_marked(
        points,
        runtime.upload(mark.astype(np.int32, copy=False)),
        runtime.upload(leaves.points),
        runtime.upload(leaves.box),
        runtime.upload(leaves.start),
        runtime.upload(leaves.neighbor),
        runtime.upload(entry),
        runtime.upload(reach.astype(np.float64)),
        runtime.empty((len(leaves), 2), np.int64),
        found,
    )
    return runtime.download(found)[:entries] > 0
