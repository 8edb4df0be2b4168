"""Stanford's range images: PLY with an element ``range_grid``, a list of no or one vertex an entry.

The grid is stored row by row. A column is one position of the laser, thus a stripe; the row is the
place along it. In interlaced Cyberware data the odd rows of a column were taken half a step later;
they stay in the stripe.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.files.columns import MM
from octoseg_ti.files.validation import make_scans
from octoseg_ti.types import Scans

_HINT = "a whole range image is wanted, with num_cols x num_rows grid entries"


def grid_scans(
    path: Path, points: np.ndarray, vertex: np.ndarray, info: dict[str, str], unit: str | None
) -> Scans:
    """Return the scans of a range image, in the order of columns and rows.

    Args:
        path: The file, for messages.
        points: Vertices in the unit of the file, shape (M, 3).
        vertex: Vertex of every grid entry, -1 = none, shape (num_rows * num_cols,).
        info: The ``obj_info`` lines of the header.
        unit: "mm" or "m"; default: m when the header says that this is Cyberware data, else mm.

    Raises:
        DataError: The grid does not fit its header or its vertices.
    """
    width, height = int(info.get("num_cols", 0)), int(info.get("num_rows", 0))
    if width < 1 or height < 1 or width * height != len(vertex):
        what = f"the range grid has {len(vertex)} entries, not num_cols x num_rows"
        raise DataError(what, path=path, hint=_HINT)
    if vertex.min() < -1 or vertex.max() >= len(points):
        raise DataError("a range grid entry names no vertex", path=path, hint=_HINT)
    if unit is None and info.get("is_cyberware_data") == "1":
        unit = "m"
    row, column = np.divmod(np.flatnonzero(vertex >= 0), width)
    order = np.lexsort((row, column))
    row, column = row[order], column[order]
    values = {
        "points": points[vertex[row * width + column]] * MM[unit],
        "stripe": column,
        "column": row,
    }
    return make_scans(path, values)


def info_of(lines: list[str]) -> dict[str, str]:
    """Return the ``obj_info`` lines of a header as names and values."""
    pairs = (line.split(None, 1) for line in lines)
    return {pair[0]: pair[1].strip() for pair in pairs if len(pair) == 2}


def from_elements(content: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return points and the vertex of every entry, from elements that plyfile has read.

    Raises:
        ValueError: An entry has several vertices.
    """
    grid = content["range_grid"]
    lists = grid.data[grid.properties[0].name]
    vertex = np.array([_single(entry) for entry in lists], np.int64)
    data = content["vertex"].data
    return np.stack([data[axis].astype(np.float64) for axis in "xyz"], axis=1), vertex


def from_text(body: bytes, elements: list[tuple[str, int, list[str]]]) -> tuple[np.ndarray, Any]:
    """Return points and the vertex of every entry, from the body of an ASCII file.

    General PLY readers take seconds for the hundred thousands of tiny lists of one range image.

    Args:
        body: What follows the header.
        elements: Name, count and property names of every element, in the order of the file.

    Raises:
        ValueError: Cut off, or an entry has several vertices.
    """
    lines = body.decode("ascii").splitlines()
    start = 0
    found: dict[str, np.ndarray] = {}
    for name, count, properties in elements:
        block = lines[start : start + count]
        start += count
        if len(block) < count:
            raise ValueError(f"cut off: {len(block)} of {count} lines of element {name}")
        if name == "vertex":
            table = np.loadtxt(block, ndmin=2)
            found[name] = table[:, [properties.index(axis) for axis in "xyz"]]
        elif name == "range_grid":
            found[name] = np.array([_single(line.split()[1:], line) for line in block], np.int64)
    return found["vertex"], found["range_grid"]


def _single(entry: Any, line: str = "") -> int:
    """Return the one vertex of a grid entry, -1 for none."""
    if len(entry) > 1 or (line and int(line.split(None, 1)[0]) != len(entry)):
        raise ValueError("a range grid entry must hold no or one vertex")
    return int(entry[0]) if len(entry) else -1
