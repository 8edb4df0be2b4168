"""Meshes of the fitted surfaces, trimmed to where the patch has points, for viewing only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from octoseg_ti.types import Segmentation, SurfaceKind
from octoseg_ti.view.scene import finite_rows

_TILES = 24
_MOST_BINS = 40_000
_MOST_POINTS = 60_000

Evaluate = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mesh:
    """Triangles on a fitted surface."""

    vertices: np.ndarray
    """Positions [mm], shape (V, 3), f64."""
    normals: np.ndarray
    """Unit normals on the side of the probe, shape (V, 3), f64."""
    triangles: np.ndarray
    """Vertices of every triangle, shape (T, 3), i64, counter-clockwise seen from the probe."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Chart:
    """A surface unrolled into the plane, so that it can be divided into squares."""

    uv: np.ndarray
    """Coordinates of the points on the surface [mm, or rad where it closes], shape (N, 2)."""
    radius: tuple[float, float]
    """Radius about which a coordinate is an angle [mm]; 0 = it is a length."""
    evaluate: Evaluate
    """Gives position and unit normal at coordinates of shape (M, 2)."""


def patch_mesh(result: Segmentation, k: int) -> Mesh | None:
    """Return the fitted surface of patch k where it has points; None without an analytic surface.

    The surface is unrolled and divided into squares about as wide as two points are apart; the
    squares that hold points, and single holes among them, become triangles.
    """
    on = np.flatnonzero(result.labels == k)
    on = on[finite_rows(result.points[on])]
    on = on[:: max(1, -(-len(on) // _MOST_POINTS))]
    points, normals = result.points[on], result.normals[on]
    if len(points) < 3:
        return None
    chart = _chart(SurfaceKind(int(result.kind[k])), result.parameters[k], points)
    if chart is None:
        return None
    filled, origin, step, wraps = _raster(chart)
    u, v = np.nonzero(filled)
    width = filled.shape[1] + 1
    corners = []
    for du, dv in ((0, 0), (1, 0), (1, 1), (0, 1)):
        cu = (u + du) % filled.shape[0] if wraps[0] else u + du
        cv = (v + dv) % filled.shape[1] if wraps[1] else v + dv
        corners.append(cu * width + cv)
    used, index = np.unique(np.stack(corners, axis=1), return_inverse=True)
    quad = index.reshape(-1, 4)
    at = origin + np.stack([used // width, used % width], axis=1) * step
    vertices, outer = chart.evaluate(at)
    # The probe saw the side to which the normals of the points point.
    _, at_points = chart.evaluate(chart.uv)
    if np.einsum("ij,ij->", at_points, normals) < 0:
        outer = -outer
    triangles = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), outer[triangles].sum(axis=1)) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return Mesh(vertices=vertices, normals=outer, triangles=triangles)


def _chart(kind: SurfaceKind, parameters: np.ndarray, points: np.ndarray) -> _Chart | None:
    base, axis, a, b = parameters[:3], parameters[3:6], float(parameters[6]), float(parameters[7])
    if kind == SurfaceKind.SPHERE and np.isfinite(base).all() and a > 0:
        return _sphere(base, a, points)
    length = float(np.linalg.norm(axis))
    if not (np.isfinite(base).all() and np.isfinite(length) and length > 0):
        return None
    axis = axis / length
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(axis, side), axis], axis=1)
    x, y, z = ((points - base) @ frame).T
    turn = np.arctan2(y, x)

    def place(local: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return base + local @ frame.T, normal @ frame.T

    def ring(angle: np.ndarray) -> np.ndarray:
        return np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)

    up = np.array([0.0, 0.0, 1.0])
    if kind == SurfaceKind.PLANE:

        def plane(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return place(np.insert(uv, 2, 0.0, axis=1), np.tile(up, (len(uv), 1)))

        return _Chart(uv=np.stack([x, y], axis=1), radius=(0, 0), evaluate=plane)
    if kind == SurfaceKind.CYLINDER and a > 0:

        def cylinder(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            out = ring(uv[:, 0])
            return place(a * out + uv[:, 1:] * up, out)

        return _Chart(uv=np.stack([turn, z], axis=1), radius=(a, 0), evaluate=cylinder)
    if kind == SurfaceKind.CONE and 0 < a < np.pi / 2:

        def cone(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            out, h = ring(uv[:, 0]), uv[:, 1:]
            normal = np.cos(a) * out - np.sin(a) * np.sign(h) * up
            return place(np.abs(h) * np.tan(a) * out + h * up, normal)

        narrow = float(np.percentile(np.abs(z), 10)) * np.tan(a)
        return _Chart(uv=np.stack([turn, z], axis=1), radius=(narrow, 0), evaluate=cone)
    if kind == SurfaceKind.TORUS and a > 0 and b > 0:
        tube = np.arctan2(z, np.hypot(x, y) - a)

        def torus(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            normal = np.cos(uv[:, 1:]) * ring(uv[:, 0]) + np.sin(uv[:, 1:]) * up
            return place(a * ring(uv[:, 0]) + b * normal, normal)

        return _Chart(uv=np.stack([turn, tube], axis=1), radius=(a, b), evaluate=torus)
    return None


def _sphere(center: np.ndarray, radius: float, points: np.ndarray) -> _Chart:
    """Return the equal-area chart of Lambert about the middle of the points, which has no poles."""
    ray = points - center
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
    top = ray.mean(axis=0)
    top = top / np.linalg.norm(top) if np.linalg.norm(top) > 1e-6 else np.array([0.0, 0, 1])
    side = np.cross(top, np.eye(3)[np.argmin(np.abs(top))])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(top, side), top], axis=1)
    x, y, z = (ray @ frame).T
    grow = radius * np.sqrt(2 / np.maximum(1 + z, 1e-9))

    def evaluate(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        square = np.minimum((uv * uv).sum(axis=1, keepdims=True) / radius**2, 4.0)
        flat = np.sqrt(1 - square / 4) * uv / radius
        normal = np.concatenate([flat, 1 - square / 2], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal = normal @ frame.T
        return center + radius * normal, normal

    return _Chart(uv=np.stack([grow * x, grow * y], axis=1), radius=(0, 0), evaluate=evaluate)


def _raster(chart: _Chart) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[bool, bool]]:
    """Return (which squares are filled, their origin, their sides, whether an axis closes)."""
    scale = np.array([r if r > 0 else 1.0 for r in chart.radius])
    low, high = chart.uv.min(axis=0), chart.uv.max(axis=0)
    wraps = (chart.radius[0] > 0, chart.radius[1] > 0)
    extent = np.maximum((high - low) * scale, 1e-9)
    # Twice the mean distance of the points, from the area of the tiles that they touch.
    tile = np.minimum(((chart.uv - low) * scale / extent * _TILES).astype(int), _TILES - 1)
    share = len(np.unique(tile[:, 0] * _TILES + tile[:, 1])) / _TILES**2
    cell = max(
        2 * np.sqrt(share * extent[0] * extent[1] / len(chart.uv)),
        np.sqrt(extent[0] * extent[1] / _MOST_BINS),
        float(extent.max()) / _MOST_BINS,
    )
    origin, step, count = low.copy(), cell / scale, np.ceil(extent / cell).astype(int) + 1
    for i in (0, 1):
        if wraps[i]:
            count[i] = int(np.clip(round(2 * np.pi * scale[i] / cell), 12, 720))
            origin[i], step[i] = -np.pi, 2 * np.pi / count[i]
    index = np.floor((chart.uv - origin) / step).astype(int)
    index = np.clip(index, 0, count - 1)
    filled = np.zeros(count, bool)
    filled[index[:, 0], index[:, 1]] = True
    return _close(filled, wraps), origin, step, wraps


def _close(filled: np.ndarray, wraps: tuple[bool, bool]) -> np.ndarray:
    """Fill holes of one square: grow by one, then shrink by one."""
    for grow in (True, False):
        padded = filled
        for axis in (0, 1):
            pad = [(1, 1) if i == axis else (0, 0) for i in (0, 1)]
            padded = (
                np.pad(padded, pad, mode="wrap")
                if wraps[axis]
                else np.pad(padded, pad, constant_values=not grow)
            )
        height, width = filled.shape
        shifted = [padded[i : i + height, j : j + width] for i in range(3) for j in range(3)]
        filled = np.any(shifted, axis=0) if grow else np.all(shifted, axis=0)
    return filled
