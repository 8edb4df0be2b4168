"""The door: what a file says becomes `Scans` and `Truth`, or one clear line.

Points that are not finite pass: the pipeline marks them, and rows keep their places.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from octoseg_ti.errors import DataError, MissingPackageError
from octoseg_ti.types import Scans, Truth

_I32 = np.iinfo(np.int32)


@contextmanager
def parsing(path: str | Path, kind: str, hint: str = "") -> Iterator[None]:
    """Turn whatever a parser raises on damaged bytes into one `DataError`.

    Parsers leak what they were built from (struct, zlib, codec, attribute and memory errors), so
    every `Exception` counts as "these bytes are not such a file"; the cause stays chained.

    Raises:
        DataError: The block failed.
    """
    try:
        yield
    except (DataError, MissingPackageError):
        raise
    except FileNotFoundError as error:
        raise DataError("no such file", path=path, hint="check the name") from error
    except OSError as error:
        what = f"cannot be read: {error.strerror or error}"
        raise DataError(what, path=path, hint=hint or "check the file") from error
    except Exception as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise DataError(f"not a readable {kind} file ({reason})", path=path, hint=hint) from error


def existing_file(path: str | Path) -> Path:
    """Return the path of a file that is there and not empty.

    Raises:
        DataError: Missing, a folder, or without a byte.
    """
    path = Path(path)
    if path.is_dir():
        raise DataError("this is a folder", path=path, hint="name a file")
    if not path.exists():
        raise DataError("no such file", path=path, hint="check the name")
    if path.is_file() and path.stat().st_size == 0:
        raise DataError("the file is empty", path=path, hint="write or fetch it again")
    return path


def read_bytes(path: Path) -> bytes:
    """Return the bytes of a file, unpacked when its name ends in ``.gz``."""
    if path.suffix.lower() == ".gz":
        with gzip.open(path, "rb") as packed:
            return packed.read()
    return path.read_bytes()


def make_scans(path: str | Path | None, values: dict[str, Any]) -> Scans:
    """Check the arrays of a file, bring them to the types of `Scans`, and build it.

    Stripe numbers that start again in every view are made unique by an offset per view.

    Args:
        path: The file, for messages.
        values: The fields of `Scans` that the file has; None or a missing key = not there.

    Raises:
        DataError: No points, a wrong shape or type, a stripe in pieces, a pose that is none.
    """
    given = {key: value for key, value in values.items() if value is not None}
    points = _rows(path, "points", given["points"])
    n = len(points)
    if n == 0:
        raise DataError("there are no points", path=path, hint="give at least one point")
    normals = _rows(path, "normals", given["normals"], n) if "normals" in given else None
    stripe = _integers(path, "stripe", given["stripe"], n) if "stripe" in given else None
    column = _integers(path, "column", given["column"], n) if "column" in given else None
    view = _integers(path, "view", given["view"], n) if "view" in given else None
    time_ns = None
    if "time_ns" in given:
        time_ns = _integers(path, "time_ns", given["time_ns"], n, np.int64)
    for name, array in (("stripe", stripe), ("column", column), ("view", view)):
        if array is not None and int(array.min()) < 0:
            raise DataError(f"{name} has negative numbers", path=path, hint="count from 0")
    if stripe is not None:
        stripe, renumbered = _whole_stripes(path, stripe, view)
        if renumbered and "stripe_origin" in given:
            what = "stripe numbers occur in several views, so stripe_origin is ambiguous"
            raise DataError(what, path=path, hint="number the stripes through all views")
    poses = _poses(path, given.get("T_world_view"))
    views = 1 if view is None else int(view.max()) + 1
    if poses is not None and len(poses) < views:
        what = f"T_world_view has {len(poses)} poses for {views} views"
        raise DataError(what, path=path, hint="give one 4x4 matrix per view")
    origin = _rows(path, "origin", given["origin"]) if "origin" in given else None
    if origin is not None and len(origin) < views:
        what = f"origin has {len(origin)} rows for {views} views"
        raise DataError(what, path=path, hint="give one probe position per view")
    stripe_origin = None
    if "stripe_origin" in given:
        stripe_origin = _rows(path, "stripe_origin", given["stripe_origin"])
        if stripe is None or len(stripe_origin) < int(stripe.max()) + 1:
            what = f"stripe_origin has {len(stripe_origin)} rows, fewer than the stripes"
            raise DataError(what, path=path, hint="give one probe position per stripe")
    frame = str(given.get("frame", "world"))
    if frame not in ("world", "view"):
        raise DataError(f"frame is {frame!r}", path=path, hint='use "world" or "view"')
    if frame == "view" and poses is None:
        raise DataError('frame is "view" without T_world_view', path=path, hint="give the poses")
    name = str(given.get("name", "")) or ("" if path is None else Path(path).name)
    return Scans(
        points=points, normals=normals, stripe=stripe, column=column, view=view, time_ns=time_ns,
        T_world_view=poses, origin=origin, stripe_origin=stripe_origin, frame=frame, name=name,
    )  # fmt: skip


def make_truth(path: str | Path | None, values: dict[str, Any], count: int | None = None) -> Truth:
    """Check the arrays of a file, bring them to the types of `Truth`, and build it.

    Args:
        path: The file, for messages.
        values: The fields of `Truth` that the file has; ``info`` may be JSON text.
        count: Number of points that the arrays must have.

    Raises:
        DataError: A wrong shape or type, or a label below -1.
    """
    given = {key: value for key, value in values.items() if value is not None}
    n = len(np.asarray(given["patch"])) if count is None else count
    fields: dict[str, Any] = {}
    for name, dtype in (
        ("patch", np.int32),
        ("surface", np.int32),
        ("kind", np.int8),
        ("edge_class", np.uint8),
        ("artefact", np.uint8),
    ):
        if name in given:
            fields[name] = _integers(path, name, given[name], n, dtype)
    if int(fields["patch"].min(initial=0)) < -1:
        raise DataError("truth labels below -1", path=path, hint="use -1 for unlabelled points")
    for name in ("position", "normal"):
        if name in given:
            fields[name] = _rows(path, name, given[name], n)
    for name in ("edge_distance", "radius"):
        if name in given:
            length = np.asarray(given[name])
            if length.shape != (n,) or length.dtype.kind not in "fiu":
                what = f"{name} has shape {length.shape}, not ({n},)"
                raise DataError(what, path=path, hint="give one length per point")
            fields[name] = np.ascontiguousarray(length, np.float32)
    fields["T_world_view"] = _poses(path, given.get("T_world_view"))
    info = given.get("info", {})
    fields["info"] = json.loads(info) if isinstance(info, str) else dict(info)
    return Truth(**fields)


def runs(stripe: np.ndarray, view: np.ndarray | None) -> np.ndarray:
    """Return the first row of every stripe, and N at the end, shape (runs + 1,), i64."""
    change = stripe[1:] != stripe[:-1]
    if view is not None:
        change = change | (view[1:] != view[:-1])
    return np.concatenate([[0], np.flatnonzero(change) + 1, [len(stripe)]])


def _whole_stripes(
    path: str | Path | None, stripe: np.ndarray, view: np.ndarray | None
) -> tuple[np.ndarray, bool]:
    """Return unique stripe numbers, and whether they had to be changed."""
    first = runs(stripe, view)[:-1]
    number = stripe[first]
    run_view = np.zeros(len(first), np.int64) if view is None else view[first].astype(np.int64)
    order = np.argsort(run_view, kind="stable")
    same_view = run_view[order][1:] == run_view[order][:-1]
    step = np.diff(number[order].astype(np.int64))
    pairs = run_view * (int(_I32.max) + 1) + number
    if len(np.unique(pairs)) < len(pairs):
        what = "the points of a stripe are not stored one after the other"
        raise DataError(what, path=path, hint="sort the points by view and stripe")
    if np.any(same_view & (step < 0)):
        what = "stripe numbers go down within a view"
        raise DataError(what, path=path, hint="store the stripes in scan order")
    if len(np.unique(number)) == len(number):
        return stripe, False
    assert view is not None  # equal numbers in different runs need several views
    spans = np.zeros(int(run_view.max()) + 1, np.int64)
    np.maximum.at(spans, run_view, number.astype(np.int64) + 1)
    offset = np.concatenate([[0], np.cumsum(spans)[:-1]])
    unique = stripe + offset[view]
    if int(unique.max()) > _I32.max:
        raise DataError("stripe numbers are too large", path=path, hint="number them from 0")
    return unique.astype(np.int32), True


def _rows(path: str | Path | None, name: str, value: Any, n: int | None = None) -> np.ndarray:
    """Return an (N, 3) f64 array."""
    array = np.asarray(value)
    wanted = f"({'N' if n is None else n}, 3)"
    if array.ndim != 2 or array.shape[1] != 3 or (n is not None and len(array) != n):
        what = f"{name} has shape {array.shape}, not {wanted}"
        raise DataError(what, path=path, hint="store one row of three numbers per point")
    if array.dtype.kind not in "fiu":
        what = f"{name} holds {array.dtype}, not numbers"
        raise DataError(what, path=path, hint="use float32 or float64")
    return np.ascontiguousarray(array, np.float64)


def _integers(
    path: str | Path | None, name: str, value: Any, n: int, dtype: Any = np.int32
) -> np.ndarray:
    """Return an (N,) integer array; whole numbers stored as floats are accepted."""
    array = np.asarray(value)
    if array.shape != (n,):
        what = f"{name} has shape {array.shape}, not ({n},)"
        raise DataError(what, path=path, hint="give one number per point")
    limits = np.iinfo(dtype)
    whole = array.dtype.kind in "iub"
    if array.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            whole = bool(np.all(np.isfinite(array) & (array == np.rint(array))))
    if not whole:
        raise DataError(f"{name} must be whole numbers", path=path, hint="use int32")
    if n and (int(array.min()) < limits.min or int(array.max()) > limits.max):
        what = f"{name} does not fit {np.dtype(dtype).name}"
        raise DataError(what, path=path, hint="use smaller numbers")
    return np.ascontiguousarray(array, dtype)


def _poses(path: str | Path | None, value: Any) -> np.ndarray | None:
    """Return (V, 4, 4) f64 rigid poses, or None."""
    if value is None:
        return None
    poses = np.asarray(value)
    if poses.ndim == 2:
        poses = poses[None]
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or poses.dtype.kind not in "fiu":
        what = f"T_world_view has shape {np.shape(value)}, not (V, 4, 4)"
        raise DataError(what, path=path, hint="give one 4x4 matrix per view")
    poses = np.ascontiguousarray(poses, np.float64)
    rotation = poses[:, :3, :3]
    rigid = (
        np.isfinite(poses).all()
        and np.allclose(poses[:, 3], [0.0, 0.0, 0.0, 1.0], atol=1e-9)
        and np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-4)
        and np.all(np.linalg.det(rotation) > 0)
    )
    if not rigid:
        what = "T_world_view holds a matrix that is not a rotation and a translation"
        raise DataError(what, path=path, hint="give rigid poses, view to world, in mm")
    return poses
