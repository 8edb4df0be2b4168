"""The nearest edge of every point, exactly: pieces lie in boxes, and only near ones are opened.

Points are in groups, and every group has a list of the boxes that may matter to its points.
"""

import math
from typing import NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, ti
from octoseg_ti.types import EdgeClass

_BOX = 3.0  # pieces of edges are put together in cubes of this size [mm]
_GROUP = 4.0  # points are put together in cubes of this size [mm], or larger ones ...
_MOST_GROUPS = 64  # ... so that there are no more along a side


class Edges(NamedTuple):
    """The edges of a part as short straight pieces; ``E`` pieces."""

    start: np.ndarray
    """One end [mm], shape (E, 3)."""
    end: np.ndarray
    """Other end [mm], shape (E, 3)."""
    kind: np.ndarray
    """`EdgeClass`: SHARP, FILLET where a patch runs into a fillet, SMOOTH where two patches meet
    without an angle, shape (E,), u8."""


def nearest_edge(edges: Edges, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distance to the nearest edge [mm] and its class for every point.

    Args:
        edges: The edges; with none of them every distance is infinite.
        points: Positions [mm], shape (N, 3).

    Returns:
        Distances, shape (N,), f64; classes (`EdgeClass`), shape (N,), u8.
    """
    count = len(points)
    if len(edges.kind) == 0 or count == 0:
        return np.full(count, math.inf), np.full(count, EdgeClass.NONE, np.uint8)
    runtime.ensure_started()
    # Positions are small numbers around the part, so a plain key of the cube is unique.
    middle = 0.5 * (edges.start + edges.end)
    cube = np.floor((middle - middle.min(axis=0)) / _BOX).astype(np.int64)
    key = np.ravel_multi_index(tuple(cube.T), tuple(cube.max(axis=0) + 1))
    order = np.argsort(key, kind="stable")
    start, end, kind = edges.start[order], edges.end[order], edges.kind[order]
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    boxes = np.concatenate(
        [
            np.minimum.reduceat(np.minimum(start, end), first),
            np.maximum.reduceat(np.maximum(start, end), first),
        ],
        axis=1,
    )
    pieces = (
        runtime.upload(np.ascontiguousarray(boxes)),
        runtime.upload(np.append(first, len(start)).astype(np.int32)),
        runtime.upload(np.ascontiguousarray(np.concatenate([start, end - start], axis=1))),
    )
    points = np.ascontiguousarray(points, np.float64)
    group, centres, radius = _grouped(points)
    # The middle of a group tells which boxes can matter to any of its points.
    every = (np.zeros(len(centres), np.int32), np.array([0, len(boxes)], np.int32))
    far, _ = _search(pieces, centres, *every, np.arange(len(boxes), dtype=np.int32))
    distances, owners = _search(pieces, points, group, *_listed(boxes, centres, far + 2.0 * radius))
    return distances, kind[owners]


def _grouped(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Put points that are close together into groups, one for each small cube with points in it.

    Returns:
        Group of every point, shape (N,), i32; centres of the groups [mm], shape (G, 3); how far off
        its centre a point may be [mm].
    """
    low = points.min(axis=0)
    extent = points.max(axis=0) - low
    size = max(_GROUP, float(extent.max()) / _MOST_GROUPS)
    place = ((points - low) / size).astype(np.int32)
    shape = tuple((extent / size).astype(np.int32) + 1)
    key = np.ravel_multi_index(tuple(place.T), shape)
    used = np.zeros(math.prod(shape), bool)
    used[key] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    cubes = np.stack(np.unravel_index(np.flatnonzero(used), shape), axis=1)
    return number[key], low + (cubes + 0.5) * size, 0.5 * math.sqrt(3.0) * size + 1e-6


def _listed(
    boxes: np.ndarray, centres: np.ndarray, limit: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the boxes within a distance of every centre, in order, as (first, listed)."""
    given = (runtime.upload(np.ascontiguousarray(boxes)), runtime.upload(centres))
    limits, starts = runtime.upload(limit), runtime.zeros(len(centres) + 1, np.int32)
    _list_near(*given, limits, 0, starts, runtime.empty(1, np.int32))
    runtime.sync()
    first = np.cumsum(runtime.download(starts)[: len(centres) + 1]).astype(np.int32)
    listed = runtime.empty(int(first[-1]), np.int32)
    _list_near(*given, limits, 1, runtime.upload(first), listed)
    runtime.sync()
    return first, runtime.download(listed)


def _search(
    pieces: tuple[object, ...], points: np.ndarray, group: np.ndarray, first: np.ndarray,
    listed: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the distance of every point to the nearest piece in the boxes listed for its group."""
    count = len(points)
    distances, owners = runtime.empty(count, np.float64), runtime.empty(count, np.int32)
    given = (runtime.upload(array) for array in (points, group, first, listed))
    _find_nearest(*pieces, *given, distances, owners)
    runtime.sync()
    return runtime.download(distances)[:count], runtime.download(owners)[:count]


@ti.func
def _to_box(boxes: ti.template(), b, p):
    """Return the squared distance of a point to box b; 0 inside."""
    total = 0.0
    for k in ti.static(range(3)):
        off = ti.max(boxes[b, k] - p[k], p[k] - boxes[b, k + 3], 0.0)
        total += off * off
    return total


@ti.func
def _to_piece(pieces: ti.template(), e, p):
    """Return the squared distance of a point to piece e."""
    offset = p - ti.Vector([pieces[e, 0], pieces[e, 1], pieces[e, 2]])
    span = ti.Vector([pieces[e, 3], pieces[e, 4], pieces[e, 5]])
    share = ti.min(ti.max(offset.dot(span) / ti.max(span.dot(span), 1e-30), 0.0), 1.0)
    offset -= share * span
    return offset.dot(offset)


@ti.kernel
def _list_near(
    # In:
    boxes_in: F64Rows,
    centres_in: F64Rows,
    limits_in: F64Array,
    write: ti.i32,
    # Out:
    first_out: I32Array,
    listed_out: I32Array,
):
    """Count the boxes within its limit of every centre into the place after its own; then list."""
    for i in range(centres_in.shape[0]):
        p = ti.Vector([centres_in[i, 0], centres_in[i, 1], centres_in[i, 2]])
        limit = limits_in[i] * limits_in[i]
        found = 0
        for b in range(boxes_in.shape[0]):
            if _to_box(boxes_in, b, p) <= limit:
                if write == 1:
                    listed_out[first_out[i] + found] = b
                found += 1
        if write == 0:
            first_out[i + 1] = found


@ti.kernel
def _find_nearest(
    # In:
    boxes_in: F64Rows,
    first_in: I32Array,
    pieces_in: F64Rows,
    points_in: F64Rows,
    group_in: I32Array,
    near_in: I32Array,
    listed_in: I32Array,
    # Out:
    distances_out: F64Array,
    owners_out: I32Array,
):
    """Open the listed box that is nearest, then all that are nearer than the best piece so far."""
    for i in range(points_in.shape[0]):
        p = ti.Vector([points_in[i, 0], points_in[i, 1], points_in[i, 2]])
        start, stop = near_in[group_in[i]], near_in[group_in[i] + 1]
        nearest = listed_in[start]
        room = _to_box(boxes_in, nearest, p)
        for n in range(start + 1, stop):
            far = _to_box(boxes_in, listed_in[n], p)
            if far < room:
                room = far
                nearest = listed_in[n]
        best = _to_piece(pieces_in, first_in[nearest], p)
        owner = first_in[nearest]
        for e in range(first_in[nearest] + 1, first_in[nearest + 1]):
            far = _to_piece(pieces_in, e, p)
            if far < best:
                best = far
                owner = e
        for n in range(start, stop):
            b = listed_in[n]
            if b != nearest and _to_box(boxes_in, b, p) < best:
                for e in range(first_in[b], first_in[b + 1]):
                    far = _to_piece(pieces_in, e, p)
                    if far < best:
                        best = far
                        owner = e
        distances_out[i] = ti.sqrt(best)
        owners_out[i] = owner
