"""Replays a scan into Rerun, stripe by stripe, at the pace at which it was taken."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.types import Scans, Segmentation
from octoseg_ti.view import scene
from octoseg_ti.view.blueprint import blueprint
from octoseg_ti.view.entities import (
    log_scanner,
    log_scanner_axes,
    log_segmentation,
    log_world,
    shift_of,
    stripe_colors,
)
from octoseg_ti.view.stream import Sink, close_stream, open_stream, replaced

_PER_POINT = ("points", "normals", "stripe", "column", "view", "time_ns")


@dataclass(frozen=True, slots=True, kw_only=True)
class Played:
    """What `play` did."""

    stripes: int
    """Stripes sent, all loops together."""
    points: int
    """Points sent, all loops together."""
    seconds: float
    """Wall time [s]."""
    lag: float
    """Longest time by which a stripe was late [s]; 0 when played as fast as possible."""
    segmentations: int
    """Segmentations made on the way."""


def play(
    scans: Scans,
    *,
    rate: float = 0.0,
    loop: int = 1,
    lines: tuple[int | None, int | None] | None = None,
    every: int = 1,
    save: str | Path | None = None,
    url: str | None = None,
    spawn: bool = False,
    segment: Callable[[Scans], Segmentation] | None = None,
    segment_every: int = 0,
    progress: Callable[[float], None] | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Played:
    """Send the stripes of a scan one after the other to Rerun.

    Every stripe has its deadline from the start, so that waits do not add up to a drift; no stripe
    is dropped when the receiver is slow. What is sent does not depend on the rate.

    Args:
        scans: The scan, with stripes.
        rate: Pace as a multiple of the recorded one; 0 = as fast as possible.
        loop: How often to play; 0 = until interrupted. Every loop is a recording of its own.
        lines: First stripe and the one after the last, counted from 0; None = no limit.
        every: Send only every n-th of these stripes.
        save: File to write.
        url: Viewer that already runs.
        spawn: Start a viewer.
        segment: Segments a scan; called with the stripes sent so far, and its answer is sent too.
        segment_every: Segment after every so many stripes; 0 = only at the end.
        progress: Told the share of the stripes sent, 0..1.
        clock: Monotonic clock [s].
        sleep: Waits for some seconds.

    Raises:
        DataError: There are no stripes to play, no times to pace them by, or an option is out of
            range.
    """
    if not (np.isfinite(rate) and rate >= 0):
        raise DataError(f"the rate must be 0 or more, not {rate}")
    if loop < 0 or every < 1 or segment_every < 0:
        raise DataError("loop and segment-every must be 0 or more, and every at least 1")
    if save is not None and loop != 1:
        raise DataError("a file holds one loop", hint="leave --loop away when saving")
    scans = _choose(scans, lines, every)
    if rate > 0 and scans.time_ns is None:
        raise DataError("the scan has no times to pace it by", hint="play it at rate 0")
    with nullcontext() if save is None else replaced(save) as part:
        sink = Sink(file=part, url=url, spawn=spawn)
        player = _Player(scans, sink, segment, segment_every, progress, clock, sleep)
        for _ in range(loop) if loop else itertools.count():
            player.run(rate)
    return player.played()


def _choose(scans: Scans, lines: tuple[int | None, int | None] | None, every: int) -> Scans:
    """Return the scan with the chosen stripes only."""
    if scans.stripe is None:
        raise DataError("the points have no stripes to play")
    bounds = scene.stripe_bounds(scans.stripe)
    chosen = np.arange(len(bounds) - 1)[slice(*(lines or (None, None)), every)]
    if not len(chosen):
        raise DataError(f"no stripe is chosen of the {len(bounds) - 1} there are")
    on = np.zeros(len(bounds) - 1, bool)
    on[chosen] = True
    return _take(scans, np.repeat(on, np.diff(bounds)))


def _take(scans: Scans, on: Any) -> Scans:
    """Return the scan with some of its points; ``on`` is a mask or a slice."""
    columns = {name: getattr(scans, name) for name in _PER_POINT}
    taken: dict[str, Any] = {
        name: None if c is None else np.asarray(c)[on] for name, c in columns.items()
    }
    return dataclasses.replace(scans, **taken)


class _Player:
    """The state of one call of `play`."""

    def __init__(
        self,
        scans: Scans,
        sink: Sink,
        segment: Callable[[Scans], Segmentation] | None,
        segment_every: int,
        progress: Callable[[float], None] | None,
        clock: Callable[[], float],
        sleep: Callable[[float], None],
    ) -> None:
        self.scans, self.sink = scans, sink
        self.segment, self.segment_every = segment, segment_every
        self.progress, self.clock, self.sleep = progress, clock, sleep
        self.points = scene.world_points(scans)
        self.shift = shift_of(self.points)
        self.bounds = scene.stripe_bounds(np.asarray(scans.stripe))
        self.began = clock()
        self.stripes, self.sent, self.lag, self.segmentations = 0, 0, 0.0, 0

    def played(self) -> Played:
        return Played(
            stripes=self.stripes,
            points=self.sent,
            seconds=self.clock() - self.began,
            lag=self.lag,
            segmentations=self.segmentations,
        )

    def run(self, rate: float) -> None:
        """Play all stripes once."""
        import rerun as rr

        view = scene.viewpoint(self.points - self.shift, self.scans.normals)
        layout = blueprint(view, result=self.segment is not None, playing=True)
        rec = open_stream(self.sink, name=self.scans.name, layout=layout)
        try:
            log_world(rec, self.shift)
            radius = rr.Radius.ui_points(1.5)
            rec.log("/world/scan/lines", rr.Points3D.from_fields(radii=radius), static=True)
            starts = self.bounds[:-1]
            if self.scans.stripe_origin is not None:
                log_scanner_axes(rec)
            due = _due(self.scans.time_ns, starts, rate).tolist()
            colors = stripe_colors(self.scans, starts)
            start = self.clock()
            for k in range(len(starts)):
                wait = start + due[k] - self.clock()
                if wait > 0:
                    self.sleep(wait)
                elif rate > 0:
                    self.lag = max(self.lag, -wait)
                self._send(rec, k, colors[k])
                if self.progress is not None:
                    self.progress((k + 1) / len(starts))
        finally:
            close_stream(rec)

    def _send(self, rec: Any, k: int, color: np.ndarray) -> None:
        import rerun as rr

        start, stop = int(self.bounds[k]), int(self.bounds[k + 1])
        scans = self.scans
        assert scans.stripe is not None
        rec.set_time("scan_line", sequence=int(scans.stripe[start]))
        if scans.time_ns is not None:
            rec.set_time("scan_time", duration=np.timedelta64(int(scans.time_ns[start]), "ns"))
        positions = (self.points[start:stop] - self.shift).astype(np.float32)
        rec.log("/world/scan/lines", rr.Points3D(positions, colors=[color]))
        log_scanner(rec, scans, np.array([start]), self.shift)
        self.stripes += 1
        self.sent += stop - start
        last = k + 2 == len(self.bounds)
        due = self.segment_every > 0 and (k + 1) % self.segment_every == 0
        if self.segment is not None and (last or due):
            found = self.segment(_take(scans, slice(0, stop)))
            log_segmentation(rec, found, shift=self.shift, static=False)
            self.segmentations += 1


def _due(time_ns: np.ndarray | None, starts: np.ndarray, rate: float) -> np.ndarray:
    """Return when every stripe is due after the first [s]; a clock set back stands still."""
    if rate == 0 or time_ns is None:
        return np.zeros(len(starts))
    gaps = np.maximum(np.diff(np.asarray(time_ns)[starts]), 0)
    return np.concatenate([[0.0], np.cumsum(gaps) * 1e-9 / rate])
