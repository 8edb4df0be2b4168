"""Verb `simulate`: a recording of a simulated scanner, with the truth about every point."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from octoseg_ti.cli import UsageError, suggest
from octoseg_ti.cli.options import Machine, check_inputs, check_outputs
from octoseg_ti.cli.output import Report, out, out_json, progress, size_of
from octoseg_ti.errors import DataError
from scanner_sim.presets import SCANNERS
from scanner_sim.scanner import StripeScanner, View
from scanner_sim.solid_options import SUFFIXES as SOLIDS
from scanner_sim.solid_options import SolidOptions

if TYPE_CHECKING:
    from octoseg_ti.types import Scans, Truth
    from scanner_sim import ScanStream

ScannerName = Literal["default", "ideal", "surveyor-like", "modern", "harsh"]
SUFFIXES = (".mcap", ".npz", ".ply", ".rrd")


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulateOptions:
    """Simulate a stripe scanner that knows the truth.

    octoseg simulate test-block -o scan.mcap

    octoseg simulate bracket.step -o scan.mcap

    The recording holds the stripes, the poses of the scanner and, for every point, its patch,
    surface, true position and normal, and the nearest true edge. The same seed gives the same file.
    --scanner names a whole scanner; every option below changes it: --scanner surveyor-like
    --speckle 0.
    """

    part: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PART")]
    """Part on the table: two-planes, test-block, phone, a random block (random:SEED or
    random:SEED:FAMILY with the families sharp, filleted, smooth and mixed, the default), or a file:
    .step .stp .stl .obj .ply"""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """File to write, by suffix: .mcap .npz .ply .rrd"""
    preset: Annotated[ScannerName, tyro.conf.arg(aliases=["--scanner"])] = "default"
    """Whole scanner by name, whose values the options of the scanner then change."""
    seed: int = 7
    """Seed of noise and dropouts."""
    views: str | None = None
    """Where to look from: "auto" plans indexed orientations of the probe head that cover the part,
    a number takes at most so many of these, and "tilt,azimuth;tilt,azimuth" in degrees names them
    (a third number shifts the pass along the laser line, in mm). Default: the views of the part."""
    overlap: float = 0.3
    """Share of a planned pass that its neighbours see too, 0..0.9."""
    truth: bool = True
    """Record the truth about every point. Without it, and with the pitches given, memory stays
    bounded for any number of points."""
    json: bool = False
    """Print the figures as JSON."""
    quiet: bool = False
    """Print nothing but errors."""
    scanner: tyro.conf.OmitArgPrefixes[StripeScanner] = field(default_factory=StripeScanner)
    solid: tyro.conf.OmitArgPrefixes[SolidOptions] = field(default_factory=SolidOptions)
    machine: tyro.conf.OmitArgPrefixes[Machine] = field(default_factory=Machine)

    @staticmethod
    def defaults(arguments: list[str]) -> dict[str, Any]:
        """Return the scanner that the arguments name as default."""
        return {"scanner": scanner_in(arguments)}


def scanner_in(arguments: list[str]) -> StripeScanner:
    """Return the scanner that --scanner names; the parser refuses an unknown one later."""
    name = "default"
    for k, argument in enumerate(arguments):
        key, found, value = argument.partition("=")
        if key in ("--scanner", "--preset"):
            name = value if found else next(iter(arguments[k + 1 : k + 2]), name)
    return SCANNERS.get(name, SCANNERS["default"])


OPTIONS = {"simulate": SimulateOptions}


def run_simulate(options: SimulateOptions) -> int:
    """Simulate and write."""
    check_outputs([options.output], SUFFIXES)
    part = find_part(options.part, options.solid)
    options.machine.start()
    scanner = options.scanner
    if options.views is not None:
        views = chosen_views(part, scanner, options.views, options.overlap)
        scanner = replace(scanner, views=views)
    run = {"command": "octoseg simulate", "part": options.part, "seed": str(options.seed)}
    if options.preset != "default":
        run["scanner"] = options.preset
    from scanner_sim import scan_views

    with progress("simulate", quiet=options.quiet) as report:
        stream = scan_views(part, scanner, seed=options.seed, truth=options.truth, progress=report)
        # With all views scanned before the first is given there is nothing to gain from parts, and
        # truth beside its stripe packs better.
        in_parts = stream.at_once and options.output.suffix.lower() == ".mcap"
        figures = (_write_parts if in_parts else _write_whole)(options, stream, run, report)
    if options.json:
        out_json({"part": options.part, "seed": options.seed, **figures, "output": options.output})
    elif not options.quiet:
        if hasattr(part, "summary"):
            out(part.summary())
        out(_line(options.part, figures))
        out(f"wrote {options.output} ({size_of(options.output)})")
    return 0


def _write_parts(
    options: SimulateOptions, stream: ScanStream, run: dict[str, str], report: Report
) -> dict[str, Any]:
    """Write a recording view by view, as the scan goes on; the truth follows at the end."""
    from octoseg_ti.files.recording_write import RecordingWriter

    figures = {"points": 0, "stripes": 0, "views": 0}
    with RecordingWriter(
        options.output, name=run["part"], run=run, truth_follows=options.truth
    ) as writer:
        for scans in stream:
            writer.add(scans)
            if len(scans):
                figures = {name: n + _counts(scans)[name] for name, n in figures.items()}
        if stream.truth is not None:
            report(f"write the truth to {options.output.name}")
            writer.add_truth(stream.truth)
    return figures | _truth_figures(stream.truth)


def _write_whole(
    options: SimulateOptions, stream: ScanStream, run: dict[str, str], report: Report
) -> dict[str, Any]:
    """Write everything in one piece."""
    from octoseg_ti import files
    from scanner_sim.simulate import joined

    scans = joined(list(stream))
    report(f"write {options.output.name}")
    files.write(options.output, scans, truth=stream.truth, run=run)
    return _counts(scans) | _truth_figures(stream.truth)


def _truth_figures(truth: Truth | None) -> dict[str, Any]:
    if truth is None:
        return {"patches": None, "artefacts": None, "truth": None}
    return {
        "patches": truth.patch_count,
        "artefacts": None if truth.artefact is None else artefact_counts(truth.artefact),
        "truth": truth.info,
    }


def chosen_views(part: Any, scanner: StripeScanner, text: str, overlap: float) -> tuple[View, ...]:
    """Return the views that ``--views`` asks for.

    Raises:
        UsageError: The text is neither "auto", nor a number, nor a list of views.
    """
    from scanner_sim import parse_views, plan_views

    word = text.strip().lower()
    try:
        if word == "auto" or word.isdigit():
            count = None if word == "auto" else int(word)
            return plan_views(part, scanner, overlap=overlap, count=count)
        return parse_views(text)
    except DataError as error:
        hint = "" if error.hint else '; write "auto", a number, or "tilt,azimuth;..." in degrees'
        raise UsageError(f"simulate: --views {text}: {error}{hint}") from error


def find_part(name: str, solid: SolidOptions | None = None) -> Any:
    """Return the named part, or the one in the named file.

    Args:
        name: A known part, or a path: what ends in a suffix of a solid is one.
        solid: How to read a file.

    Raises:
        UsageError: There is no part of this name.
        DataError: The file cannot be read.
    """
    from scanner_sim import blocks

    if name.partition(":")[0] == "random":
        try:
            return blocks.by_name(name)
        except DataError as error:
            raise UsageError(f"{error}") from error
    if name in blocks.PARTS:
        return blocks.by_name(name)
    if Path(name).suffix.lower() in SOLIDS:
        from scanner_sim.solids import read_part

        check_inputs([Path(name)])
        return read_part(name, solid)
    known = ", ".join([*blocks.PARTS, "random:SEED[:FAMILY]"])
    files = " ".join(SOLIDS)
    near = suggest(name, list(blocks.PARTS))
    raise UsageError(f"no part {name!r}{near}; parts: {known}, or a file: {files}")


def scan_summary(scans: Scans, truth: Truth) -> dict[str, Any]:
    """Return the figures of a simulated scan."""
    return _counts(scans) | _truth_figures(truth)


def _counts(scans: Scans) -> dict[str, Any]:
    import numpy as np

    return {
        "points": len(scans),
        "stripes": 0 if scans.stripe is None else len(np.unique(scans.stripe)),
        "views": 1 if scans.view is None else len(np.unique(scans.view)),
    }


def artefact_counts(artefact: Any) -> dict[str, int]:
    """Return the number of points of every class of artefact."""
    import numpy as np

    from octoseg_ti.types import Artefact

    return {
        kind.name.lower().replace("_", "-"): int(np.count_nonzero(artefact == kind))
        for kind in Artefact
    }


def describe_scan(part: str, scans: Scans, truth: Truth) -> str:
    """Return the same in a line."""
    return _line(part, scan_summary(scans, truth))


def _line(part: str, figures: dict[str, Any]) -> str:
    patches = figures["patches"]
    known = "no truth recorded" if patches is None else f"{patches} true patches"
    artefacts = figures["artefacts"] or {}
    counts = ", ".join(f"{n} {kind}" for kind, n in artefacts.items() if kind != "clean" and n)
    return (
        f"{part}: {figures['points']} points in {figures['stripes']} stripes and "
        f"{figures['views']} view(s), {known}"
    ) + (f"; artefacts: {counts}" if counts else "")
