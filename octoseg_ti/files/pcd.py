"""PCD point clouds of the Point Cloud Library, version 0.7: ascii, binary and binary_compressed."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.files.atomic import replacing
from octoseg_ti.files.columns import MM, rows, scan_values, table
from octoseg_ti.files.lzf import decompress
from octoseg_ti.files.validation import existing_file, make_scans, parsing, read_bytes
from octoseg_ti.types import Scans, Segmentation, Truth

_HINT = "a PCD file (version 0.7) with fields x, y, z is wanted"
_KINDS = {"F": "f", "I": "i", "U": "u"}
_LETTERS = {"f": "F", "i": "I", "u": "U"}


def read_scans(path: str | Path, *, unit: str | None = None) -> Scans:
    """Read points, and normals, stripes, columns, views where they are.

    Rows that are not finite are kept. A viewpoint other than the identity moves the points, as the
    format wants it, and is the probe position.

    Args:
        path: The file.
        unit: "mm" (default) or "m".

    Raises:
        DataError: Missing, damaged, not a PCD, or without points.
    """
    path = existing_file(path)
    with parsing(path, "PCD", _HINT):
        content = read_bytes(path)
        header, start = _header(path, content)
        data = _rows(path, header, content[start:])
        names = set(data.dtype.names or ())
        if not names.issuperset("xyz"):
            raise DataError("there are no fields x, y and z", path=path, hint=_HINT)
        values = scan_values(data, names, MM[unit])
        return make_scans(path, _seen_from(values, header.get("VIEWPOINT", []), MM[unit]))


def write(
    path: str | Path,
    what: Scans | Segmentation,
    *,
    truth: Truth | None = None,
    overwrite: bool = True,
) -> None:
    """Write binary PCD with the columns of the PLY output.

    Colours are packed into one field ``rgb``, as the format has it; normals are named normal_x to
    z.

    Raises:
        DataError: The output cannot be written.
    """
    columns = table(path, what, truth)
    red, green, blue = (columns.pop(name).astype(np.uint32) for name in ("red", "green", "blue"))
    columns["rgb"] = red << 16 | green << 8 | blue
    columns = {
        f"normal_{name[1]}" if name in ("nx", "ny", "nz") else name: value
        for name, value in columns.items()
    }
    data = rows(columns)
    kinds = [value.dtype for value in columns.values()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(columns),
        "SIZE " + " ".join(str(kind.itemsize) for kind in kinds),
        "TYPE " + " ".join(_LETTERS[kind.kind] for kind in kinds),
        "COUNT " + " ".join("1" for _ in kinds),
        f"WIDTH {len(data)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(data)}",
        "DATA binary",
    ]
    with replacing(path, overwrite=overwrite) as output:
        output.write(("\n".join(header) + "\n").encode())
        output.write(data.tobytes())


def _header(path: Path, content: bytes) -> tuple[dict[str, list[str]], int]:
    """Return the words of every header line, and where the data begin."""
    header: dict[str, list[str]] = {}
    start = 0
    while start < len(content):
        end = content.find(b"\n", start)
        if end < 0:
            break
        words = content[start:end].decode("ascii").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
            if words[0].upper() == "DATA":
                return header, start
    raise DataError("not a PCD file: its header does not end", path=path, hint=_HINT)


def _layout(header: dict[str, list[str]]) -> np.dtype:
    """Return the dtype of a row; nameless padding fields get names of their own."""
    fields: list[Any] = []
    names = header["FIELDS"]
    counts = header.get("COUNT", ["1"] * len(names))
    for i, (name, size, kind, count) in enumerate(
        zip(names, header["SIZE"], header["TYPE"], counts, strict=True)
    ):
        if int(count) < 1:
            raise ValueError(f"field {name} has count {count}")
        kind = f"<{_KINDS[kind]}{int(size)}"
        entry = (f"_{i}" if name == "_" else name, kind)
        fields.append(entry if int(count) == 1 else (*entry, (int(count),)))
    return np.dtype(fields)


def _rows(path: Path, header: dict[str, list[str]], data: bytes) -> np.ndarray:
    """Return the points as structured rows.

    Raises:
        DataError: There are fewer points than the header says.
    """
    layout = _layout(header)
    count = int(header["WIDTH"][0]) * int(header.get("HEIGHT", ["1"])[0])
    count = int(header.get("POINTS", [str(count)])[0])
    form = header["DATA"][0].lower()
    if form == "ascii":
        flat = _flat(layout)
        found = np.loadtxt(io.StringIO(data.decode("ascii")), dtype=flat, ndmin=1)
        found = found.view(layout)
    elif form == "binary":
        found = np.frombuffer(data[: count * layout.itemsize], layout)
    elif form == "binary_compressed":
        found = _unpacked(layout, count, data)
    else:
        raise DataError(f"unknown data form {form!r}", path=path, hint=_HINT)
    if len(found) != count:
        what = f"cut off: {len(found)} of {count} points"
        raise DataError(what, path=path, hint="fetch or write it again")
    return found


def _flat(layout: np.dtype) -> np.dtype:
    """Return the layout with a column for every number of a field."""
    flat = []
    assert layout.fields is not None
    for name in layout.names or ():
        kind = layout.fields[name][0]
        size = int(np.prod(kind.shape)) if kind.shape else 1
        flat += [(f"{name}__{k}", kind.base.str) for k in range(size)]
    return np.dtype(flat)


def _unpacked(layout: np.dtype, count: int, data: bytes) -> np.ndarray:
    """Return the rows of compressed data, which holds one field after the other."""
    packed, size = np.frombuffer(data[:8], "<u4").tolist()
    if size != count * layout.itemsize or packed > len(data) - 8:
        raise ValueError("the compressed block does not fit the header")
    plain = decompress(data[8 : 8 + packed], size)
    found = np.empty(count, layout)
    start = 0
    assert layout.fields is not None
    for name in layout.names or ():
        kind = layout.fields[name][0]
        end = start + count * kind.itemsize
        found[name] = np.frombuffer(plain[start:end], kind.base).reshape((count, *kind.shape))
        start = end
    return found


def _seen_from(values: dict[str, Any], viewpoint: list[str], scale: float) -> dict[str, Any]:
    """Apply VIEWPOINT (tx ty tz qw qx qy qz) to the values of a scan."""
    place = [float(word) for word in viewpoint]
    if len(place) != 7 or place == [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]:
        return values
    from octoseg_ti.files.poses import moved, pose

    w, x, y, z = place[3:]
    matrix = pose((x, y, z, w), scale * np.array(place[:3]))
    values["points"] = moved(matrix, values["points"])
    if "normals" in values:
        values["normals"] = values["normals"] @ matrix[:3, :3].T
    values["origin"] = matrix[None, :3, 3]
    return values
