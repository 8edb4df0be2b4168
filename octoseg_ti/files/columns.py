"""Scans and results as a table with a row per point, for formats that are tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.palette import SCAN_COLOR, colors
from octoseg_ti.types import Scans, Segmentation, Truth

MM = {"mm": 1.0, "m": 1000.0, None: 1.0}
"""Millimetres in a unit; None is the default of formats that do not know theirs."""


def table(
    path: str | Path, what: Scans | Segmentation, truth: Truth | None = None
) -> dict[str, np.ndarray]:
    """Return the columns of a point table, each of shape (N,), in the order of the file.

    Args:
        path: The output, for messages.
        what: Scans or a result.
        truth: Adds ``truth_patch`` and what else it knows.

    Raises:
        DataError: Scans in the view frame; a table has no room for poses.
    """
    if isinstance(what, Scans) and what.frame != "world":
        raise DataError(
            "a point table has no room for the poses of the views",
            path=path,
            hint="write .mcap or .npz, or points in the world frame",
        )
    columns: dict[str, np.ndarray] = dict(zip("xyz", what.points.T, strict=True))
    if what.normals is not None:
        columns |= {f"n{axis}": what.normals[:, i] for i, axis in enumerate("xyz")}
    if isinstance(what, Segmentation):
        columns["label"] = what.labels
        names: tuple[str, ...] = ("edge", "level", "outlier", "stripe", "view")
        if what.fillets is not None:
            columns["fillet"] = what.fillets.point
        rgba = colors(what.labels)
    else:
        names = ("stripe", "column", "view")
        labels = None if truth is None else truth.patch
        rgba = np.tile(np.array(SCAN_COLOR, np.uint8), (len(what), 1))
        rgba = rgba if labels is None else colors(labels)
    columns |= {name: getattr(what, name) for name in names if getattr(what, name) is not None}
    columns |= {name: rgba[:, i] for i, name in enumerate(("red", "green", "blue"))}
    if truth is not None:
        for name in (
            "patch",
            "surface",
            "kind",
            "edge_distance",
            "edge_class",
            "radius",
            "artefact",
        ):
            if getattr(truth, name) is not None:
                columns[f"truth_{name}"] = getattr(truth, name)
    return columns


def rows(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Return the columns as packed little-endian structured rows, shape (N,)."""
    layout = [(name, value.dtype.newbyteorder("<").str) for name, value in columns.items()]
    table_rows = np.empty(len(columns["x"]), np.dtype(layout))
    for name, value in columns.items():
        table_rows[name] = value
    return table_rows


def scan_values(data: Any, names: set[str], scale: float) -> dict[str, Any]:
    """Return the fields of `Scans` from a table with named columns.

    A table with labels is a result of ours: its normals are not taken over, they are estimated
    anew.

    Args:
        data: Anything that gives a column for ``data[name]``.
        names: Its columns.
        scale: Millimetres in its unit.

    Raises:
        KeyError: There is no x, y or z.
    """
    values: dict[str, Any] = {
        "points": np.stack([np.asarray(data[axis], np.float64) for axis in "xyz"], axis=1) * scale
    }
    for triple in (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")):
        if names.issuperset(triple) and "label" not in names:
            values["normals"] = np.stack([np.asarray(data[n], np.float64) for n in triple], axis=1)
    for name in ("stripe", "column", "view"):
        if name in names:
            values[name] = np.asarray(data[name])
    return values
