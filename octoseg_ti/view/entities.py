"""What is logged to Rerun, entity by entity. Lengths are mm, as in the API."""

from __future__ import annotations

from typing import Any

import numpy as np

from octoseg_ti import palette
from octoseg_ti.errors import DataError
from octoseg_ti.evaluation import evaluate, wrong_points
from octoseg_ti.types import Scans, Segmentation, SurfaceKind, Truth
from octoseg_ti.view import scene
from octoseg_ti.view.report import markdown
from octoseg_ti.view.surface_mesh import patch_mesh

BOXES = 60_000
"""Most boxes that the viewer draws of one entity."""

_ARROWS = 20_000
_POINT = 1.5  # radius on the screen, in points: radii in mm below a pixel give moire patterns
# Above this coordinate [mm] f32 positions would be off by more than half a micrometre.
_FAR = 8192.0


def shift_of(*clouds: np.ndarray) -> np.ndarray:
    """Return what to subtract from positions before they become f32 [mm], shape (3,).

    Zero for parts near the origin. The entity ``/world`` carries the same shift as its transform,
    so that positions in the viewer stay true.
    """
    finite = [cloud[scene.finite_rows(cloud)] for cloud in clouds]
    finite = [cloud for cloud in finite if len(cloud)]
    if not finite:
        return np.zeros(3)
    low = np.min([cloud.min(axis=0) for cloud in finite], axis=0)
    high = np.max([cloud.max(axis=0) for cloud in finite], axis=0)
    if max(np.abs(low).max(), np.abs(high).max()) < _FAR:
        return np.zeros(3)
    return np.round((low + high) / 2)


def log_world(rec: Any, shift: np.ndarray) -> None:
    """Log the frame of the part."""
    import rerun as rr

    rec.log("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _name_classes(rec, "/world/edges", ["none", "sharp", "fillet", "smooth"], scene.EDGE_COLORS)
    errors = ["right", "wrong region", "no label", "label on unknown truth"]
    _name_classes(rec, "/world/errors", errors, scene.ERROR_COLORS)
    if shift.any():
        rec.log("/world", rr.Transform3D(translation=shift), static=True)


def _name_classes(rec: Any, entity: str, names: list[str], colors: np.ndarray) -> None:
    """Give the classes 1, 2, ... below an entity names and colours, and class 0 the name none."""
    import rerun as rr

    known = [rr.AnnotationInfo(id=0, label="none", color=scene.REST_COLOR)]
    known += [
        rr.AnnotationInfo(id=k + 1, label=name, color=tuple(int(c) for c in colors[k]))
        for k, name in enumerate(names)
    ]
    rec.log(entity, rr.AnnotationContext(known), static=True)


def log_stripes(rec: Any, scans: Scans, *, shift: np.ndarray | None = None) -> None:
    """Log the scan: every stripe at its place on the timelines ``scan_line`` and ``scan_time``.

    Points without stripes are logged as one static cloud.

    Args:
        rec: A Rerun recording stream.
        scans: The scan.
        shift: Subtracted from all positions [mm], shape (3,).
    """
    import rerun as rr

    shift = np.zeros(3) if shift is None else shift
    positions = (scene.world_points(scans) - shift).astype(np.float32)
    radius = rr.Radius.ui_points(_POINT)
    if scans.stripe is None:
        points = rr.Points3D(positions, colors=scene.SCAN_COLOR, radii=radius)
        rec.log("/world/scan/lines", points, static=True)
        return
    rec.log("/world/scan/lines", rr.Points3D.from_fields(radii=radius), static=True)
    stripe = np.asarray(scans.stripe)
    bounds = scene.stripe_bounds(stripe)
    starts, lengths = bounds[:-1], np.diff(bounds)
    if not len(starts):
        return
    index = stripe_index(rr, scans, starts)
    extra = {
        name: _one_each(column)
        for name, column in (("column", scans.column), ("view", scans.view))
        if column is not None
    }
    columns = [
        *rr.Points3D.columns(positions=positions).partition(lengths),
        *rr.Points3D.columns(colors=stripe_colors(scans, starts)).partition(np.ones_like(starts)),
    ]
    if extra:
        columns += rr.DynamicArchetype.columns("octoseg.Scan", components=extra).partition(lengths)
    rec.send_columns("/world/scan/lines", index, columns)
    if scans.stripe_origin is not None:
        log_scanner_axes(rec)
        log_scanner(rec, scans, starts, shift)


def _one_each(values: np.ndarray) -> Any:
    """Return an Arrow column of one value a row; Rerun would make one of Python lists."""
    import pyarrow as pa

    flat = pa.array(np.ascontiguousarray(values))
    return pa.ListArray.from_arrays(pa.array(np.arange(len(flat) + 1, dtype=np.int32)), flat)


def stripe_index(rr: Any, scans: Scans, starts: np.ndarray) -> list[Any]:
    """Return the timelines of the stripes that start at these points."""
    assert scans.stripe is not None
    index = [rr.TimeColumn("scan_line", sequence=np.asarray(scans.stripe)[starts].astype(np.int64))]
    if scans.time_ns is not None:
        nanoseconds = np.asarray(scans.time_ns)[starts].astype("timedelta64[ns]")
        index.append(rr.TimeColumn("scan_time", duration=nanoseconds))
    return index


def stripe_colors(scans: Scans, starts: np.ndarray) -> np.ndarray:
    """Return one colour for every stripe, shape (L, 4), u8: by view where there are several."""
    if scans.view is None or len(np.unique(scans.view)) < 2:
        return np.tile(np.array(scene.SCAN_COLOR, np.uint8), (len(starts), 1))
    return palette.colors(np.asarray(scans.view)[starts])


def log_scanner(rec: Any, scans: Scans, starts: np.ndarray, shift: np.ndarray) -> None:
    """Log the pose of the probe at every stripe, where it is known."""
    import rerun as rr

    if scans.stripe_origin is None:
        return
    places = np.asarray(scans.stripe_origin, np.float64)
    stripe = np.asarray(scans.stripe)[starts]
    known = stripe < len(places)
    known[known] = scene.finite_rows(places[stripe[known]])
    if not known.any():
        return
    starts, stripe = starts[known], stripe[known]
    turns = np.tile(np.eye(3), (len(starts), 1, 1))
    if scans.T_world_view is not None:
        view = np.zeros(len(starts), int) if scans.view is None else np.asarray(scans.view)[starts]
        turns = np.asarray(scans.T_world_view)[view, :3, :3]
    columns = rr.Transform3D.columns(
        translation=(places[stripe] - shift).astype(np.float32),
        # Rerun stores matrices column by column.
        mat3x3=turns.transpose(0, 2, 1).reshape(-1, 9).astype(np.float32),
    )
    rec.send_columns("/world/scanner", stripe_index(rr, scans, starts), columns)


def log_scanner_axes(rec: Any) -> None:
    """Draw the pose of the probe as three axes."""
    import rerun as rr

    rec.log("/world/scanner", rr.TransformAxes3D(10.0), static=True)


def log_truth(rec: Any, points: np.ndarray, truth: Truth, *, shift: np.ndarray) -> None:
    """Log the true patches on the scanned points.

    Args:
        rec: A Rerun recording stream.
        points: Positions [mm], shape (N, 3).
        truth: Truth of these points.
        shift: Subtracted from all positions [mm], shape (3,).
    """
    names = [f"true patch {k}" for k in range(truth.patch_count)]
    _name_classes(rec, "/world/truth", names, palette.colors(np.arange(truth.patch_count)))
    _cloud(rec, "/world/truth/points", points - shift, palette.colors(truth.patch), truth.patch)


def log_segmentation(
    rec: Any,
    result: Segmentation,
    *,
    truth: Truth | None = None,
    shift: np.ndarray | None = None,
    static: bool = True,
) -> None:
    """Log everything a segmentation holds, stage by stage.

    Args:
        rec: A Rerun recording stream.
        result: The segmentation.
        truth: Truth of its points: adds which of them are wrong.
        shift: Subtracted from all positions [mm], shape (3,).
        static: For all times; otherwise at the time set on ``rec``.

    Raises:
        DataError: The truth has another number of points.
    """
    import rerun as rr

    if truth is not None and len(truth) != len(result):
        raise DataError(f"the truth has {len(truth)} points, the result {len(result)}")
    shift = np.zeros(3) if shift is None else shift
    if not static:
        # An earlier answer may have had more patches or levels than this one.
        for entity in ("/world/surfaces", "/world/octree"):
            rec.log(entity, rr.Clear(recursive=True))
    points = (result.points - shift).astype(np.float32)
    keep = scene.finite_rows(points)
    has_normal = keep & result.normals.any(axis=1)
    colors = scene.normal_colors(result.normals)
    _cloud(rec, "/world/normals/points", points, colors, on=has_normal, static=static)
    some = np.flatnonzero(has_normal)
    some = some[:: max(1, -(-len(some) // _ARROWS))]
    length = 3 * max(result.measured.spacing_along, result.measured.spacing_across)
    arrows = rr.Arrows3D(
        origins=points[some],
        vectors=length * result.normals[some],
        colors=colors[some],
        radii=rr.Radius.ui_points(0.5),
    )
    rec.log("/world/normals/arrows", arrows, static=static)

    _log_cells(rec, result, shift, static)
    edge = result.edge > 0
    classes = scene.edge_colors(result.edge)
    _cloud(rec, "/world/edges/points", points, classes, result.edge, on=edge, static=static)
    rest = ~edge & (result.outlier == 0)
    _cloud(rec, "/world/edges/removed", points, classes, on=rest, static=static)
    names = [f"patch {k} ({SurfaceKind(int(c)).name.lower()})" for k, c in enumerate(result.kind)]
    _name_classes(rec, "/world/segments", names, palette.colors(np.arange(len(names))))
    colors = palette.colors(result.labels)
    _cloud(rec, "/world/segments/points", points, colors, result.labels, static=static)
    if truth is not None:
        wrong = wrong_points(result.labels, truth.patch)
        colors = scene.ERROR_COLORS[wrong]
        _cloud(rec, "/world/errors/points", points, colors, wrong, static=static)
    _log_surfaces(rec, result, shift, static)
    _log_numbers(rec, result, truth, static)


def _cloud(
    rec: Any,
    entity: str,
    positions: np.ndarray,
    colors: np.ndarray,
    classes: np.ndarray | None = None,
    *,
    on: np.ndarray | None = None,
    static: bool = True,
) -> None:
    """Log the finite points among ``on``; class 0 = none, else label + 1."""
    import rerun as rr

    keep = scene.finite_rows(positions)
    if on is not None:
        keep &= on
    ids = None
    if classes is not None:
        ids = np.clip(classes[keep].astype(np.int64) + 1, 0, 65_535).astype(np.uint16)
    points = rr.Points3D(
        positions[keep].astype(np.float32, copy=False),
        colors=colors[keep],
        class_ids=ids,
        radii=rr.Radius.ui_points(_POINT),
    )
    rec.log(entity, points, static=static)


def _log_cells(rec: Any, result: Segmentation, shift: np.ndarray, static: bool) -> None:
    cells = result.cells
    corners = scene.initial_corners(cells) - shift
    _boxes(rec, "/world/octree/initial/level_0", corners, cells.initial_size, (90, 96, 110), static)
    deepest = int(cells.level.max(initial=0))
    for level in np.unique(cells.level):
        on = cells.level == level
        color = scene.level_colors(np.array([level]), deepest)[0]
        entity = f"/world/octree/final/level_{level}"
        _boxes(rec, entity, cells.corner[on] - shift, float(cells.size[on][0]), color, static)


def _boxes(
    rec: Any, entity: str, corners: np.ndarray, size: float, color: Any, static: bool
) -> None:
    """Log cubes, in several entities where one would be more than the viewer draws."""
    import rerun as rr

    for part, start in enumerate(range(0, len(corners), BOXES)):
        boxes = rr.Boxes3D(
            centers=corners[start : start + BOXES] + size / 2,
            half_sizes=[[size / 2] * 3],
            colors=color,
            radii=rr.Radius.ui_points(0.7),
            fill_mode="majorwireframe",
        )
        rec.log(entity if part == 0 else f"{entity}_part_{part}", boxes, static=static)


def _log_surfaces(rec: Any, result: Segmentation, shift: np.ndarray, static: bool) -> None:
    import rerun as rr

    deviation = result.deviation
    for k in range(result.patch_count):
        mesh = patch_mesh(result, k)
        if mesh is None:
            continue
        kind = SurfaceKind(int(result.kind[k])).name.lower()
        rec.log(
            f"/world/surfaces/{k}",
            rr.Mesh3D(
                vertex_positions=(mesh.vertices - shift).astype(np.float32),
                vertex_normals=mesh.normals.astype(np.float32),
                triangle_indices=mesh.triangles.astype(np.uint32),
                albedo_factor=palette.colors(np.array([k]))[0],
            ),
            rr.AnyValues(
                kind=kind,
                parameters=result.parameters[k],
                deviations=deviation[k],
                rms_mm=float(result.residual[k]),
                surface=int(result.surface[k]),
            ),
            static=static,
        )


def _log_numbers(rec: Any, result: Segmentation, truth: Truth | None, static: bool) -> None:
    import rerun as rr

    if result.patch_count:
        chart = rr.BarChart(result.patch_sizes)
        rec.log("/metrics/segment_sizes", chart, static=static)
    outer = {name: 1e3 * s for name, s in result.seconds.items() if "." not in name}
    if outer:
        rec.log("/metrics/milliseconds", rr.BarChart(list(outer.values())), static=static)
    for name, seconds in result.seconds.items():
        rec.log(f"/metrics/seconds/{name}", rr.Scalars(seconds), static=static)
    scores = None if truth is None else evaluate(result, truth)
    report = markdown(result, scores=scores, truth=truth)
    text = rr.TextDocument(report, media_type=rr.MediaType.MARKDOWN)
    rec.log("/report", text, static=static)
    lines = [f"- {k}: {v}" for k, v in _flat(result.params.to_dict())]
    text = rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
    rec.log("/params", text, static=static)


def _flat(values: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = []
    for key, value in values.items():
        if isinstance(value, dict):
            out += _flat(value, f"{prefix}{key}.")
        else:
            out.append((f"{prefix}{key}", value))
    return out
