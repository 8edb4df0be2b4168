"""Rays against triangles: a balanced tree of boxes, walked without a stack.

The tree is perfect and its nodes are numbered like a heap (children 2n and 2n + 1), so it needs no
pointers: every level halves every group of triangles at the median of their centres, along the
longest side of the group's box. A walk needs the number of the node and one bit a level, whether
the other child has been visited; the child on the side that the ray comes from goes first.

The test of a triangle is the watertight one of Woop, Benthin and Wald (Journal of Computer Graphics
Techniques 2(1), 2013): seen along the ray, both triangles at an edge compute the same number for
it, so no ray slips through between them.
"""

import math
from typing import NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, ti

_FAR = 1e30
_LEAF = 4  # a leaf holds at most this many triangles
_PAD = 1e-9  # boxes are this much too large, relative to the size of the whole
ANY = -1
"""The wanted surface of a ray that may hit them all."""


class Tree(NamedTuple):
    """Triangles in the order of the leaves, and the boxes above; ``T`` triangles, ``L`` leaves."""

    boxes: np.ndarray
    """Lower and upper corner of every node [mm], shape (2 L, 6), f64; node 0 is not used."""
    axis: np.ndarray
    """Axis along which a node is halved; shape (L,), i32."""
    starts: np.ndarray
    """First triangle of every leaf, then T, shape (L + 1,), i32."""
    corners: np.ndarray
    """The three corners of every triangle [mm], shape (T, 9), f64."""
    surface: np.ndarray
    """Surface of every triangle, shape (T,), i32."""
    number: np.ndarray
    """Number of every triangle in the mesh, shape (T,), i64."""


def build_tree(corners: np.ndarray, surface: np.ndarray) -> Tree:
    """Build the tree over triangles.

    Args:
        corners: Corners of the triangles [mm], shape (T, 3, 3), at least one triangle.
        surface: Surface of every triangle, shape (T,).
    """
    count = len(corners)
    levels = max(math.ceil(math.log2(count / _LEAF)), 0) if count > _LEAF else 0
    low, high = corners.min(axis=1), corners.max(axis=1)
    centre = 0.5 * (low + high)
    order = np.arange(count)
    axis = np.zeros(1 << levels, np.int32)
    for level in range(levels):
        starts = _starts(count, level)
        group = np.repeat(np.arange(1 << level), np.diff(starts))
        placed = centre[order]
        extent = np.maximum.reduceat(placed, starts[:-1]) - np.minimum.reduceat(placed, starts[:-1])
        longest = np.argmax(extent, axis=1)
        axis[1 << level : 2 << level] = longest
        order = order[np.lexsort((placed[np.arange(count), longest[group]], group))]
    starts = _starts(count, levels)
    size = high.max(axis=0) - low.min(axis=0)
    pad = _PAD * float(np.linalg.norm(size))
    boxes = np.zeros((2 << levels, 6))
    boxes[1 << levels :, :3] = np.minimum.reduceat(low[order], starts[:-1]) - pad
    boxes[1 << levels :, 3:] = np.maximum.reduceat(high[order], starts[:-1]) + pad
    for level in reversed(range(levels)):
        pair = boxes[2 << level : 4 << level].reshape(1 << level, 2, 6)
        boxes[1 << level : 2 << level, :3] = pair[:, :, :3].min(axis=1)
        boxes[1 << level : 2 << level, 3:] = pair[:, :, 3:].max(axis=1)
    return Tree(
        boxes=boxes, axis=axis, starts=starts.astype(np.int32),
        corners=np.ascontiguousarray(corners[order].reshape(count, 9), np.float64),
        surface=np.ascontiguousarray(surface[order], np.int32), number=order,
    )  # fmt: skip


def _starts(count: int, level: int) -> np.ndarray:
    """Return where the groups of a level begin; those of the next level halve them."""
    return np.arange((1 << level) + 1, dtype=np.int64) * count >> level


def cast_triangles(
    tree: Tree,
    origins: np.ndarray,
    directions: np.ndarray,
    reach: np.ndarray,
    *,
    any_hit: bool = False,
    wanted: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Follow rays to the first triangle.

    Args:
        tree: The triangles.
        origins: Starting points [mm], shape (N, 3).
        directions: Unit vectors, shape (N, 3).
        reach: Length of every ray [mm], shape (N,); hits beyond it do not count.
        any_hit: Stop at any hit within reach, not the nearest one: enough to know what is hidden.
        wanted: The only surface that every ray can hit, or `ANY`, shape (N,); None = any for all.

    Returns:
        Distances [mm], shape (N,), f64, infinite without a hit; numbers of the triangles in the
        mesh, shape (N,), i64, -1 without a hit.
    """
    runtime.ensure_started()
    count = len(origins)
    if count == 0:
        return np.empty(0), np.empty(0, np.int64)
    limits = np.where(np.isfinite(reach), reach, _FAR).astype(np.float64)
    only = np.full(count, ANY, np.int32) if wanted is None else np.asarray(wanted, np.int32)
    distances = runtime.empty(count, np.float64)
    triangles = runtime.empty(count, np.int32)
    _cast_rays(
        int(any_hit), runtime.upload(tree.boxes), runtime.upload(tree.axis),
        runtime.upload(tree.starts), runtime.upload(tree.corners), runtime.upload(tree.surface),
        runtime.upload(np.asarray(origins, np.float64)),
        runtime.upload(np.asarray(directions, np.float64)),
        runtime.upload(limits), runtime.upload(only), distances, triangles,
    )  # fmt: skip
    runtime.sync()
    place = runtime.download(triangles)[:count]
    distance = np.where(place >= 0, runtime.download(distances)[:count], math.inf)
    return distance, np.where(place >= 0, tree.number[place], -1)


@ti.func
def _vector(rows: ti.template(), i, k):
    """Read three neighbouring columns of a row."""
    return ti.Vector([rows[i, k], rows[i, k + 1], rows[i, k + 2]])


@ti.func
def _main_axis(direction):
    """Return the axis along which a vector is longest."""
    along = 0
    if ti.abs(direction[1]) > ti.abs(direction[0]):
        along = 1
    if ti.abs(direction[2]) > ti.max(ti.abs(direction[0]), ti.abs(direction[1])):
        along = 2
    return along


@ti.func
def _turned(v, along):
    """Return the coordinates in an order that puts one axis last."""
    result = v
    if along == 0:
        result = ti.Vector([v[1], v[2], v[0]])
    elif along == 1:
        result = ti.Vector([v[2], v[0], v[1]])
    return result


@ti.func
def _inverse(x):
    """Return 1 / x, and a huge number for 0."""
    return 1.0 / x if ti.abs(x) > 1e-200 else 1e200


@ti.func
def _meets(boxes: ti.template(), node, origin, inverse, reach):
    """Say whether a ray meets the box of a node within its reach."""
    enter = 0.0
    leave = reach
    for k in ti.static(range(3)):
        first = (boxes[node, k] - origin[k]) * inverse[k]
        second = (boxes[node, k + 3] - origin[k]) * inverse[k]
        enter = ti.max(enter, ti.min(first, second))
        leave = ti.min(leave, ti.max(first, second))
    return enter <= leave


@ti.func
def _crossing(corners: ti.template(), i, origin, ray, along):
    """Return the distance to triangle i in units of the ray's main component, or -1."""
    result = -1.0
    a = _turned(_vector(corners, i, 0) - origin, along)
    b = _turned(_vector(corners, i, 3) - origin, along)
    c = _turned(_vector(corners, i, 6) - origin, along)
    slope_x, slope_y = ray[0] / ray[2], ray[1] / ray[2]
    ax, ay = a[0] - slope_x * a[2], a[1] - slope_y * a[2]
    bx, by = b[0] - slope_x * b[2], b[1] - slope_y * b[2]
    cx, cy = c[0] - slope_x * c[2], c[1] - slope_y * c[2]
    u = cx * by - cy * bx
    v = ax * cy - ay * cx
    w = bx * ay - by * ax
    if (u >= 0.0 and v >= 0.0 and w >= 0.0) or (u <= 0.0 and v <= 0.0 and w <= 0.0):
        whole = u + v + w
        if whole != 0.0:
            result = (u * a[2] + v * b[2] + w * c[2]) / whole / ray[2]
    return result


@ti.kernel
def _cast_rays(
    any_hit: ti.i32,
    # In:
    boxes_in: F64Rows,
    axis_in: I32Array,
    starts_in: I32Array,
    corners_in: F64Rows,
    surface_in: I32Array,
    origins_in: F64Rows,
    directions_in: F64Rows,
    reach_in: F64Array,
    wanted_in: I32Array,
    # Out:
    distances_out: F64Array,
    triangles_out: I32Array,
):
    """Walk the tree once a ray; leave out every box that begins behind the best hit."""
    leaves = starts_in.shape[0] - 1
    for i in range(origins_in.shape[0]):
        origin = _vector(origins_in, i, 0)
        direction = _vector(directions_in, i, 0)
        inverse = ti.Vector(
            [_inverse(direction[0]), _inverse(direction[1]), _inverse(direction[2])]
        )
        along = _main_axis(direction)
        ray = _turned(direction, along)
        best = reach_in[i]
        found = -1
        node = 1
        visited = ti.i64(0)  # a bit a level: the other child has had its turn
        while node > 0:
            down = False
            if _meets(boxes_in, node, origin, inverse, best):
                if node < leaves:
                    axis = axis_in[node]
                    backwards = (
                        (axis == 0 and direction[0] < 0.0)
                        or (axis == 1 and direction[1] < 0.0)
                        or (axis == 2 and direction[2] < 0.0)
                    )
                    node = 2 * node + (1 if backwards else 0)
                    visited = visited << 1
                    down = True
                else:
                    for k in range(starts_in[node - leaves], starts_in[node - leaves + 1]):
                        if wanted_in[i] < 0 or surface_in[k] == wanted_in[i]:
                            t = _crossing(corners_in, k, origin, ray, along)
                            if 0.0 <= t and t < best:
                                best = t
                                found = k
            if not down:
                while node > 1 and (visited & 1) == 1:
                    node = node >> 1
                    visited = visited >> 1
                node = node ^ 1 if node > 1 else 0
                visited = visited | 1
                if any_hit == 1 and found >= 0:
                    node = 0
        distances_out[i] = best
        triangles_out[i] = found
