"""The messages of a recording: Foxglove's schemas, and three flat ones of our own.

Recordings are in metres. Numbers of fields are never reused: new fields come at the end of a table.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from octoseg_ti.files.poses import quaternion

METRE = 1000.0
"""Millimetres in a metre: files are in metres, arrays in millimetres."""

_KINDS = {
    "u1": PackedElementField.UINT8,
    "i1": PackedElementField.INT8,
    "u2": PackedElementField.UINT16,
    "i2": PackedElementField.INT16,
    "u4": PackedElementField.UINT32,
    "i4": PackedElementField.INT32,
    "f4": PackedElementField.FLOAT32,
    "f8": PackedElementField.FLOAT64,
}
CUBE_ALPHA = 0.35
"""Opacity of the cubes of a grid, so that the points inside are seen."""

_CODES = {int(kind): code for code, kind in _KINDS.items()}

PARAMS_FIELDS = (
    ("preset", "string"),
    ("cleaning_enabled", "bool"),
    ("cleaning_spike", "double"),
    ("cleaning_isolation", "double"),
    ("cleaning_detached", "double"),
    ("normals_rule", "string"),
    ("normals_gap", "double"),
    ("normals_weight", "string"),
    ("normals_neighbors", "double"),
    ("grid_divisions", "double"),
    ("grid_tolerance", "double"),
    ("grid_min_cell", "double"),
    ("grid_min_points", "double"),
    ("edges_rule", "string"),
    ("edges_smallest_levels", "double"),
    ("edges_fillet_levels", "double"),
    ("edges_radius", "double"),
    ("edges_fillet_radius", "double"),
    ("regions_homogeneity", "double"),
    ("regions_min_points", "double"),
    ("regions_assign_edges", "bool"),
    ("grid_edge_tolerance", "double"),
    ("registration_refine", "bool"),
    ("registration_reach", "double"),
    ("registration_overlap", "double"),
    ("normals_smooth", "double"),
    ("edges_fillet_radius", "double"),
    ("surfaces_enabled", "bool"),
    ("surfaces_noise", "double"),
    ("surfaces_tilt", "double"),
)
"""octoseg.Params: "section_option" of `Params`, mm and rad; NaN or "" = derived from the data."""

METRICS_FIELDS = (
    ("points", "double"),
    ("patches", "double"),
    ("labelled_share", "double"),
    ("edge_points", "double"),
    ("outliers", "double"),
    ("cells", "double"),
    ("levels", "double"),
    ("passes", "double"),
    ("seconds", "double"),
    ("spacing_along_mm", "double"),
    ("spacing_across_mm", "double"),
    ("noise_mm", "double"),
    ("normal_noise_rad", "double"),
)
"""octoseg.Metrics: what was found and measured, flat, so that every value can be plotted."""

STAGE_FIELDS = (
    ("name", "string"),
    ("start_ns", "int64"),
    ("duration_ns", "int64"),
    ("points", "int64"),
)
"""octoseg.Stage: one stage of the run, on the clock that starts with its first stage."""


def _flat_messages(tables: Mapping[str, Sequence[tuple[str, str]]]) -> dict[str, Any]:
    """Return message classes without nesting, made from (name, type) tables."""
    field = descriptor_pb2.FieldDescriptorProto
    types = {
        "double": field.TYPE_DOUBLE,
        "string": field.TYPE_STRING,
        "bool": field.TYPE_BOOL,
        "int64": field.TYPE_INT64,
    }
    file = descriptor_pb2.FileDescriptorProto(
        name="octoseg/messages.proto", package="octoseg", syntax="proto3"
    )
    for message_name, fields in tables.items():
        message = file.message_type.add(name=message_name)
        for number, (name, kind) in enumerate(fields, start=1):
            message.field.add(
                name=name, number=number, type=types[kind], label=field.LABEL_OPTIONAL
            )
    pool = descriptor_pool.Default()
    pool.Add(file)  # type: ignore[no-untyped-call]
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"octoseg.{name}"))
        for name in tables
    }


_FLAT = _flat_messages({"Params": PARAMS_FIELDS, "Metrics": METRICS_FIELDS, "Stage": STAGE_FIELDS})
Params = _FLAT["Params"]
Metrics = _FLAT["Metrics"]
Stage = _FLAT["Stage"]


def flat_params(values: Mapping[str, Mapping[str, Any]], preset: str = "") -> Any:
    """Return octoseg.Params of nested plain values (`Params.to_dict`)."""
    message = Params(preset=preset)
    for name, kind in PARAMS_FIELDS[1:]:
        section, _, option = name.partition("_")
        value = values[section][option]
        if kind == "double":
            value = float("nan") if value is None else float(value)
        elif kind == "string" and value is None:
            value = ""
        setattr(message, name, value)
    return message


class CloudLayout:
    """One field layout of foxglove.PointCloud: packs rows of a structured array into messages.

    Parts that never change are built once; a message costs one copy of its rows.
    """

    def __init__(self, dtype: np.dtype, frame: str = "world") -> None:
        """Describe the fields of a packed little-endian structured dtype."""
        self.dtype = dtype
        self._message = PointCloud(frame_id=frame, point_stride=dtype.itemsize)
        self._message.pose.orientation.w = 1.0
        assert dtype.fields is not None
        for name in dtype.names or ():
            kind, offset = dtype.fields[name][:2]
            self._message.fields.add(name=name, offset=offset, type=_KINDS[kind.str[1:]])

    def pack(self, rows: np.ndarray, time_ns: int) -> bytes:
        """Return the message of rows (structured, shape (n,)) with a header time [ns]."""
        message = self._message
        message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, 1_000_000_000)
        message.data = rows.tobytes()
        return message.SerializeToString()


def cloud_dtype(message: PointCloud) -> np.dtype:
    """Return the structured dtype of a PointCloud message.

    Raises:
        ValueError: A field of unknown type, or one that reaches beyond the stride.
    """
    names, formats, offsets = [], [], []
    for field in message.fields:
        if field.type not in _CODES:
            raise ValueError(f"field {field.name!r} has the unknown type {field.type}")
        names.append(field.name)
        formats.append("<" + _CODES[field.type])
        offsets.append(field.offset)
    layout = {
        "names": names,
        "formats": formats,
        "offsets": offsets,
        "itemsize": message.point_stride,
    }
    return np.dtype(layout)  # type: ignore[call-overload]


def transform_message(
    transforms: Sequence[tuple[str, str, np.ndarray]], time_ns: int
) -> FrameTransforms:
    """Return foxglove.FrameTransforms of (parent, child, 4x4 pose [mm] child to parent)."""
    message = FrameTransforms()
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    for parent, child, matrix in transforms:
        entry = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
        entry.timestamp.seconds, entry.timestamp.nanos = seconds, nanos
        t = matrix[:3, 3] / METRE
        entry.translation.x, entry.translation.y, entry.translation.z = t
        q = entry.rotation
        q.x, q.y, q.z, q.w = quaternion(matrix[:3, :3])
    return message


def cubes_message(
    identity: str, corner: np.ndarray, size: np.ndarray, color: np.ndarray, time_ns: int
) -> SceneUpdate:
    """Return foxglove.SceneUpdate with one entity of axis-parallel cubes.

    Args:
        identity: Id of the entity; a later message of that id replaces it.
        corner: Lower corners [mm], shape (C, 3).
        size: Edge lengths [mm], shape (C,).
        color: RGBA, shape (C, 4), u8.
        time_ns: Time of the entity [ns].
    """
    message = SceneUpdate()
    entity = message.entities.add(id=identity, frame_id="world")
    entity.timestamp.seconds, entity.timestamp.nanos = divmod(time_ns, 1_000_000_000)
    template, places = _cube_template()
    rows = np.tile(np.frombuffer(template, np.uint8), (len(size), 1))
    center = (corner + 0.5 * size[:, None]) / METRE
    values = [*center.T, *np.tile(size / METRE, (3, 1)), *(color[:, :3].T / 255.0)]
    values.append(np.full(len(size), CUBE_ALPHA))
    for place, value in zip(places, values, strict=True):
        rows[:, place : place + 8] = value.astype("<f8").view(np.uint8).reshape(-1, 8)
    entity.MergeFromString(rows.tobytes())
    return message


def _cube_template() -> tuple[bytes, list[int]]:
    """Return an entity of one cube as bytes, and where its ten numbers are.

    Protobuf itself writes the bytes; filling in the numbers of all cubes at once and letting
    protobuf parse them is an order of magnitude faster than setting ten attributes per cube.
    """
    marks = [float(np.sqrt(2.0 + k)) for k in range(10) if k not in (2, 7)] + [0.1, 0.2]
    entity = SceneEntity()
    cube = entity.cubes.add()
    position, extent, paint = cube.pose.position, cube.size, cube.color
    position.x, position.y, position.z = marks[:3]
    extent.x, extent.y, extent.z = marks[3:6]
    paint.r, paint.g, paint.b, paint.a = marks[6:]
    cube.pose.orientation.w = 1.0
    template = entity.SerializeToString()
    return template, [template.index(struct.pack("<d", mark)) for mark in marks]


def log_message(text: str, time_ns: int, level: int = Log.INFO) -> Log:
    """Return a foxglove.Log line of the given level."""
    message = Log(level=level, message=text, name="octoseg")  # type: ignore[arg-type]
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, 1_000_000_000)
    return message
