"""Scans, truth and results as NPZ: the plain exchange format, without loss.

A file of ours has the array ``octoseg``: "scans" or "segmentation". In a file without it,
``labels`` are truth (a labelled data set); in a segmentation they are the result.
"""

from __future__ import annotations

import dataclasses
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.files import archives
from octoseg_ti.files.atomic import replacing
from octoseg_ti.files.validation import existing_file, make_scans, make_truth, parsing
from octoseg_ti.types import Scans, Segmentation, SurfaceKind, Truth

MARKER = "octoseg"
_SCANS = tuple(field.name for field in dataclasses.fields(Scans))
_TRUTH = tuple(field.name for field in dataclasses.fields(Truth))
_HINT = "an .npz file of plain arrays is wanted, with `points` (N, 3)"


def load(path: str | Path, names: set[str] | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of an NPZ file.

    Args:
        path: The file.
        names: Which arrays, where they exist; None = all.

    Raises:
        DataError: Missing, damaged, not an NPZ file, or with pickled objects in it.
    """
    path = existing_file(path)
    with parsing(path, "NPZ", _HINT):
        if not zipfile.is_zipfile(path):
            raise DataError("not an NPZ file, or cut off", path=path, hint=_HINT)
        with np.load(path, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files if names is None or key in names}


def read_scans(path: str | Path) -> Scans:
    """Read the scans of an NPZ file: `points` [mm], and what else `Scans` has.

    From a segmentation only its points, stripes and views are taken: normals are estimated anew.

    Raises:
        DataError: See `load` and `make_scans`.
    """
    arrays = load(path, {*_SCANS, MARKER})
    if "points" not in arrays:
        raise DataError("there is no array `points`", path=path, hint=_HINT)
    if _content(arrays) == "segmentation":
        arrays.pop("normals", None)
    with parsing(path, "NPZ", _HINT):
        values: dict[str, Any] = {name: arrays[name] for name in _SCANS if name in arrays}
        for name in ("frame", "name"):
            if name in values:
                values[name] = str(values[name])
        return make_scans(path, values)


def read_truth(path: str | Path) -> Truth | None:
    """Read the truth of an NPZ file, or None when it has none.

    Labels keep their numbers. ``kinds``, one name per label, tells the kind of every surface.

    Raises:
        DataError: See `load` and `make_truth`.
    """
    arrays = load(path)
    with parsing(path, "NPZ", _HINT):
        own = {name: arrays[f"truth_{name}"] for name in _TRUTH if f"truth_{name}" in arrays}
        count = len(np.asarray(arrays["points"])) if "points" in arrays else None
        if "patch" in own:
            values: dict[str, Any] = dict(own)
            if "info" in values:
                values["info"] = str(values["info"])
            return make_truth(path, values, count)
        if _content(arrays) or "labels" not in arrays:
            return None
        values = {"patch": arrays["labels"]}
        if "kinds" in arrays:
            kinds = np.array([_kind(str(name)) for name in arrays["kinds"]], np.int8)
            labels = np.asarray(arrays["labels"])
            known = (labels >= 0) & (labels < len(kinds))
            values["kind"] = np.where(known, kinds[np.where(known, labels, 0)], SurfaceKind.NONE)
        return make_truth(path, values, count)


def read_segmentation(path: str | Path) -> Segmentation:
    """Read a result from an NPZ file that `write` has made.

    Raises:
        DataError: See `load`; or the file holds no result.
    """
    arrays = load(path)
    if _content(arrays) != "segmentation":
        raise DataError(
            "this file holds no result", path=path, hint="make one with `octoseg segment`"
        )
    with parsing(path, "NPZ", _HINT):
        return archives.result_from_arrays(arrays)


def write(
    path: str | Path,
    what: Scans | Segmentation,
    *,
    truth: Truth | None = None,
    overwrite: bool = True,
) -> None:
    """Write scans or a result, and the truth as arrays ``truth_*``.

    Raises:
        DataError: The output cannot be written.
    """
    if isinstance(what, Scans):
        arrays: dict[str, Any] = {MARKER: "scans"}
        for name in _SCANS:
            if getattr(what, name) is not None:
                arrays[name] = getattr(what, name)
    else:
        arrays = {MARKER: "segmentation", **archives.result_arrays(what, per_point=True)}
    if truth is not None:
        for name in _TRUTH:
            value = getattr(truth, name)
            if name == "info":
                value = json.dumps(value)
            if value is not None:
                arrays[f"truth_{name}"] = value
    with replacing(path, overwrite=overwrite) as output:
        output.write(archives.pack(arrays))


def _content(arrays: dict[str, np.ndarray]) -> str:
    """Return what a file of ours holds, or an empty text."""
    return str(arrays[MARKER]) if MARKER in arrays else ""


def _kind(name: str) -> int:
    """Return the `SurfaceKind` of a name such as "plane"; unknown names are free-form."""
    known = {kind.name.lower(): kind for kind in SurfaceKind}
    return int(known.get(name.strip().lower().replace("-", "_"), SurfaceKind.FREE_FORM))
