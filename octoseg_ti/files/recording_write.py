"""Recordings as MCAP: stripes as they come, their truth, and the poses of view and probe.

Points are in the fixed frame ``world``, so that a viewer may accumulate stripes; positions of the
probe travel in ``/tf``. ``sequence`` is the stripe number, ``log_time`` the time of the stripe.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from octoseg_ti import __version__
from octoseg_ti.errors import DataError
from octoseg_ti.files import archives, messages
from octoseg_ti.files.atomic import AtomicFile
from octoseg_ti.files.messages import CloudLayout
from octoseg_ti.files.recording_rows import (
    in_world,
    joined,
    needs_double,
    part_of,
    positions,
    scan_rows,
    truth_rows,
)
from octoseg_ti.files.validation import runs
from octoseg_ti.types import Scans, Truth

if TYPE_CHECKING:
    from typing_extensions import Self

LIBRARY = f"octoseg {__version__}"
START_NS = 1_767_225_600_000_000_000
"""Time stamp of time 0: 2026-01-01T00:00:00Z. Fixed, so that equal input gives equal bytes."""

_NOMINAL_STEP_NS = 1_000_000  # a stripe without a time gets its turn, one millisecond each
_BLOCK = 50_000  # points of a message when there are no stripes


_TRUTH_NOTES = {"error_100nm": "distance from the true surface along its normal, 0.1 um"}


class _Told(NamedTuple):
    """A piece that waits for its truth."""

    rows: np.ndarray
    """Positions as the messages hold them, fields x, y, z."""
    bounds: np.ndarray
    """First row of every message, and the number of rows at the end."""
    numbers: list[int]
    """Stripe of every message."""
    times: list[int]
    """Time of every message [ns]."""


class RecordingWriter:
    """Writes an MCAP recording piece by piece; the file appears when `finish` is called.

    Use it as a context manager: it finishes on success, and leaves nothing behind on an exception.
    The truth of all stripes is kept in memory until `finish`, because its exact form is one
    attachment.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        name: str = "",
        precise: bool | None = None,
        run: Mapping[str, str] | None = None,
        start_ns: int = START_NS,
        overwrite: bool = True,
        truth_follows: bool = False,
    ) -> None:
        """Open the part file and write the header.

        Args:
            path: The recording to write.
            name: Where the scans come from.
            precise: Positions in double precision; default: when the first piece needs it.
            run: How the recording came about, for the metadata record ``octoseg.run``.
            start_ns: Time stamp of time 0 [ns since 1970].
            overwrite: False refuses a file that exists.
            truth_follows: `add_truth` will be called after the last piece; where the messages
                lie is kept for it, 12 to 24 bytes a point.

        Raises:
            DataError: The output cannot be written.
        """
        self.path = Path(path)
        self.start_ns = start_ns
        self.time_ns = 0
        """Time of the latest stripe since the start of the recording [ns]."""
        self._precise = precise
        self._truth_follows = truth_follows
        self._truth: list[Truth] = []
        self._told: list[_Told] = []
        self._points: list[np.ndarray] = []
        self._times: list[np.ndarray] = []
        self._extras: dict[str, np.ndarray] = {}
        self._exact_times = False
        self._origins: dict[int, np.ndarray] = {}
        self._views_told: set[int] = set()
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._layouts: dict[str, CloudLayout] = {}
        self._stripes = 0
        self._form: tuple[bool, ...] | None = None
        self._sealed: Future[bytes] | None = None
        self._output = AtomicFile(path, overwrite=overwrite)
        self._done = False
        try:
            self._writer = Writer(
                self._output,  # type: ignore[arg-type]
                chunk_size=1024 * 1024,
                compression=CompressionType.ZSTD,
                enable_data_crcs=True,
            )
            self._writer.start(profile="", library=LIBRARY)
            details = {
                "version": __version__,
                "name": name,
                "units": "m",
                "frame": "world",
                "start_ns": str(start_ns),
            }
            self._writer.add_metadata("octoseg.run", details | dict(run or {}))
        except BaseException:
            self.abort()
            raise

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish, or remove everything when the block failed."""
        if kind is not None:
            self.abort()
        elif not self._done:
            self.finish()

    def add_stripe(
        self,
        points: np.ndarray,
        *,
        stripe: int,
        view: int | None = None,
        column: np.ndarray | None = None,
        time_ns: int | None = None,
        normals: np.ndarray | None = None,
        origin: np.ndarray | None = None,
        truth: Truth | None = None,
    ) -> None:
        """Append one stripe.

        Args:
            points: Positions along the stripe [mm], world frame, shape (n, 3).
            stripe: Its number; larger than those before.
            view: Number of its view.
            column: Detector rows, shape (n,).
            time_ns: Time since the start of the recording [ns].
            normals: Unit normals, shape (n, 3).
            origin: Probe position [mm], world frame, shape (3,).
            truth: The truth of these points.
        """
        n = len(points)
        if origin is not None:
            self._origins[stripe] = np.asarray(origin, np.float64)
        self.add(
            Scans(
                points=np.asarray(points, np.float64),
                normals=normals,
                stripe=np.full(n, stripe, np.int32),
                column=column,
                view=None if view is None else np.full(n, view, np.int32),
                time_ns=None if time_ns is None else np.full(n, time_ns, np.int64),
            ),
            truth,
        )

    def add(self, scans: Scans, truth: Truth | None = None) -> None:
        """Append scans of any number of stripes, with poses and truth where given.

        Raises:
            DataError: The disk is full, or positions need double precision after a first piece
                that did not.
            ValueError: A piece has other arrays than the first one, or the scans were sealed.
        """
        form = tuple(
            value is not None
            for value in (
                scans.stripe,
                scans.normals,
                scans.column,
                scans.view,
                scans.time_ns,
                truth,
            )
        )
        if self._sealed is not None:
            raise ValueError("no scans can be added after seal_scans")
        if self._form is None:
            self._form = form
        elif self._form != form:
            raise ValueError("every piece of a recording must have the same arrays")
        self._extras.update(archives.scan_extras(scans))
        if len(scans) == 0:
            return
        points, normals = in_world(scans)
        rows = scan_rows(scans, points, normals, truth, self._position_type(points))
        truth_part = None
        if truth is not None:
            stored = positions(rows)
            truth_part = truth_rows(truth, rows, stored)
            self._truth.append(truth)
            self._points.append(stored)
        if scans.stripe is None:
            bounds = np.append(np.arange(0, len(points), _BLOCK), len(points))
        else:
            bounds = runs(scans.stripe, scans.view)
        times = self._stripe_times(scans, bounds)
        first = bounds[:-1]
        stripe = range(self._stripes, self._stripes + len(first))
        numbers = list(stripe) if scans.stripe is None else scans.stripe[first].tolist()
        views = [0] * len(first) if scans.view is None else scans.view[first].tolist()
        scan_layout = self._layout("/scan/lines", rows.dtype, self._scan_notes(scans))
        truth_layout = None
        if truth_part is not None:
            truth_layout = self._layout("/truth/lines", truth_part.dtype, _TRUTH_NOTES)
        for a, b, number, view, time in zip(
            first.tolist(), bounds[1:].tolist(), numbers, views, times, strict=True
        ):
            stamp = self.start_ns + time
            self._tell_poses(number, view, time)
            self.write("/scan/lines", scan_layout.pack(rows[a:b], stamp), time, number)
            if truth_part is not None and truth_layout is not None:
                self.write("/truth/lines", truth_layout.pack(truth_part[a:b], stamp), time, number)
        if self._truth_follows:
            self._told.append(_Told(rows[["x", "y", "z"]].copy(), bounds, numbers, times))
        self._stripes += len(first)
        self.time_ns = max(self.time_ns, times[-1])

    def seal_scans(self) -> None:
        """Say that no more scans come: their truth is packed while other messages are written."""
        if self._truth and self._sealed is None:
            worker = ThreadPoolExecutor(max_workers=1)
            self._sealed = worker.submit(self._pack_truth)
            worker.shutdown(wait=False)

    def add_truth(self, truth: Truth) -> None:
        """Append the truth of all stripes that were added, for a writer with ``truth_follows``.

        The messages lie behind the stripes in the file, and carry the times and numbers of theirs:
        readers order by time.

        Args:
            truth: The truth of all points, in their order.

        Raises:
            DataError: The disk is full.
            ValueError: The truth has another number of points, or was not announced.
        """
        count = sum(len(told.rows) for told in self._told)
        if not self._truth_follows or count != len(truth):
            raise ValueError(f"truth of {len(truth)} points for {count} that wait for it")
        self._writer.flush()  # every chunk stays in the order of time
        at = 0
        for told in self._told:
            some = slice(at, at + len(told.rows))
            at = some.stop
            piece = part_of(truth, some)
            stored = positions(told.rows)
            rows = truth_rows(piece, told.rows, stored)
            layout = self._layout("/truth/lines", rows.dtype, _TRUTH_NOTES)
            for a, b, number, time in zip(
                told.bounds[:-1].tolist(), told.bounds[1:].tolist(), told.numbers, told.times,
                strict=True,
            ):  # fmt: skip
                data = layout.pack(rows[a:b], self.start_ns + time)
                self.write("/truth/lines", data, time, number)
            self._points.append(stored)
        self._truth = [truth]
        self._told = []

    def register(self, topic: str, message_class: Any, notes: Mapping[str, str]) -> None:
        """Open a channel, with its schema, unless the topic is there."""
        if topic in self._channels:
            return
        schema = message_class.DESCRIPTOR.full_name
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(
                schema, "protobuf", build_file_descriptor_set(message_class).SerializeToString()
            )
        self._channels[topic] = self._writer.register_channel(
            topic, "protobuf", self._schemas[schema], {"schema_version": "1", **notes}
        )

    def write(self, topic: str, data: bytes, time_ns: int, sequence: int = 0) -> None:
        """Append a serialised message to a registered topic.

        Args:
            topic: A topic that was given to `register`.
            data: The message.
            time_ns: Its time since the start of the recording [ns].
            sequence: Stripe number, or number of the message.
        """
        stamp = self.start_ns + time_ns
        self._writer.add_message(self._channels[topic], stamp, data, stamp, sequence)

    def cloud(
        self,
        topic: str,
        rows: np.ndarray,
        time_ns: int,
        notes: Mapping[str, str] | None = None,
    ) -> None:
        """Append structured rows as one PointCloud in the world frame."""
        layout = self._layout(topic, rows.dtype, notes or {})
        self.write(topic, layout.pack(rows, self.start_ns + time_ns), time_ns)

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Append an attachment."""
        self._writer.add_attachment(self.start_ns, self.start_ns, name, media_type, data)

    def metadata(self, name: str, values: Mapping[str, Any]) -> None:
        """Append a metadata record; values are turned into text."""
        self._writer.add_metadata(name, {key: str(value) for key, value in values.items()})

    def finish(self) -> None:
        """Write the attachments and the summary, and give the file its name.

        Raises:
            DataError: The disk is full or gone; nothing is left behind.
        """
        try:
            extras: dict[str, Any] = dict(self._extras)
            if self._origins:
                size = max(self._origins) + 1
                extras["stripe_origin"] = np.full((size, 3), np.nan)
                for number, origin in self._origins.items():
                    extras["stripe_origin"][number] = origin
            if self._exact_times:
                times = np.concatenate(self._times)
                extras["time_step_ns"] = np.diff(times, prepend=np.int64(0))  # near constant
            if extras:
                self.attach("scan.npz", "application/zip", archives.pack(extras))
            if self._truth:
                content = self._sealed.result() if self._sealed else self._pack_truth()
                self.attach("ground_truth.npz", "application/zip", content)
            self._writer.finish()
        except BaseException:
            self.abort()
            raise
        self._done = True
        self._output.commit()

    def abort(self) -> None:
        """Give up: remove the part file; a file of that name stays as it was."""
        self._done = True
        self._output.abort()

    def has_stripes(self) -> bool:
        """Say whether any points were added."""
        return self._stripes > 0

    def _pack_truth(self) -> bytes:
        """Return the attachment with the truth of all pieces."""
        return archives.pack_truth(joined(self._truth), np.concatenate(self._points))

    def _layout(self, topic: str, dtype: np.dtype, notes: Mapping[str, str]) -> CloudLayout:
        """Return the layout of a cloud topic, and open the topic when it is new."""
        layout = self._layouts.get(topic)
        if layout is None:
            self.register(topic, messages.PointCloud, {"units": "m", "frame": "world", **notes})
            layout = self._layouts[topic] = CloudLayout(dtype)
        if layout.dtype != dtype:
            raise ValueError(f"{topic} has the fields {layout.dtype.names}, not {dtype.names}")
        return layout

    def _scan_notes(self, scans: Scans) -> dict[str, str]:
        """Return the channel metadata that tell a reader which arrays were given."""
        return {
            "organised": "false" if scans.stripe is None else "true",
            "time": "nominal" if scans.time_ns is None else "recorded",
        }

    def _position_type(self, points: np.ndarray) -> str:
        """Return the type of x, y, z, which the first piece decides.

        Raises:
            DataError: Single precision was decided, and does not do for these points.
        """
        if self._precise is None:
            self._precise = needs_double(points)
        elif not self._precise and needs_double(points):
            what = "positions so large need double precision from the first stripe on"
            raise DataError(what, path=self.path, hint="open the writer with precise=True")
        return "<f8" if self._precise else "<f4"

    def _stripe_times(self, scans: Scans, bounds: np.ndarray) -> list[int]:
        """Return the time of every message, and note whether stripes have inner times."""
        if scans.time_ns is None:
            return [(self._stripes + k) * _NOMINAL_STEP_NS for k in range(len(bounds) - 1)]
        self._times.append(scans.time_ns)
        times = scans.time_ns[bounds[:-1]]
        same = np.array_equal(np.repeat(times, np.diff(bounds)), scans.time_ns)
        self._exact_times = self._exact_times or not same
        return times.tolist()

    def _tell_poses(self, number: int, view: int, time: int) -> None:
        """Write the pose of a view once, and that of the probe with every stripe."""
        poses = self._extras.get("T_world_view")
        matrix = np.eye(4) if poses is None else poses[view]
        entries = []
        if view not in self._views_told:
            self._views_told.add(view)
            entries.append(("world", f"view_{view}", matrix))
        place = self._origins.get(number)
        if place is None and "stripe_origin" in self._extras:
            place = self._extras["stripe_origin"][number]
        elif place is None and "origin" in self._extras:
            place = self._extras["origin"][view]
        if place is not None and np.isfinite(place).all():
            probe = matrix.copy()
            probe[:3, 3] = place
            entries.append(("world", "scanner", probe))
        if entries:
            self.register("/tf", messages.FrameTransforms, {"units": "m"})
            message = messages.transform_message(entries, self.start_ns + time)
            self.write("/tf", message.SerializeToString(), time, number)
