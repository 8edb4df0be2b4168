"""Morton codes: the coordinates of a box, bit by bit in turn, x highest; 21 bits an axis."""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, I64Array, ti

AXIS_BITS = 21


@ti.func
def _spread(v: ti.i64) -> ti.i64:
    """Insert two zero bits before each of the lowest 21 bits."""
    x = v & ti.i64(0x1FFFFF)
    x = (x | (x << 32)) & ti.i64(0x1F00000000FFFF)
    x = (x | (x << 16)) & ti.i64(0x1F0000FF0000FF)
    x = (x | (x << 8)) & ti.i64(0x100F00F00F00F00F)
    x = (x | (x << 4)) & ti.i64(0x10C30C30C30C30C3)
    x = (x | (x << 2)) & ti.i64(0x1249249249249249)
    return x


@ti.func
def compacted(key: ti.i64, axis: ti.i32) -> ti.i32:
    """Return the coordinate that was spread over every third bit of a key."""
    x = (key >> (2 - axis)) & ti.i64(0x1249249249249249)
    x = (x | (x >> 2)) & ti.i64(0x10C30C30C30C30C3)
    x = (x | (x >> 4)) & ti.i64(0x100F00F00F00F00F)
    x = (x | (x >> 8)) & ti.i64(0x1F0000FF0000FF)
    x = (x | (x >> 16)) & ti.i64(0x1F00000000FFFF)
    x = (x | (x >> 32)) & ti.i64(0x1FFFFF)
    return ti.cast(x, ti.i32)


@ti.kernel
def _code(
    scale: ti.f64,
    # In:
    corner_in: F64Array,
    last_in: I32Array,
    point_in: F64Rows,
    # Out:
    key_out: I64Array,
):
    """Write the Morton key of the finest box that holds each point (x highest)."""
    for i in key_out:
        key = ti.i64(0)
        for k in ti.static(range(3)):
            at = ti.cast((point_in[i, k] - corner_in[k]) * scale, ti.i32)
            at = ti.max(0, ti.min(last_in[k], at))
            key = key | (_spread(ti.cast(at, ti.i64)) << (2 - k))
        key_out[i] = key


def morton_keys(points: Any, corner: np.ndarray, scale: float, last: np.ndarray) -> Any:
    """Return the Morton key of the box of every point.

    Args:
        points: Positions [mm], shape (n, 3), f64, a kernel array.
        corner: Lower corner of the box (0, 0, 0) [mm], shape (3,).
        scale: Boxes per mm.
        last: Largest box coordinate of each axis, shape (3,): points beyond are put there.

    Returns:
        Keys, shape (n,), i64, a kernel array.

    Raises:
        ValueError: A coordinate needs more than 21 bits.
    """
    runtime.ensure_started()
    if int(np.max(last)) >= 1 << AXIS_BITS:
        raise ValueError(f"a Morton key holds {AXIS_BITS} bits an axis, not {int(np.max(last))}")
    key = runtime.empty(points.shape[0], np.int64)
    _code(
        scale,
        runtime.upload(np.asarray(corner, np.float64)),
        runtime.upload(np.asarray(last, np.int32)),
        points,
        key,
    )
    return key
