"""The rows of the cloud topics: what a point of a stripe, and of its truth, has in a recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from octoseg_ti.files.messages import METRE
from octoseg_ti.files.poses import moved
from octoseg_ti.palette import SCAN_COLOR, colors
from octoseg_ti.types import Scans, Truth

RESOLUTION_MM = 1e-3
"""Single-precision metres are used while they keep positions to 1 um."""

ERROR_STEP_MM = 1e-4
"""Unit of the field ``error_100nm`` of ``/truth/lines``."""

RGBA = [("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1")]
NORMAL = [("normal_x", "<f4"), ("normal_y", "<f4"), ("normal_z", "<f4")]


def needs_double(points: np.ndarray) -> bool:
    """Say whether single-precision metres would move a point [mm] by more than 1 um."""
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = (points / METRE).astype(np.float32).astype(np.float64) * METRE
        finite = np.isfinite(points)
        return bool(np.any(np.abs(rounded - points)[finite] > RESOLUTION_MM))


def put_columns(rows: np.ndarray, names: str | tuple[str, ...], values: np.ndarray) -> None:
    """Copy the columns of an (N, k) array into k fields of structured rows."""
    with np.errstate(over="ignore"):
        for i, name in enumerate(names):
            rows[name] = values[:, i]


def put_colors(rows: np.ndarray, rgba: np.ndarray) -> None:
    """Copy RGBA u8, shape (N, 4) or (4,), into the colour fields of structured rows."""
    for i, (name, _) in enumerate(RGBA):
        rows[name] = rgba[..., i]


def positions(rows: np.ndarray) -> np.ndarray:
    """Return the positions [mm] in structured rows, shape (N, 3), f64."""
    return np.stack([rows[name].astype(np.float64) for name in "xyz"], axis=1) * METRE


def in_world(scans: Scans) -> tuple[np.ndarray, np.ndarray | None]:
    """Return points and normals in the world frame."""
    points, normals = scans.points, scans.normals
    if scans.frame == "world":
        return points, normals
    assert scans.T_world_view is not None  # `Scans` in the view frame have poses
    view = np.zeros(len(points), np.int32) if scans.view is None else scans.view
    points = points.copy()
    normals = None if normals is None else normals.copy()
    for k in np.unique(view).tolist():
        mine = view == k
        points[mine] = moved(scans.T_world_view[k], points[mine])
        if normals is not None:
            normals[mine] = normals[mine] @ scans.T_world_view[k][:3, :3].T
    return points, normals


def scan_rows(
    scans: Scans,
    points: np.ndarray,
    normals: np.ndarray | None,
    truth: Truth | None,
    position: str,
) -> np.ndarray:
    """Return the rows of /scan/lines, shape (N,).

    Args:
        scans: The scans.
        points: Their points [mm], world frame, shape (N, 3).
        normals: Their normals, world frame, shape (N, 3).
        truth: Their truth, whose rows get the same stride.
        position: Type of x, y and z, "<f4" or "<f8".
    """
    fields = [("x", position), ("y", position), ("z", position)]
    if normals is not None:
        fields += NORMAL
    if scans.column is not None:
        fields.append(("column", "<u4"))
    if scans.view is not None:
        fields.append(("view", "<u2"))
    layout = np.dtype(fields + RGBA)
    if truth is not None:
        layout = _padded(layout, _truth_dtype(truth, position).itemsize)
    rows = np.zeros(len(points), layout)
    put_columns(rows, "xyz", points / METRE)
    if normals is not None:
        put_columns(rows, ("normal_x", "normal_y", "normal_z"), normals)
    for name in ("column", "view"):
        if name in (rows.dtype.names or ()):
            rows[name] = getattr(scans, name)
    put_colors(rows, np.array(SCAN_COLOR, np.uint8))
    return rows


def truth_rows(truth: Truth, scan: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the rows of /truth/lines: measured positions, ids, true normals, error, colours.

    Args:
        truth: The truth.
        scan: The rows of /scan/lines, shape (N,).
        points: Measured positions as the rows hold them [mm], world frame, shape (N, 3).
    """
    assert scan.dtype.fields is not None
    layout = _truth_dtype(truth, scan.dtype.fields["x"][0].str)
    rows = np.zeros(len(points), _padded(layout, scan.dtype.itemsize))
    for name in "xyz":
        rows[name] = scan[name]
    rows["patch"] = truth.patch
    if truth.surface is not None:
        rows["surface_id"] = truth.surface
    if truth.normal is not None:
        put_columns(rows, ("normal_x", "normal_y", "normal_z"), truth.normal)
    if truth.position is not None and truth.normal is not None:
        error = np.einsum("ij,ij->i", points - truth.position, truth.normal) / ERROR_STEP_MM
        rows["error_100nm"] = np.clip(np.rint(np.nan_to_num(error)), -32767, 32767)
    if truth.artefact is not None:
        rows["artefact"] = truth.artefact
    put_colors(rows, colors(truth.patch))
    return rows


_PER_POINT = ("patch", "surface", "kind", "position", "normal", "edge_distance", "edge_class",
              "radius", "artefact")  # fmt: skip


def part_of(truth: Truth, rows: slice) -> Truth:
    """Return the truth of some points."""
    values = {name: getattr(truth, name) for name in _PER_POINT}
    picked: dict[str, Any] = {n: None if v is None else v[rows] for n, v in values.items()}
    return replace(truth, **picked)


def joined(pieces: list[Truth]) -> Truth:
    """Return the truth of all pieces, one after the other."""
    if len(pieces) == 1:
        return pieces[0]
    fields: dict[str, Any] = {}
    for name in _PER_POINT:
        values = [getattr(piece, name) for piece in pieces]
        if all(value is not None for value in values):
            fields[name] = np.concatenate(values)
    return Truth(info=pieces[0].info, T_world_view=pieces[0].T_world_view, **fields)


def _truth_dtype(truth: Truth, position: str) -> np.dtype:
    """Return the fields of /truth/lines for what this truth knows."""
    fields = [(name, position) for name in "xyz"] + [("patch", "<i4")]
    if truth.surface is not None:
        fields.append(("surface_id", "<i4"))
    if truth.normal is not None:
        fields += NORMAL
    if truth.position is not None and truth.normal is not None:
        fields.append(("error_100nm", "<i2"))
    if truth.artefact is not None:
        fields.append(("artefact", "|u1"))
    return np.dtype(fields + RGBA)


def _padded(layout: np.dtype, stride: int) -> np.dtype:
    """Return a layout of at least this stride.

    Stripe and truth lie side by side in a chunk, and begin with the same positions: with one stride
    for both, these repeat at a fixed distance, which the compressor finds.
    """
    if layout.itemsize >= stride:
        return layout
    assert layout.fields is not None and layout.names is not None
    fields = [layout.fields[name] for name in layout.names]
    wide = {
        "names": list(layout.names),
        "formats": [field[0] for field in fields],
        "offsets": [field[1] for field in fields],
        "itemsize": stride,
    }
    return np.dtype(wide)  # type: ignore[call-overload]
