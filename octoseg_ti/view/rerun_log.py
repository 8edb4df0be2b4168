"""Rerun recordings of scans and segmentations: to a file, to a viewer, or stripe by stripe.

Lengths are mm, as in the API; the recording says so under its property ``octoseg``. The pinned
version of Rerun is known to this module, `stream`, `entities`, `blueprint` and `player` only.
"""

from __future__ import annotations

from pathlib import Path

from octoseg_ti.errors import DataError
from octoseg_ti.types import Scans, Segmentation, Truth
from octoseg_ti.view import scene
from octoseg_ti.view.blueprint import blueprint
from octoseg_ti.view.entities import (
    log_segmentation,
    log_stripes,
    log_truth,
    log_world,
    shift_of,
)
from octoseg_ti.view.player import Played, play
from octoseg_ti.view.stream import Sink, close_stream, open_stream, replaced

__all__ = [
    "Played",
    "log_segmentation",
    "log_stripes",
    "play",
    "save_rrd",
    "show",
]


def save_rrd(
    path: str | Path,
    *,
    scans: Scans | None = None,
    segmentation: Segmentation | None = None,
    truth: Truth | None = None,
) -> None:
    """Write a Rerun file that opens with a tab for every stage.

    The file appears under its name only when it is complete.

    Args:
        path: The file; by custom it ends in .rrd.
        scans: The scan, played back by stripe.
        segmentation: What was found in it.
        truth: Truth of the points of the segmentation, or else of the scan.

    Raises:
        DataError: There is nothing to write, the lengths differ, or the file cannot be written.
    """
    with replaced(path) as part:
        _record(Sink(file=part), scans=scans, segmentation=segmentation, truth=truth)


def show(
    *,
    scans: Scans | None = None,
    segmentation: Segmentation | None = None,
    truth: Truth | None = None,
    url: str | None = None,
) -> None:
    """Open the Rerun viewer with a tab for every stage.

    Args:
        scans: The scan, played back by stripe.
        segmentation: What was found in it.
        truth: Truth of the points of the segmentation, or else of the scan.
        url: Viewer that already runs; default: start one.

    Raises:
        DataError: There is nothing to show, or the lengths differ.
        RuntimeError: The viewer cannot be started or reached.
    """
    sink = Sink(url=url) if url is not None else Sink(spawn=True)
    _record(sink, scans=scans, segmentation=segmentation, truth=truth)


def _record(
    sink: Sink, *, scans: Scans | None, segmentation: Segmentation | None, truth: Truth | None
) -> None:
    if scans is None and segmentation is None:
        raise DataError("there is neither a scan nor a segmentation to show")
    clouds = [] if scans is None else [scene.world_points(scans)]
    normals = None if scans is None else scans.normals
    if segmentation is not None:
        clouds.append(segmentation.points)
        normals = segmentation.normals
    if truth is not None and len(truth) != len(clouds[-1]):
        raise DataError(f"the truth has {len(truth)} points, not {len(clouds[-1])}")
    shift = shift_of(*clouds)
    subject = segmentation if segmentation is not None else scans
    rec = open_stream(
        sink,
        name=subject.name if subject is not None else "",
        layout=blueprint(
            scene.viewpoint(clouds[-1] - shift, normals),
            truth=truth is not None,
            result=segmentation is not None,
        ),
    )
    try:
        log_world(rec, shift)
        if scans is not None:
            log_stripes(rec, scans, shift=shift)
        if truth is not None:
            log_truth(rec, clouds[-1], truth, shift=shift)
        if segmentation is not None:
            log_segmentation(rec, segmentation, truth=truth, shift=shift)
    finally:
        close_stream(rec)
