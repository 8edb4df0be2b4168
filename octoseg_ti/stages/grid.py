"""Stage 4: the sparse grid (section 3.3): cubic cells, split while their normals deviate.

The octree is linear: points are sorted by Morton key, a cell is a range of the sorted points, and
a split cell has a row in the child table. Empty cells do not exist.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from octoseg_ti.device import radix, runtime
from octoseg_ti.device.morton import AXIS_BITS, compacted, morton_keys
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, I32Rows, I64Array, I64Rows, ti
from octoseg_ti.errors import DataError
from octoseg_ti.stages.moments import COUNT as MOMENTS
from octoseg_ti.stages.moments import (
    HI,
    LEVEL,
    LO,
    RESIDUAL,
    SIGMA,
    STOP,
    X,
    Y,
    Z,
    add_up,
    describe,
)
from octoseg_ti.types import StopReason

# A root table of more entries is traded for deeper trees.
_MOST_ROOTS = 1 << 21
_DEFAULT_LEVELS = 4
_FEW_POINTS = int(StopReason.FEW_POINTS)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grid:
    """The cells, level after level, and the points in Morton order (kernel arrays)."""

    corner: np.ndarray
    """Lower corner of the box of the cells [mm], shape (3,)."""
    size: float
    """Edge length of an initial cell [mm]."""
    shape: tuple[int, int, int]
    """Initial cells along x, y, z."""
    depth: int
    """Levels that a key can address below the initial cells."""
    signed: bool
    """Normals have a side; without one only their axes are compared."""
    count: int
    """Number of nodes; the tables may have more rows."""
    order: Any
    """Index of the points in Morton order, shape (n,), i32."""
    place: Any
    """Place in Morton order of every point, shape (n,), i32."""
    point: Any
    """Points in Morton order, relative to ``corner`` [mm], shape (n, 3), f64."""
    normal: Any
    """Their unit normals, shape (n, 3), f64."""
    key: Any
    """Morton key of the smallest box of every sorted point, shape (n,), i64."""
    root: Any
    """Node of every initial cell, -1 if empty, shape (product of ``shape``,), i32."""
    node: Any
    """Integers of every node: lo, hi, level, x, y, z, stop reason; shape (M, 7), i32."""
    child: Any
    """Daughters of every node, -1 if empty; first entry -2 for a leaf; shape (M, 8), i32."""
    mean: Any
    """Mean normal (3), mean point (3), deviation, residual of every node, shape (M, 8), f64."""
    moment: Any
    """Moments of every node (`stages.moments`), shape (M, 19), i64."""
    first: np.ndarray
    """First sorted point of every node, shape (M,), i32 (host, as are the next two)."""
    holds: np.ndarray
    """Points of every node, shape (M,), i32."""
    edge_length: np.ndarray
    """Edge length of every node [mm], shape (M,), f64."""
    passes: int
    """Subdivision passes, counting the initial grid."""


@ti.func
def find_node(
    x: ti.i32,
    y: ti.i32,
    z: ti.i32,
    level: ti.i32,
    shape: ti.template(),
    depth: ti.i32,
    root: ti.template(),
    child: ti.template(),
) -> ti.i32:
    """Return the node of a box of a level: the box itself or a coarser leaf; -1 = none."""
    bx, by, bz = x >> level, y >> level, z >> level
    found = -1
    if (
        x >= 0
        and y >= 0
        and z >= 0
        and level <= depth
        and bx < shape[0]
        and by < shape[1]
        and bz < shape[2]
    ):
        found = root[(bx * shape[1] + by) * shape[2] + bz]
        down = level
        while found >= 0 and down > 0:
            if child[found, 0] == -2:
                down = 0
            else:
                down -= 1
                o = (((x >> down) & 1) << 2) | (((y >> down) & 1) << 1) | ((z >> down) & 1)
                found = child[found, o]
    return found


@ti.kernel
def _gather(
    workers: ti.i32,
    stride: ti.i32,
    shift: ti.i32,
    # In:
    corner_in: F64Array,
    key_in: I64Array,
    order_in: I32Array,
    point_in: F64Rows,
    normal_in: F64Rows,
    # Out:
    point_out: F64Rows,
    normal_out: F64Rows,
    place_out: I32Array,
    head_out: I32Array,
):
    """Bring the points into Morton order, and count those that begin an initial cell."""
    for i in order_in:
        j = order_in[i]
        place_out[j] = i
        for k in ti.static(range(3)):
            point_out[i, k] = point_in[j, k] - corner_in[k]
            normal_out[i, k] = normal_in[j, k]
    n = key_in.shape[0]
    chunk = (n + workers - 1) // workers
    for u in range(workers * stride):
        if u % stride == 0:
            w = u // stride
            heads = 0
            for i in range(w * chunk, ti.min(n, (w + 1) * chunk)):
                if i == 0 or (key_in[i] >> shift) != (key_in[ti.max(0, i - 1)] >> shift):
                    heads += 1
            head_out[w] = heads


@ti.kernel
def _emit_heads(
    n: ti.i32,
    workers: ti.i32,
    stride: ti.i32,
    shift: ti.i32,
    shape: ti.types.vector(3, ti.i32),
    # In:
    key_in: I64Array,
    first_in: I32Array,
    # Out:
    node_out: I32Rows,
    root_out: I32Array,
):
    """Write the initial cells."""
    chunk = (n + workers - 1) // workers
    for u in range(workers * stride):
        if u % stride == 0:
            w = u // stride
            at = first_in[w]
            for i in range(w * chunk, ti.min(n, (w + 1) * chunk)):
                cell = key_in[i] >> shift
                if i == 0 or cell != (key_in[ti.max(0, i - 1)] >> shift):
                    node_out[at, LO] = i
                    node_out[at, LEVEL] = 0
                    for k in ti.static(range(3)):
                        node_out[at, X + k] = compacted(cell, k)
                    b = node_out[at, X] * shape[1] + node_out[at, Y]
                    root_out[b * shape[2] + node_out[at, Z]] = at
                    at += 1
                if i + 1 == n or cell != (key_in[ti.min(n - 1, i + 1)] >> shift):
                    node_out[at - 1, HI] = i + 1


@ti.kernel
def _decide(
    level: ti.types.vector(6, ti.i32),
    limit: ti.types.vector(4, ti.f64),
    # In:
    key_in: I64Array,
    moment_in: I64Rows,
    # Out:
    node_inout: I32Rows,
    mean_out: F64Rows,
    count_out: I32Array,
    bound_out: I32Rows,
):
    """Describe the nodes of a level, decide which are split, and where their daughters begin.

    The level holds its first node, one past the last, the fewest points that are split, the stop
    reason of this level (0 when its cells may be split), the shift of its keys, and whether normals
    have a side. The limits are of the deviation, of the residual, and of the deviation of a cell
    that cannot be split; then comes the size of the cells.
    """
    first = level[0]
    for c in range(first, level[1]):
        describe(c, level[5], limit[3], node_inout, moment_in, mean_out)
        lo = node_inout[c, LO]
        hi = node_inout[c, HI]
        stop = 0
        count = 0
        sigma = mean_out[c, SIGMA]
        step = mean_out[c, RESIDUAL] > limit[1]
        if sigma > limit[0] or step:
            stop = level[3]
            if hi - lo < level[2]:
                stop = _FEW_POINTS
            if stop != 0 and sigma <= limit[2] and not step:
                stop = 0
            elif stop == 0:
                bound_out[c - first, 0] = lo
                for o in range(8):
                    a = bound_out[c - first, o]
                    b = hi
                    while a < b:  # the first point of a later octant
                        middle = (a + b) // 2
                        if ti.cast((key_in[middle] >> level[4]) & 7, ti.i32) > o:
                            b = middle
                        else:
                            a = middle + 1
                    bound_out[c - first, o + 1] = a
                    count += ti.cast(a > bound_out[c - first, o], ti.i32)
        count_out[c - first] = count
        node_inout[c, STOP] = stop


@ti.kernel
def _emit_children(
    first: ti.i32,
    last: ti.i32,
    level: ti.i32,
    # In:
    count_in: I32Array,
    place_in: I32Array,
    bound_in: I32Rows,
    # Out:
    node_inout: I32Rows,
    child_out: I32Rows,
):
    """Write the daughters of the split nodes, and the child table."""
    for c in range(first, last):
        at = place_in[c - first]
        for o in range(8):
            child_out[c, o] = -2
            if count_in[c - first] > 0:
                child_out[c, o] = -1
                if bound_in[c - first, o + 1] > bound_in[c - first, o]:
                    child_out[c, o] = at
                    node_inout[at, LO] = bound_in[c - first, o]
                    node_inout[at, HI] = bound_in[c - first, o + 1]
                    node_inout[at, LEVEL] = level + 1
                    node_inout[at, X] = 2 * node_inout[c, X] + (o >> 2)
                    node_inout[at, Y] = 2 * node_inout[c, Y] + ((o >> 1) & 1)
                    node_inout[at, Z] = 2 * node_inout[c, Z] + (o & 1)
                    at += 1


def _cells_along(extent: np.ndarray, size: float) -> np.ndarray:
    """Return how many cells cover each side of the box, at least one.

    Points on the upper side of the box belong to the last cell: a side of exactly twelve cells must
    not get a thirteenth for them, least of all depending on how the division is rounded.
    """
    return np.maximum(np.ceil(extent / size * (1.0 - 1e-12)), 1.0)


def _box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner of the bounding box."""
    # A reduction over rows of three is slow; over long rows of whole triples it is not.
    whole = len(points) // 512 * 512
    long = points[:whole].reshape(-1, 3 * 512)
    rest = points[whole:]
    low = np.concatenate([long.min(axis=0, initial=np.inf).reshape(-1, 3), rest]).min(axis=0)
    high = np.concatenate([long.max(axis=0, initial=-np.inf).reshape(-1, 3), rest]).max(axis=0)
    return low, high


def _lay_out(
    extent: np.ndarray, divisions: int | None, min_cell: float
) -> tuple[float, tuple[int, int, int], int]:
    """Choose the size and number of the initial cells, and the levels below them."""
    longest = float(extent.max())
    thick = extent[extent > 1e-9 * longest]
    if divisions is not None:
        size = float(thick.min()) / divisions
    elif min_cell > 0.0:
        size = min_cell * 2.0**_DEFAULT_LEVELS
        while np.prod(_cells_along(extent, size)) > _MOST_ROOTS:
            size *= 2.0
    else:
        raise DataError(
            "no spacing of the points can be measured: too many of them coincide",
            hint="set the smallest cell (grid.min_cell)",
        )
    cells = _cells_along(extent, size)
    if np.prod(cells) > _MOST_ROOTS:
        raise DataError(
            f"initial cells of {size:.3g} mm would number {np.prod(cells):.3g}",
            hint="give fewer divisions",
        )
    shape = tuple(int(c) for c in cells)
    depth = AXIS_BITS - max(1, (max(shape) - 1).bit_length())
    if min_cell > 0.0:
        needed = 0
        while size / 2.0 ** (needed + 1) >= min_cell * (1.0 - 1e-9):
            needed += 1
        if needed > depth:
            raise DataError(
                f"cells of {min_cell:.3g} mm are too small for a box of {longest:.6g} mm",
                hint=f"the smallest possible are {size / 2.0**depth:.3g} mm: set grid.min_cell",
            )
        depth = needed
    return size, (shape[0], shape[1], shape[2]), depth


def build_grid(
    points: np.ndarray,
    normals: np.ndarray,
    *,
    tolerance: float,
    edge_tolerance: float | None = None,
    divisions: int | None = None,
    min_cell: float = 0.0,
    min_points: int = 2,
    flatness: float = float("inf"),
    noise: float = 0.0,
    signed: bool = True,
) -> Grid:
    """Build the sparse grid: split every cell whose normals deviate more than the tolerance.

    Args:
        points: Positions [mm], world, shape (n, 3), f64, finite.
        normals: Unit normals, shape (n, 3), f64; a zero row counts as none.
        tolerance: Largest deviation of the normals in a cell (Eq. 4).
        edge_tolerance: Largest deviation of a cell that cannot be split and still counts as
            homogeneous; None = the tolerance (the paper).
        divisions: Cells along the shortest side of the box (section 3.3); None makes the initial
            cell a power of two times ``min_cell``.
        min_cell: Smallest cell [mm]; 0 = as small as a key can address.
        min_points: A cell with fewer points is not split.
        flatness: A cell is also split when its points deviate from its mean plane by more than
            ``flatness`` times tolerance times cell size plus three times the noise; this finds
            steps between parallel faces, which normals alone cannot show. Infinite = off (the
            paper).
        noise: Standard deviation of the range [mm].
        signed: Normals have a side; else axes are compared.

    Returns:
        The grid, all arrays on the device.

    Raises:
        DataError: All points coincide, the cells are too small for the box, or there is neither a
            number of divisions nor a smallest cell.
    """
    runtime.ensure_started()
    n = len(points)
    corner, upper = _box(points)
    extent = upper - corner
    if not extent.max() > 0.0:
        raise DataError("all points coincide")
    size, shape, depth = _lay_out(extent, divisions, min_cell)
    scale = 2.0**depth / size
    last = np.array([s * 2**depth - 1 for s in shape])
    point = runtime.upload(points)
    key = morton_keys(point, corner, scale, last)
    bits = 3 * ((max(shape) - 1).bit_length() + depth)
    key, order = radix.sort_pairs(key, None, max(1, bits))
    sorted_point, sorted_normal = (
        runtime.empty((n, 3), np.float64),
        runtime.empty((n, 3), np.float64),
    )
    workers, stride = runtime.workers()
    place, heads = runtime.empty(n, np.int32), runtime.empty(workers, np.int32)
    _gather(
        workers, stride, 3 * depth, runtime.upload(corner), key, order, point,
        runtime.upload(normals), sorted_point, sorted_normal, place, heads,
    )  # fmt: skip
    roughness = tolerance if edge_tolerance is None else max(tolerance, edge_tolerance)
    counts = runtime.download(heads)
    ends = np.cumsum(counts, dtype=np.int32)
    count = int(ends[-1])
    rows = max(2 * count, n // 8)  # a guess, so that the tables seldom have to grow
    node = runtime.empty((rows, 7), np.int32)
    root = runtime.upload(np.full(shape[0] * shape[1] * shape[2], -1, np.int32))
    begin = runtime.upload(ends - counts)
    _emit_heads(n, workers, stride, 3 * depth, shape, key, begin, node, root)

    child = runtime.empty((rows, 8), np.int32)
    mean = runtime.empty((rows, 8), np.float64)
    moment = runtime.zeros((rows, MOMENTS), np.int64)
    first, level, passes = 0, 0, 1
    while count > first:
        cell = size / 2.0**level
        add_up(first, count, cell, signed, node, sorted_point, sorted_normal, moment)
        halt = 0
        if cell / 2.0 < min_cell * (1.0 - 1e-9):
            halt = int(StopReason.MIN_SIZE)
        elif level == depth:
            halt = int(StopReason.MAX_LEVEL)
        daughters = runtime.empty(count - first, np.int32)
        bound = runtime.empty((count - first, 9), np.int32)
        residual = flatness * tolerance * cell + 3.0 * noise
        _decide(
            (first, count, min_points, halt, 3 * (depth - level - 1), int(signed)),
            (tolerance, residual, roughness, cell),
            key, moment, node, mean, daughters, bound,
        )  # fmt: skip
        counts = runtime.download(daughters)
        ends = count + np.cumsum(counts, dtype=np.int32)
        total = int(ends[-1])
        if total > node.shape[0]:
            rows = 2 * total
            node, child, mean = (runtime.grown(a, rows) for a in (node, child, mean))
            moment = runtime.grown(moment, rows, zeros=True)
        begin = runtime.upload(ends - counts)
        _emit_children(first, count, level, daughters, begin, bound, node, child)
        passes += int(total > count)
        first, count, level = count, total, level + 1
    host = runtime.download(node)[:count]
    lo = np.ascontiguousarray(host[:, LO])
    sizes = size / 2.0 ** np.arange(AXIS_BITS + 1)
    return Grid(
        corner=corner, size=size, shape=shape, depth=depth, signed=signed, count=count, order=order,
        place=place, point=sorted_point, normal=sorted_normal, key=key, root=root, node=node,
        child=child, mean=mean, moment=moment, passes=passes,
        first=lo, holds=host[:, HI] - lo, edge_length=sizes[host[:, LEVEL]],
    )  # fmt: skip
