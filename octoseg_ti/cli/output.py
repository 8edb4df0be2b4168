"""Everything that goes to the screen: lines, tables, JSON, the progress bar."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from octoseg_ti.cli import drop_stdout


class Report(Protocol):
    """How long work says where it is: the step, and how much of it is done."""

    def __call__(self, step: str, done: float = 0.0, total: float = 1.0) -> None:
        """Take the state."""


def out(text: str = "") -> None:
    """Print a line; a reader that has gone away (``| head``) is no error."""
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        drop_stdout()


def note(text: str) -> None:
    """Print a remark on stderr, where it does not disturb figures."""
    sys.stderr.write(text + "\n")


def out_json(values: Any) -> None:
    """Print values as JSON; NumPy becomes plain, what is not finite becomes null."""
    out(json.dumps(plain(values), indent=2, ensure_ascii=False))


def plain(values: Any) -> Any:
    """Return values as JSON can hold them."""
    if isinstance(values, Mapping):
        return {str(key): plain(value) for key, value in values.items()}
    if isinstance(values, np.ndarray):
        return plain(values.tolist())
    if isinstance(values, list | tuple | set):
        return [plain(value) for value in values]
    if isinstance(values, np.generic):
        return plain(values.item())
    if isinstance(values, float):
        return values if math.isfinite(values) else None
    if isinstance(values, bool | int | str) or values is None:
        return values
    return str(values)


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return columns: the first flush left, the others flush right."""
    cells = [list(header), *([_cell(value) for value in row] for row in rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(header))]
    lines = []
    for row in cells:
        aligned = [
            cell.ljust(width) if k == 0 else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(aligned).rstrip())
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, float | np.floating):
        return f"{value:.4g}"
    return str(value)


def tree(values: Mapping[str, Any], indent: int = 0) -> str:
    """Return nested values as indented lines; lists of mappings become tables."""
    lines = []
    pad = "  " * indent
    for key, value in values.items():
        if isinstance(value, Mapping):
            lines.append(f"{pad}{key}:")
            if value:
                lines.append(tree(value, indent + 1))
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            header = list(value[0])
            block = table(header, [[item.get(h) for h in header] for item in value])
            lines.append(f"{pad}{key}:")
            lines += [f"{pad}  {line}" for line in block.splitlines()]
        else:
            shown = ", ".join(map(str, value)) if isinstance(value, list | tuple) else _cell(value)
            lines.append(f"{pad}{key}: {shown}")
    return "\n".join(lines)


def size_of(path: Path) -> str:
    """Return the size of a file for people: "1.2 MB"."""
    size = float(path.stat().st_size)
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000 or unit == "GB":
            return f"{size:.0f} B" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    raise AssertionError


@contextmanager
def progress(title: str, *, quiet: bool) -> Iterator[Report]:
    """Show a bar on stderr while work goes on; nothing when quiet or not on a terminal.

    Args:
        title: What is being done.
        quiet: Show nothing.

    Yields:
        A function for the work to call: ``report(step, done, total)``.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda step, done=0.0, total=1.0: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None)

        def report(step: str, done: float = 0.0, total: float = 1.0) -> None:
            bar.update(task, description=f"{title}: {step}", completed=done, total=total)

        yield report
