"""Verb `simulate`: a recording of a simulated scanner, with the truth about every point."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from octoseg_ti.cli import UsageError, suggest
from octoseg_ti.cli.options import Machine, check_inputs, check_outputs
from octoseg_ti.cli.output import out, out_json, progress, size_of
from scanner_sim.scanner import StripeScanner
from scanner_sim.solid_options import SUFFIXES as SOLIDS
from scanner_sim.solid_options import SolidOptions

if TYPE_CHECKING:
    from octoseg_ti.types import Scans, Truth

SUFFIXES = (".mcap", ".npz", ".ply", ".rrd")


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulateOptions:
    """Simulate a stripe scanner that knows the truth.

    octoseg simulate test-block -o scan.mcap

    octoseg simulate bracket.step -o scan.mcap

    The recording holds the stripes, the poses of the scanner and, for every point, its patch,
    surface, true position and normal, and the nearest true edge. The same seed gives the same file.
    """

    part: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PART")]
    """Part on the table: two-planes, test-block, phone, a random block (random:SEED or
    random:SEED:FAMILY with the families sharp, filleted, smooth and mixed, the default), or a file:
    .step .stp .stl .obj .ply"""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """File to write, by suffix: .mcap .npz .ply .rrd"""
    seed: int = 7
    """Seed of noise and dropouts."""
    json: bool = False
    """Print the figures as JSON."""
    quiet: bool = False
    """Print nothing but errors."""
    scanner: tyro.conf.OmitArgPrefixes[StripeScanner] = field(default_factory=StripeScanner)
    solid: tyro.conf.OmitArgPrefixes[SolidOptions] = field(default_factory=SolidOptions)
    machine: tyro.conf.OmitArgPrefixes[Machine] = field(default_factory=Machine)


OPTIONS = {"simulate": SimulateOptions}


def run_simulate(options: SimulateOptions) -> int:
    """Simulate and write."""
    check_outputs([options.output], SUFFIXES)
    part = find_part(options.part, options.solid)
    options.machine.start()
    from octoseg_ti import files
    from scanner_sim import simulate

    with progress("simulate", quiet=options.quiet) as report:
        scans, truth = simulate(part, options.scanner, seed=options.seed, progress=report)
        report(f"write {options.output.name}")
        run = {"command": "octoseg simulate", "part": options.part, "seed": str(options.seed)}
        files.write(options.output, scans, truth=truth, run=run)
    if options.json:
        figures = scan_summary(scans, truth)
        out_json({"part": options.part, "seed": options.seed, **figures, "output": options.output})
    elif not options.quiet:
        if hasattr(part, "summary"):
            out(part.summary())
        out(describe_scan(options.part, scans, truth))
        out(f"wrote {options.output} ({size_of(options.output)})")
    return 0


def find_part(name: str, solid: SolidOptions | None = None) -> Any:
    """Return the named part, or the one in the named file.

    Args:
        name: A known part, or a path: what ends in a suffix of a solid is one.
        solid: How to read a file.

    Raises:
        UsageError: There is no part of this name.
        DataError: The file cannot be read.
    """
    from octoseg_ti.errors import DataError
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
    import numpy as np

    return {
        "points": len(scans),
        "stripes": 0 if scans.stripe is None else len(np.unique(scans.stripe)),
        "views": 1 if scans.view is None else len(np.unique(scans.view)),
        "patches": truth.patch_count,
        "truth": truth.info,
    }


def describe_scan(part: str, scans: Scans, truth: Truth) -> str:
    """Return the same in a line."""
    s = scan_summary(scans, truth)
    return (
        f"{part}: {s['points']} points in {s['stripes']} stripes and {s['views']} view(s), "
        f"{s['patches']} true patches"
    )
