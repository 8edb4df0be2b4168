"""Verb `segment`: points or stripes to labelled patches."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from octoseg_ti.cli.options import Machine, check_inputs, check_outputs
from octoseg_ti.cli.output import out, out_json, progress, size_of
from octoseg_ti.params import PRESETS, Params

if TYPE_CHECKING:
    from octoseg_ti.alignment import Registration
    from octoseg_ti.types import Segmentation, Truth


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentOptions:
    """Find the patches, edges and surfaces of a scanned part.

    octoseg segment scan.mcap -o result.mcap -o result.ply

    Nothing needs tuning: point spacing and noise are measured, and every value that was chosen is
    reported. The options below --params steer single steps.
    """

    input: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IN")]
    """Recording or point cloud: .mcap .npz .ply .pcd .xyz .las .laz .e57"""
    output: Annotated[
        tuple[Path, ...], tyro.conf.UseAppendAction, tyro.conf.arg(aliases=["-o"], metavar="FILE")
    ]
    """File to write, by suffix: .mcap .npz .ply .pcd .xyz .rrd"""
    preset: Literal["default", "paper"] = "default"
    """"default" measures what it needs; "paper" is the published method with user values."""
    refine: bool = False
    """Align overlapping views to each other by ICP before segmenting; the recorded poses are the
    start. Short for --params.registration.refine."""
    topic: str | None = None
    """Topic of the points, when a recording has several."""
    unit: Literal["mm", "m"] | None = None
    """Unit of the coordinates; default: what the format says, else mm."""
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


OPTIONS = {"segment": SegmentOptions}


def preset_in(arguments: list[str]) -> Params:
    """Return the parameters of the --preset in the arguments."""
    named = "default"
    for here, following in zip(arguments, [*arguments, ""][1:], strict=True):
        if here == "--preset":
            named = following
        elif here.startswith("--preset="):
            named = here.partition("=")[2]
    preset: Any = PRESETS.get(named, Params)  # an unknown name is refused by the parser
    return preset()  # type: ignore[no-any-return]


def run_segment(options: SegmentOptions) -> int:
    """Read, segment, write, and say what was found."""
    from octoseg_ti import files
    from octoseg_ti.cli import UsageError

    if not options.output:
        raise UsageError("segment: where to? add -o OUT (.mcap .npz .ply .pcd .xyz .rrd)")
    check_inputs([options.input])
    check_outputs(options.output)
    options.machine.start()
    began = time.perf_counter()
    scans, truth = files.read_with_truth(options.input, topic=options.topic, unit=options.unit)

    from octoseg_ti.pipeline import segment

    params = options.params
    if options.refine:
        params = replace(params, registration=replace(params.registration, refine=True))
    with progress("segment", quiet=options.quiet) as report:
        result = segment(scans, params=params, progress=report)
        for path in options.output:
            report(f"write {path.name}")
            files.write(path, result, truth=truth, scans=scans, run={"command": "octoseg segment"})
    whole = time.perf_counter() - began
    if options.quiet and not options.json:
        return 0
    if options.json:
        outputs = {"outputs": options.output, "total_seconds": whole}
        figures = {**summary(result), "pose_errors": pose_figures(result, truth)}
        out_json({"input": options.input, **figures, **outputs})
    else:
        out(str(result))
        errors = pose_figures(result, truth)
        if errors is not None:
            out(
                f"  relative poses against the truth, at most: recorded "
                f"{errors['recorded_mm']:.4f} mm {errors['recorded_deg']:.4f} deg, refined "
                f"{errors['refined_mm']:.4f} mm {errors['refined_deg']:.4f} deg"
            )
        for path in options.output:
            out(f"wrote {path} ({size_of(path)})")
    return 0


def summary(result: Segmentation) -> dict[str, Any]:
    """Return the figures of a result, for JSON."""
    from dataclasses import asdict

    from octoseg_ti.types import SurfaceKind

    sizes, deviation = result.patch_sizes, result.deviation
    return {
        "points": len(result),
        "patches": result.patch_count,
        "labelled": float(np.mean(result.labels >= 0)) if len(result) else 0.0,
        "edge_points": int(np.count_nonzero(result.edge)),
        "outliers": int(result.outlier.sum()),
        "cells": len(result.cells),
        "cell_sizes": result.level_count,
        "passes": result.passes,
        "patch_table": [
            {
                "patch": k,
                "kind": SurfaceKind(int(result.kind[k])).name.lower(),
                "surface": int(result.surface[k]),
                "points": int(sizes[k]),
                "rms_mm": float(result.residual[k]),
                "parameters": result.parameters[k],
                "deviations": deviation[k],
            }
            for k in range(result.patch_count)
        ],
        "fillets": fillet_table(result),
        "registration": registration_figures(result.registration),
        "measured": asdict(result.measured),
        "shallowest_edge_deg": float(np.degrees(result.shallowest_edge)),
        "shallowest_edge_width_mm": result.edge_width,
        "params": result.params.to_dict(),
        "seconds": result.seconds,
    }


def fillet_table(result: Segmentation) -> list[dict[str, Any]] | None:
    """Return a row for every fillet, for JSON; None where they were not looked for."""
    found = result.fillets
    if found is None:
        return None
    return [
        {
            "fillet": k,
            "patches": found.patches[k].tolist(),
            "radius_mm": float(found.radius[k]),
            "deviation_mm": float(found.deviation[k]),
            "concave": bool(found.concave[k]),
            "points": int(found.points[k]),
            "strips": np.flatnonzero(found.strip == k).tolist(),
        }
        for k in range(len(found))
    ]


def pose_figures(result: Segmentation, truth: Truth | None) -> dict[str, Any] | None:
    """Return how far relative poses are from the true ones; None where either is not known."""
    if result.registration is None or truth is None or truth.T_world_view is None:
        return None
    from octoseg_ti.evaluation import pose_errors

    figures = {}
    for name in ("recorded", "refined"):
        shift, angle = pose_errors(getattr(result.registration, name), truth.T_world_view)
        figures[f"{name}_mm"], figures[f"{name}_deg"] = shift, float(np.degrees(angle))
    return figures


def registration_figures(aligned: Registration | None) -> dict[str, Any] | None:
    """Return how the views were aligned, for JSON; None when they were not."""
    if aligned is None:
        return None
    shift, angle = aligned.moves()
    return {
        "rms_before_mm": aligned.rms_before,
        "rms_after_mm": aligned.rms_after,
        "datum": aligned.datum,
        "left_as_recorded": aligned.left,
        "pairs": [
            {
                "views": pair,
                "matches": int(aligned.matches[k]),
                "rms_before_mm": float(aligned.before[k]),
                "rms_after_mm": float(aligned.after[k]),
            }
            for k, pair in enumerate(aligned.pairs.tolist())
        ],
        "views": [
            {
                "view": v,
                "moved_mm": float(shift[v]),
                "turned_deg": float(np.degrees(angle[v])),
                "open_directions": int(aligned.open[v]),
                "recorded": aligned.recorded[v],
                "refined": aligned.refined[v],
            }
            for v in range(len(shift))
        ],
    }
