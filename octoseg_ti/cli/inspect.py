"""Verbs `info` and `check`: look into files, verify them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from octoseg_ti.cli import UsageError
from octoseg_ti.cli.options import check_inputs
from octoseg_ti.cli.output import out, out_json, tree
from octoseg_ti.errors import DataError


@dataclass(frozen=True, slots=True, kw_only=True)
class InfoOptions:
    """Say what is in a recording or point cloud: topics or arrays, counts, frames, metadata.

    octoseg info scan.mcap
    """

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Files to look into."""
    json: bool = False
    """Print as JSON."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckOptions:
    """Verify files: checksums, times, schemas, shapes, labels. Exit code 1 when one has a problem.

    octoseg check scan.mcap result.npz
    """

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Files to verify."""
    json: bool = False
    """Print as JSON: file -> list of problems."""
    quiet: bool = False
    """Print only problems."""


OPTIONS: dict[str, Any] = {"info": InfoOptions, "check": CheckOptions}


def run_info(options: InfoOptions) -> int:
    """Describe every file."""
    _needs_files("info", options.inputs)
    check_inputs(options.inputs)
    from octoseg_ti.files import inspect

    found = {str(path): inspect.describe(path) for path in options.inputs}
    if options.json:
        out_json(next(iter(found.values())) if len(found) == 1 else found)
    else:
        for number, values in enumerate(found.values()):
            out(("\n" if number else "") + tree(values))
    return 0


def run_check(options: CheckOptions) -> int:
    """Verify every file; a file that cannot be read is a problem like any other."""
    _needs_files("check", options.inputs)
    check_inputs(options.inputs)
    from octoseg_ti.files import inspect

    problems: dict[str, list[str]] = {}
    for path in options.inputs:
        try:
            problems[str(path)] = list(inspect.check(path))
        except DataError as error:
            problems[str(path)] = [error.what]
    if options.json:
        out_json(problems)
    else:
        for name, lines in problems.items():
            for line in lines:
                out(f"{name}: {line}")
            if not lines and not options.quiet:
                out(f"{name}: ok")
    bad = [name for name, lines in problems.items() if lines]
    if bad:
        count = sum(map(len, problems.values()))
        raise DataError(f"{count} problem(s) in {', '.join(bad)}")
    return 0


def _needs_files(verb: str, inputs: tuple[Path, ...]) -> None:
    if not inputs:
        raise UsageError(f"{verb}: missing FILE; see octoseg {verb} --help")
