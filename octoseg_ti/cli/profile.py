"""Verb `profile`: where the time goes, compilation apart."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from octoseg_ti.cli import UsageError
from octoseg_ti.cli.options import Machine, check_inputs, check_outputs
from octoseg_ti.cli.output import out, out_json, progress, table
from octoseg_ti.cli.segment import preset_in
from octoseg_ti.params import Params

if TYPE_CHECKING:
    from octoseg_ti.device.profiling import Profile, Trace


@dataclass(frozen=True, slots=True, kw_only=True)
class ProfileOptions:
    """Time every stage and every kernel of the segmentation of a file.

    octoseg profile scan.mcap

    The first run, which compiles or loads the kernels, is shown apart from the median and the least
    of the runs after it. Kernels are timed in runs of their own, because that slows the stages
    down. Reading the file is not part of the times.
    """

    input: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Recording or point cloud."""
    repeat: int = 20
    """Runs after the first."""
    trace: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write the last run whose kernels were timed as a .json trace for ui.perfetto.dev."""
    preset: Literal["default", "paper"] = "default"
    """Named set of parameters."""
    json: bool = False
    """Print the figures as JSON."""
    quiet: bool = False
    """Print nothing but errors."""
    machine: tyro.conf.OmitArgPrefixes[Machine] = field(default_factory=Machine)
    params: Params = field(default_factory=Params)

    @staticmethod
    def defaults(arguments: list[str]) -> dict[str, Any]:
        """Return the parameters of the preset in the arguments as defaults."""
        return {"params": preset_in(arguments)}


OPTIONS = {"profile": ProfileOptions}


def run_profile(options: ProfileOptions) -> int:
    """Read once, segment repeatedly, print the tables."""
    if options.repeat < 1:
        raise UsageError(f"--repeat must be at least 1, not {options.repeat}")
    check_inputs([options.input])
    if options.trace is not None:
        check_outputs([options.trace], (".json",))
    options.machine.start()
    from octoseg_ti import files, segment
    from octoseg_ti.device import profiling, runtime

    scans = files.read(options.input)

    def work(trace: Trace) -> None:
        segment(scans, params=options.params, trace=trace)

    # Only these backends record the times of kernels.
    timed = options.machine.arch in ("cpu", "cuda")
    machine = vars_of(runtime.ensure_started())
    with progress("profile", quiet=options.quiet) as report:
        profile = (profiling.measure_apart if timed else profiling.measure)(
            work,
            points=len(scans),
            repeat=options.repeat,
            progress=lambda share: report("run", share),
        )
    if options.trace is not None:
        write_trace(options.trace, profiling.chrome_trace((profile.watched or profile.runs)[-1]))
    if options.json:
        out_json({"input": options.input, "machine": machine, **profile.to_dict()})
    elif not options.quiet:
        out(describe(profile, machine, str(options.input)))
        if options.trace is not None:
            out(f"\nwrote {options.trace}: open it in https://ui.perfetto.dev")
    return 0


def vars_of(options: Any) -> dict[str, Any]:
    """Return how Taichi runs, and on what."""
    import platform
    from dataclasses import asdict

    from octoseg_ti import __version__

    return {
        "octoseg": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        **asdict(options),
    }


def describe(profile: Profile, machine: dict[str, Any], name: str) -> str:
    """Return the tables of stages and kernels as text."""
    stages = table(
        ["stage", "ms", "least ms", "Mpoints/s", "% of total", "first run ms", "of it compile ms"],
        [
            [
                "  " * row["depth"] + row["stage"].split(".")[-1],
                f"{row['ms']:.2f}",
                f"{row['min_ms']:.2f}",
                None if row["mpoints_per_s"] is None else f"{row['mpoints_per_s']:.2f}",
                f"{row['percent']:.1f}",
                f"{row['cold_ms']:.1f}",
                f"{row['compile_ms']:.1f}",
            ]
            for row in profile.stages
        ],
    )
    head = (
        f"{name}: {profile.points} points; {machine['arch']}, {machine['threads']} thread(s); "
        f"median and least of {len(profile.runs)} runs"
    )
    if not profile.kernels:
        return f"{head}\n\n{stages}\n\nthis arch records no times of kernels"
    runs = len(profile.watched or profile.runs)
    kernels = table(
        ["kernel", "launches/run", "ms/run", "mean ms", "max ms", "% of kernels"],
        [
            [
                row["kernel"],
                f"{row['count'] / runs:.3g}",
                f"{row['total_ms'] / runs:.3f}",
                f"{row['mean_ms']:.3f}",
                f"{row['max_ms']:.3f}",
                f"{row['percent']:.1f}",
            ]
            for row in profile.kernels
        ],
    )
    return f"{head}\n\n{stages}\n\n{kernels}"


def write_trace(path: Path, events: dict[str, Any]) -> None:
    """Write the trace beside its target, then rename, so that it is never half-written."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(json.dumps(events), encoding="utf-8")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
