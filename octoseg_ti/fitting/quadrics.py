"""Planes and quadrics through many groups of points, in closed form.

A quadric is a height over the plane: a + b u + c v + d u^2 + e u v + f v^2. Every smooth surface is
nearly one over a neighbourhood that is small beside its radii, so its residual tells how far points
scatter, and how much any curved surface could gain over the plane.
"""

from typing import Any, NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, symmetric_eigen, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, ti

QUADRIC_FREEDOM = 6
"""Degrees of freedom of a quadric."""

_RIDGE = 1e-12
# Columns of the work of a group: normal equations (lower triangle by rows) and right side.
_RIGHT, _WORK = 21, 27
# Columns of what is found: centre and normal first; the sums are those of squares of cosines with
# the plane and with the quadric, of squares of normals, and of cosines with the plane.
_EXTENT, _FLAT, _SQUARE, _SUMS, _BEND, _FOUND = 6, 7, 8, 9, 13, 16

vec4: Any = ti.types.vector(4, ti.f64)
vec6: Any = ti.types.vector(6, ti.f64)
vec21: Any = ti.types.vector(21, ti.f64)


class Quadrics(NamedTuple):
    """Planes and quadrics through ``G`` groups; of two columns the plane comes first."""

    centre: np.ndarray
    """Centre of every group [mm], shape (G, 3)."""
    normal: np.ndarray
    """Unit normal of its plane, shape (G, 3)."""
    rms: np.ndarray
    """Root mean square height over plane and quadric [mm], shape (G, 2)."""
    tilt: np.ndarray
    """Root mean square sine between measured normals and those of plane and quadric, (G, 2)."""
    side: np.ndarray
    """Mean cosine between measured normals and that of the plane, shape (G,)."""
    bend: np.ndarray
    """Largest curvature of the quadric, times the root mean square distance of the points from
    their centre, shape (G,)."""


@ti.func
def _frame(points: ti.template(), first: ti.i32, last: ti.i32):
    """Return centre, extent, mean square height over the plane in extents, and the axes w, u, v."""
    count = ti.cast(ti.max(last - first, 1), ti.f64)
    centre = vec3(0.0, 0.0, 0.0)
    for i in range(first, last):
        centre += row(points, i)
    centre /= count
    main = vec3(0.0, 0.0, 0.0)
    mixed = vec3(0.0, 0.0, 0.0)
    for i in range(first, last):
        q = row(points, i) - centre
        main += q * q
        mixed += vec3(q[0] * q[1], q[0] * q[2], q[1] * q[2])
    square = ti.max((main[0] + main[1] + main[2]) / count, 1e-300)
    m = main / (count * square)
    n = mixed / (count * square)
    value, w, u, v = symmetric_eigen(m[0], n[0], n[1], m[1], n[2], m[2])
    return centre, ti.sqrt(square), value[0], w, u, v


@ti.func
def _terms(u: ti.f64, v: ti.f64) -> vec6:
    """Return what the factors of a quadric are multiplied by."""
    return vec6(1.0, u, v, u * u, u * v, v * v)


@ti.func
def _write_equations(
    points: ti.template(),
    first: ti.i32,
    last: ti.i32,
    centre: vec3,
    along: vec3,
    across: vec3,
    up: vec3,
    work: ti.template(),
    g: ti.i32,
):
    """Write the normal equations of the quadric through some points."""
    normal = vec21(0.0)
    right = vec6(0.0)
    for i in range(first, last):
        q = row(points, i) - centre
        t = _terms(q.dot(along), q.dot(across))
        right += q.dot(up) * t
        for a in ti.static(range(6)):
            for b in ti.static(range(a + 1)):
                normal[a * (a + 1) // 2 + b] += t[a] * t[b]
    count = ti.cast(ti.max(last - first, 1), ti.f64)
    for k in ti.static(range(21)):
        work[g, k] = normal[k] / count
    for k in ti.static(range(6)):
        work[g, _RIGHT + k] = right[k] / count


@ti.func
def _solve(work: ti.template(), g: ti.i32):
    """Replace the right side by the solution: Cholesky with loops, small to compile."""
    for a in range(6):
        for b in range(a + 1):
            k = a * (a + 1) // 2 + b
            s = work[g, k]
            for c in range(b):
                s -= work[g, a * (a + 1) // 2 + c] * work[g, b * (b + 1) // 2 + c]
            if a == b:
                # What no point holds is next to nothing.
                work[g, k] = ti.sqrt(ti.max(s + _RIDGE, _RIDGE))
            else:
                work[g, k] = s / work[g, b * (b + 1) // 2 + b]
        s = work[g, _RIGHT + a]
        for c in range(a):
            s -= work[g, a * (a + 1) // 2 + c] * work[g, _RIGHT + c]
        work[g, _RIGHT + a] = s / work[g, a * (a + 1) // 2 + a]
    for back in range(6):
        a = 5 - back
        s = work[g, _RIGHT + a]
        for c in range(a + 1, 6):
            s -= work[g, c * (c + 1) // 2 + a] * work[g, _RIGHT + c]
        work[g, _RIGHT + a] = s / work[g, a * (a + 1) // 2 + a]


@ti.kernel
def _fit(
    groups: ti.i32,
    stride: ti.i32,
    # In:
    point_in: F64Rows,
    normal_in: F64Rows,
    start_in: I32Array,
    # Out:
    work_inout: F64Rows,
    found_out: F64Rows,
):
    """Fit a plane and a quadric to every group, one group after the other inside."""
    for t in range(groups * stride):
        if t % stride == 0:
            g = t // stride
            first = start_in[g]
            last = start_in[g + 1]
            centre, extent, flat, up, along, across = _frame(point_in, first, last)
            # Lengths in extents.
            up /= extent
            along /= extent
            across /= extent
            _write_equations(point_in, first, last, centre, along, across, up, work_inout, g)
            _solve(work_inout, g)
            h = vec6(0.0)
            for k in ti.static(range(6)):
                h[k] = work_inout[g, _RIGHT + k]
            square = 0.0
            sums = vec4(0.0, 0.0, 0.0, 0.0)
            for i in range(first, last):
                q = row(point_in, i) - centre
                n = extent * row(normal_in, i)
                u = q.dot(along)
                v = q.dot(across)
                off = q.dot(up) - h.dot(_terms(u, v))
                square += off * off
                slope_u = h[1] + 2.0 * h[3] * u + h[4] * v
                slope_v = h[2] + h[4] * u + 2.0 * h[5] * v
                facing = n.dot(up)
                cosine = facing - slope_u * n.dot(along) - slope_v * n.dot(across)
                cosine *= cosine / (1.0 + slope_u * slope_u + slope_v * slope_v)
                sums += vec4(facing * facing, cosine, row(normal_in, i).norm_sqr(), facing)
            for k in ti.static(range(3)):
                found_out[g, k] = centre[k]
                found_out[g, 3 + k] = extent * up[k]
                found_out[g, _BEND + k] = h[3 + k]
            for k in ti.static(range(4)):
                found_out[g, _SUMS + k] = sums[k]
            found_out[g, _EXTENT] = extent
            found_out[g, _FLAT] = flat
            found_out[g, _SQUARE] = square / ti.cast(ti.max(last - first, 1), ti.f64)


def fit_quadrics(point: np.ndarray, normal: np.ndarray, start: np.ndarray) -> Quadrics:
    """Fit a plane and a quadric to every group of points.

    Args:
        point: Points of the groups, one group after the other [mm], shape (S, 3), f64.
        normal: Measured unit normals, zero where there is none, shape (S, 3), f64.
        start: First point of every group, and S at the end, ascending, shape (G + 1,); no group is
            empty.
    """
    runtime.ensure_started()
    groups = len(start) - 1
    found = runtime.empty((groups, _FOUND), np.float64)
    _fit(
        groups,
        runtime.workers()[1],
        runtime.upload(np.asarray(point, np.float64)),
        runtime.upload(np.asarray(normal, np.float64)),
        runtime.upload(np.asarray(start, np.int32)),
        runtime.empty((groups, _WORK), np.float64),
        found,
    )
    f = runtime.download(found)[:groups]
    sums = f[:, _SUMS : _SUMS + 4]
    known = np.maximum(sums[:, 2], 1e-300)
    squares = np.maximum(f[:, [_FLAT, _SQUARE]], 0.0)
    middle, apart = f[:, _BEND] + f[:, _BEND + 2], f[:, _BEND] - f[:, _BEND + 2]
    return Quadrics(
        centre=f[:, :3],
        normal=f[:, 3:6],
        rms=np.sqrt(squares) * f[:, _EXTENT, None],
        tilt=np.sqrt(np.maximum(1.0 - sums[:, :2] / known[:, None], 0.0)),
        side=sums[:, 3] / known,
        bend=np.abs(middle) + np.hypot(apart, f[:, _BEND + 1]),
    )
