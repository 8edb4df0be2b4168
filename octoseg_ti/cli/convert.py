"""Verb `convert`: the same data in another format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from octoseg_ti.cli.options import check_inputs, check_outputs
from octoseg_ti.cli.output import note, out, size_of
from octoseg_ti.errors import DataError

if TYPE_CHECKING:
    from octoseg_ti.types import Segmentation

RESULT_SUFFIXES = (".mcap", ".npz")
"""Formats that keep a whole result."""
COMPLETE = (".mcap", ".npz", ".rrd")
"""Formats that hold everything: the others keep points, normals and labels at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConvertOptions:
    """Translate a file into another format: points, and the result and truth that it holds.

    octoseg convert result.mcap result.ply
    """

    input: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IN")]
    """Recording or point cloud: .mcap .npz .ply .pcd .xyz .las .laz .e57"""
    output: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """File to write, by suffix: .mcap .npz .ply .pcd .xyz .rrd"""
    topic: str | None = None
    """Topic of the points, when a recording has several."""
    unit: Literal["mm", "m"] | None = None
    """Unit of the input's coordinates; default: what the format says, else mm."""
    quiet: bool = False
    """Print nothing but errors."""


OPTIONS = {"convert": ConvertOptions}


def run_convert(options: ConvertOptions) -> int:
    """Read everything that the input holds, write what the output can hold."""
    from octoseg_ti import files

    check_inputs([options.input])
    check_outputs([options.output])
    scans, truth = files.read_with_truth(options.input, topic=options.topic, unit=options.unit)
    result = result_in(options.input)
    if result is None:
        files.write(options.output, scans, truth=truth)
    else:
        files.write(options.output, result, truth=truth, scans=scans)
    if options.quiet:
        return 0
    held = ["points"] + ["result"] * (result is not None) + ["truth"] * (truth is not None)
    out(f"wrote {options.output} ({size_of(options.output)}) from {', '.join(held)}")
    if options.output.suffix.lower() not in COMPLETE and (truth or result):
        note(f"{options.output.suffix} holds points and labels only; .mcap and .npz hold all")
    return 0


def result_in(path: Path) -> Segmentation | None:
    """Return the result that a file holds, or None when it holds only points."""
    from octoseg_ti import files

    if path.suffix.lower() not in RESULT_SUFFIXES:
        return None
    try:
        return files.read_segmentation(path)
    except DataError as error:
        if "no result" in error.what:  # points alone are no fault
            return None
        raise
