"""Verb `simulate`: a recording of a simulated scanner, with the truth about every point."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from octoseg_ti.cli import UsageError, suggest
from octoseg_ti.cli.options import Machine, check_outputs
from octoseg_ti.cli.output import out, out_json, progress, size_of
from scanner_sim.presets import SCANNERS
from scanner_sim.scanner import StripeScanner

if TYPE_CHECKING:
    from octoseg_ti.types import Scans, Truth

ScannerName = Literal["default", "ideal", "surveyor-like", "modern", "harsh"]
SUFFIXES = (".mcap", ".npz", ".ply", ".rrd")


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulateOptions:
    """Simulate a stripe scanner that knows the truth.

    octoseg simulate test-block -o scan.mcap

    The recording holds the stripes, the poses of the scanner and, for every point, its patch,
    surface, true position and normal, and the nearest true edge. The same seed gives the same file.
    --scanner names a whole scanner; every option below changes it: --scanner surveyor-like
    --speckle 0.
    """

    part: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PART")]
    """Part on the table: two-planes, test-block or phone."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """File to write, by suffix: .mcap .npz .ply .rrd"""
    preset: Annotated[ScannerName, tyro.conf.arg(aliases=["--scanner"])] = "default"
    """Whole scanner by name, whose values the options of the scanner then change."""
    seed: int = 7
    """Seed of noise and dropouts."""
    json: bool = False
    """Print the figures as JSON."""
    quiet: bool = False
    """Print nothing but errors."""
    scanner: tyro.conf.OmitArgPrefixes[StripeScanner] = field(default_factory=StripeScanner)
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
    part = find_part(options.part)
    check_outputs([options.output], SUFFIXES)
    options.machine.start()
    from octoseg_ti import files
    from scanner_sim import simulate

    with progress("simulate", quiet=options.quiet) as report:
        scans, truth = simulate(part, options.scanner, seed=options.seed, progress=report)
        report(f"write {options.output.name}")
        run = {"command": "octoseg simulate", "part": options.part, "seed": str(options.seed)}
        if options.preset != "default":
            run["scanner"] = options.preset
        files.write(options.output, scans, truth=truth, run=run)
    if options.json:
        figures = scan_summary(scans, truth)
        out_json({"part": options.part, "seed": options.seed, **figures, "output": options.output})
    elif not options.quiet:
        out(describe_scan(options.part, scans, truth))
        out(f"wrote {options.output} ({size_of(options.output)})")
    return 0


def find_part(name: str) -> Any:
    """Return the named part.

    Raises:
        UsageError: There is none of this name.
    """
    from scanner_sim import blocks

    if name not in blocks.PARTS:
        known = ", ".join(blocks.PARTS)
        raise UsageError(f"no part {name!r}{suggest(name, list(blocks.PARTS))}; parts: {known}")
    return blocks.by_name(name)


def scan_summary(scans: Scans, truth: Truth) -> dict[str, Any]:
    """Return the figures of a simulated scan."""
    import numpy as np

    return {
        "points": len(scans),
        "stripes": 0 if scans.stripe is None else len(np.unique(scans.stripe)),
        "views": 1 if scans.view is None else len(np.unique(scans.view)),
        "patches": truth.patch_count,
        "artefacts": None if truth.artefact is None else artefact_counts(truth.artefact),
        "truth": truth.info,
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
    s = scan_summary(scans, truth)
    artefacts = s["artefacts"] or {}
    counts = ", ".join(f"{n} {kind}" for kind, n in artefacts.items() if kind != "clean" and n)
    return (
        f"{part}: {s['points']} points in {s['stripes']} stripes and {s['views']} view(s), "
        f"{s['patches']} true patches"
    ) + (f"; artefacts: {counts}" if counts else "")
