"""E57 scans, by pye57: every scan is a view with its pose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from octoseg_ti.errors import MissingPackageError
from octoseg_ti.files.columns import MM
from octoseg_ti.files.validation import existing_file, make_scans, parsing
from octoseg_ti.types import Scans

_HINT = "an E57 file with cartesian or spherical points is wanted"


def read_scans(path: str | Path, *, unit: str | None = None) -> Scans:
    """Read all scans of the file, moved to the file's common frame.

    Where points have row and column numbers, a column is a stripe: points are then put in the order
    of columns and rows.

    Args:
        path: The file.
        unit: "mm" or "m"; default: m, as the standard has it.

    Raises:
        DataError: Missing, damaged, not an E57 file, or without points.
        MissingPackageError: pye57 is not installed.
    """
    path = existing_file(path)
    try:
        import pye57  # type: ignore[import-untyped,unused-ignore]
    except ImportError as error:
        raise MissingPackageError("pye57", "e57", "reading E57") from error
    scale = MM[unit or "m"]
    with parsing(path, "E57", _HINT):
        file = pye57.E57(str(path))
        try:
            pieces = [_one(file, k, scale) for k in range(file.scan_count)]
        finally:
            file.close()
        if not pieces:
            raise ValueError("there is no scan in it")
        values: dict[str, Any] = {
            "points": np.concatenate([piece["points"] for piece in pieces]),
            "T_world_view": np.stack([piece["pose"] for piece in pieces]),
            "origin": np.stack([piece["pose"][:3, 3] for piece in pieces]),
        }
        lengths = [len(piece["points"]) for piece in pieces]
        values["view"] = np.repeat(np.arange(len(pieces)), lengths)
        if all("stripe" in piece for piece in pieces):
            for name in ("stripe", "column"):
                values[name] = np.concatenate([piece[name] for piece in pieces])
        return make_scans(path, values)


def _one(file: Any, index: int, scale: float) -> dict[str, Any]:
    """Return points [mm], pose and grid numbers of one scan."""
    header = file.get_header(index)
    raw = file.read_scan(
        index, ignore_missing_fields=True, row_column="rowIndex" in header.point_fields
    )
    points = np.stack([raw[f"cartesian{axis}"] for axis in "XYZ"], axis=1).astype(np.float64)
    pose = np.eye(4)
    if header.has_pose():
        pose[:3, :3] = header.rotation_matrix
        pose[:3, 3] = scale * np.asarray(header.translation, np.float64)
    piece: dict[str, Any] = {"points": points * scale, "pose": pose}
    if "rowIndex" in raw and "columnIndex" in raw:
        row, column = np.asarray(raw["rowIndex"]), np.asarray(raw["columnIndex"])
        order = np.lexsort((row, column))
        piece |= {"points": piece["points"][order], "stripe": column[order], "column": row[order]}
    return piece
