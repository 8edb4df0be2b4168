"""A small renderer of points, lines and boxes: parallel projection, z-buffer, eye-dome shading.

Plain NumPy, so that pictures can be made without a display, a GPU or a further package.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from octoseg_ti.view.scene import Viewpoint, finite_rows

_BACKGROUND = (255, 255, 255)
# Fragments handled at once; bounds the memory of scenes with many boxes.
_CHUNK = 2_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Camera:
    """Parallel projection onto a picture. Pixel (0, 0) is at the top left."""

    direction: np.ndarray
    """Unit vector from the eye into the scene, shape (3,)."""
    right: np.ndarray
    """Unit vector to the right in the picture, shape (3,)."""
    down: np.ndarray
    """Unit vector downwards in the picture, shape (3,)."""
    center: np.ndarray
    """Point drawn in the middle of the picture [mm], shape (3,)."""
    scale: float
    """Pixels per mm."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""

    @classmethod
    def fit(
        cls,
        points: np.ndarray,
        *,
        direction: Any,
        up: Any = (0.0, 0.0, 1.0),
        width: int = 960,
        height: int = 640,
        margin: float = 0.05,
    ) -> Camera:
        """Return the camera that shows all points as large as they fit.

        Args:
            points: Positions [mm], shape (N, 3); rows that are not finite are ignored.
            direction: From the eye into the scene, shape (3,), any length.
            up: Upwards in the picture, shape (3,); must not be parallel to ``direction``.
            width: Width of the picture [pixels].
            height: Height of the picture [pixels].
            margin: Share of the picture left free on every side.

        Raises:
            ValueError: ``up`` and ``direction`` are parallel, or the picture has no pixels.
        """
        if width < 1 or height < 1:
            raise ValueError(f"a picture of {width} x {height} pixels has no pixels")
        direction = _unit(direction)
        right = np.cross(direction, _unit(up))
        if np.linalg.norm(right) < 1e-9:
            raise ValueError("up is parallel to the direction of view")
        right = _unit(right)
        down = np.cross(direction, right)
        points = np.asarray(points, np.float64).reshape(-1, 3)
        points = points[finite_rows(points)]
        if not len(points):
            points = np.zeros((1, 3))
        # Around the middle, so that far offsets do not eat digits.
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        plane = (points - middle) @ np.stack([right, down, direction], axis=1)
        low, high = plane.min(axis=0), plane.max(axis=0)
        room = (1 - 2 * margin) * np.array([width, height])
        extent = np.maximum((high - low)[:2], 1e-300)
        scale = float(np.min(room / extent))
        shift = (low + high) / 2
        return cls(
            direction=direction,
            right=right,
            down=down,
            center=middle + shift[0] * right + shift[1] * down + shift[2] * direction,
            scale=scale if scale < 1e12 else 1.0,
            width=width,
            height=height,
        )

    @classmethod
    def at(
        cls, view: Viewpoint, points: np.ndarray, *, width: int = 960, height: int = 640
    ) -> Camera:
        """Return the camera of a point of view that shows all points."""
        return cls.fit(points, direction=view.direction, up=view.up, width=width, height=height)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return (x, y, depth) in pixels, shape (N, 3), f32; larger depth = farther away.

        Points that are not finite are not finite in the picture either, and are never drawn.
        """
        axes = np.stack([self.right, self.down, self.direction], axis=1) * self.scale
        with np.errstate(invalid="ignore"):
            out = (np.asarray(points, np.float64) - self.center) @ axes
        out[:, 0] += self.width / 2
        out[:, 1] += self.height / 2
        return out.astype(np.float32)


class Canvas:
    """A picture with a depth in every pixel."""

    def __init__(self, camera: Camera) -> None:
        """Start with nothing in front of the camera."""
        self.camera = camera
        self.depth = np.full((camera.height, camera.width), np.inf, np.float32)
        # Red, green, blue and a free byte in one number: moved around three times as fast.
        self.color = np.zeros((camera.height, camera.width), np.uint32)

    def points(self, points: np.ndarray, colors: Any, *, size: int = 2) -> None:
        """Draw squares of ``size`` pixels, nearer ones over farther ones.

        Args:
            points: Positions [mm], shape (N, 3); rows that are not finite are left out.
            colors: One colour, or one for every point, shape (3 or 4,) or (N, 3 or 4), u8.
            size: Side of the square [pixels].
        """
        self.projected(self.camera.project(points), colors, size=size)

    def projected(self, at: np.ndarray, colors: Any, *, size: int = 2) -> None:
        """Draw points as `points` does, from what `Camera.project` made of them."""
        layer = Canvas(self.camera)
        layer._fragments(at, _per_row(colors, len(at)))
        # Only the nearest point of a pixel can be the nearest one of its square anywhere, so the
        # squares are grown from pixels, at a cost that does not depend on the number of points.
        height, width = self.depth.shape
        for dy in range(-((size - 1) // 2), size // 2 + 1):
            for dx in range(-((size - 1) // 2), size // 2 + 1):
                to = _overlap(height, dy), _overlap(width, dx)
                source = _overlap(height, -dy), _overlap(width, -dx)
                nearer = layer.depth[source] < self.depth[to]
                np.copyto(self.depth[to], layer.depth[source], where=nearer)
                np.copyto(self.color[to], layer.color[source], where=nearer)

    def lines(self, starts: np.ndarray, ends: np.ndarray, colors: Any) -> None:
        """Draw lines of one pixel.

        Args:
            starts: First ends [mm], shape (N, 3).
            ends: Second ends [mm], shape (N, 3).
            colors: One colour, or one for every line, u8.
        """
        if not len(starts):
            return
        a, b = self.camera.project(starts), self.camera.project(ends)
        steps = int(np.ceil(np.abs(b - a)[:, :2].max())) + 1
        colors = _per_row(colors, len(starts))
        t = np.linspace(0, 1, max(steps, 2), dtype=np.float32)[None, :, None]
        block = max(1, _CHUNK // t.size)
        for k in range(0, len(a), block):
            part = slice(k, k + block)
            at = a[part, None] + t * (b[part] - a[part])[:, None]
            self._fragments(at.reshape(-1, 3), np.repeat(colors[part], t.size, axis=0))

    def frames(self, corners: np.ndarray, size: float, colors: Any) -> None:
        """Draw the twelve edges of cubes of one size.

        Args:
            corners: Lower corners [mm], shape (N, 3).
            size: Edge length [mm].
            colors: One colour, or one for every cube, u8.
        """
        colors = np.asarray(colors)
        for axis in range(3):
            along = size * np.eye(3)[axis]
            for p, q in np.ndindex(2, 2):
                start = corners + size * np.insert(np.array([p, q], float), axis, 0)
                self.lines(start, start + along, colors)

    def boxes(self, corners: np.ndarray, size: float, colors: Any) -> None:
        """Draw solid cubes of one size with dark edges.

        In a parallel projection all cubes of one size look the same, so one is drawn by
        intersecting rays with it, and then stamped.

        Args:
            corners: Lower corners [mm], shape (N, 3).
            size: Edge length [mm].
            colors: One colour, or one for every cube, u8.
        """
        if not len(corners):
            return
        offset, shade = self._stamp(size)
        colors = _per_row(colors, len(corners))
        at = self.camera.project(corners)
        at[:, :2] = np.floor(at[:, :2])
        # The nearest cubes first: most of the others then fail the depth test at once.
        order = np.argsort(at[:, 2], kind="stable")
        at, colors = at[order], colors[order]
        block = max(1, _CHUNK // len(offset))
        for k in range(0, len(at), block):
            part = slice(k, k + block)
            fragments = (at[part, None] + offset).reshape(-1, 3)
            bright = _unpack(colors[part])[:, None] * shade[:, None]
            self._fragments(fragments, _pack(bright.astype(np.uint8).reshape(-1, 3)))

    def _stamp(self, size: float) -> tuple[np.ndarray, np.ndarray]:
        """Return pixel offsets with depth, shape (F, 3), and brightness, shape (F,), of a cube."""
        camera = self.camera
        side = size * camera.scale
        axes = np.stack([camera.right, camera.down, camera.direction])
        reach = side * np.stack([np.minimum(axes, 0).sum(1), np.maximum(axes, 0).sum(1)])
        xs = np.arange(np.floor(reach[0, 0]), np.ceil(reach[1, 0]) + 1) + 0.5
        ys = np.arange(np.floor(reach[0, 1]), np.ceil(reach[1, 1]) + 1) + 0.5
        x, y = (grid.ravel() for grid in np.meshgrid(xs, ys))
        # The ray of a pixel starts in the plane through the lower corner of the cube.
        base = x[:, None] * axes[0] + y[:, None] * axes[1]
        slope = np.where(np.abs(axes[2]) < 1e-9, 1e-9, axes[2])
        enter = np.minimum(-base / slope, (side - base) / slope)
        leave = np.maximum(-base / slope, (side - base) / slope)
        depth = enter.max(axis=1)
        hit = depth < leave.min(axis=1)
        if not hit.any():  # a cube smaller than a pixel
            return np.zeros((1, 3), np.float32), np.ones(1, np.float32)
        face = enter.argmax(axis=1)[hit]
        where = base[hit] + depth[hit, None] * axes[2]
        border = np.minimum(where, side - where)
        border[np.arange(len(face)), face] = np.inf
        brightness = 0.62 + 0.38 * np.abs(axes[2])[face]
        if side > 5:
            brightness = np.where(border.min(axis=1) < 0.9, 0.35 * brightness, brightness)
        offset = np.stack([x[hit] - 0.5, y[hit] - 0.5, depth[hit]], axis=1)
        return offset.astype(np.float32), brightness.astype(np.float32)

    def _fragments(self, at: np.ndarray, colors: np.ndarray) -> None:
        """Put (x, y, depth) with colours where they are nearer than what is there."""
        height, width = self.depth.shape
        inside = (at[:, 0] >= 0) & (at[:, 0] < width) & (at[:, 1] >= 0) & (at[:, 1] < height)
        rows = np.flatnonzero(inside)
        place = at[rows, 1].astype(np.int64) * width + at[rows, 0].astype(np.int64)
        depth = at[rows, 2]
        flat = self.depth.reshape(-1)
        nearer = depth < flat[place]
        place, depth, rows = place[nearer], depth[nearer], rows[nearer]
        np.minimum.at(flat, place, depth)
        nearest = depth == flat[place]
        self.color.reshape(-1)[place[nearest]] = colors[rows[nearest]]

    def image(self, *, eye_dome: float = 1.0, background: Any = _BACKGROUND) -> np.ndarray:
        """Return the picture, shape (height, width, 3), u8.

        Args:
            eye_dome: Strength of the shading of pixels behind their neighbours (Boucheny 2009);
                0 = none.
            background: Colour where nothing was drawn.
        """
        drawn = np.isfinite(self.depth)
        color = _unpack(self.color).astype(np.float32)
        if eye_dome > 0 and drawn.any():
            color *= np.exp(-eye_dome * self._obscurance(drawn))[..., None]
        color[~drawn] = background
        color += 0.5
        return color.astype(np.uint8)

    def _obscurance(self, drawn: np.ndarray) -> np.ndarray:
        """Return how far every pixel lies behind its neighbours, 0..1."""
        height, width = self.depth.shape
        far = np.where(drawn, self.depth, np.float32(1e30))
        total = np.zeros_like(far)
        for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0), (2, 2), (2, -2), (-2, 2), (-2, -2)):
            here = _overlap(height, dy), _overlap(width, dx)
            there = _overlap(height, -dy), _overlap(width, -dx)
            # A depth of a pixel or two a pixel is a slope, of many pixels a step.
            behind = far[here] - far[there]
            behind -= 2 * max(abs(dx), abs(dy))
            behind *= 1 / 12
            np.clip(behind, 0, 1, out=behind)
            total[here] += behind
        return total / 4


def render(
    points: np.ndarray,
    colors: Any,
    *,
    width: int = 960,
    height: int = 640,
    direction: Any = (-0.4, 0.75, -0.6),
    up: Any = (0.0, 0.0, 1.0),
    point_px: int = 2,
    camera: Camera | None = None,
    eye_dome: float = 1.0,
    background: Any = _BACKGROUND,
) -> np.ndarray:
    """Draw points.

    Args:
        points: Positions [mm], shape (N, 3); rows that are not finite are left out.
        colors: One colour, or one for every point, shape (3 or 4,) or (N, 3 or 4), u8.
        width: Width of the picture [pixels].
        height: Height of the picture [pixels].
        direction: From the eye into the scene, shape (3,).
        up: Upwards in the picture, shape (3,).
        point_px: Side of the square drawn for a point [pixels].
        camera: Used as it is; default: one that shows all points.
        eye_dome: Strength of the shading by depth; 0 = none.
        background: Colour where there is no point.

    Returns:
        The picture, shape (height, width, 3), u8.

    Raises:
        ValueError: Shapes that do not fit together, or a direction that is parallel to ``up``.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have shape (N, 3), not {points.shape}")
    if point_px < 1:
        raise ValueError(f"a point must have at least 1 pixel, not {point_px}")
    if camera is None:
        camera = Camera.fit(points, direction=direction, up=up, width=width, height=height)
    canvas = Canvas(camera)
    canvas.points(points, colors, size=point_px)
    return canvas.image(eye_dome=eye_dome, background=background)


def _unit(vector: Any) -> np.ndarray:
    vector = np.asarray(vector, np.float64)
    return vector / np.linalg.norm(vector)


def _per_row(colors: Any, count: int) -> np.ndarray:
    """Return one packed colour a row, shape (count,), u32."""
    colors = np.asarray(colors, np.uint8)
    if colors.ndim == 1:
        colors = np.broadcast_to(colors, (count, len(colors)))
    if colors.ndim != 2 or len(colors) != count or colors.shape[1] not in (3, 4):
        raise ValueError(f"{count} rows need one colour each, not an array of {colors.shape}")
    return _pack(colors)


def _pack(colors: np.ndarray) -> np.ndarray:
    """Return colours of shape (N, 3 or 4), u8, as numbers, shape (N,), u32."""
    out = np.zeros((len(colors), 4), np.uint8)
    out[:, :3] = colors[:, :3]
    return out.view(np.uint32)[:, 0]


def _unpack(packed: np.ndarray) -> np.ndarray:
    """Return packed colours as red, green, blue, shape (..., 3), u8."""
    return np.ascontiguousarray(packed).view(np.uint8).reshape(*packed.shape, 4)[..., :3]


def _overlap(length: int, shift: int) -> slice:
    """Return the indices k for which k and k - shift are both within the length."""
    return slice(max(shift, 0), length + min(shift, 0))
