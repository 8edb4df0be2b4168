"""PLY point clouds, ASCII and binary, and Stanford's range grids."""

from __future__ import annotations

import gzip
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from plyfile import (  # type: ignore[import-untyped,unused-ignore]
    PlyData,
    PlyElement,
    PlyElementParseError,
)

from octoseg_ti import __version__
from octoseg_ti.errors import DataError
from octoseg_ti.files import range_grid
from octoseg_ti.files.atomic import replacing
from octoseg_ti.files.columns import MM, rows, scan_values, table
from octoseg_ti.files.validation import existing_file, make_scans, parsing
from octoseg_ti.types import Fillets, Scans, Segmentation, Truth

_HINT = "a PLY file with an element `vertex` of x, y, z is wanted"


def read_scans(path: str | Path, *, unit: str | None = None) -> Scans:
    """Read points, and normals, stripes, columns, views where they are.

    A file with an element ``range_grid`` is read by the columns of its grid (`range_grid`).

    Args:
        path: .ply or .ply.gz
        unit: "mm" or "m"; default: mm, and m for Cyberware range grids, which say what they are.

    Raises:
        DataError: Missing, damaged, not a PLY, or without points.
    """
    path = existing_file(path)
    with parsing(path, "PLY", _HINT), _opened(path) as stream:
        header = _header(stream)
        names = [element[0] for element in header.elements]
        if "range_grid" in names and header.form == "ascii":
            points, vertex = range_grid.from_text(stream.read(), header.elements)
            return range_grid.grid_scans(path, points, vertex, header.info, unit)
        content = _content(stream, header)
        if "vertex" not in content:
            raise DataError("there is no element `vertex`", path=path, hint=_HINT)
        vertices = content["vertex"].data
        fields = set(vertices.dtype.names or ())
        if not fields.issuperset("xyz"):
            raise DataError("the vertices have no x, y and z", path=path, hint=_HINT)
        if "range_grid" in names:
            points, vertex = range_grid.from_elements(content)
            return range_grid.grid_scans(path, points, vertex, header.info, unit)
        return make_scans(path, scan_values(vertices, fields, MM[unit]))


def write(
    path: str | Path,
    what: Scans | Segmentation,
    *,
    truth: Truth | None = None,
    overwrite: bool = True,
) -> None:
    """Write binary PLY: a vertex property for everything that a point has, colours by label.

    A result also has an element ``patch`` with kind, surface, residual, parameters, and the upper
    triangle of their covariance by rows (``cov_px_px``, ``cov_px_py``, ... ``cov_b_b``), and an
    element ``fillet`` with the patches that a fillet runs between, its radius and the deviation of
    that.

    Raises:
        DataError: The output cannot be written.
    """
    elements = [PlyElement.describe(rows(table(path, what, truth)), "vertex")]
    if isinstance(what, Segmentation):
        elements.append(PlyElement.describe(_patch_rows(what), "patch"))
        if what.fillets is not None:
            elements.append(PlyElement.describe(_fillet_rows(what.fillets), "fillet"))
    comments = [f"octoseg {__version__}", "unit mm", "edge 0 none, 1 sharp, 2 fillet, 3 smooth"]
    content = PlyData(elements, byte_order="<", comments=comments)
    with replacing(path, overwrite=overwrite) as output:
        content.write(output.file)


def _patch_rows(result: Segmentation) -> np.ndarray:
    """Return a row per patch: kind, surface, residual [mm], parameters and their covariance."""
    names = ("px", "py", "pz", "ax", "ay", "az", "a", "b")
    pairs = {
        f"cov_{one}_{other}": (i, j)
        for i, one in enumerate(names)
        for j, other in enumerate(names)
        if i <= j
    }
    layout = [("kind", "i1"), ("surface", "<i4"), ("residual", "<f8")]
    layout += [(name, "<f8") for name in (*names, *pairs)]
    patches = np.empty(result.patch_count, np.dtype(layout))
    for name in ("kind", "surface", "residual"):
        patches[name] = getattr(result, name)
    for i, name in enumerate(names):
        patches[name] = result.parameters[:, i]
    for name, (i, j) in pairs.items():
        patches[name] = result.covariance[:, i, j]
    return patches


def _fillet_rows(fillets: Fillets) -> np.ndarray:
    """Return a row per fillet: its two patches, radius and deviation [mm], side and points."""
    layout = [
        ("patch_a", "<i4"), ("patch_b", "<i4"), ("radius", "<f8"), ("deviation", "<f8"),
        ("concave", "u1"), ("points", "<i4"),
    ]  # fmt: skip
    found = np.empty(len(fillets), np.dtype(layout))
    found["patch_a"], found["patch_b"] = fillets.patches.T
    for name in ("radius", "deviation", "concave", "points"):
        found[name] = getattr(fillets, name)
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class _Header:
    """What must be known of a file before plyfile reads it."""

    form: str
    elements: list[tuple[str, int, list[str]]]
    lists: dict[str, dict[str, int]]
    info: dict[str, str]


@contextmanager
def _opened(path: Path) -> Iterator[IO[bytes]]:
    """Give the file, unpacked into a nameless one if compressed: plyfile maps real files."""
    if path.suffix.lower() != ".gz":
        with open(path, "rb") as stream:
            yield stream
    else:
        with tempfile.TemporaryFile() as stream, gzip.open(path, "rb") as packed:
            shutil.copyfileobj(packed, stream)
            stream.seek(0)
            yield stream


def _header(stream: IO[bytes]) -> _Header:
    """Read the header, and leave the stream behind it.

    Raises:
        ValueError: This is no PLY header.
    """
    if stream.readline(8).strip() != b"ply":
        raise ValueError("it does not begin with ply")
    form, info = "", []
    elements: list[tuple[str, int, list[str]]] = []
    lists: dict[str, dict[str, int]] = {}
    while True:
        line = stream.readline(4096).decode("ascii")
        words = line.split()
        if not line or words[:1] == ["end_header"]:
            break
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["obj_info"]:
            info.append(line.split(None, 1)[1])
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1][2].append(words[-1])
            if words[1] == "list":
                # A guess for meshes; plyfile says so when a face is no triangle.
                lists.setdefault(elements[-1][0], {})[words[-1]] = 3
    if not line:
        raise ValueError("the header does not end")
    return _Header(form=form, elements=elements, lists=lists, info=range_grid.info_of(info))


def _content(stream: IO[bytes], header: _Header) -> PlyData:
    """Read everything by plyfile; triangle lists at once, other lists one by one."""
    if header.lists:
        stream.seek(0)
        try:
            return PlyData.read(stream, known_list_len=header.lists)
        except PlyElementParseError:
            pass  # lists of other lengths, or a damaged file: the plain way tells
    stream.seek(0)
    return PlyData.read(stream)
