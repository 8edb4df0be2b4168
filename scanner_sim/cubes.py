"""A part cut into equal cubes, and in each of them what is left of the part's program.

In a small cube most surfaces have one side only, so most of the program is decided: a union with
what is solid there is solid, one with what is empty there is the rest. What is left are the few
instructions about surfaces that pass through the cube; in most cubes none. Rays go from cube to
cube, points ask theirs, and the answers are those of the whole program.
"""

from typing import NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, ti
from octoseg_ti.types import SurfaceKind
from scanner_sim.crossings import distance
from scanner_sim.part import FlatPart, Op

_PLANE = int(SurfaceKind.PLANE)
_LEAF, _UNION = int(Op.LEAF), int(Op.UNION)
_COARSE = 4  # cubes along the longest side of the part, to begin with
_HALVINGS = 4
_MARGIN = 1e-3  # the cubes reach so far beyond the part [mm]
_ROOM = 1e-4  # a cube's program also holds for places this far outside of it [mm]
_DEPTH = 32  # values on the stack; two bits each fill a word
_EMPTY, _OPEN, _SOLID = 0, 1, 3  # what is known about a value: false, not decided, true


class Cubes(NamedTuple):
    """The cubes of a part; ``C`` of them, x slowest, z fastest."""

    code: np.ndarray
    """Instructions (`Op`, arg, flag) of all cubes, shape (M, 3), i32."""
    first: np.ndarray
    """Where the instructions of each cube begin, and the end of the last, shape (C + 1,), i32."""
    grid: np.ndarray
    """Lower corner [mm], edge length [mm], and number of cubes along x, y, z; shape (3, 3), f64."""


def divide(part: FlatPart) -> Cubes:
    """Cut the box around a part into cubes, coarse ones first, and those in eight."""
    runtime.ensure_started()
    low, high = part.box[0] - _MARGIN, part.box[1] + _MARGIN
    size = float((high - low).max()) / _COARSE
    count = np.maximum(np.ceil((high - low) / size - 1e-9), 1.0).astype(np.int64)
    kinds, data = runtime.upload(part.surfaces.kind), runtime.upload(part.surfaces.data)
    code, first = part.code, np.array([0, len(part.code)], np.int32)
    parent = np.zeros(int(count.prod()), np.int32)
    for step in range(_HALVINGS + 1):
        if step:
            parent = _parents(count)
            size, count = size / 2.0, 2 * count
        grid = np.stack([low, np.full(3, size), count])
        # A program never gets longer, so the parent's length is room enough.
        room = np.diff(first)[parent]
        start = np.concatenate([[0], np.cumsum(room)]).astype(np.int32)
        rows = runtime.empty((max(int(start[-1]), 1), 3), np.int32)
        lengths = runtime.empty(len(parent), np.int32)
        _decide(
            runtime.upload(code), runtime.upload(first), runtime.upload(parent),
            runtime.upload(start), kinds, data, runtime.upload(grid), rows, lengths,
        )  # fmt: skip
        runtime.sync()
        length = runtime.download(lengths)[: len(parent)]
        used = np.arange(start[-1]) < np.repeat(start[:-1] + length, room)
        code = runtime.download(rows)[: start[-1]][used]
        if len(code) == 0:
            code = np.zeros((1, 3), np.int32)  # kernels take no empty arrays
        first = np.concatenate([[0], np.cumsum(length)]).astype(np.int32)
    return Cubes(code, first, grid)


def _parents(count: np.ndarray) -> np.ndarray:
    """Return, for the cubes of half the size, the number of the one that each is part of."""
    x, y, z = (np.arange(2 * n) // 2 for n in count)
    number = (x[:, None, None] * count[1] + y[:, None]) * count[2] + z
    return number.astype(np.int32).ravel()


@ti.func
def _reach(kind, data: ti.template(), s, size):
    """Return how much the distance to surface s differs at most between a cube and its middle."""
    reach = ti.sqrt(3.0)
    if kind == _PLANE:
        reach = ti.abs(data[s, 3]) + ti.abs(data[s, 4]) + ti.abs(data[s, 5])
    return 0.5 * size * reach


@ti.kernel
def _decide(
    # In:
    code_in: I32Rows,
    first_in: I32Array,
    parent_in: I32Array,
    start_in: I32Array,
    kinds_in: I32Array,
    data_in: F64Rows,
    grid_in: F64Rows,
    # Out:
    code_out: I32Rows,
    length_out: I32Array,
):
    """Write for every cube what is left of its parent's program, and how long that is.

    Of every value on the stack it is known whether it is decided, and where its instructions begin:
    they go when what they are joined with decides.
    """
    for c in range(parent_in.shape[0]):
        size = grid_in[1, 0]
        planes, rows = ti.i32(grid_in[2, 2]), ti.i32(grid_in[2, 1])
        place = ti.Vector([c // (planes * rows), c // planes % rows, c % planes])
        middle = ti.Vector([grid_in[0, k] + (place[k] + 0.5) * size for k in range(3)])
        begin = ti.Vector([0] * _DEPTH)
        stack = ti.i64(0)
        depth, length = 0, 0
        for i in range(first_in[parent_in[c]], first_in[parent_in[c] + 1]):
            op, arg, flag = code_in[i, 0], code_in[i, 1], code_in[i, 2]
            value = _OPEN
            kept = True
            if op == _LEAF:
                begin[depth] = length
                depth += 1
                gap = distance(kinds_in[arg], data_in, arg, middle)
                if ti.abs(gap) > _reach(kinds_in[arg], data_in, arg, size) + _ROOM:
                    value = _SOLID if (gap < 0.0) != (flag == 1) else _EMPTY
                    kept = False
            else:
                depth -= 1
                left, right = ti.i32((stack >> 2) & 3), ti.i32(stack & 3)
                stack = stack >> 4
                decided = _SOLID if op == _UNION else _EMPTY
                if left == decided or right == decided:
                    value = decided
                    length = begin[depth - 1]
                elif left != _OPEN and right != _OPEN:
                    value = left
                # Where only one is open, the other does not matter: its instructions are enough.
                kept = left == _OPEN and right == _OPEN
            stack = (stack << 2) | value
            if kept:
                at = start_in[c] + length
                code_out[at, 0], code_out[at, 1], code_out[at, 2] = op, arg, flag
                length += 1
        length_out[c] = length
