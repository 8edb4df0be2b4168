"""Looking into files: what is in them, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.files import READABLE, read, read_segmentation, read_truth, suffix_of
from octoseg_ti.files.validation import existing_file

if TYPE_CHECKING:
    from octoseg_ti.files.recording_read import Contents
    from octoseg_ti.types import Scans, Truth


def describe(path: str | Path) -> dict[str, Any]:
    """Return what a file holds, as plain values for a table or JSON.

    Args:
        path: Any file that `read` takes.

    Returns:
        ``path``, ``format``, ``bytes``; for a recording also ``library``, ``topics`` (topic,
        schema, encoding, messages), ``duration_s``, ``frames``, ``metadata``, ``attachments``; for
        an NPZ file ``arrays`` (shape and dtype); and what its scans are: ``points``, ``stripes``,
        ``views``, ``finite``, ``box_mm``, ``normals``, ``truth_patches``, ``patches``.

    Raises:
        DataError: Missing, damaged or unknown.
    """
    path = existing_file(path)
    suffix = suffix_of(path)
    if suffix not in READABLE:
        what = f"cannot read {suffix or 'a file without suffix'}"
        raise DataError(what, path=path, hint=f"known: {' '.join(READABLE)}")
    facts: dict[str, Any] = {
        "path": str(path),
        "format": suffix.lstrip("."),
        "bytes": path.stat().st_size,
    }
    if suffix == ".mcap":
        from octoseg_ti.files.recording_read import RESULT_TOPIC, SCAN_TOPIC, collect

        contents = collect(path, None)
        facts |= _recording_facts(contents)
        has_result = "result.npz" in contents.attachments
        clouds = {topic["topic"] for topic in facts["topics"] if topic["schema"] == _CLOUD}
        if not clouds & {SCAN_TOPIC, RESULT_TOPIC} and len(clouds) != 1:
            return facts  # nothing, or too much, to read as scans
    elif suffix == ".npz":
        from octoseg_ti.files.npz import load

        arrays = load(path)
        facts["arrays"] = {
            name: {"shape": list(array.shape), "dtype": array.dtype.name}
            for name, array in arrays.items()
        }
        has_result = str(arrays.get("octoseg", "")) == "segmentation"
    else:
        has_result = False
    facts |= _scan_facts(read(path), read_truth(path))
    return facts | (_result_facts(path) if has_result else {})


def check(path: str | Path) -> list[str]:
    """Read a file from end to end and return what is wrong with it.

    Recordings: every checksum, decodable messages, times that never go back, stripe numbers in
    order, a transform before the first cloud. All: arrays of the right shape, positions that are
    numbers, unit normals, labels in range.

    Args:
        path: Any file that `read` takes.

    Returns:
        One line per problem; empty = none was found.
    """
    problems: list[str] = []
    try:
        suffix = suffix_of(existing_file(path))
        scans = None
        if suffix == ".mcap":
            problems += _recording_problems(Path(path))
        facts = describe(path)
        if "points" in facts:
            scans = read(path)
            problems += _scan_problems(scans, read_truth(path))
        if "patches" in facts:
            result = read_segmentation(path)
            if scans is not None and len(result) != len(scans):
                problems.append(f"the result has {len(result)} points, the scans {len(scans)}")
            length = np.linalg.norm(result.normals.astype(np.float64), axis=1)
            bad = int(np.count_nonzero((length > 0) & ~(np.abs(length - 1.0) < 1e-3)))
            if bad:
                problems.append(f"{bad} normals of the result have no unit length")
            bad = int(np.count_nonzero(~_possible(result.covariance)))
            if bad:
                problems.append(f"{bad} covariances of the result are none of any parameters")
    except DataError as error:
        problems.append(error.what + (f"; {error.hint}" if error.hint else ""))
    return problems


_CLOUD = "foxglove.PointCloud"
_KNOWN_PREFIXES = ("foxglove.", "octoseg.")


def _recording_facts(contents: Contents) -> dict[str, Any]:
    """Return the facts of a recording beyond its scans."""
    from octoseg_ti.files import messages

    times = [message.log_time for message in contents.messages]
    frames: set[str] = set()
    for message in contents.messages:
        channel = contents.channels[message.channel_id]
        if contents.schema_of(channel) == "foxglove.FrameTransforms":
            for entry in messages.FrameTransforms.FromString(message.data).transforms:
                frames |= {entry.parent_frame_id, entry.child_frame_id}
    topics = [
        {
            "topic": channel.topic,
            "schema": contents.schema_of(channel),
            "encoding": channel.message_encoding,
            "messages": contents.counts.get(channel.id, 0),
        }
        for channel in sorted(contents.channels.values(), key=lambda channel: channel.topic)
    ]
    return {
        "library": contents.library,
        "topics": topics,
        "duration_s": (max(times) - min(times)) / 1e9 if times else 0.0,
        "frames": sorted(frames),
        "metadata": contents.metadata,
        "attachments": {name: len(a.data) for name, a in contents.attachments.items()},
    }


def _scan_facts(scans: Scans, truth: Truth | None) -> dict[str, Any]:
    """Return the facts of scans and their truth."""
    finite = np.isfinite(scans.points).all(axis=1)
    box = None
    if finite.any():
        inside = scans.points[finite]
        box = [inside.min(axis=0).tolist(), inside.max(axis=0).tolist()]
    return {
        "points": len(scans),
        "stripes": None if scans.stripe is None else len(np.unique(scans.stripe)),
        "views": 1 if scans.view is None else len(np.unique(scans.view)),
        "finite": int(np.count_nonzero(finite)),
        "box_mm": box,
        "normals": scans.normals is not None,
        "truth_patches": None if truth is None else truth.patch_count,
    }


def _result_facts(path: Path) -> dict[str, Any]:
    """Return the facts of a result."""
    result = read_segmentation(path)
    return {
        "points": len(result),
        "patches": result.patch_count,
        "labelled": int(np.count_nonzero(result.labels >= 0)),
        "covariances": int(np.isfinite(result.covariance).any(axis=(1, 2)).sum()),
        "cells": len(result.cells),
        "levels": result.level_count,
        "seconds": dict(result.seconds),
    }


def _possible(covariance: np.ndarray) -> np.ndarray:
    """Say which matrices may be covariances, shape (K,): symmetric, no correlation beyond 1."""
    finite = ~np.isinf(covariance).any(axis=(1, 2))
    matrix = np.where(np.isfinite(covariance), covariance, 0.0)
    deviation = np.sqrt(np.maximum(np.einsum("kii->ki", matrix), 0.0))
    most = (1.0 + 1e-6) * deviation[:, :, None] * deviation[:, None, :]
    mirrored = np.swapaxes(matrix, 1, 2) == matrix
    return np.asarray(finite & ((np.abs(matrix) <= most) & mirrored).all(axis=(1, 2)))


def _recording_problems(path: Path) -> list[str]:
    """Return what is wrong with the messages of a recording."""
    from google.protobuf.message import DecodeError
    from mcap.exceptions import McapError
    from mcap_protobuf.decoder import DecoderFactory

    from octoseg_ti.files.recording_read import collect

    problems: list[str] = []
    contents = collect(path, None)
    factory = DecoderFactory()
    decoders: dict[int, Any] = {}
    latest = {False: -1, True: -1}
    back = 0
    sequence: dict[int, int] = {}
    unordered: dict[str, int] = {}
    undecodable: dict[str, int] = {}
    seen_transform = False
    for message in contents.messages:
        channel = contents.channels[message.channel_id]
        schema = contents.schema_of(channel)
        if message.channel_id not in decoders:
            decoders[message.channel_id] = None
            if channel.message_encoding != "protobuf" or not schema.startswith(_KNOWN_PREFIXES):
                problems.append(
                    f"topic {channel.topic} has the unknown schema {schema or '(none)'} "
                    f"in {channel.message_encoding or 'no'} encoding"
                )
            else:
                try:
                    decoders[message.channel_id] = factory.decoder_for(
                        channel.message_encoding, contents.schemas.get(channel.schema_id)
                    )
                except (McapError, DecodeError, TypeError, ValueError, KeyError) as error:
                    problems.append(f"the schema of topic {channel.topic} is damaged: {error}")
        decoder = decoders[message.channel_id]
        if decoder is not None:
            try:
                decoder(message.data)
            except DecodeError:
                undecodable[channel.topic] = undecodable.get(channel.topic, 0) + 1
        # Truth may follow its scan, and then starts again at time 0.
        of_truth = channel.topic == "/truth/lines"
        back += message.log_time < latest[of_truth]
        latest[of_truth] = max(latest[of_truth], message.log_time)
        if channel.topic in ("/scan/lines", "/truth/lines"):
            if not seen_transform:
                problems.append(f"no transform comes before the first cloud of {channel.topic}")
                seen_transform = True
            if message.sequence <= sequence.get(message.channel_id, -1):
                unordered[channel.topic] = unordered.get(channel.topic, 0) + 1
            sequence[message.channel_id] = message.sequence
        seen_transform = seen_transform or schema.startswith("foxglove.FrameTransform")
    if back:
        problems.append(f"{back} messages are older than the one before")
    problems += [f"{n} messages of {topic} cannot be decoded" for topic, n in undecodable.items()]
    problems += [f"{n} stripes of {topic} are out of order" for topic, n in unordered.items()]
    return problems


def _scan_problems(scans: Scans, truth: Truth | None) -> list[str]:
    """Return what is wrong with scans and their truth."""
    problems = []
    bad = int(np.count_nonzero(~np.isfinite(scans.points).all(axis=1)))
    if bad:
        problems.append(f"{bad} of {len(scans)} positions are not finite")
    if scans.normals is not None:
        length = np.linalg.norm(scans.normals, axis=1)
        bad = int(np.count_nonzero(~(np.abs(length - 1.0) < 1e-3)))
        if bad:
            problems.append(f"{bad} normals have no unit length")
    if scans.time_ns is not None and np.any(np.diff(scans.time_ns) < 0):
        problems.append("the times of the points go back")
    if truth is not None:
        if len(truth) != len(scans):
            problems.append(f"the truth has {len(truth)} points, the scans {len(scans)}")
        sizes = np.bincount(truth.patch[truth.patch >= 0], minlength=truth.patch_count)
        empty = int(np.count_nonzero(sizes == 0))
        if empty:
            problems.append(f"{empty} of {len(sizes)} truth labels have no point")
    return problems
