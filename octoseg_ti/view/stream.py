"""Opening and closing a Rerun recording, and where it goes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octoseg_ti.errors import DataError

APPLICATION = "octoseg"


@dataclass(frozen=True, slots=True, kw_only=True)
class Sink:
    """Where a recording goes: exactly one of these."""

    file: Path | None = None
    """To a file."""
    url: str | None = None
    """To a viewer that runs, "rerun+http://127.0.0.1:9876/proxy" for instance."""
    spawn: bool = False
    """To a viewer started for it."""


def open_stream(sink: Sink, *, name: str, layout: Any) -> Any:
    """Return a new recording stream that is connected to a sink.

    Args:
        sink: Where it goes.
        name: Name of the recording in the viewer.
        layout: Blueprint.

    Raises:
        ValueError: Not exactly one target is given.
        RuntimeError: The target cannot be reached.
    """
    import rerun as rr

    from octoseg_ti import __version__

    if (sink.file is not None) + (sink.url is not None) + sink.spawn != 1:
        raise ValueError("a recording goes to a file, or to a running viewer, or to a new viewer")
    rec = rr.RecordingStream(APPLICATION)
    if sink.file is not None:
        rec.save(sink.file, default_blueprint=layout)
    elif sink.url is not None:
        rec.connect_grpc(sink.url, default_blueprint=layout)
    else:
        rec.spawn(default_blueprint=layout)
    if name:
        rec.send_recording_name(name)
    rec.send_property("octoseg", rr.AnyValues(version=__version__, length_unit="mm"))
    return rec


def close_stream(rec: Any) -> None:
    """Send what is still waiting, and close the recording."""
    try:
        rec.flush()
    finally:
        rec.disconnect()


@contextmanager
def replaced(path: str | Path) -> Iterator[Path]:
    """Give the name of a file to write, which replaces ``path`` once it is complete.

    After an error or an interruption ``path`` is as it was, and the new file is gone.

    Raises:
        DataError: The file cannot be written.
    """
    path = Path(path)
    part = path.with_name(path.name + ".part")
    if not path.parent.is_dir():
        raise DataError(f"the folder {path.parent} does not exist", path=path)
    if path.is_dir():
        raise DataError("is a folder", path=path)
    try:
        part.touch()
        yield part
        os.replace(part, path)
    except OSError as error:
        raise DataError(f"cannot be written: {error.strerror or error}", path=path) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
