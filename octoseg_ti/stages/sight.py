"""Lines of sight that are blocked: a probe sees nothing that lies behind a surface.

A mirror image looks like a face, but lies where the light would have come from had it gone straight
on: mostly inside the part, behind the surface that mirrored it. Lines of sight are followed through
the cells of the grid, step by step. A point blocks one that passes through the surface beside it;
holes, which a large cell may bridge, do not.
"""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, ti
from octoseg_ti.stages.grid import Grid, find_node
from octoseg_ti.stages.moments import HI, LO, POINT

_GRAZING = 0.2  # a line that meets a plane at a smaller sine may as well pass beside it
_STEPS = 4096.0  # of a line at most

ivec4: Any = ti.types.vector(4, ti.i32)


@ti.func
def _entry(start: vec3, way: vec3, high: vec3) -> ti.f64:
    """Return how far along a line it enters the box from 0 to ``high``."""
    first = 0.0
    for c in ti.static(range(3)):
        if way[c] > 0.0 and start[c] < 0.0:
            first = ti.max(first, -start[c] / way[c])
        if way[c] < 0.0 and start[c] > high[c]:
            first = ti.max(first, (high[c] - start[c]) / way[c])
    return first


@ti.func
def _through(start: vec3, way: vec3, last: ti.f64, reach: ti.f64, p: vec3, normal: vec3) -> ti.i32:
    """Say whether a line meets the tangent plane at a point near that, before its last part."""
    down = way.dot(normal)
    met = 0
    if ti.abs(down) > _GRAZING:
        far = (p - start).dot(normal) / down
        if far < last and (start + far * way - p).norm() < reach:
            met = 1
    return met


@ti.kernel
def _follow(
    rule: vec3,
    boxes: ivec4,
    # In:
    line_in: F64Rows,
    root_in: I32Array,
    child_in: I32Rows,
    node_in: I32Rows,
    mean_in: F64Rows,
    point_in: F64Rows,
    normal_in: F64Rows,
    label_in: I32Array,
    weight_in: I32Array,
    # Out:
    blocked_out: I32Array,
):
    """Write whether a point whose label weighs more than the least blocks a line.

    A line holds its start, its end, and that least weight; the first weight is that of no label.
    The rule holds the size of the smallest cells, the length at the end that is left out, and the
    reach of a point. Of a large cell only what lies near its mean plane is looked at.
    """
    for a in blocked_out:
        finest, reach, depth = rule[0], rule[2], boxes[3]
        shape = ti.Vector([boxes[0], boxes[1], boxes[2]])
        start = vec3(line_in[a, 0], line_in[a, 1], line_in[a, 2])
        way = vec3(line_in[a, 3], line_in[a, 4], line_in[a, 5]) - start
        length = ti.max(way.norm(), 1e-300)
        way /= length
        first = _entry(start, way, ti.cast(shape, ti.f64) * (finest * ti.cast(1 << depth, ti.f64)))
        last = length - rule[1]
        steps = ti.cast(ti.ceil(ti.max(0.0, ti.min((last - first) / finest, _STEPS))), ti.i32)
        step = (last - first) / ti.max(steps, 1)
        blocked = 0
        k = 0
        while k < steps and blocked == 0:
            p = start + (first + (k + 0.5) * step) * way
            at = ti.cast(ti.floor(p / finest), ti.i32)
            c = find_node(at[0], at[1], at[2], depth, shape, depth, root_in, child_in)
            if c >= 0:
                middle = vec3(mean_in[c, POINT], mean_in[c, POINT + 1], mean_in[c, POINT + 2])
                if ti.abs((p - middle).dot(row(mean_in, c))) <= step + reach:
                    i = node_in[c, LO]
                    while i < node_in[c, HI] and blocked == 0:
                        if weight_in[label_in[i] + 1] > line_in[a, 6]:
                            blocked = _through(
                                start, way, last, reach, row(point_in, i), row(normal_in, i)
                            )
                        i += 1
            k += 1
        blocked_out[a] = blocked


def blocked_lines(
    grid: Grid,
    origin: np.ndarray,
    point: np.ndarray,
    least: np.ndarray,
    label: np.ndarray,
    weight: np.ndarray,
    *,
    clear: float,
    reach: float,
) -> np.ndarray:
    """Say which lines of sight pass through a surface.

    Args:
        grid: The sparse grid.
        origin: Where every line starts, relative to the corner of the grid [mm], shape (A, 3), f64.
        point: Where it ends, shape (A, 3), f64.
        least: Only points whose label weighs more than this block it, shape (A,).
        label: Label of every sorted point, 0..K-1, -1 = none, shape (n,), i32.
        weight: Weight of every label, shape (K,); points without one weigh nothing.
        clear: What is nearer to the end of a line does not block it [mm].
        reach: A point stands for the surface around it, so far [mm].

    Returns:
        True for a line that is blocked, shape (A,), bool.
    """
    runtime.ensure_started()
    if len(least) == 0:
        return np.zeros(0, bool)
    blocked = runtime.empty(len(least), np.int32)
    _follow(
        vec3(grid.size / 2.0**grid.depth, clear, reach),
        ivec4(*grid.shape, grid.depth),
        runtime.upload(np.column_stack([origin, point, least.astype(np.float64)])),
        grid.root,
        grid.child,
        grid.node,
        grid.mean,
        grid.point,
        grid.normal,
        runtime.upload(label),
        runtime.upload(np.append(0, weight).astype(np.int32)),
        blocked,
    )
    return runtime.download(blocked) > 0
