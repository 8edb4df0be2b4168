"""Verb `play`: replays a recording stripe by stripe into Rerun."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from octoseg_ti.cli import UsageError
from octoseg_ti.cli.convert import result_in
from octoseg_ti.cli.options import Machine, check_inputs, check_outputs
from octoseg_ti.cli.output import note, out, out_json, progress, size_of
from octoseg_ti.errors import DataError


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayOptions:
    """Replay a recording stripe by stripe in the Rerun viewer, or into a file for it.

    octoseg play scan.mcap --rate 1
    octoseg play scan.mcap --save scan.rrd

    Without --save, --connect or --headless a viewer is started.
    """

    input: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Recording, or a point cloud with stripes."""
    rate: float = 0.0
    """Speed: 1 = as recorded, 2 = twice as fast, 0 = as fast as possible."""
    loop: int = 1
    """How often to play; 0 = until interrupted."""
    lines: str | None = None
    """Play only the stripes A:B, B not included; either may be left out."""
    every: int = 1
    """Play every N-th stripe."""
    segment: bool = False
    """Segment the played stripes and show the result; a recorded result is shown anyway."""
    save: Annotated[Path | None, tyro.conf.arg(metavar="FILE.rrd")] = None
    """Write a file for the viewer instead of opening it."""
    connect: Annotated[str | None, tyro.conf.arg(metavar="URL")] = None
    """Send to a viewer that runs at this URL, e.g. rerun+http://127.0.0.1:9876/proxy"""
    spawn: bool = False
    """Start a viewer, also beside --save."""
    headless: bool = False
    """Send nowhere: checks that the recording plays."""
    topic: str | None = None
    """Topic of the points, when a recording has several."""
    json: bool = False
    """Print the figures as JSON."""
    quiet: bool = False
    """Print nothing but errors."""
    machine: tyro.conf.OmitArgPrefixes[Machine] = field(default_factory=Machine)


OPTIONS = {"play": PlayOptions}


def run_play(options: PlayOptions) -> int:
    """Read, choose stripes, segment on request, play."""
    lines = parse_lines(options.lines)
    if options.every < 1:
        raise UsageError(f"--every must be at least 1, not {options.every}")
    if not (math.isfinite(options.rate) and options.rate >= 0):
        raise UsageError(f"--rate must be 0 or more, not {options.rate:g}")
    if options.loop < 0:
        raise UsageError(f"--loop must be 0 or more, not {options.loop}")
    if options.headless and (options.save or options.spawn or options.connect):
        raise UsageError("--headless sends nowhere: it excludes --save, --spawn and --connect")
    check_inputs([options.input])
    if options.save is not None:
        check_outputs([options.save], (".rrd",))
    options.machine.start()
    from octoseg_ti import files
    from octoseg_ti.view import rerun_log

    scans = files.read(options.input, topic=options.topic)
    if scans.stripe is None:
        raise DataError(
            "has no stripes to play",
            path=options.input,
            hint="octoseg convert FILE OUT.rrd shows it as a whole",
        )
    result = _result(options, scans)
    with progress("play", quiet=options.quiet) as report:
        figures = rerun_log.play(
            scans,
            rate=options.rate,
            loop=options.loop,
            lines=lines,
            every=options.every,
            save=options.save,
            connect=options.connect,
            spawn=_spawns(options),
            segmentation=result,
            progress=report,
        )
    if options.json:
        out_json(figures)
    elif not options.quiet:
        out(", ".join(f"{key} {value}" for key, value in figures.items()))
        if options.save is not None:
            out(f"wrote {options.save} ({size_of(options.save)}): rerun {options.save}")
    return 0


def _spawns(options: PlayOptions) -> bool:
    """Say whether a viewer is to be started."""
    elsewhere = options.save or options.connect or options.headless
    return options.spawn or not elsewhere


def _result(options: PlayOptions, scans: Any) -> Any:
    """Return the result to show: computed now, recorded, or none."""
    if not options.segment:
        return result_in(options.input)
    from octoseg_ti.pipeline import segment

    if not options.quiet:
        note(f"{options.input}: segmenting it now")
    return segment(scans)


def parse_lines(text: str | None) -> tuple[int, int | None] | None:
    """Return the half-open range of stripes that "A:B" names.

    Raises:
        UsageError: Not of this form, or empty.
    """
    if text is None:
        return None
    first, colon, last = text.partition(":")
    try:
        start = int(first) if first else 0
        stop = int(last) if last else None
    except ValueError:
        colon = ""
    if not colon or start < 0 or (stop is not None and stop <= start):
        raise UsageError(f"--lines must be A:B with 0 <= A < B, not {text!r}")
    return start, stop
