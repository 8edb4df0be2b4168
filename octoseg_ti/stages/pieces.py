"""Connected pieces of surfaces, over the leaves in which these have points."""

from typing import Any, NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F32Array, F64Rows, I32Array, I32Rows, I64Array, ti
from octoseg_ti.device.unionfind import roots, unite
from octoseg_ti.stages.labelling import MOST
from octoseg_ti.stages.leaves import Leaves
from octoseg_ti.types import NONE

# Squares are added up in whole units, so that the sum does not depend on the order of the points.
_UNIT = 1024.0


class Entries(NamedTuple):
    """The points of every surface in every leaf: one row an entry of the lists, row by row."""

    box: np.ndarray
    """Their lower and upper corner [mm], shape (k, 6)."""
    size: np.ndarray
    """How many there are, shape (k,), i32."""
    square: np.ndarray
    """Sum of the squares of how far they are from the surface that would be next, shape (k,)."""
    of_point: np.ndarray
    """Entry of every sorted point, -1 = none, shape (n,), i32."""


@ti.func
def _entry_of(own: ti.template(), first: ti.template(), c: ti.i32, s: ti.i32) -> ti.i32:
    """Return the entry of a surface in the list of a leaf, -1 where it is not in the list."""
    k = 0
    while k < MOST and own[c, k] != s:
        k += 1
    return ti.select(s >= 0 and k < MOST, first[c] + k, -1)


@ti.kernel
def _measure_entries(
    cap: ti.f64,
    # In:
    leaf_in: I32Rows,
    own_in: I32Rows,
    first_in: I32Array,
    label_in: I32Array,
    point_in: F64Rows,
    off_in: F32Array,
    # Out:
    box_inout: F64Rows,
    size_inout: I32Array,
    square_inout: I64Array,
    entry_out: I32Array,
):
    """Add the points of every leaf to its entries, and write the entry of every point."""
    for c in first_in:
        for i in range(leaf_in[c, 0], leaf_in[c, 0] + leaf_in[c, 1]):
            e = _entry_of(own_in, first_in, c, label_in[i])
            entry_out[i] = e
            if e >= 0:
                p = row(point_in, i)
                for k in ti.static(range(3)):
                    box_inout[e, k] = ti.min(box_inout[e, k], p[k])
                    box_inout[e, 3 + k] = ti.max(box_inout[e, 3 + k], p[k])
                off = ti.min(ti.cast(off_in[i], ti.f64), cap)
                size_inout[e] = size_inout[e] + 1
                square_inout[e] = square_inout[e] + ti.cast(_UNIT * off * off + 0.5, ti.i64)


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
            (k, 6), by `measure_entries`.
        gap: Largest distance of the boxes of two entries of one piece [mm].

    Returns:
        Piece of every entry of ``own``, shape (C, MOST), i32, -1 where that holds no surface. A
        piece has the number of its first entry, of those that hold one counted row by row.
    """
    runtime.ensure_started()
    there = own >= 0
    parent = runtime.upload(np.arange(len(box), dtype=np.int32))
    if len(leaves.a) and len(box):
        _join_pieces(
            gap,
            runtime.upload(own),
            _first_entries(own),
            runtime.upload(box),
            runtime.upload(leaves.a),
            runtime.upload(leaves.b),
            parent,
        )
    piece = np.full(own.shape, NONE, np.int32)
    piece[there] = roots(parent)[: len(box)]
    return piece


def measure_entries(
    points: Any, leaves: Leaves, own: np.ndarray, label: np.ndarray, off: np.ndarray, cap: float
) -> Entries:
    """Return what the points of every surface in every leaf are.

    Args:
        points: Sorted positions [mm], shape (n, 3), f64 (kernel array).
        leaves: The leaves.
        own: Surfaces with points in every leaf, ascending, then -1; shape (C, MOST), i32.
        label: Surface of every sorted point, -1 = none, shape (n,), i32.
        off: How far it is from the surface that would be next, 0 or more, shape (n,), f32.
        cap: No distance counts for more.
    """
    runtime.ensure_started()
    count = int(np.count_nonzero(own >= 0))
    box = np.empty((count, 6))
    box[:, :3], box[:, 3:] = np.inf, -np.inf
    entry = np.full(len(label), NONE, np.int32)
    kept = runtime.upload(box), runtime.zeros(count, np.int32), runtime.zeros(count, np.int64)
    if count:
        of_point = runtime.upload(entry)
        _measure_entries(
            cap, runtime.upload(leaves.points), runtime.upload(own), _first_entries(own),
            runtime.upload(label), points, runtime.upload(off), *kept, of_point,
        )  # fmt: skip
        entry = runtime.download(of_point)
    box, size, square = (runtime.download(array)[:count] for array in kept)
    return Entries(box, size, square / _UNIT, entry)


def _first_entries(own: np.ndarray) -> Any:
    """Return the first entry of every leaf, for kernels."""
    held = np.count_nonzero(own >= 0, axis=1)
    return runtime.upload((np.cumsum(held) - held).astype(np.int32))
