"""Scans, truth and result as one MCAP recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from octoseg_ti.files.recording_result import add_params, add_result
from octoseg_ti.files.recording_write import RecordingWriter
from octoseg_ti.types import Scans, Segmentation, Truth


def write_recording(
    path: str | Path,
    *,
    scans: Scans | None = None,
    truth: Truth | None = None,
    segmentation: Segmentation | None = None,
    report: str | None = None,
    scores: Mapping[str, Any] | None = None,
    run: Mapping[str, str] | None = None,
    overwrite: bool = True,
) -> None:
    """Write a recording in one go; any of scans, truth and result may be missing.

    Args:
        path: The file to write.
        scans: The scan lines.
        truth: Their truth, in the order of the points.
        segmentation: The result, in the order of the points.
        report: Markdown for the attachment ``report.md``.
        scores: Figures against the truth, for the metadata record ``octoseg.scores``.
        run: How the data came about, for the metadata record ``octoseg.run``.
        overwrite: False refuses a file that exists.

    Raises:
        DataError: The output cannot be written; nothing is left behind.
    """
    name = (
        scans.name if scans is not None else segmentation.name if segmentation is not None else ""
    )
    with RecordingWriter(path, name=name, run=run, overwrite=overwrite) as writer:
        if segmentation is not None:
            add_params(writer, segmentation)
        if scans is not None:
            writer.add(scans, truth)
            writer.seal_scans()
        if segmentation is not None:
            column = None if scans is None else scans.column
            add_result(writer, segmentation, column=column, report=report, scores=scores)
