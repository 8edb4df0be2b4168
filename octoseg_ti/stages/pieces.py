"""Connected pieces of surfaces, over the leaves in which these have points."""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, ti
from octoseg_ti.device.unionfind import roots, unite
from octoseg_ti.stages.labelling import MOST, common_label
from octoseg_ti.stages.leaves import Leaves, ranges
from octoseg_ti.types import NONE


@ti.func
def _apart(box: ti.template(), i: ti.i32, j: ti.i32) -> ti.f64:
    """Return the distance of two boxes."""
    gap = vec3(0.0, 0.0, 0.0)
    for k in ti.static(range(3)):
        gap[k] = ti.max(box[i, k] - box[j, 3 + k], box[j, k] - box[i, 3 + k], 0.0)
    return gap.norm()


@ti.kernel
def _join_pieces(
    gap: ti.f64,
    # In:
    own_in: I32Rows,
    first_in: I32Array,
    box_in: F64Rows,
    a_in: I32Array,
    b_in: I32Array,
    # Out:
    parent_inout: I32Array,
):
    """Join the entries of every surface that two leaves share, if its points are that near."""
    for e in a_in:
        a, b = a_in[e], b_in[e]
        j = 0
        for k in range(MOST):
            s = own_in[a, k]
            if s >= 0:
                while j < MOST and own_in[b, j] >= 0 and own_in[b, j] < s:
                    j += 1
                if j < MOST and own_in[b, j] == s:
                    one, other = first_in[a] + k, first_in[b] + j
                    if _apart(box_in, one, other) <= gap:
                        unite(parent_inout, one, other)


def pieces(leaves: Leaves, own: np.ndarray, box: np.ndarray, gap: float) -> np.ndarray:
    """Return the connected pieces of the surfaces.

    Leaves may touch whose points are far apart; and a large leaf that holds a few points of a
    surface reaches farther than these.

    Args:
        leaves: The leaves.
        own: Surfaces with points in every leaf, ascending, then -1; shape (C, MOST), i32.
        box: Lower and upper corner of the points of every entry that is one, row by row [mm], shape
            (k, 6), by `entry_boxes`.
        gap: Largest distance of the boxes of two entries of one piece [mm].

    Returns:
        Piece of every entry of ``own``, shape (C, MOST), i32, -1 where that holds no surface. A
        piece has the number of its first entry, of those that hold one counted row by row.
    """
    runtime.ensure_started()
    there = own >= 0
    held = np.count_nonzero(there, axis=1)
    parent = runtime.upload(np.arange(len(box), dtype=np.int32))
    if len(leaves.a) and len(box):
        _join_pieces(
            gap,
            runtime.upload(own),
            runtime.upload((np.cumsum(held) - held).astype(np.int32)),
            runtime.upload(box),
            runtime.upload(leaves.a),
            runtime.upload(leaves.b),
            parent,
        )
    piece = np.full(own.shape, NONE, np.int32)
    piece[there] = roots(parent)[: len(box)]
    return piece


def entry_boxes(
    points: np.ndarray, leaves: Leaves, own: np.ndarray, label: np.ndarray
) -> np.ndarray:
    """Return the box around the points of every surface in every leaf [mm], shape (k, 6).

    Args:
        points: Sorted positions [mm], shape (n, 3), f64.
        leaves: The leaves.
        own: Surfaces with points in every leaf, ascending, then -1; shape (C, most), i32.
        label: Surface of every sorted point, -1 = none, shape (n,), i32.

    Returns:
        Lower and upper corner for every entry of ``own`` that is one, row by row.
    """
    cell, rank = np.nonzero(own >= 0)
    width = np.int64(own.max(initial=0)) + 1
    key = cell * width + own[cell, rank]
    box = leaves.box[cell].copy()
    several = np.flatnonzero((own[:, 1] >= 0) | (common_label(leaves, label) < 0))
    count = leaves.count[several]
    mine = ranges(leaves.first[several], count)
    name = np.repeat(several, count) * width + label[mine]
    mine, name = mine[label[mine] >= 0], name[label[mine] >= 0]
    order = np.argsort(name, kind="stable")
    mine, name = mine[order], name[order]
    first = np.flatnonzero(np.diff(name, prepend=-1))
    at = np.minimum(np.searchsorted(key, name[first]), max(len(key) - 1, 0))
    held = key[at] == name[first]  # the lists have an end
    low = np.minimum.reduceat(points[mine], first, axis=0) if len(first) else np.zeros((0, 3))
    high = np.maximum.reduceat(points[mine], first, axis=0) if len(first) else np.zeros((0, 3))
    box[at[held]] = np.concatenate([low, high], axis=1)[held]
    return box
