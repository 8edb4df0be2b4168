"""Where the fit of a plane, cylinder, cone, sphere and torus begins: closed forms over moments.

A line along the normal of a surface of revolution meets its axis. With k = p x n and the moment
m = c x a of an axis through c along a this reads a.k + m.n = 0, linear in the axis and blind to
the sign of the normals (the linear line complex; Pottmann & Wallner 2001, Computational Line
Geometry, section 6). So a few directions are tried as axis, each gets its place from the normals,
and in the half plane of distance and height the surface is a line or a circle.
"""

from typing import NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import mat3, row, vec2, vec3
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, ti
from octoseg_ti.device.surfaces import CONE, CYLINDER, KINDS, PLANE, SPHERE, TORUS
from octoseg_ti.fitting.motions import STATE

_DIRECTIONS = 6  # tried as axis
_FAR = 1e3  # no start is farther from the points than this, in units of their extent
_LEAST = 1e-2  # the smallest ring to start from, in extents: at none, nothing would move it
_OTHER = 0.87  # cosine below which a direction is quite another one
_RIDGE = 1e-6  # of the mean square of the normals: keeps what they leave open near the points


class Moments(NamedTuple):
    """Means over the samples of every group, with q = (p - centre) / extent and k = q x n."""

    weight: np.ndarray
    """Sum of the weights, (G,)."""
    centre: np.ndarray
    """Centre [mm], (G, 3)."""
    extent: np.ndarray
    """Root mean square distance from the centre [mm], (G,)."""
    qq: np.ndarray
    nn: np.ndarray
    kk: np.ndarray
    nk: np.ndarray
    """Mean outer products, (G, 3, 3)."""
    wq: np.ndarray
    """Mean of |q|^2 q, (G, 3)."""
    n: np.ndarray
    nnq: np.ndarray
    """Mean of n and of n (n.q), (G, 3)."""
    q: np.ndarray
    """Mean of q where there is a normal, zero elsewhere, (G, 3)."""
    ww: np.ndarray
    """Mean of |q|^4, (G,)."""


_COLUMNS = 2 + 5 * 3 + 4 * 9


@ti.func
def _put(rows: ti.template(), i: ti.i32, at: ti.i32, v: vec3):
    """Write a vector into row ``i`` from column ``at`` on."""
    for k in ti.static(range(3)):
        rows[i, at + k] = v[k]


@ti.func
def _centre(point: ti.template(), weight: ti.template(), lo: ti.i32, hi: ti.i32):
    """Return (sum of the weights, centre) of the samples lo..hi."""
    total = 0.0
    centre = vec3(0.0, 0.0, 0.0)
    for i in range(lo, hi):
        total += weight[i]
        centre += weight[i] * row(point, i)
    return total, centre / ti.max(total, 1e-300)


@ti.kernel
def _gather_moments(
    groups: ti.i32,
    stride: ti.i32,
    # In:
    point_in: F64Rows,
    normal_in: F64Rows,
    weight_in: F64Array,
    start_in: I32Array,
    # Out:
    moment_out: F64Rows,
):
    """Write sums over the samples of every group; a second round about the centre of the first."""
    for t in range(groups * stride):
        if t % stride == 0:
            g = t // stride
            total, centre = _centre(point_in, weight_in, start_in[g], start_in[g + 1])
            square = 0.0
            qq = mat3(0.0)
            nn = mat3(0.0)
            kk = mat3(0.0)
            nk = mat3(0.0)
            wq = vec3(0.0, 0.0, 0.0)
            sn = vec3(0.0, 0.0, 0.0)
            nnq = vec3(0.0, 0.0, 0.0)
            sq = vec3(0.0, 0.0, 0.0)
            for i in range(start_in[g], start_in[g + 1]):
                w = weight_in[i]
                q = row(point_in, i) - centre
                n = row(normal_in, i)
                wn = w * n
                wk = q.cross(wn)
                c = q.norm_sqr()
                square += w * c * c
                qq += w * q.outer_product(q)
                nn += wn.outer_product(n)
                kk += wk.outer_product(q.cross(n))
                nk += n.outer_product(wk)
                wq += w * c * q
                sn += wn
                nnq += n.dot(q) * wn
                sq += w * n.norm_sqr() * q
            moment_out[g, 0] = total
            moment_out[g, 1] = square
            _put(moment_out, g, 2, centre)
            _put(moment_out, g, 5, wq)
            _put(moment_out, g, 8, sn)
            _put(moment_out, g, 11, nnq)
            _put(moment_out, g, 14, sq)
            for k in ti.static(range(9)):
                moment_out[g, 17 + k] = qq[k // 3, k % 3]
                moment_out[g, 26 + k] = nn[k // 3, k % 3]
                moment_out[g, 35 + k] = kk[k // 3, k % 3]
                moment_out[g, 44 + k] = nk[k // 3, k % 3]


def gather_moments(
    points: np.ndarray, normals: np.ndarray, weight: np.ndarray, start: np.ndarray
) -> Moments:
    """Return the moments of every group; arguments as of `fit_all`, all given."""
    runtime.ensure_started()
    groups = len(start) - 1
    raw = runtime.empty((groups, _COLUMNS), np.float64)
    stride = runtime.workers()[1]
    _gather_moments(
        groups,
        stride,
        runtime.upload(points),
        runtime.upload(normals),
        runtime.upload(weight),
        runtime.upload(start),
        raw,
    )
    m = runtime.download(raw)[:groups]
    total = np.maximum(m[:, 0], 1e-300)
    mean = m / total[:, None]
    matrices = mean[:, 17:].reshape(groups, 4, 3, 3)
    square = np.trace(matrices[:, 0], axis1=1, axis2=2)
    extent = np.sqrt(square)
    e = np.where(extent > 0.0, extent, 1.0)
    e1, e2 = e[:, None], e[:, None, None]
    return Moments(
        weight=m[:, 0],
        centre=m[:, 2:5],
        extent=extent,
        qq=matrices[:, 0] / e2**2,
        nn=matrices[:, 1],
        kk=matrices[:, 2] / e2**2,
        nk=matrices[:, 3] / e2,
        wq=mean[:, 5:8] / e1**3,
        n=mean[:, 8:11],
        nnq=mean[:, 11:14] / e1,
        q=mean[:, 14:17] / e1,
        ww=mean[:, 1] / e**4,
    )


@ti.kernel
def _gather_profiles(
    tasks: ti.i32,
    stride: ti.i32,
    # In:
    point_in: F64Rows,
    normal_in: F64Rows,
    weight_in: F64Array,
    start_in: I32Array,
    frame_in: F64Rows,
    axis_in: F64Rows,
    # Out:
    moment_out: F64Rows,
):
    """Write sums over x = rho - its middle and z of every group about every axis tried."""
    for t in range(tasks * stride):
        if t % stride == 0:
            j = t // stride
            g = j // _DIRECTIONS
            origin = row(axis_in, j)
            axis = vec3(axis_in[j, 3], axis_in[j, 4], axis_in[j, 5])
            middle = origin.norm()
            s = vec3(0.0, 0.0, 0.0)
            xz = vec3(0.0, 0.0, 0.0)
            cq = vec3(0.0, 0.0, 0.0)
            nn = vec3(0.0, 0.0, 0.0)
            tq = vec2(0.0, 0.0)
            for i in range(start_in[g], start_in[g + 1]):
                w = weight_in[i]
                q = (row(point_in, i) - row(frame_in, g)) * frame_in[g, 3] - origin
                n = row(normal_in, i)
                z = axis.dot(q)
                away = q - z * axis
                rho = away.norm()
                x = rho - middle
                nz = n.dot(axis)
                nx = n.dot(away) / ti.max(rho, 1e-12)
                c = x * x + z * z
                s += w * vec3(x, z, c)
                xz += w * vec3(x * x, x * z, z * z)
                cq += w * vec3(c * x, c * z, c * c)
                nn += w * vec3(nx * nx, nx * nz, nz * nz)
                tq += (w * (nx * z - nz * x)) * vec2(-nz, nx)
            _put(moment_out, j, 0, s)
            _put(moment_out, j, 3, xz)
            _put(moment_out, j, 6, cq)
            _put(moment_out, j, 9, nn)
            moment_out[j, 12] = tq[0]
            moment_out[j, 13] = tq[1]


def _solve(matrix: np.ndarray, right: np.ndarray, ridge: float = 1e-12) -> np.ndarray:
    """Return the solutions of stacked symmetric systems, kept finite where they are singular."""
    value, vector = np.linalg.eigh(matrix)
    floor = np.maximum(ridge * np.abs(value).max(axis=-1, keepdims=True), 1e-300)
    part = np.einsum("...ji,...j->...i", vector, right) / np.maximum(value, floor)
    return np.einsum("...ij,...j->...i", vector, part)


def _size(v: np.ndarray) -> np.ndarray:
    """Return the lengths of vectors, shape (..., 1)."""
    size: np.ndarray = np.sqrt(np.sum(v * v, axis=-1, keepdims=True))
    return size


def _limited(v: np.ndarray) -> np.ndarray:
    """Return vectors cut to the longest that is allowed."""
    return v * np.minimum(1.0, _FAR / np.maximum(_size(v), 1e-300))


def _toward(v: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Return directions of vectors; the other ones where a vector is too short to have any."""
    size = _size(v)
    return np.where(size > 1e-6, v / np.maximum(size, 1e-6), otherwise)


def across(axis: np.ndarray) -> np.ndarray:
    """Return a unit vector at right angles to each axis, shape (..., 3); of none, zero."""
    x, y, z = np.moveaxis(axis, -1, 0)
    aside = np.abs(x) < 0.6
    # The axis times the x axis, and where that is near it, times the y axis.
    v = np.zeros(axis.shape)
    v[..., 0], v[..., 1] = np.where(aside, 0.0, -z), np.where(aside, z, 0.0)
    v[..., 2] = np.where(aside, -y, x)
    size = _size(v)
    return np.divide(v, size, out=np.zeros_like(v), where=size > 0)


def _axes(m: Moments) -> np.ndarray:
    """Return the axes to try, point and direction in scaled units, shape (G, _DIRECTIONS, 6)."""
    size = np.trace(m.nn, axis1=1, axis2=2)
    size = np.where(size > 0.0, size, 1.0)[:, None, None]
    centred = m.nn - m.n[:, :, None] * m.n[:, None, :] / size
    inverse = np.linalg.inv(m.nn + (1e-9 * size) * np.eye(3))
    line = m.kk - np.swapaxes(m.nk, 1, 2) @ inverse @ m.nk
    finite = np.nan_to_num(np.stack((m.nn, centred, (line + np.swapaxes(line, 1, 2)) / 2, m.qq)))
    vector = np.linalg.eigh(finite)[1]
    axis = np.stack((*vector[:, :, :, 0], vector[3, :, :, 1], vector[3, :, :, 2]), axis=1)
    u = across(axis)
    v = np.cross(axis, u)
    basis = np.stack((u, v), axis=-1)  # (G, D, 3, 2)
    system = np.swapaxes(basis, -1, -2) @ m.nn[:, None] @ basis + (_RIDGE * size[:, None]) * np.eye(
        2
    )
    right = -np.einsum("gdic,gij,gdj->gdc", basis, m.nk, axis)
    moment = np.einsum("gdic,gdc->gdi", basis, _solve(system, right))
    return np.concatenate((_limited(np.cross(axis, moment)), axis), axis=-1)


def _spheres(m: Moments) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and radius of a sphere to start from: lines along normals, or an algebraic fit.

    Of the two the one with the smaller deviation, to first order (E|q|^2 = 1 by the scale).
    """
    size = np.trace(m.nn, axis1=1, axis2=2)[:, None, None]
    matrix = np.stack((size * np.eye(3) - m.nn, m.qq), axis=1)
    centre = _limited(_solve(matrix, np.stack((m.q - m.nnq, m.wq / 2.0), axis=1), _RIDGE))
    square = 1.0 + np.sum(centre**2, axis=-1)
    spread = (
        (m.ww - 1.0)[:, None]
        - 4.0 * np.einsum("gci,gi->gc", centre, m.wq)
        + 4.0 * np.einsum("gci,gij,gcj->gc", centre, m.qq, centre)
    )
    best = np.argmin(spread / square, axis=1)
    rows = np.arange(len(best))
    return centre[rows, best], np.sqrt(square[rows, best])


def _profile_means(
    points: np.ndarray,
    normals: np.ndarray,
    weight: np.ndarray,
    start: np.ndarray,
    m: Moments,
    axes: np.ndarray,
) -> np.ndarray:
    """Return the means in the half planes of all axes, shape (G, D, 14)."""
    groups = len(start) - 1
    frame = np.column_stack((m.centre, 1.0 / np.where(m.extent > 0.0, m.extent, 1.0)))
    tasks = groups * _DIRECTIONS
    raw = runtime.empty((tasks, 14), np.float64)
    _gather_profiles(
        tasks,
        runtime.workers()[1],
        runtime.upload(points),
        runtime.upload(normals),
        runtime.upload(weight),
        runtime.upload(start),
        runtime.upload(frame),
        runtime.upload(axes.reshape(tasks, 6)),
        raw,
    )
    sums = runtime.download(raw)[:tasks].reshape(groups, _DIRECTIONS, 14)
    return sums / np.maximum(m.weight, 1e-300)[:, None, None]


def _lines(f: np.ndarray, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (angle h, offset s, mean square deviation) of the line in every half plane.

    The line of least deviation; where the normals contradict it by more than 45 degrees, the one
    that they ask for.
    """
    xx, xz, zz = f[..., 3] - f[..., 0] ** 2, f[..., 4] - f[..., 0] * f[..., 1], f[..., 5]
    zz = zz - f[..., 1] ** 2
    # The direction of least spread is half a turn of the doubled angle from that of most.
    points = 0.5 * np.arctan2(-2.0 * xz, zz - xx)
    asked = 0.5 * np.arctan2(2.0 * f[..., 10], f[..., 9] - f[..., 11])
    far = np.abs(np.cos(points - asked)) < np.sqrt(0.5)
    turn = np.where(far, asked, points)
    c, s = np.cos(turn), np.sin(turn)
    square = c * c * xx + 2.0 * c * s * xz + s * s * zz
    return -turn, c * (f[..., 0] + middle) + s * f[..., 1], square


def _circles(
    f: np.ndarray, middle: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return (ring radius, height, tube radius, mean square deviation) in every half plane."""
    mean, c = f[..., :2], f[..., 2]
    cov = f[..., [[3, 4], [4, 5]]] - mean[..., :, None] * mean[..., None, :]
    cq = f[..., 6:8] - c[..., None] * mean
    cc = f[..., 8] - c * c
    # From the normals: t.(q - centre) = 0 with t at right angles to n; and by the points alone.
    tt = f[..., [[11, 10], [10, 9]]] * np.array([[1.0, -1.0], [-1.0, 1.0]])
    matrix, right = np.stack((tt, cov), axis=-3), np.stack((f[..., 12:14], cq / 2.0), axis=-2)
    centre = _limited(_solve(matrix, right, _RIDGE))
    off = centre - mean[..., None, :]
    tube = np.sqrt(np.trace(cov, axis1=-2, axis2=-1)[..., None] + np.sum(off**2, axis=-1))
    spread = (
        cc[..., None]
        - 4.0 * np.einsum("...ci,...i->...c", centre, cq)
        + 4.0 * np.einsum("...ci,...ij,...cj->...c", centre, cov, centre)
    )
    square = spread / (4.0 * np.maximum(tube, 1e-12) ** 2)
    ring = centre[..., 0] + middle[..., None]
    square = np.where(ring > 0.0, square, np.inf)
    best = np.argmin(square, axis=-1)[..., None]

    def take(a: np.ndarray) -> np.ndarray:
        return np.take_along_axis(a, best, axis=-1)[..., 0]

    return np.maximum(take(ring), 0.0), take(centre[..., 1]), take(tube), take(square)


def starts(
    points: np.ndarray, normals: np.ndarray, weight: np.ndarray, start: np.ndarray, m: Moments
) -> np.ndarray:
    """Return two states of every group and kind to start from, shape (2, G, KINDS, STATE).

    The second one has quite another axis, for cones and tori only: a saddle can be the inner side
    of a torus about either of two axes, and noise hides which. NaN = none.

    Args:
        points: Positions [mm], shape (S, 3), f64.
        normals: Normals, shape (S, 3), f64; their sign does not matter; zero = none.
        weight: Weights, shape (S,), f64.
        start: First sample of every group, and S at the end, shape (G + 1,), i32.
        m: The moments of the groups.

    Returns:
        Point, axis, a direction across it and shape, as `profile` reads it, in units of the extent
        of the group about its centre.
    """
    groups = len(start) - 1
    state = np.full((2, groups, KINDS, STATE), np.nan)
    state[0] = 0.0
    axes = _axes(m)
    f = np.nan_to_num(_profile_means(points, normals, weight, start, m, axes))
    middle = np.linalg.norm(axes[..., :3], axis=-1)
    # For every axis a cylinder, a cone and a torus, in this order. The best of each is taken, and
    # of the latter two also the best with another axis.
    every = np.zeros((3, groups, _DIRECTIONS, STATE))
    square = np.empty((3, groups, _DIRECTIONS))
    every[..., :6] = axes
    every[0, ..., 9], square[0] = f[..., 0] + middle, f[..., 3] - f[..., 0] ** 2
    every[1, ..., 9], every[1, ..., 10], square[1] = _lines(f, middle)
    ring, height, every[2, ..., 10], square[2] = _circles(f, middle)
    every[2, ..., 9] = np.maximum(ring, _LEAST)
    every[2, ..., :3] += height[..., None] * axes[..., 3:]
    square = np.nan_to_num(square, nan=np.inf)
    kinds, rows = np.array([[CYLINDER], [CONE], [TORUS]]), np.arange(groups)
    order = np.arange(3)[:, None]
    chosen = every[order, rows, np.argmin(square, axis=2)]
    state[0, rows, kinds] = chosen
    alike = np.abs(np.einsum("gdi,kgi->kgd", axes[..., 3:], chosen[1:, :, 3:6])) > _OTHER
    square = np.where(alike, np.inf, square[1:])
    other = every[order[1:], rows, np.argmin(square, axis=2)]
    found = np.isfinite(square.min(axis=2, keepdims=True))
    state[1, rows, kinds[1:]] = np.where(found, other, np.nan)
    state[0, :, SPHERE, :3], state[0, :, SPHERE, 9] = _spheres(m)
    state[0, :, PLANE, 3:6] = np.linalg.eigh(np.nan_to_num(m.qq))[1][:, :, 0]
    return with_directions(state)


def with_directions(state: np.ndarray) -> np.ndarray:
    """Return states with u, and the axis of spheres, towards the origin, which the points surround.

    Args:
        state: Points, axes and shapes, shape (..., KINDS, STATE).
    """
    state = state.copy()
    state[..., SPHERE, 3:6] = _toward(-state[..., SPHERE, :3], across(-state[..., SPHERE, :3]))
    axis, toward = state[..., 3:6], -state[..., :3]
    toward = toward - np.sum(toward * axis, axis=-1, keepdims=True) * axis
    state[..., 6:9] = _toward(toward, across(axis))
    return state
