"""The topics of a result: points with labels, normals, edges, cells, figures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from octoseg_ti.files import archives, messages
from octoseg_ti.files.messages import METRE
from octoseg_ti.files.recording_rows import (
    NORMAL,
    RGBA,
    needs_double,
    put_colors,
    put_columns,
)
from octoseg_ti.files.recording_write import RecordingWriter
from octoseg_ti.palette import colors, level_colors, normal_colors
from octoseg_ti.types import Cells, EdgeClass, Segmentation

MAX_CUBES = 100_000
"""Largest grid that is also written as cubes, which are for the eye; the cells always are."""

_EDGE_COLORS = np.array(
    [(128, 128, 128, 255), (226, 60, 48, 255), (240, 176, 32, 255), (64, 140, 230, 255)], np.uint8
)


def add_params(writer: RecordingWriter, result: Segmentation, preset: str = "") -> None:
    """Write the parameters in force, as ``/params`` and as the attachment ``config.json``."""
    values = result.params.to_dict()
    writer.register("/params", messages.Params, {"units": "mm, rad"})
    writer.write("/params", messages.flat_params(values, preset).SerializeToString(), 0)
    writer.attach("config.json", "application/json", json.dumps(values, indent=2).encode())


def add_result(
    writer: RecordingWriter,
    result: Segmentation,
    *,
    column: np.ndarray | None = None,
    report: str | None = None,
    scores: Mapping[str, Any] | None = None,
) -> None:
    """Append a result to a recording; what no topic holds goes into ``result.npz``.

    Args:
        writer: An open recording, with the scans or without.
        result: The segmentation.
        column: Detector rows of the points, shape (N,).
        report: Markdown for the attachment ``report.md``.
        scores: Figures against the truth, for the metadata record ``octoseg.scores``.

    Raises:
        DataError: The disk is full or gone.
    """
    time = writer.time_ns + 1_000_000 if writer.has_stripes() else 0
    if not writer.has_stripes():
        writer.register("/tf", messages.FrameTransforms, {"units": "m"})
        still = messages.transform_message([("world", "view_0", np.eye(4))], writer.start_ns)
        writer.write("/tf", still.SerializeToString(), 0)
    segments = _segment_rows(result, column)
    writer.cloud("/segments/points", segments, time, {"label": "-1 = no patch"})
    _add_views(writer, result, segments, time)
    _add_cells(writer, result.cells, time)
    _add_figures(writer, result, time)
    _add_registration(writer, result, time)
    writer.attach(
        "result.npz",
        "application/zip",
        archives.pack(archives.result_arrays(result, per_point=False)),
    )
    if report is not None:
        writer.attach("report.md", "text/markdown", report.encode())
    if scores is not None:
        writer.metadata("octoseg.scores", scores)


def initial_cells(cells: Cells) -> tuple[np.ndarray, int]:
    """Return the corners of the initial cells that hold a leaf, and how many were undecided.

    The leaves do not say where the initial grid begins; it follows from any undivided initial cell.
    When all were divided, the grid is taken to begin at the lowest corner of the leaves.

    Args:
        cells: The final grid.

    Returns:
        Lower corners [mm], shape (C0, 3), f64, ordered by x, y, z; and 1 if the beginning was
        taken from the lowest corner, else 0.
    """
    side = cells.initial_size
    if len(cells) == 0:
        return np.empty((0, 3)), 0
    whole = np.flatnonzero(cells.level == 0)
    origin = cells.corner[whole[0]] if len(whole) else cells.corner.min(axis=0)
    middle = cells.corner + 0.5 * cells.size[:, None]
    index = np.floor((middle - origin) / side).astype(np.int64)
    low = index.min(axis=0)
    counts = index.max(axis=0) - low + 1
    keys = np.unique(np.ravel_multi_index(tuple((index - low).T), tuple(counts)))
    index = np.stack(np.unravel_index(keys, tuple(counts)), axis=1) + low
    return origin + index * side, int(len(whole) == 0)


def _segment_rows(result: Segmentation, column: np.ndarray | None) -> np.ndarray:
    """Return the rows of /segments/points: everything that a point has, at full resolution."""
    position = "<f8" if needs_double(result.points) else "<f4"
    fields = [("x", position), ("y", position), ("z", position)]
    fields += [("label", "<i4"), *NORMAL]
    extra = {"line": result.stripe, "column": column, "view": result.view}
    fields += [(name, "<i4") for name, value in extra.items() if value is not None]
    fields += [("edge", "u1"), ("level", "i1"), ("outlier", "u1"), *RGBA]
    rows = np.empty(len(result), np.dtype(fields))
    put_columns(rows, "xyz", result.points / METRE)
    put_columns(rows, ("normal_x", "normal_y", "normal_z"), result.normals)
    rows["label"] = result.labels
    for name in ("edge", "level", "outlier"):
        rows[name] = getattr(result, name)
    for name, value in extra.items():
        if value is not None:
            rows[name] = value
    put_colors(rows, colors(result.labels))
    return rows


def _add_views(
    writer: RecordingWriter, result: Segmentation, segments: np.ndarray, time: int
) -> None:
    """Write the normal map and the edge points, each a choice of fields of the segments."""
    assert segments.dtype.fields is not None
    known = np.flatnonzero(np.abs(result.normals).sum(axis=1) > 0)
    names = ["x", "y", "z", "normal_x", "normal_y", "normal_z"]
    normals = _picked(segments, names, known)
    put_colors(normals, normal_colors(result.normals[known]))
    writer.cloud("/normals/points", normals, time)

    on_edge = np.flatnonzero(result.edge != EdgeClass.NONE)
    names = ["x", "y", "z", "edge"]
    names += [name for name in ("line", "column", "view") if name in segments.dtype.fields]
    edges = _picked(segments, names, on_edge)
    put_colors(edges, _EDGE_COLORS[np.minimum(result.edge[on_edge], len(_EDGE_COLORS) - 1)])
    writer.cloud("/edges/points", edges, time, {"edge": "1 sharp, 2 fillet, 3 smooth"})


def _picked(rows: np.ndarray, names: list[str], index: np.ndarray) -> np.ndarray:
    """Return some fields of some rows, with room for colours, packed."""
    assert rows.dtype.fields is not None
    fields = [(name, rows.dtype.fields[name][0].str) for name in names]
    picked = np.empty(len(index), np.dtype(fields + RGBA))
    for name in names:
        picked[name] = rows[name][index]
    return picked


def _add_cells(writer: RecordingWriter, cells: Cells, time: int) -> None:
    """Write the grid as points with a size, and, while it is not too large, as cubes."""
    position = "<f8" if needs_double(cells.corner) else "<f4"
    fields = [("x", position), ("y", position), ("z", position), ("size", position)]
    fields += [("level", "u1"), ("count", "<u4"), ("label", "<i4"), ("edge", "u1"), *RGBA]
    rows = np.empty(len(cells), np.dtype(fields))
    put_columns(rows, "xyz", (cells.corner + 0.5 * cells.size[:, None]) / METRE)
    rows["size"] = cells.size / METRE
    for name in ("level", "count", "label", "edge"):
        rows[name] = getattr(cells, name)
    shades = level_colors(cells.level)
    put_colors(rows, shades)
    writer.cloud("/octree/cells", rows, time)
    if len(cells) > MAX_CUBES:
        text = f"{len(cells)} cells are in /octree/cells only: too many to draw as cubes"
        _log(writer, text, time, messages.Log.WARNING)
        return
    corner, _ = initial_cells(cells)
    stamp = writer.start_ns + time
    sizes = np.full(len(corner), cells.initial_size)
    first = level_colors(np.zeros(len(corner), np.int8), int(cells.level.max(initial=0)) + 1)
    grids = {
        "/octree/initial": messages.cubes_message("initial", corner, sizes, first, stamp),
        "/octree/final": messages.cubes_message("final", cells.corner, cells.size, shades, stamp),
    }
    for topic, message in grids.items():
        writer.register(topic, messages.SceneUpdate, {"units": "m", "frame": "world"})
        writer.write(topic, message.SerializeToString(), time)


def _add_figures(writer: RecordingWriter, result: Segmentation, time: int) -> None:
    """Write /metrics, /profile/stages and one line of /log."""
    measured = result.measured
    metrics = messages.Metrics(
        points=len(result),
        patches=result.patch_count,
        labelled_share=float(np.mean(result.labels >= 0)) if len(result) else 0.0,
        edge_points=float(np.count_nonzero(result.edge)),
        outliers=float(np.count_nonzero(result.outlier)),
        cells=len(result.cells),
        levels=result.level_count,
        passes=result.passes,
        seconds=sum(result.seconds.values()),
        spacing_along_mm=measured.spacing_along,
        spacing_across_mm=measured.spacing_across,
        noise_mm=measured.noise,
        normal_noise_rad=measured.normal_noise,
    )
    writer.register("/metrics", messages.Metrics, {"units": "mm, rad, s"})
    writer.write("/metrics", metrics.SerializeToString(), time)
    writer.register("/profile/stages", messages.Stage, {"units": "ns"})
    start = 0
    for number, (name, seconds) in enumerate(result.seconds.items()):
        duration = round(seconds * 1e9)
        stage = messages.Stage(name=name, start_ns=start, duration_ns=duration, points=len(result))
        writer.write("/profile/stages", stage.SerializeToString(), time, number)
        start += duration
    text = f"{len(result)} points in {len(result.cells)} cells: {result.patch_count} patches"
    _log(writer, text, time, messages.Log.INFO)


def _add_registration(writer: RecordingWriter, result: Segmentation, time: int) -> None:
    """Write the refined poses beside the recorded ones, and how well they fit."""
    aligned = result.registration
    if aligned is None:
        return
    entries = [("world", f"view_{v}/refined", pose) for v, pose in enumerate(aligned.refined)]
    writer.register("/tf", messages.FrameTransforms, {"units": "m"})
    message = messages.transform_message(entries, writer.start_ns + time)
    writer.write("/tf", message.SerializeToString(), time)
    writer.metadata(
        "octoseg.registration",
        {
            "pairs": json.dumps(aligned.pairs.tolist()),
            "rms_before_mm": json.dumps(aligned.before.tolist()),
            "rms_after_mm": json.dumps(aligned.after.tolist()),
            "datum": json.dumps(aligned.datum.tolist()),
            "left_as_recorded": json.dumps(aligned.left.tolist()),
            "open_directions": json.dumps(aligned.open.tolist()),
        },
    )
    _log(writer, str(aligned), time, messages.Log.INFO)


def _log(writer: RecordingWriter, text: str, time: int, level: int) -> None:
    """Write one line of /log."""
    writer.register("/log", messages.Log, {})
    message = messages.log_message(text, writer.start_ns + time, level)
    writer.write("/log", message.SerializeToString(), time)
