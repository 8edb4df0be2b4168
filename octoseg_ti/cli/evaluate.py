"""Verb `evaluate`: scores against the recorded truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from octoseg_ti.cli import UsageError
from octoseg_ti.cli.convert import result_in
from octoseg_ti.cli.options import Machine, check_inputs
from octoseg_ti.cli.output import note, out, out_json, progress, table
from octoseg_ti.errors import DataError

if TYPE_CHECKING:
    from octoseg_ti.evaluation import Scores


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateOptions:
    """Score results against the truth: the five counts of Hoover, IoU, ARI, normals, edges.

    octoseg evaluate result.mcap

    A file that holds a result is scored as it is. A file with points and truth only is segmented
    first, with the default parameters, and the output says so.
    """

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Files to score."""
    truth: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Take the truth from this file; default: from each file itself."""
    overlap: float = 0.8
    """Share of the points that two regions must have in common to match (T), above 0.5."""
    edge_distance: float | None = None
    """A point this near to a true edge counts as an edge point [mm]; default: from the spacing."""
    json: bool = False
    """Print the scores as JSON."""
    quiet: bool = False
    """No progress, no remarks."""
    machine: tyro.conf.OmitArgPrefixes[Machine] = field(default_factory=Machine)


OPTIONS = {"evaluate": EvaluateOptions}


def run_evaluate(options: EvaluateOptions) -> int:
    """Score every file; one that fails does not stop the others, but the exit code says so."""
    if not options.inputs:
        raise UsageError("evaluate: missing FILE; see octoseg evaluate --help")
    if not 0.5 < options.overlap <= 1.0:
        raise UsageError(f"--overlap must be above 0.5 and at most 1, not {options.overlap:g}")
    given = () if options.truth is None else (options.truth,)
    check_inputs([*options.inputs, *given])
    options.machine.start()
    scored: dict[str, tuple[Scores, str]] = {}
    failures: list[DataError] = []
    for path in options.inputs:
        try:
            scored[str(path)] = _score(path, options)
        except DataError as error:
            if len(options.inputs) == 1:
                raise
            failures.append(error)
            note(f"octoseg: {error}")
    if options.json:
        found = {
            name: {"from": source, **scores.to_dict()} for name, (scores, source) in scored.items()
        }
        out_json(next(iter(found.values())) if len(options.inputs) == 1 else found)
    elif len(options.inputs) == 1:
        (scores, source), name = *scored.values(), str(options.inputs[0])
        out(f"{name} ({source})\n{scores}")
    else:
        out(scores_table(scored))
    if failures:
        raise DataError(f"{len(failures)} of {len(options.inputs)} files could not be scored")
    return 0


def _score(path: Path, options: EvaluateOptions) -> tuple[Scores, str]:
    """Return the scores of a file, and where the result came from."""
    from octoseg_ti import files
    from octoseg_ti.evaluation import evaluate

    where = options.truth or path
    result, source = result_in(path), "recorded result"
    scans = None
    if result is None and options.truth is None:
        scans, truth = files.read_with_truth(path)
    else:
        truth = files.read_truth(where)
    if truth is None:
        raise DataError("holds no truth to score against", path=where, hint="name one by --truth")
    if result is None:
        from octoseg_ti.pipeline import segment

        source = "segmented now, default parameters"
        if not options.quiet:
            note(f"{path}: holds no result; segmenting it now")
        if scans is None:
            scans = files.read(path)
        with progress("segment", quiet=options.quiet) as report:
            result = segment(scans, progress=report)
    if len(result) != len(truth):
        raise DataError(
            f"{len(result)} points, but the truth in {where} has {len(truth)}",
            path=path,
            hint="result and truth must come from the same scan",
        )
    scores = evaluate(result, truth, overlap=options.overlap, edge_distance=options.edge_distance)
    return scores, source


def scores_table(scored: dict[str, tuple[Scores, str]]) -> str:
    """Return one line per file."""
    header = [
        "file", "true", "found", "correct", "over", "under", "missed", "noise",
        "IoU", "ARI", "labelled", "normals", "edge F1", "result",
    ]  # fmt: skip
    rows = []
    for name, (scores, source) in scored.items():
        values = scores.to_dict()
        regions: dict[str, Any] = values["regions"]
        normals, edges = values["normals"] or {}, values["edges"].get("all") or {}
        angle = normals.get("median_deg")
        rows.append([
            name, regions["patches"], regions["regions"], regions["correct"], regions["over"],
            regions["under"], regions["missed"], regions["noise"], regions["mean_iou"],
            regions["ari"], f"{regions['labelled']:.1%}",
            None if angle is None else f"{angle:.2f} deg", edges.get("f1"),
            "recorded" if source.startswith("recorded") else "now",
        ])  # fmt: skip
    return table(header, rows)
