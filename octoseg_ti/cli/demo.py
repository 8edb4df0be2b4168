"""Verb `demo`: the whole road once, from a simulated scan to a scored and pictured result."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from octoseg_ti.cli.options import Machine, make_folder, need_display
from octoseg_ti.cli.output import out, out_json, progress, size_of

OUTPUTS = ("scan.mcap", "result.mcap", "result.npz", "result.ply", "result.rrd")


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions:
    """Simulate a test block, segment it, score it and write everything into a folder.

    octoseg demo

    Needs no display and no GPU. Afterwards the folder holds the recording, the result in four
    formats and a report with pictures, and the screen shows the scores.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = Path("octoseg_demo")
    """Folder to write."""
    part: str = "test-block"
    """Part on the table: two-planes, test-block, phone, random:SEED or random:SEED:FAMILY."""
    seed: int = 7
    """Seed of noise and dropouts."""
    range_noise: float = 0.01
    """Standard deviation of the noise along the line of sight [mm]."""
    open: bool = False
    """Open the result in Rerun."""
    json: bool = False
    """Print the figures as JSON."""
    quiet: bool = False
    """Print nothing but errors."""
    machine: tyro.conf.OmitArgPrefixes[Machine] = field(default_factory=Machine)


OPTIONS = {"demo": DemoOptions}


def run_demo(options: DemoOptions) -> int:
    """Walk the road."""
    from octoseg_ti.cli.segment import summary
    from octoseg_ti.cli.simulate import describe_scan, find_part, scan_summary

    part = find_part(options.part)
    make_folder(options.output)
    options.machine.start()
    from octoseg_ti import evaluate, files, segment
    from octoseg_ti.view.report import write_report
    from scanner_sim import StripeScanner, simulate

    folder, began = options.output, time.perf_counter()
    with progress("demo", quiet=options.quiet) as report:
        scanner = StripeScanner(range_noise=options.range_noise)
        scans, truth = simulate(part, scanner, seed=options.seed, progress=report)
        files.write(folder / "scan.mcap", scans, truth=truth)
        result = segment(scans, progress=report)
        scores = evaluate(result, truth)
        report("write the report")
        write_report(folder, result, scores=scores, truth=truth)
        text = (folder / "report.md").read_text(encoding="utf-8")
        for name in OUTPUTS[1:]:
            report(f"write {name}")
            files.write(
                folder / name,
                result,
                truth=truth,
                scans=scans,
                report=text,
                scores=scores.to_dict(),
                run={"command": "octoseg demo", "seed": str(options.seed)},
            )
    seconds = time.perf_counter() - began
    written = sorted(p for p in folder.iterdir() if p.is_file())
    if options.json:
        scan = scan_summary(scans, truth)
        figures = {"scores": scores.to_dict(), "files": written, "total_seconds": seconds}
        out_json({"part": options.part, "scan": scan, "result": summary(result), **figures})
    elif not options.quiet:
        out(describe_scan(options.part, scans, truth))
        out(f"\n{result}\n\n{scores}\n")
        out(f"{folder}/ after {seconds:.1f} s:")
        for path in written:
            out(f"  {path.name:<14} {size_of(path)}")
        out(_how_to_open(folder))
    if options.open:
        open_in_rerun(folder / "result.rrd")
    return 0


def _how_to_open(folder: Path) -> str:
    return "\n".join([
        "look at it:",
        f"  a browser       {folder / 'report.html'}",
        f"  Rerun           rerun {folder / 'result.rrd'}",
        f"  Foxglove        open {folder / 'result.mcap'} as a local file",
        f"  MeshLab and co  {folder / 'result.ply'} (colours are patches)",
        "your own scan:    octoseg segment scan.npz -o result.ply",
    ])  # fmt: skip


def open_in_rerun(path: Path) -> None:
    """Open a file in the Rerun viewer, as a process of its own.

    Raises:
        Failure: There is no display.
    """
    need_display(f"{path} is written: open it elsewhere")
    subprocess.Popen(
        [sys.executable, "-m", "rerun", str(path)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
