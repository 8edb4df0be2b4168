"""Moments of cells (Eqs 3 and 4): sums that tell mean, deviation and flatness without the points.

A cell has 19 moments, in units of 2^-30: the count; sum N; sum N N'; sum p; sum p p', with p
measured from the middle of the cell in half cell sizes. They are integers, so a sum depends neither
on the order of the points nor on the threads.
"""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, symmetric_eigen, vec3
from octoseg_ti.device.runtime import F64Rows, I32Rows, I64Rows, ti

COUNT = 19
_ONE = 1073741824.0  # 2^30: a sum of 2^33 values still fits 64 bits
_SLICE = 256
# Rows and columns of the upper triangle of a symmetric matrix, in the order of its six sums.
_ROW = (0, 0, 0, 1, 1, 2)
_COLUMN = (0, 1, 2, 1, 2, 2)

# Columns of the integer table of the cells ...
LO, HI, LEVEL, X, Y, Z, STOP = range(7)
# ... and of the real one: normalised mean normal (3), mean point (3), deviation, residual.
NORMAL, POINT, SIGMA, RESIDUAL = 0, 3, 6, 7


@ti.func
def _fixed(x: ti.f64) -> ti.i64:
    """Return a value of -1..1 in fixed point."""
    return ti.cast(x * _ONE + ti.select(x < 0.0, -0.5, 0.5), ti.i64)


_sums = ti.types.vector(COUNT, ti.i64)


@ti.func
def _sums_of(
    first: ti.i32,
    end: ti.i32,
    middle: vec3,
    size: ti.f64,
    signed: ti.i32,
    point: ti.template(),
    normal: ti.template(),
) -> _sums:
    """Return the moments of some of the points of a cell."""
    sums = _sums(0)
    sums[0] = ti.cast(end - first, ti.i64)
    for i in range(first, end):
        n = row(normal, i)
        p = (row(point, i) - middle) * (2.0 / size)
        for k in ti.static(range(3)):
            sums[1 + k] += _fixed(n[k])
            sums[10 + k] += _fixed(p[k])
        if signed == 1:
            # With a side, only the trace of sum N N' is used: how many have a normal.
            sums[4] += _fixed(n.norm_sqr())
        else:
            for k in ti.static(range(6)):
                sums[4 + k] += _fixed(n[ti.static(_ROW[k])] * n[ti.static(_COLUMN[k])])
        for k in ti.static(range(6)):
            sums[13 + k] += _fixed(p[ti.static(_ROW[k])] * p[ti.static(_COLUMN[k])])
    return sums


@ti.kernel
def _accumulate(
    first: ti.i32,
    last: ti.i32,
    slices: ti.i32,
    stride: ti.i32,
    signed: ti.i32,
    size: ti.f64,
    # In:
    node_in: I32Rows,
    point_in: F64Rows,
    normal_in: F64Rows,
    # Out:
    moment_inout: I64Rows,
):
    """Add up the moments of the nodes first..last-1, one level, in slices of the sorted points."""
    for u in range(slices * stride):
        if u % stride == 0:
            i = u // stride * _SLICE
            end = ti.min(i + _SLICE, point_in.shape[0])
            c = first  # the first node of the level that ends after i
            high = last
            while c < high:
                middle = (c + high) // 2
                if node_in[middle, HI] > i:
                    high = middle
                else:
                    c = middle + 1
            while c < last and i < end:
                i = ti.max(i, node_in[c, LO])
                stop = ti.min(end, node_in[c, HI])
                if i < stop:
                    centre = size * (vec3(node_in[c, X], node_in[c, Y], node_in[c, Z]) + 0.5)
                    sums = _sums_of(i, stop, centre, size, signed, point_in, normal_in)
                    for k in ti.static(range(COUNT)):
                        ti.atomic_add(moment_inout[c, k], sums[k])
                    i = stop
                c += 1


@ti.func
def _moments(moment: ti.template(), c: ti.i32, first: ti.i32, scale: ti.f64) -> vec3:
    """Return three sums of cell c as means."""
    return scale * vec3(moment[c, first], moment[c, first + 1], moment[c, first + 2])


@ti.func
def describe(
    c: ti.i32,
    signed: ti.i32,
    size: ti.f64,
    node: ti.template(),
    moment: ti.template(),
    mean: ti.template(),
):
    """Write mean normal, mean point, deviation (Eq. 4) and residual of a cell from its moments."""
    scale = 1.0 / (_ONE * ti.cast(moment[c, 0], ti.f64))
    # Eq. 4 for unit normals: sigma^2 = 1 - |mean|^2. Points without a normal are no part of it.
    nn = _moments(moment, c, 4, scale)
    nm = _moments(moment, c, 7, scale)
    present = ti.max(nn[0] + nm[0] + nm[2], 1e-12)
    normal = _moments(moment, c, 1, scale)
    variance = 1.0 - normal.norm_sqr() / (present * present)
    if signed == 0:
        # The mean axis, and the spread around it: the normals may point either way.
        values, _, _, axis = symmetric_eigen(nn[0], nn[1], nn[2], nm[0], nm[1], nm[2])
        normal = axis
        variance = 1.0 - values[2] / present
    length = normal.norm()
    if length > 0.0:
        normal = normal / length
    p = _moments(moment, c, 10, scale)
    pp = _moments(moment, c, 13, scale)
    pm = _moments(moment, c, 16, scale)
    cov = vec3(
        (pp[0] - p[0] * p[0]) * normal[0] + 2.0 * (pp[1] - p[0] * p[1]) * normal[1],
        (pm[0] - p[1] * p[1]) * normal[1] + 2.0 * (pm[1] - p[1] * p[2]) * normal[2],
        (pm[2] - p[2] * p[2]) * normal[2] + 2.0 * (pp[2] - p[0] * p[2]) * normal[0],
    )
    middle = size * (vec3(node[c, X], node[c, Y], node[c, Z]) + 0.5)
    for k in ti.static(range(3)):
        mean[c, NORMAL + k] = normal[k]
        mean[c, POINT + k] = middle[k] + 0.5 * size * p[k]
    mean[c, SIGMA] = ti.sqrt(ti.max(0.0, variance))
    mean[c, RESIDUAL] = 0.5 * size * ti.sqrt(ti.max(0.0, cov.dot(normal)))


def add_up(
    first: int,
    last: int,
    size: float,
    signed: bool,
    node: Any,
    point: Any,
    normal: Any,
    moment: Any,
) -> None:
    """Add up the moments of the cells of one level.

    Args:
        first: First cell of the level in the tables.
        last: One past its last cell.
        size: Edge length of its cells [mm].
        signed: Normals have a side; else their axes are averaged.
        node: Integer table of the cells, shape (M, 7), i32; ranges of the sorted points.
        point: Sorted points, relative to the corner of the grid [mm], shape (n, 3), f64.
        normal: Sorted unit normals, shape (n, 3), f64; a zero row counts as none.
        moment: Moments of the cells, shape (M, 19), i64: the rows first..last-1 are added to.
    """
    runtime.ensure_started()
    slices = -(-point.shape[0] // _SLICE)
    stride = runtime.stride_of(slices)
    _accumulate(first, last, slices, stride, int(signed), size, node, point, normal, moment)


def point_sums(moment: np.ndarray, off: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return count, sum of positions and of their products for cells, measured from given places.

    Args:
        moment: Moments of the cells, shape (c, 19), i64.
        off: From the place to measure from to the middle of every cell [mm], shape (3, c).
        size: Edge length of every cell [mm], shape (c,).

    Returns:
        Count, sums x, y, z [mm] and sums of the products xx, xy, xz, yy, yz, zz [mm^2]; shape
        (10, c), f64.
    """
    sums = np.empty((10, len(moment)))
    sums[0] = moment[:, 0]
    sums[1:] = moment[:, 10:].T
    half = 0.5 * size
    sums[1:4] *= half / _ONE
    sums[4:] *= half**2 / _ONE
    # Moved: sum (p + d)(p + d)' = sum p p' + d sum p' + sum p d' + n d d'.
    for k, (a, b) in enumerate(zip(_ROW, _COLUMN, strict=True)):
        sums[4 + k] += off[a] * (sums[1 + b] + sums[0] * off[b]) + sums[1 + a] * off[b]
    sums[1:4] += sums[0] * off
    return sums
