"""Points that are linked on the faces of a part: neighbours in the mesh of a scan, and components.

The number of a component follows from its first member, so it is the same for any thread count.
"""

import numpy as np

from octoseg_ti.device import runtime, unionfind
from octoseg_ti.device.linalg import row
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, I32Rows, I64Array, ti
from octoseg_ti.device.searching import first_not_less
from octoseg_ti.device.unionfind import unite

_NEIGHBOURS = 6
# An edge that comes between two points is not further from both than this share of their distance,
# and this [mm] for faces that are not flat.
_AROUND, _BESIDE = 1.1, 0.02


def in_doubt(clear: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return whether an edge can come between two points.

    Args:
        clear: Distances of both points to the nearest edge [mm], their sum, shape (P,).
        length: Distance of the points [mm], shape (P,).
    """
    doubt: np.ndarray = clear <= _AROUND * length + _BESIDE
    return doubt


def link_mesh(
    position: np.ndarray,
    surface: np.ndarray,
    stripe: np.ndarray,
    column: np.ndarray,
    clear: np.ndarray,
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Link neighbours along the stripes and across them that lie on one surface.

    Args:
        position: Positions [mm], shape (N, 3), stripe after stripe, in order along each.
        surface: Surface of every point, shape (N,), i32.
        stripe: Stripe of every point, unique over all views, shape (N,), i32.
        column: Number of the laser's ray of every point, shape (N,), i32.
        clear: Around every point there is no edge up to this distance [mm], shape (N,).
        reach: Points further apart are not linked [mm].

    Returns:
        Component of every point by the links that no edge can come between, shape (N,); and the
        pairs for which one can, shape (P, 2).
    """
    runtime.ensure_started()
    count, width = len(position), int(column.max()) + 3
    parent = runtime.upload(np.arange(count, dtype=np.int32))
    doubtful = runtime.empty((count, _NEIGHBOURS), np.int32)
    _link_mesh(
        float(reach), width, runtime.upload(stripe.astype(np.int64) * width + column),
        runtime.upload(np.asarray(surface, np.int32)),
        runtime.upload(np.asarray(position, np.float64)),
        runtime.upload(np.asarray(clear, np.float64)), parent, doubtful,
    )  # fmt: skip
    runtime.sync()
    other = runtime.download(doubtful)[:count]
    one, step = np.nonzero(other >= 0)
    return _numbered(unionfind.roots(parent)[:count]), np.column_stack([one, other[one, step]])


def components(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return the connected component of every node, in the order of their first nodes, (count,).

    Args:
        pairs: Linked nodes, shape (P, 2).
        count: Number of nodes.
    """
    return _numbered(unionfind.components(count, pairs[:, 0], pairs[:, 1]))


def _numbered(root: np.ndarray) -> np.ndarray:
    """Return the numbers of the components, in the order of their first members."""
    number: np.ndarray = np.cumsum(root == np.arange(len(root))) - 1
    return number[root]


@ti.func
def _place_of(keys: ti.template(), key, start, stop):
    """Return where a key is among those from start to stop, which ascend; -1 = nowhere."""
    low = first_not_less(keys, key, start, stop)
    place = -1
    if low < stop:
        if keys[low] == key:
            place = low
    return place


@ti.kernel
def _link_mesh(
    reach: ti.f64,
    width: ti.i32,
    # In:
    keys_in: I64Array,
    surface_in: I32Array,
    position_in: F64Rows,
    clear_in: F64Array,
    # Out:
    parent_inout: I32Array,
    doubtful_out: I32Rows,
):
    """Look for the neighbours of every point: two along the stripe, three across, one beyond."""
    for i in range(keys_in.shape[0]):
        steps = ti.Vector([1, 2, width - 1, width, width + 1, 2 * width])
        for n in range(_NEIGHBOURS):
            doubtful_out[i, n] = -1
            # No two points have one key, so that a point is not further away than its key.
            stop = ti.min(i + steps[n] + 1, keys_in.shape[0])
            j = _place_of(keys_in, keys_in[i] + steps[n], i + 1, stop)
            if j >= 0:
                length = (row(position_in, i) - row(position_in, j)).norm()
                if surface_in[j] == surface_in[i] and length <= reach:
                    if clear_in[i] + clear_in[j] > _AROUND * length + _BESIDE:
                        unite(parent_inout, i, j)
                    else:
                        doubtful_out[i, n] = j
