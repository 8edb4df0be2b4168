"""What every view of the data needs: world positions, a point of view, colours with a meaning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.types import Cells, EdgeClass, Scans

SCAN_COLOR = (70, 110, 180, 255)
REST_COLOR = (176, 180, 188, 255)

EDGE_COLORS = np.array(
    [REST_COLOR, (200, 35, 35, 255), (235, 140, 20, 255), (130, 60, 190, 255)], np.uint8
)
"""Colour of every `EdgeClass`: none grey, sharp red, fillet orange, smooth violet."""

ERROR_COLORS = np.array(
    [(200, 205, 210, 255), (210, 40, 40, 255), (245, 165, 35, 255), (95, 75, 200, 255)], np.uint8
)
"""Right grey, wrong region red, no label orange, label on unknown truth violet."""

# From large cells (dark) to small ones (bright): equal steps in lightness, safe for the colour
# blind.
_LEVEL_RAMP = np.array(
    [(68, 20, 90), (62, 75, 138), (38, 130, 142), (53, 183, 121), (170, 215, 60), (250, 225, 60)],
    np.float64,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Viewpoint:
    """Where to look at a part from."""

    direction: np.ndarray
    """Unit vector from the eye to the part, shape (3,)."""
    up: np.ndarray
    """Unit vector that is upwards in the picture, shape (3,)."""
    center: np.ndarray
    """Middle of the bounding box [mm], shape (3,)."""
    radius: float
    """Half the diagonal of the bounding box [mm]; never 0."""


def finite_rows(rows: np.ndarray) -> np.ndarray:
    """Say of every row of shape (N, 3) whether it is finite, shape (N,), bool."""
    # Column by column: several times as fast as a reduction over rows of three.
    x, y, z = np.isfinite(rows).T
    return x & y & z


def world_points(scans: Scans) -> np.ndarray:
    """Return the points in the world frame [mm], shape (N, 3), f64.

    Raises:
        DataError: The points are in view frames and there are no poses.
    """
    points = np.asarray(scans.points, np.float64)
    if scans.frame != "view":
        return points
    if scans.T_world_view is None:
        raise DataError("points are in the frame of their view, but there are no poses")
    poses = np.asarray(scans.T_world_view, np.float64)
    view = np.zeros(len(points), np.int64) if scans.view is None else scans.view
    world = np.empty_like(points)
    for k in np.unique(view):
        on = view == k
        world[on] = points[on] @ poses[k, :3, :3].T + poses[k, :3, 3]
    return world


def viewpoint(points: np.ndarray, normals: np.ndarray | None = None) -> Viewpoint:
    """Choose a point of view that shows the scanned side, from above and off the long axis.

    Args:
        points: Positions [mm], shape (N, 3); rows that are not finite are ignored.
        normals: Normals pointing to the probe, shape (N, 3); they tell the scanned side. Without
            them, or when they point all around, z is up.
    """
    points = points[finite_rows(points)]
    low = points.min(axis=0) if len(points) else np.zeros(3)
    high = points.max(axis=0) if len(points) else np.ones(3)
    up = np.array([0.0, 0.0, 1.0])
    if normals is not None and len(normals):
        mean = np.nan_to_num(np.asarray(normals, np.float64)).mean(axis=0)
        length = float(np.linalg.norm(mean))
        if length > 0.2:
            axis = int(np.argmax(np.abs(mean)))
            snapped = np.zeros(3)
            snapped[axis] = np.sign(mean[axis])
            up = snapped if mean @ snapped > 0.85 * length else mean / length
    # The longer side of the box runs from left to right.
    extent = high - low
    across = [a - (a @ up) * up for a in np.eye(3)]
    candidates = [a / np.linalg.norm(a) for a in across if np.linalg.norm(a) > 0.3]
    right = max(candidates, key=lambda a: float(np.abs(a) @ extent))
    front = np.cross(up, right)
    eye = 0.62 * up - 0.72 * front + 0.32 * right
    radius = float(np.linalg.norm(extent)) / 2
    return Viewpoint(
        direction=-eye / np.linalg.norm(eye),
        up=up,
        center=(low + high) / 2,
        radius=radius if radius > 0 else 1.0,
    )


def normal_colors(normals: np.ndarray) -> np.ndarray:
    """Return the normal map of unit normals, shape (N, 4), u8: x red, y green, z blue; 0 grey."""
    normals = np.nan_to_num(np.asarray(normals, np.float32))
    out = np.full((len(normals), 4), 255, np.uint8)
    out[:, :3] = np.clip(127.5 * (normals + 1), 0, 255)
    out[~normals.any(axis=1)] = REST_COLOR
    return out


def level_colors(levels: np.ndarray, deepest: int) -> np.ndarray:
    """Return colours of levels, shape (N, 4), u8: dark = large cells, bright = small, grey = -1."""
    levels = np.asarray(levels)
    place = np.clip(levels / max(deepest, 1), 0, 1) * (len(_LEVEL_RAMP) - 1)
    ramp = np.arange(len(_LEVEL_RAMP))
    out = np.full((len(levels), 4), 255, np.uint8)
    for c in range(3):
        out[:, c] = np.interp(place, ramp, _LEVEL_RAMP[:, c])
    out[levels < 0] = REST_COLOR
    return out


def edge_colors(edge: np.ndarray) -> np.ndarray:
    """Return colours of edge classes, shape (N, 4), u8."""
    return EDGE_COLORS[np.clip(edge, 0, int(EdgeClass.SMOOTH))]


def stripe_bounds(stripe: np.ndarray) -> np.ndarray:
    """Return where each run of one stripe number starts, and at the end N, shape (L + 1,), i64."""
    stripe = np.asarray(stripe)
    if not len(stripe):
        return np.zeros(1, np.int64)
    return np.concatenate([[0], np.flatnonzero(np.diff(stripe)) + 1, [len(stripe)]])


def initial_corners(cells: Cells) -> np.ndarray:
    """Return the lower corners of the initial cells that the leaves came from [mm], shape (M, 3).

    The leaves do not say where the grid starts. If a leaf is an initial cell itself, it does;
    otherwise the grid is taken to start at the lowest corner of the leaves, as it does when it was
    laid on the bounding box of the points.
    """
    if not len(cells):
        return np.zeros((0, 3))
    largest = np.flatnonzero(cells.level == 0)
    start = cells.corner[largest[0]] if len(largest) else cells.corner.min(axis=0)
    # The middle of a leaf lies safely inside its initial cell, its corner on a border.
    index = np.floor((cells.corner + cells.size[:, None] / 2 - start) / cells.initial_size)
    return start + np.unique(index, axis=0) * cells.initial_size
