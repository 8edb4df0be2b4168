"""Recordings as MCAP, read back: our own exactly, foreign ones by their point cloud topic."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema

from octoseg_ti.errors import DataError
from octoseg_ti.files import archives, messages
from octoseg_ti.files.messages import METRE
from octoseg_ti.files.poses import moved, pose
from octoseg_ti.files.recording_check import BROKEN, records, verify
from octoseg_ti.files.recording_rows import positions
from octoseg_ti.files.validation import make_scans, make_truth, parsing
from octoseg_ti.types import Scans, Segmentation, Truth

SCAN_TOPIC = "/scan/lines"
RESULT_TOPIC = "/segments/points"
CLOUD_SCHEMA = "foxglove.PointCloud"
_MAX_HOPS = 64  # links of a transform chain; more means a loop


@dataclass(slots=True, kw_only=True)
class Contents:
    """What one pass over a recording collects."""

    path: Path
    library: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: list[Message] = field(default_factory=list)
    """Messages of the wanted topics, in file order."""
    counts: dict[int, int] = field(default_factory=dict)
    """Messages of every channel."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, Attachment] = field(default_factory=dict)

    def schema_of(self, channel: Channel) -> str:
        """Return the schema name of a channel, or an empty text."""
        schema = self.schemas.get(channel.schema_id)
        return schema.name if schema is not None else ""

    def topics(self) -> dict[str, Channel]:
        """Return the channels by topic."""
        return {channel.topic: channel for channel in self.channels.values()}


def collect(path: str | Path, wanted: set[str] | None) -> Contents:
    """Verify a recording and read it once.

    Args:
        path: The recording.
        wanted: Topics whose messages are kept; None keeps those of every topic.

    Raises:
        DataError: The file is missing, damaged or no MCAP, or a topic has an unknown encoding.
    """
    path = verify(path)
    contents = Contents(path=path)
    for record in records(path):
        if isinstance(record, Message):
            channel = contents.channels.get(record.channel_id)
            if channel is None:
                what = f"a message names the unknown channel {record.channel_id}"
                raise DataError(what, path=path, hint=BROKEN)
            contents.counts[record.channel_id] = contents.counts.get(record.channel_id, 0) + 1
            if wanted is None or channel.topic in wanted:
                contents.messages.append(record)
        elif isinstance(record, Channel):
            contents.channels[record.id] = record
        elif isinstance(record, Schema):
            contents.schemas[record.id] = record
        elif isinstance(record, Metadata):
            contents.metadata[record.name] = dict(record.metadata)
        elif isinstance(record, Attachment):
            contents.attachments[record.name] = record
        elif isinstance(record, Header):
            contents.library = record.library
    return contents


def read_scans(path: str | Path, *, topic: str | None = None) -> Scans:
    """Read the scan lines of a recording.

    A recording of ours comes back as it was: float32 metres as written, times, columns, views,
    poses; one that holds a result only gives the points, stripes and views of the result. In a
    foreign one every message of the topic is a stripe (one message alone is an unorganised cloud);
    messages in a frame with a known transform are moved to its root frame.

    Args:
        path: The recording.
        topic: A foxglove.PointCloud topic; default: ours, else the only one.

    Returns:
        The scans, world frame, mm.

    Raises:
        DataError: Damaged, no such topic, several topics to choose from, or no points.
    """
    return _scans_in(_collected(path, topic), topic)


def read_scans_and_truth(
    path: str | Path, *, topic: str | None = None
) -> tuple[Scans, Truth | None]:
    """Read scan lines, and their truth when there is one, in one pass over the file.

    Raises:
        DataError: As `read_scans` and `read_truth`.
    """
    contents = _collected(path, topic)
    return _scans_in(contents, topic), _truth_in(contents)


def _collected(path: str | Path, topic: str | None) -> Contents:
    """Return what `read_scans` needs of a recording, and the truth with it."""
    return collect(path, None if topic is None else {topic, SCAN_TOPIC, "/tf"})


def _scans_in(contents: Contents, topic: str | None) -> Scans:
    """Return the scan lines that were collected."""
    path = contents.path
    channel = _cloud_channel(contents, topic)
    ours = "octoseg.run" in contents.metadata
    mine = [m for m in contents.messages if m.channel_id == channel.id]
    with parsing(path, "MCAP", BROKEN):
        if ours and channel.topic == SCAN_TOPIC:
            values = _own_scans(contents, channel, mine)
        elif ours and channel.topic == RESULT_TOPIC:
            values = _result_scans(contents, mine)
        else:
            values = _foreign_scans(contents, channel)
    return make_scans(path, values)


def read_truth(path: str | Path) -> Truth | None:
    """Read the truth of a recording, bit for bit as it was written; None when it has none.

    Raises:
        DataError: Damaged, or the truth does not fit the points.
    """
    return _truth_in(collect(path, {SCAN_TOPIC}))


def _truth_in(contents: Contents) -> Truth | None:
    """Return the truth that was collected."""
    path = contents.path
    attachment = contents.attachments.get("ground_truth.npz")
    if attachment is None:
        return None
    _cloud_channel(contents, None)
    own = {c.id for c in contents.channels.values() if c.topic == SCAN_TOPIC}
    with parsing(path, "MCAP", BROKEN):
        points = positions(_rows([m for m in contents.messages if m.channel_id in own])[0])
        values = archives.unpack_truth(attachment.data, points)
        return make_truth(path, values, len(points))


def read_segmentation(path: str | Path) -> Segmentation:
    """Read the result in a recording.

    Raises:
        DataError: Damaged, or there is no result in it.
    """
    contents = collect(path, {RESULT_TOPIC})
    attachment = contents.attachments.get("result.npz")
    if attachment is None or not contents.messages:
        what = "this recording holds no result"
        raise DataError(what, path=path, hint="make one with `octoseg segment`")
    with parsing(path, "MCAP", BROKEN):
        rows, _ = _rows(contents.messages)
        arrays: dict[str, Any] = archives.unpack(attachment.data)
        names = {"labels": "label", "edge": "edge", "level": "level", "outlier": "outlier"}
        names |= {"stripe": "line", "view": "view"}
        for name, column in names.items():
            if column in (rows.dtype.names or ()):
                arrays[name] = rows[column]
        arrays["points"] = positions(rows)
        arrays["normals"] = np.stack([rows[f"normal_{axis}"] for axis in "xyz"], axis=1)
        return archives.result_from_arrays(arrays)


def _cloud_channel(contents: Contents, topic: str | None) -> Channel:
    """Return the channel of the scan: the one asked for, ours, or the only one there is."""
    path, topics = contents.path, contents.topics()
    clouds = sorted(name for name, c in topics.items() if contents.schema_of(c) == CLOUD_SCHEMA)
    name = topic
    if name is None:
        ours = [own for own in (SCAN_TOPIC, RESULT_TOPIC) if own in topics]
        name = ours[0] if ours else clouds[0] if len(clouds) == 1 else None
    if name is None and clouds:
        what = f"several point cloud topics: {', '.join(clouds)}"
        raise DataError(what, path=path, hint="choose one with topic=")
    if name is None:
        seen = ", ".join(sorted({contents.schema_of(c) or c.topic for c in topics.values()}))
        what = f"no {CLOUD_SCHEMA} topic" + (f" (there are: {seen})" if seen else "")
        raise DataError(what, path=path, hint="record the scan lines as foxglove.PointCloud")
    if name not in topics:
        what = f"no topic {name}"
        raise DataError(what, path=path, hint=f"there are: {', '.join(clouds) or 'none'}")
    channel = topics[name]
    if contents.schema_of(channel) != CLOUD_SCHEMA or channel.message_encoding != "protobuf":
        what = (
            f"topic {name} is {contents.schema_of(channel) or 'without schema'} "
            f"in {channel.message_encoding or 'no'} encoding"
        )
        raise DataError(what, path=path, hint=f"{CLOUD_SCHEMA} in protobuf can be read")
    return channel


def _rows(mine: list[Message]) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of clouds of one field layout, and the points of each, shape (M,)."""
    if not mine:
        raise ValueError("the topic has no messages")
    first = messages.PointCloud.FromString(mine[0].data)
    dtype = messages.cloud_dtype(first)
    data, lengths = [], []
    for message in mine:
        cloud = messages.PointCloud.FromString(message.data)
        if cloud.point_stride != dtype.itemsize or len(cloud.fields) != len(first.fields):
            raise ValueError("the fields change within the topic")
        if len(cloud.data) % dtype.itemsize:
            raise ValueError("a cloud ends in the middle of a point")
        data.append(cloud.data)
        lengths.append(len(cloud.data) // dtype.itemsize)
    return np.frombuffer(b"".join(data), dtype), np.array(lengths)


def _own_scans(contents: Contents, channel: Channel, mine: list[Message]) -> dict[str, Any]:
    """Return the fields of `Scans` of a recording of ours."""
    rows, lengths = _rows(mine)
    run = contents.metadata["octoseg.run"]
    names = rows.dtype.names or ()
    values: dict[str, Any] = {"points": positions(rows), "name": run.get("name", "")}
    if "normal_x" in names:
        values["normals"] = np.stack([rows[f"normal_{axis}"] for axis in "xyz"], axis=1)
    for name in ("column", "view"):
        if name in names:
            values[name] = rows[name]
    if channel.metadata.get("organised", "true") == "true":
        values["stripe"] = np.repeat([message.sequence for message in mine], lengths)
    if channel.metadata.get("time") == "recorded":
        start = int(run.get("start_ns", "0"))
        values["time_ns"] = np.repeat([message.log_time - start for message in mine], lengths)
    if "scan.npz" in contents.attachments:
        exact = archives.unpack(contents.attachments["scan.npz"].data)
        if "time_step_ns" in exact:
            values["time_ns"] = np.cumsum(exact.pop("time_step_ns"))
        values |= exact
    return values


def _result_scans(contents: Contents, mine: list[Message]) -> dict[str, Any]:
    """Return the fields of `Scans` that a result of ours keeps; normals are estimated anew."""
    rows, _ = _rows(mine)
    values: dict[str, Any] = {"points": positions(rows)}
    values["name"] = contents.metadata["octoseg.run"].get("name", "")
    for name, column in (("stripe", "line"), ("column", "column"), ("view", "view")):
        if column in (rows.dtype.names or ()):
            values[name] = rows[column]
    return values


def _foreign_scans(contents: Contents, channel: Channel) -> dict[str, Any]:
    """Return the fields of `Scans` of any PointCloud topic, in the root frame of its transforms."""
    parents: dict[str, tuple[str, np.ndarray]] = {}
    points, times, origins, lengths = [], [], [], []
    for message in contents.messages:
        schema = contents.schema_of(contents.channels[message.channel_id])
        if schema == "foxglove.FrameTransforms":
            for entry in messages.FrameTransforms.FromString(message.data).transforms:
                _note_transform(parents, entry)
        elif schema == "foxglove.FrameTransform":
            _note_transform(parents, FrameTransform.FromString(message.data))
        if message.channel_id != channel.id:
            continue
        rows, _ = _rows([message])
        if not {"x", "y", "z"} <= set(rows.dtype.names or ()):
            raise ValueError(f"topic {channel.topic} has no fields x, y and z")
        cloud = messages.PointCloud.FromString(message.data)
        matrix = _to_root(parents, cloud.frame_id)
        if cloud.HasField("pose"):
            matrix = matrix @ _pose_of(cloud.pose.position, cloud.pose.orientation)
        xyz = positions(rows)
        identity = np.array_equal(matrix, np.eye(4))
        points.append(xyz if identity else moved(matrix, xyz))
        times.append(message.log_time)
        origins.append(matrix[:3, 3])
        lengths.append(len(rows))
    if not points:
        raise ValueError(f"topic {channel.topic} has no messages")
    values: dict[str, Any] = {"points": np.concatenate(points), "name": contents.path.name}
    if len(points) > 1:
        values["stripe"] = np.repeat(np.arange(len(points)), lengths)
        values["time_ns"] = np.repeat(np.array(times, np.int64) - min(times), lengths)
        if len(np.unique(np.array(origins), axis=0)) > 1:  # the frame moves with the probe
            values["stripe_origin"] = np.array(origins)
    return values


def _note_transform(parents: dict[str, tuple[str, np.ndarray]], entry: Any) -> None:
    """Remember the latest transform of a frame."""
    parents[entry.child_frame_id] = (
        entry.parent_frame_id,
        _pose_of(entry.translation, entry.rotation),
    )


def _pose_of(position: Any, orientation: Any) -> np.ndarray:
    """Return the 4x4 pose [mm] of a Foxglove position [m] and orientation; all zero = none."""
    q = (orientation.x, orientation.y, orientation.z, orientation.w)
    q = (0.0, 0.0, 0.0, 1.0) if not any(q) else q
    return pose(q, METRE * np.array([position.x, position.y, position.z]))


def _to_root(parents: dict[str, tuple[str, np.ndarray]], frame: str) -> np.ndarray:
    """Return the pose of a frame in the last frame of its chain."""
    matrix = np.eye(4)
    for _ in range(_MAX_HOPS):
        if frame not in parents:
            return matrix
        frame, step = parents[frame]
        matrix = step @ matrix
    raise ValueError(f"the transforms of frame {frame!r} form a loop")
