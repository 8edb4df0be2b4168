"""Verb `play`: replays a recording stripe by stripe into Rerun."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from octoseg_ti.cli import UsageError
from octoseg_ti.cli.convert import result_in
from octoseg_ti.cli.options import Machine, check_inputs, check_outputs, need_display
from octoseg_ti.cli.output import out, out_json, progress, size_of
from octoseg_ti.errors import DataError

if TYPE_CHECKING:
    from octoseg_ti.types import Scans, Segmentation


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayOptions:
    """Replay a recording stripe by stripe in the Rerun viewer, or into a file for it.

    octoseg play scan.mcap --rate 1
    octoseg play scan.mcap --save scan.rrd

    A result in the recording is shown at the end, unless only some stripes are played.
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
    """Segment the played stripes, and show the result."""
    segment_every: int = 0
    """With --segment: not only at the end, but also after every N stripes."""
    save: Annotated[Path | None, tyro.conf.arg(metavar="FILE.rrd")] = None
    """Write a file for the viewer instead of opening it."""
    connect: Annotated[str | None, tyro.conf.arg(metavar="URL")] = None
    """Send to a viewer that runs at this URL, e.g. rerun+http://127.0.0.1:9876/proxy"""
    spawn: bool = False
    """Start a viewer; this is what happens without --save, --connect or --headless."""
    headless: bool = False
    """Show nothing and keep nothing: only checks that the recording plays."""
    topic: str | None = None
    """Topic of the points, when a recording has several."""
    json: bool = False
    """Print the figures as JSON."""
    quiet: bool = False
    """Print nothing but errors."""
    machine: tyro.conf.OmitArgPrefixes[Machine] = field(default_factory=Machine)


OPTIONS = {"play": PlayOptions}


def run_play(options: PlayOptions) -> int:
    """Read, choose stripes, play, segment on request."""
    _check(options)
    check_inputs([options.input])
    if options.save is not None:
        check_outputs([options.save], (".rrd",))
    elsewhere = options.save or options.connect or options.headless
    if not elsewhere:
        need_display("--save FILE.rrd writes a file for it")
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
    with (
        tempfile.TemporaryDirectory() as scratch,
        progress("play", quiet=options.quiet) as report,
    ):
        played = rerun_log.play(
            scans,
            rate=options.rate,
            loop=options.loop,
            lines=parse_lines(options.lines),
            every=options.every,
            save=Path(scratch) / "play.rrd" if options.headless else options.save,
            url=options.connect,
            spawn=not elsewhere,
            segment=_segmenter(options),
            segment_every=options.segment_every,
            progress=lambda share: report("stripes", share),
        )
    if options.json:
        out_json(asdict(played))
    elif not options.quiet:
        late = f", at most {played.lag:.3f} s late" if options.rate else ""
        out(f"{played.stripes} stripes, {played.points} points in {played.seconds:.2f} s{late}")
        if options.save is not None:
            out(f"wrote {options.save} ({size_of(options.save)}): rerun {options.save}")
    return 0


def _check(options: PlayOptions) -> None:
    """Refuse options that make no sense, alone or together."""
    parse_lines(options.lines)
    if options.every < 1:
        raise UsageError(f"--every must be at least 1, not {options.every}")
    if not (math.isfinite(options.rate) and options.rate >= 0):
        raise UsageError(f"--rate must be 0 or more, not {options.rate:g}")
    if options.loop < 0 or options.segment_every < 0:
        raise UsageError("--loop and --segment-every must be 0 or more")
    targets = [options.save, options.connect, options.spawn, options.headless]
    if sum(map(bool, targets)) > 1:
        raise UsageError("one of --save, --connect, --spawn and --headless at a time")
    if options.loop != 1 and (options.save or options.headless):
        raise UsageError("--loop is for viewers: a file holds one loop")


def _segmenter(options: PlayOptions) -> Callable[[Scans], Segmentation] | None:
    """Return what segments the played stripes: the method, the recorded result, or nothing."""
    if options.segment:
        from octoseg_ti.pipeline import segment

        return segment
    whole = options.lines is None and options.every == 1
    recorded = result_in(options.input) if whole else None
    return None if recorded is None else lambda played: recorded


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
