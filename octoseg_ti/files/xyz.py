"""Points as text: a row per point, blanks, tabs, commas or semicolons between the numbers."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.files.atomic import replacing
from octoseg_ti.files.columns import MM, scan_values, table
from octoseg_ti.files.validation import existing_file, make_scans, parsing, read_bytes
from octoseg_ti.types import Scans, Segmentation, Truth

_HINT = "rows of x y z, or of x y z nx ny nz, are wanted"
_UNIT_LENGTH_TOLERANCE = 0.02
_HEAD_LINES = 100


def read_scans(path: str | Path, *, unit: str | None = None) -> Scans:
    """Read points, and unit normals where columns four to six hold them.

    Lines before the first row of numbers are a header; if the last of it names the columns (x, y,
    z, ...), they are taken by name. Otherwise the first three columns are the position, and the
    next three are normals if they have unit length in every row; further columns are not used.

    Args:
        path: The text file.
        unit: "mm" (default) or "m".

    Raises:
        DataError: Missing, not text, ragged rows, or no points.
    """
    path = existing_file(path)
    with parsing(path, "XYZ", _HINT):
        text = read_bytes(path).decode("utf-8-sig")
        header, delimiter, skip = _head(path, text)
        values = np.loadtxt(
            io.StringIO(text), delimiter=delimiter, comments=("#", "//"), skiprows=skip, ndmin=2
        )
        if len(header) == values.shape[1] and set(header).issuperset("xyz"):
            named = dict(zip(header, values.T, strict=True))
            return make_scans(path, scan_values(named, set(header), MM[unit]))
        if values.shape[1] < 3:
            what = f"a row has {values.shape[1]} numbers"
            raise DataError(what, path=path, hint=_HINT)
        normals = values[:, 3:6] if values.shape[1] >= 6 else None
        if normals is not None:
            length = np.linalg.norm(normals, axis=1)
            if not np.all(np.abs(length - 1.0) < _UNIT_LENGTH_TOLERANCE):
                normals = None
        return make_scans(path, {"points": values[:, :3] * MM[unit], "normals": normals})


def write(
    path: str | Path,
    what: Scans | Segmentation,
    *,
    truth: Truth | None = None,
    overwrite: bool = True,
) -> None:
    """Write a table whose first line names its columns; enough digits to read back equal numbers.

    Raises:
        DataError: The output cannot be written.
    """
    columns = table(path, what, truth)
    for name in ("red", "green", "blue"):  # colours are for viewers, which want them elsewhere
        del columns[name]
    texts = [_texts(column) for column in columns.values()]
    with replacing(path, overwrite=overwrite) as output:
        output.write(f"# {' '.join(columns)}\n".encode())
        output.write("\n".join(map(" ".join, zip(*texts, strict=True))).encode() + b"\n")


def _texts(column: np.ndarray) -> list[str]:
    """Return every number with as many digits as bring it back."""
    if column.dtype == np.float32:
        return [f"{value:.9g}" for value in column.tolist()]
    return list(map(repr, column.tolist()))


def _head(path: Path, text: str) -> tuple[list[str], str | None, int]:
    """Return the column names, the delimiter (None = blanks), and the lines before the numbers."""
    names: list[str] = []
    for number, line in enumerate(io.StringIO(text)):
        bare = line.split("//")[0].strip()
        delimiter = next((mark for mark in (",", ";") if mark in bare), None)
        words = bare.lstrip("#").replace(",", " ").replace(";", " ").split()
        if not words:
            continue
        if not bare.startswith("#") and _numbers(words) and len(words) > 1:
            return names, delimiter, number
        # A single number is the count of points that some programs put first.
        names = [word.strip('"').lower() for word in words]
        if number > _HEAD_LINES:
            break
    raise DataError("there is no row of numbers", path=path, hint=_HINT)


def _numbers(words: list[str]) -> bool:
    """Say whether every word is a number."""
    try:
        [float(word) for word in words]
    except ValueError:
        return False
    return True
