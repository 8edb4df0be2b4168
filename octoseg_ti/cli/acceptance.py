"""Verb `acceptance`: what a simulated scanner measures on a ball, a plane and a step."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from octoseg_ti.cli.options import Machine, make_folder
from octoseg_ti.cli.output import out, out_json, plain, progress, table
from octoseg_ti.cli.simulate import ScannerName, scanner_in
from scanner_sim.presets import LIMITS, Limits
from scanner_sim.scanner import StripeScanner

if TYPE_CHECKING:
    import numpy as np

    from scanner_sim.acceptance import Acceptance

PICTURE, TABLE, REPORT = "phantom-points.png", "acceptance.json", "acceptance.md"
_WORDS = {
    "probing_form": "probing form, 25 mm ball, 95 %",
    "size_error": "size error, 25 mm ball",
    "flatness": "flatness, 95 %",
    "step_error": "height error, 5 mm step",
}
_SHOWN = 0.5  # the picture shows this much on either side of the step [mm], or two line widths


@dataclass(frozen=True, slots=True, kw_only=True)
class AcceptanceOptions:
    """Measure a simulated scanner as its users would.

    octoseg acceptance --scanner surveyor-like -o acceptance

    A ball, a plane and a step are scanned and fitted by least squares, and plates are tilted to see
    the noise grow; the figures stand beside the range that the scanner states. With -o the folder
    gets a report, the figures as JSON, and a cross-section of the step with the points that no
    surface has.
    """

    preset: Annotated[ScannerName, tyro.conf.arg(aliases=["--scanner"])] = "default"
    """Whole scanner by name, whose values the options of the scanner then change."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = None
    """Folder to write."""
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


OPTIONS = {"acceptance": AcceptanceOptions}


def run_acceptance(options: AcceptanceOptions) -> int:
    """Measure, print, draw."""
    if options.output is not None:
        make_folder(options.output)
    options.machine.start()
    from scanner_sim.acceptance import acceptance

    limits = LIMITS[options.preset]
    with progress("acceptance", quiet=options.quiet) as report:
        report("measure")
        found = acceptance(options.scanner, seed=options.seed)
        if options.output is not None:
            report("draw")
            write_folder(options.output, found, limits, options)
    if options.json:
        out_json(figures(found, limits, options))
    elif not options.quiet:
        out(describe(found, limits, options.preset))
        if options.output is not None:
            out(f"\nwrote {REPORT}, {TABLE} and {PICTURE} to {options.output}")
    return 0


def figures(found: Acceptance, limits: Limits, options: AcceptanceOptions) -> dict[str, Any]:
    """Return the figures for JSON: lengths in mm, angles in degrees."""
    values: dict[str, Any] = {"scanner": options.preset, "seed": options.seed}
    for name in _WORDS:
        low, high = getattr(limits, name)
        value = getattr(found, name)
        values[name] = {"mm": value, "stated": [low, high], "within": low <= value <= high}
    values["probing_form_all_mm"] = found.probing_form_all
    values["flatness_all_mm"] = found.flatness_all
    values["noise"] = [
        {"angle_deg": math.degrees(r.angle), "measured_mm": r.measured, "stated_mm": r.stated}
        for r in found.noise
    ]
    values["parameters"] = {
        f.name: getattr(options.scanner, f.name)
        for f in dataclasses.fields(StripeScanner)
        if f.name != "views"
    }
    return values


def describe(found: Acceptance, limits: Limits, name: str) -> str:
    """Return the tables as text, in micrometres."""
    return "\n\n".join(table(heads, rows) for heads, rows in _tables(found, limits, name))


def markdown(found: Acceptance, limits: Limits, options: AcceptanceOptions) -> str:
    """Return the report: the tables, the picture, and what was measured."""
    lines = [
        f"# Acceptance of the simulated scanner {options.preset}",
        "",
        "Artefacts as in ISO 10360-8 and VDI/VDE 2634, scanned with seed "
        f"{options.seed} and fitted by least squares; the form is what holds 95 % of the points.",
    ]
    for heads, rows in _tables(found, limits, options.preset):
        lines += ["", *(f"| {' | '.join(row)} |" for row in (heads, ["---"] * len(heads), *rows))]
    lines += ["", f"![Cross-section of a 5 mm step]({PICTURE})", ""]
    return "\n".join(lines)


def _tables(
    found: Acceptance, limits: Limits, name: str
) -> list[tuple[list[str], list[list[str]]]]:
    """Return heads and rows of the two tables, in micrometres."""
    rows = []
    for key, words in _WORDS.items():
        low, high = getattr(limits, key)
        value = getattr(found, key)
        within = "yes" if low <= value <= high else "NO"
        rows.append([words, f"{1e3 * value:.2f}", f"{1e3 * low:g} to {1e3 * high:g}", within])
    noise = [
        [f"{math.degrees(r.angle):.0f} deg", f"{1e3 * r.measured:.2f}", f"{1e3 * r.stated:.2f}"]
        for r in found.noise
    ]
    return [
        ([f"scanner {name} [um]", "measured", "stated", "within"], rows),
        (["noise by angle of incidence [um]", "measured", "stated"], noise),
    ]


def write_folder(
    folder: Path, found: Acceptance, limits: Limits, options: AcceptanceOptions
) -> None:
    """Write the figures and the picture, each beside its target and then renamed."""
    from octoseg_ti.files.atomic import replacing
    from octoseg_ti.view.figures import png

    text = json.dumps(plain(figures(found, limits, options)), indent=2)
    with replacing(folder / TABLE) as output:
        output.write(text.encode("utf-8"))
    with replacing(folder / REPORT) as output:
        output.write(markdown(found, limits, options).encode("utf-8"))
    with replacing(folder / PICTURE) as output:
        output.write(png(phantom_points(options.scanner, seed=options.seed)))


def phantom_points(scanner: StripeScanner, *, seed: int) -> np.ndarray:
    """Return the cross-section of a scanned step: its points by artefact, the line's width."""
    import numpy as np

    from octoseg_ti.types import Artefact
    from octoseg_ti.view.section import section
    from scanner_sim.acceptance import scan_of_step

    scans, truth = scan_of_step(scanner, seed=seed)
    assert scans.T_world_view is not None
    pose = scans.T_world_view[0]
    world = scans.points @ pose[:3, :3].T + pose[:3, 3]
    near = np.abs(world[:, 0]) <= max(_SHOWN, 2.0 * scanner.line_width)
    artefact = np.zeros(len(world), np.uint8) if truth.artefact is None else truth.artefact
    half = scanner.line_width / 2
    return section(
        world[near, 0], world[near, 2], artefact[near],
        names=[kind.name.lower().replace("_", "-") for kind in Artefact],
        title="cross-section of a 5 mm step at x = 0, points by artefact",
        band=None if half == 0.0 else (-half, half),
        band_name=f"line width {scanner.line_width:g} mm",
    )  # fmt: skip
