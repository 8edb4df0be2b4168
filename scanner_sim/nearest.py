"""The nearest edge of every point, exactly: pieces lie in boxes, and only near ones are opened."""

import math
from typing import NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, ti
from octoseg_ti.types import EdgeClass

_BOX = 10.0  # pieces of edges are put together in cubes of this size [mm]


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
    distances = runtime.empty(count, np.float64)
    owners = runtime.empty(count, np.int32)
    _find_nearest(
        runtime.upload(np.ascontiguousarray(boxes)),
        runtime.upload(np.append(first, len(start)).astype(np.int32)),
        runtime.upload(np.ascontiguousarray(np.concatenate([start, end - start], axis=1))),
        runtime.upload(np.ascontiguousarray(points, np.float64)), distances, owners,
    )  # fmt: skip
    runtime.sync()
    return runtime.download(distances)[:count], kind[runtime.download(owners)[:count]]


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
def _find_nearest(
    # In:
    boxes_in: F64Rows,
    first_in: I32Array,
    pieces_in: F64Rows,
    points_in: F64Rows,
    # Out:
    distances_out: F64Array,
    owners_out: I32Array,
):
    """Open the box that is nearest, then all boxes that are nearer than the best piece so far."""
    for i in range(points_in.shape[0]):
        p = ti.Vector([points_in[i, 0], points_in[i, 1], points_in[i, 2]])
        nearest = 0
        room = _to_box(boxes_in, 0, p)
        for b in range(1, boxes_in.shape[0]):
            far = _to_box(boxes_in, b, p)
            if far < room:
                room = far
                nearest = b
        best = _to_piece(pieces_in, first_in[nearest], p)
        owner = first_in[nearest]
        for e in range(first_in[nearest] + 1, first_in[nearest + 1]):
            far = _to_piece(pieces_in, e, p)
            if far < best:
                best = far
                owner = e
        for b in range(boxes_in.shape[0]):
            if b != nearest and _to_box(boxes_in, b, p) < best:
                for e in range(first_in[b], first_in[b + 1]):
                    far = _to_piece(pieces_in, e, p)
                    if far < best:
                        best = far
                        owner = e
        distances_out[i] = ti.sqrt(best)
        owners_out[i] = owner
