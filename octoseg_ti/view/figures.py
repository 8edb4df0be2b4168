"""The pictures of a segmentation, in the order of the method; all from one point of view."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octoseg_ti import palette
from octoseg_ti.evaluation import wrong_points
from octoseg_ti.types import Segmentation, Truth
from octoseg_ti.view import scene
from octoseg_ti.view.render import Camera, Canvas, render

__all__ = [
    "TITLES",
    "contact_sheet",
    "draw",
    "figures",
    "png",
    "render",
    "save_png",
]

TITLES = {
    "scan": "Scan",
    "normals": "Normals",
    "initial-grid": "Initial grid",
    "final-grid": "Final grid by level",
    "edge-points": "Edge points",
    "edges-removed": "Edges removed",
    "segments": "Segments",
    "truth": "Truth",
    "errors": "Errors",
}
"""Name and title of every picture, in order; the last two need the truth."""

_ARROWS = 6000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Subject:
    """What all pictures of one segmentation share."""

    result: Segmentation
    truth: Truth | None
    camera: Camera
    at: np.ndarray
    """Projected points, shape (N, 3)."""
    size: int
    light: np.ndarray


def figures(
    result: Segmentation,
    *,
    truth: Truth | None = None,
    width: int = 960,
    height: int = 640,
) -> dict[str, np.ndarray]:
    """Draw every picture of a segmentation.

    Args:
        result: The segmentation.
        truth: Truth of its points, for two more pictures.
        width: Width of a picture [pixels].
        height: Height of a picture [pixels].

    Returns:
        Pictures by name, in the order of `TITLES`, each of shape (height, width, 3), u8.
    """
    names = [name for name in TITLES if truth is not None or name not in ("truth", "errors")]
    subject = _subject(result, truth, width, height)
    return {name: _DRAW[name](subject) for name in names}


def draw(
    name: str,
    result: Segmentation,
    *,
    truth: Truth | None = None,
    width: int = 960,
    height: int = 640,
) -> np.ndarray:
    """Draw one picture of `TITLES`, shape (height, width, 3), u8.

    Raises:
        ValueError: There is no picture of that name, or it needs a truth that is not given.
    """
    if name not in _DRAW:
        raise ValueError(f"no picture is called {name!r}; there are {', '.join(_DRAW)}")
    if truth is None and name in ("truth", "errors"):
        raise ValueError(f"the picture {name!r} needs the truth")
    return _DRAW[name](_subject(result, truth, width, height))


def _subject(result: Segmentation, truth: Truth | None, width: int, height: int) -> _Subject:
    view = scene.viewpoint(result.points, result.normals)
    # A spike must not shrink the part to a dot: the picture shows what is in the grid, and the
    # grid.
    shown = [result.points[result.level >= 0] if (result.level >= 0).any() else result.points]
    corners = scene.initial_corners(result.cells)
    for far in np.ndindex(2, 2, 2):
        shown.append(corners + np.array(far) * result.cells.initial_size)
    camera = Camera.at(view, np.concatenate(shown), width=width, height=height)
    # A lamp over the left shoulder: faces that look alike in colour differ in brightness.
    lamp = -camera.direction - 0.5 * camera.right - 0.6 * camera.down
    lamp /= np.linalg.norm(lamp)
    normals = np.nan_to_num(result.normals)
    light = 0.55 + 0.45 * np.abs(normals @ lamp.astype(np.float32))
    light[~normals.any(axis=1)] = 0.8
    at = camera.project(result.points)
    return _Subject(
        result=result,
        truth=truth,
        camera=camera,
        at=at,
        size=_point_size(at, camera),
        light=light,
    )


def _point_size(at: np.ndarray, camera: Camera) -> int:
    """Return the side of the squares [pixels] that closes the gaps between projected points."""
    # Area of the picture that is covered, seen in coarse tiles; a tile is covered when any point
    # is in it.
    tile = 16
    columns = camera.width // tile + 1
    inside = (
        (at[:, 0] >= 0) & (at[:, 0] < camera.width) & (at[:, 1] >= 0) & (at[:, 1] < camera.height)
    )
    tiles = (at[inside, :2] // tile).astype(np.int64)
    covered = np.count_nonzero(np.bincount(tiles[:, 1] * columns + tiles[:, 0])) * tile * tile
    gap = np.sqrt(covered / max(int(inside.sum()), 1))
    return int(np.clip(np.ceil(1.7 * gap), 1, 8))


def _shaded(subject: _Subject, colors: np.ndarray) -> np.ndarray:
    return (np.asarray(colors)[:, :3] * subject.light[:, None]).astype(np.uint8)


def _points(subject: _Subject, colors: np.ndarray, on: np.ndarray | None = None) -> np.ndarray:
    canvas = Canvas(subject.camera)
    shaded = _shaded(subject, colors)
    on = np.ones(len(shaded), bool) if on is None else on
    canvas.projected(subject.at[on], shaded[on], size=subject.size)
    return canvas.image()


def _scan(subject: _Subject) -> np.ndarray:
    result = subject.result
    colors = np.tile(np.array(scene.SCAN_COLOR, np.uint8), (len(result), 1))
    if result.view is not None and len(np.unique(result.view)) > 1:
        colors = palette.colors(result.view)
    colors[result.outlier > 0] = scene.EDGE_COLORS[1]
    return _points(subject, colors)


def _normals(subject: _Subject) -> np.ndarray:
    """Porcupine of the normals over the points, in the colours of the normal map."""
    result = subject.result
    canvas = Canvas(subject.camera)
    colors = scene.normal_colors(result.normals)
    canvas.projected(subject.at, _pale(colors), size=subject.size)
    some = np.flatnonzero(result.normals.any(axis=1) & scene.finite_rows(result.points))
    some = some[:: max(1, -(-len(some) // _ARROWS))]
    length = 14 / subject.camera.scale
    ends = result.points[some] + length * result.normals[some]
    canvas.lines(result.points[some], ends, (colors[some, :3] * 0.75).astype(np.uint8))
    return canvas.image(eye_dome=0.0)


def _pale(colors: np.ndarray) -> np.ndarray:
    return (0.35 * colors[:, :3] + 0.65 * 240).astype(np.uint8)


def _initial_grid(subject: _Subject) -> np.ndarray:
    cells = subject.result.cells
    canvas = Canvas(subject.camera)
    color = scene.level_colors(np.zeros(1), 1)[0] // 2 + np.uint8(110)
    canvas.boxes(scene.initial_corners(cells), cells.initial_size, color)
    return canvas.image(eye_dome=0.3)


def _final_grid(subject: _Subject) -> np.ndarray:
    """Wire frames of the cells over the points, both in the colour of their level."""
    result, cells = subject.result, subject.result.cells
    canvas = Canvas(subject.camera)
    deepest = int(cells.level.max(initial=0))
    shaded = _shaded(subject, scene.level_colors(result.level, deepest))
    canvas.projected(subject.at, (0.5 * shaded + 0.5 * 235).astype(np.uint8), size=subject.size)
    for level in np.unique(cells.level):
        on = cells.level == level
        size = float(cells.size[on][0])
        # Frames of few pixels would be blots; there the points show the level.
        if size * subject.camera.scale >= 4:
            color = scene.level_colors(np.array([level]), deepest)[0]
            canvas.frames(cells.corner[on], size, (0.8 * color).astype(np.uint8))
    return canvas.image(eye_dome=0.0)


def _edge_points(subject: _Subject) -> np.ndarray:
    """Edge points in the colour of their class, over the pale part."""
    result = subject.result
    canvas = Canvas(subject.camera)
    on = result.edge > 0
    rest = _pale(_shaded(subject, scene.edge_colors(result.edge)))
    canvas.projected(subject.at[~on], rest[~on], size=subject.size)
    canvas.projected(subject.at[on], scene.edge_colors(result.edge[on]), size=subject.size)
    return canvas.image()


def _edges_removed(subject: _Subject) -> np.ndarray:
    result = subject.result
    colors = np.tile(np.array(scene.REST_COLOR, np.uint8), (len(result), 1))
    return _points(subject, colors, (result.edge == 0) & (result.outlier == 0))


def _segments(subject: _Subject) -> np.ndarray:
    return _points(subject, palette.colors(subject.result.labels))


def _truth(subject: _Subject) -> np.ndarray:
    assert subject.truth is not None
    return _points(subject, palette.colors(subject.truth.patch))


def _errors(subject: _Subject) -> np.ndarray:
    assert subject.truth is not None
    wrong = wrong_points(subject.result.labels, subject.truth.patch)
    return _points(subject, scene.ERROR_COLORS[wrong])


_DRAW = {
    "scan": _scan,
    "normals": _normals,
    "initial-grid": _initial_grid,
    "final-grid": _final_grid,
    "edge-points": _edge_points,
    "edges-removed": _edges_removed,
    "segments": _segments,
    "truth": _truth,
    "errors": _errors,
}


def contact_sheet(pictures: Mapping[str, np.ndarray], *, columns: int = 3) -> np.ndarray:
    """Return one picture of all pictures, each with its title above it, u8.

    Args:
        pictures: Pictures of one size by name, as `figures` returns them.
        columns: Pictures side by side.

    Raises:
        ValueError: There are no pictures.
    """
    from PIL import Image, ImageDraw, ImageFont

    if not pictures:
        raise ValueError("a contact sheet needs at least one picture")
    height, width = next(iter(pictures.values())).shape[:2]
    bar = max(20, height // 18)
    rows = -(-len(pictures) // columns)
    sheet = Image.new("RGB", (columns * width, rows * (height + bar)), (255, 255, 255))
    pen = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=0.62 * bar)
    for k, (name, picture) in enumerate(pictures.items()):
        x, y = (k % columns) * width, (k // columns) * (height + bar)
        pen.rectangle((x, y, x + width - 1, y + bar - 1), fill=(236, 238, 242))
        title = f"{k + 1}  {TITLES.get(name, name)}"
        pen.text((x + bar // 2, y + bar // 2), title, fill=(30, 34, 40), font=font, anchor="lm")
        sheet.paste(Image.fromarray(picture), (x, y + bar))
    return np.asarray(sheet)


def png(picture: np.ndarray) -> bytes:
    """Return a picture as the bytes of a PNG file."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG", optimize=False, compress_level=6)
    return buffer.getvalue()


def save_png(path: str | Path, picture: np.ndarray) -> None:
    """Write a picture as a PNG file."""
    Path(path).write_bytes(png(picture))
