"""LAS and LAZ point clouds, by laspy."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from octoseg_ti.errors import MissingPackageError
from octoseg_ti.files.columns import MM
from octoseg_ti.files.validation import existing_file, make_scans, parsing
from octoseg_ti.types import Scans

_HINT = "a LAS or LAZ file is wanted"


def read_scans(path: str | Path, *, unit: str | None = None) -> Scans:
    """Read the points; what else LAS holds says nothing about the shape.

    Args:
        path: .las or .laz
        unit: "mm" or "m"; default: m.

    Raises:
        DataError: Missing, damaged, not a LAS file, or without points.
        MissingPackageError: laspy, or a LAZ backend, is not installed.
    """
    path = existing_file(path)
    try:
        import laspy  # type: ignore[import-untyped,unused-ignore]
    except ImportError as error:
        raise MissingPackageError("laspy", "las", "reading LAS and LAZ") from error
    if path.suffix.lower() == ".laz" and not laspy.LazBackend.detect_available():
        raise MissingPackageError("lazrs", "las", "reading LAZ")
    with parsing(path, "LAS", _HINT):
        cloud = laspy.read(io.BytesIO(path.read_bytes()))
        expected = cloud.header.point_count
        if len(cloud.points) != expected:
            raise ValueError(f"cut off: {len(cloud.points)} of {expected} points")
        points = np.stack([cloud.x, cloud.y, cloud.z], axis=1).astype(np.float64)
        return make_scans(path, {"points": points * MM[unit or "m"]})
