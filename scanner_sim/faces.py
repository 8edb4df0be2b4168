"""Questions about the faces of a part, many at a time: which pass by a place, where they go on."""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, ti
from scanner_sim.crossings import distance, surface_normal, vector
from scanner_sim.part import FlatPart
from scanner_sim.raycast import side_at, upload_program

_STEPS = 4  # places that are tried between two points


def goes_on(
    part: FlatPart, surface: np.ndarray, first: np.ndarray, second: np.ndarray
) -> np.ndarray:
    """Return whether a face goes on between two of its points: at four places it bounds the part.

    Args:
        part: The solid.
        surface: Surface of every pair, shape (P,), i32.
        first: One point [mm], shape (P, 3).
        second: The other one, close to it [mm], shape (P, 3).

    Returns:
        Shape (P,), bool.
    """
    count = len(surface)
    whole = runtime.empty(count, np.int32)
    if count:
        runtime.ensure_started()
        _walk(*upload_program(part), *_arrays(surface, first, second), whole)
        runtime.sync()
    found: np.ndarray = runtime.download(whole)[:count] == 1
    return found


def side_near(
    part: FlatPart, surface: np.ndarray, point: np.ndarray, run: np.ndarray, probe: float
) -> np.ndarray:
    """Return on which side of its surface the part lies, close to a point of an edge; 0 = none.

    Args:
        part: The solid.
        surface: Surface of every point, shape (N,).
        point: Points on it [mm], shape (N, 3).
        run: Direction of the edge, shape (N, 3).
        probe: How far from the edge to look [mm].

    Returns:
        1 = inside, -1 = outside, 0 = the surface bounds the part on neither side of the edge,
        shape (N,), i32.
    """
    count = len(surface)
    sides = runtime.empty(count, np.int32)
    if count:
        runtime.ensure_started()
        _look_aside(*upload_program(part), *_arrays(surface, point, run), float(probe), sides)
        runtime.sync()
    return runtime.download(sides)[:count]


def passing(
    part: FlatPart,
    surface: np.ndarray,
    ends: tuple[np.ndarray, np.ndarray],
    touch: float,
    slack: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return, for short pieces of edges, the other surfaces that pass through them.

    Args:
        part: The solid.
        surface: Surface on which every piece was found, shape (E,), i32.
        ends: Both ends of every piece [mm], shapes (E, 3).
        touch: One end is this close to a surface that passes [mm].
        slack: And so close is the middle [mm].

    Returns:
        Pieces, and the surface that passes through each, shapes (M,); by piece, then by surface.
    """
    count = len(surface)
    if count == 0:
        return np.empty(0, np.int64), np.empty(0, np.int32)
    runtime.ensure_started()
    surfaces = (runtime.upload(part.surfaces.kind), runtime.upload(part.surfaces.data))
    limits = np.ascontiguousarray(part.surface_boxes.reshape(-1, 6))
    pieces = (*surfaces, runtime.upload(limits), *_arrays(surface, *ends))
    starts = runtime.zeros(count + 1, np.int32)
    _find_passing(*pieces, touch, slack, 0, starts, runtime.empty(1, np.int32))
    runtime.sync()
    first = np.cumsum(runtime.download(starts)[: count + 1]).astype(np.int32)
    others = runtime.empty(max(int(first[-1]), 1), np.int32)
    _find_passing(*pieces, touch, slack, 1, runtime.upload(first), others)
    runtime.sync()
    near = np.repeat(np.arange(count), np.diff(first))
    return near, runtime.download(others)[: first[-1]]


def _arrays(index: np.ndarray, *rows: np.ndarray) -> tuple[object, ...]:
    return (
        runtime.upload(np.ascontiguousarray(index, np.int32)),
        *(runtime.upload(np.ascontiguousarray(row, np.float64)) for row in rows),
    )


@ti.func
def _onto(kind, data: ti.template(), s, p):
    """Return the place on surface s that is nearest to a place beside it."""
    for _ in ti.static(range(2)):
        p -= distance(kind, data, s, p) * surface_normal(kind, data, s, p)
    return p


@ti.kernel
def _walk(
    # In:
    code_in: I32Rows,
    first_in: I32Array,
    grid_in: F64Rows,
    kinds_in: I32Array,
    data_in: F64Rows,
    index_in: I32Array,
    starts_in: F64Rows,
    ends_in: F64Rows,
    # Out:
    whole_out: I32Array,
):
    """Try places between two points of a face, until one is not on the part."""
    for i in range(index_in.shape[0]):
        s = index_in[i]
        start, end = vector(starts_in, i, 0), vector(ends_in, i, 0)
        whole = 1
        for k in range(_STEPS):
            if whole == 1:
                p = start + (k + 1.0) / (_STEPS + 1.0) * (end - start)
                p = _onto(kinds_in[s], data_in, s, p)
                if side_at(code_in, first_in, grid_in, kinds_in, data_in, p, s) == 0:
                    whole = 0
        whole_out[i] = whole


@ti.kernel
def _look_aside(
    # In:
    code_in: I32Rows,
    first_in: I32Array,
    grid_in: F64Rows,
    kinds_in: I32Array,
    data_in: F64Rows,
    index_in: I32Array,
    points_in: F64Rows,
    runs_in: F64Rows,
    probe: ti.f64,
    # Out:
    sides_out: I32Array,
):
    """Look for the face on either side of an edge."""
    for i in range(index_in.shape[0]):
        s = index_in[i]
        kind = kinds_in[s]
        p = vector(points_in, i, 0)
        across = vector(runs_in, i, 0).cross(surface_normal(kind, data_in, s, p))
        side = 0
        for k in range(2):
            if side == 0:
                there = _onto(kind, data_in, s, p + (2.0 * k - 1.0) * probe * across)
                side = side_at(code_in, first_in, grid_in, kinds_in, data_in, there, s)
        sides_out[i] = side


@ti.kernel
def _find_passing(
    # In:
    kinds_in: I32Array,
    data_in: F64Rows,
    limits_in: F64Rows,
    index_in: I32Array,
    starts_in: F64Rows,
    ends_in: F64Rows,
    touch: ti.f64,
    slack: ti.f64,
    write: ti.i32,
    # Out:
    first_out: I32Array,
    others_out: I32Array,
):
    """Count the surfaces of every piece into the place after its own; then write them down."""
    for i in range(index_in.shape[0]):
        start, end = vector(starts_in, i, 0), vector(ends_in, i, 0)
        middle = 0.5 * (start + end)
        found = 0
        for s in range(kinds_in.shape[0]):
            near = s != index_in[i]
            for k in ti.static(range(3)):
                if middle[k] < limits_in[s, k] - slack or middle[k] > limits_in[s, k + 3] + slack:
                    near = False
            if near and ti.abs(distance(kinds_in[s], data_in, s, middle)) < slack:
                gap = ti.min(
                    ti.abs(distance(kinds_in[s], data_in, s, start)),
                    ti.abs(distance(kinds_in[s], data_in, s, end)),
                )
                if gap < touch:
                    if write == 1:
                        others_out[first_out[i] + found] = s
                    found += 1
        if write == 0:
            first_out[i + 1] = found
