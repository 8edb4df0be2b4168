"""Analytic surfaces in kernels: distance and normal of plane, cylinder, cone, sphere and torus.

All five are surfaces of revolution, so a point is described by its distance ``rho`` from the axis
and its height ``z`` along it, and the surface by a straight line or a circle in that half plane.
"""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, ti
from octoseg_ti.types import SurfaceKind

PLANE, CYLINDER, CONE = int(SurfaceKind.PLANE), int(SurfaceKind.CYLINDER), int(SurfaceKind.CONE)
SPHERE, TORUS = int(SurfaceKind.SPHERE), int(SurfaceKind.TORUS)
KINDS = 5
"""Number of analytic kinds; their codes are 0..KINDS - 1."""

vec4: Any = ti.types.vector(4, ti.f64)


@ti.func
def profile(kind: ti.i32, rho: ti.f64, z: ti.f64, shape: vec4) -> vec3:
    """Return (signed distance, normal's part from the axis, normal's part along the axis).

    Args:
        kind: `SurfaceKind` of the surface.
        rho: Distance from the axis.
        z: Height along the axis above the point of the surface.
        shape: (a, b, 0, 0) for all but the cone; for it (., s, cos h, sin h): the line
            ``rho cos h - z sin h = s``, so that h = 0 is a cylinder and h = 90 degrees a plane, and
            nothing goes wild between them.
    """
    d = z
    n_rho = 0.0
    n_z = 1.0
    if kind == CYLINDER:
        d = rho - shape[0]
        n_rho = 1.0
        n_z = 0.0
    elif kind == CONE:
        d = rho * shape[2] - z * shape[3] - shape[1]
        n_rho = shape[2]
        n_z = -shape[3]
    elif kind == SPHERE or kind == TORUS:
        x = rho
        radius = shape[0]
        if kind == TORUS:
            x = rho - shape[0]
            radius = shape[1]
        size = ti.sqrt(x * x + z * z)
        d = size - radius
        if size > 0.0:
            n_rho = x / size
            n_z = z / size
    return vec3(d, n_rho, n_z)


@ti.func
def cone_shape(half_angle: ti.f64, offset: ti.f64) -> vec4:
    """Return the shape of a cone for `profile`; the offset is 0 when its point is the apex."""
    return vec4(half_angle, offset, ti.cos(half_angle), ti.sin(half_angle))


@ti.func
def surface_at(kind: ti.i32, point: vec3, origin: vec3, axis: vec3, a: ti.f64, b: ti.f64):
    """Return (signed distance of a point, outward unit normal of the surface at its foot).

    The distance is positive outside: away from the axis of a cylinder or cone, the centre of a
    sphere, the ring of a torus; on the side of the normal of a plane. A cone is the half with
    its axis inside: a point behind the apex is as far as the apex is.
    """
    q = point - origin
    z = axis.dot(q)
    d = z
    n = axis
    if kind != PLANE:
        away = q - z * axis
        rho = away.norm()
        shape = vec4(a, b, 0.0, 0.0)
        if kind == CONE:
            shape = cone_shape(a, 0.0)
        f = profile(kind, rho, z, shape)
        d = f[0]
        n = f[2] * axis
        if rho > 0.0:
            n += (f[1] / rho) * away
        if kind == CONE and z * shape[2] + rho * shape[3] < 0.0:
            d = q.norm()
            n = q / d
    return d, n


@ti.func
def surface_in_row(table: ti.template(), s: ti.i32, kind: ti.i32, point: vec3):
    """Return what `surface_at` says of the surface whose parameters are row ``s`` of a table."""
    axis = vec3(table[s, 3], table[s, 4], table[s, 5])
    return surface_at(kind, point, row(table, s), axis, table[s, 6], table[s, 7])


@ti.kernel
def _evaluate(
    # In:
    point_in: F64Rows,
    which_in: I32Array,
    kind_in: I32Array,
    parameters_in: F64Rows,
    # Out:
    distance_out: F64Array,
    normal_out: F64Rows,
):
    """Write distance and normal of every point to the surface that it names."""
    for i in which_in:
        m = which_in[i]
        d, n = surface_in_row(parameters_in, m, kind_in[m], row(point_in, i))
        distance_out[i] = d
        for k in ti.static(range(3)):
            normal_out[i, k] = n[k]


def evaluate_surfaces(
    points: np.ndarray, which: np.ndarray, kind: np.ndarray, parameters: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far every point is from the surface that it names, and the normal there.

    Args:
        points: Positions [mm], shape (N, 3), f64.
        which: Surface of every point, shape (N,), i32, 0..M-1.
        kind: `SurfaceKind` of every surface, shape (M,), one of the five analytic kinds.
        parameters: As in `Segmentation.parameters`, shape (M, 8), f64.

    Returns:
        Signed distance [mm], shape (N,), positive outside; and the outward unit normal of the
        surface at the foot of every point, shape (N, 3). NaN where the parameters are NaN.
    """
    runtime.ensure_started()
    n = len(points)
    distance, normal = runtime.empty(n, np.float64), runtime.empty((n, 3), np.float64)
    if n:
        _evaluate(
            runtime.upload(np.asarray(points, np.float64)),
            runtime.upload(np.asarray(which, np.int32)),
            runtime.upload(np.asarray(kind, np.int32)),
            runtime.upload(np.asarray(parameters, np.float64)),
            distance,
            normal,
        )
    return runtime.download(distance)[:n], runtime.download(normal)[:n]


@ti.kernel
def _measure_distances(
    # In:
    point_in: F64Rows,
    which_in: I32Array,
    kind_in: I32Array,
    parameters_in: F64Rows,
    # Out:
    distance_out: F64Array,
):
    """Write the distance of every point to the surface that it names, infinite where it is -1."""
    for i in which_in:
        m = which_in[i]
        d = ti.math.inf
        if m >= 0:
            d, _ = surface_in_row(parameters_in, m, kind_in[m], row(point_in, i))
        distance_out[i] = d


def distances_to_surfaces(
    points: Any, which: np.ndarray, kind: np.ndarray, parameters: np.ndarray
) -> np.ndarray:
    """Return how far every point is from the surface that it names, if it names any.

    Args:
        points: Positions [mm], shape (N, 3), f64 (kernel array).
        which: Surface of every point, -1 = none, shape (N,), i32.
        kind: `SurfaceKind` of every surface, shape (M,), one of the five analytic kinds.
        parameters: As in `Segmentation.parameters`, shape (M, 8), f64.

    Returns:
        Signed distance [mm], shape (N,), positive outside; infinite where there is no surface.
    """
    runtime.ensure_started()
    distance = runtime.empty(len(which), np.float64)
    if len(which):
        _measure_distances(
            points,
            runtime.upload(np.asarray(which, np.int32)),
            runtime.upload(np.asarray(kind, np.int32)),
            runtime.upload(np.asarray(parameters, np.float64)),
            distance,
        )
    return runtime.download(distance)[: len(which)]
