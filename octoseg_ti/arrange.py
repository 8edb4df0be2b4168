"""From what the user gave to what the stages take: usable rows, whole stripes, views 0..V-1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from octoseg_ti.alignment import Registration
from octoseg_ti.errors import DataError
from octoseg_ti.types import Scans

_LONG_PIECE = 50  # rows; pieces that are shorter on average are gathered row by row


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Arranged:
    """The usable points, stripe after stripe."""

    row: np.ndarray
    """Row of the input that every point came from, shape (n,), i64."""
    points: np.ndarray
    """Positions [mm], shape (n, 3), f64."""
    normals: np.ndarray | None
    """Unit normals of the input, shape (n, 3), f64."""
    view: np.ndarray
    """View of every point, shape (n,), i32, 0..V-1."""
    run: np.ndarray | None
    """Index of the stripe of every point, shape (n,), i32; None for unorganised points."""
    start: np.ndarray | None
    """First point of every stripe, and n at the end, shape (S + 1,), i32."""
    whole: bool
    """Every row of the input is there, in its order."""


def as_scans(
    data: Scans | np.ndarray,
    normals: np.ndarray | None = None,
    stripe: np.ndarray | None = None,
    view: np.ndarray | None = None,
) -> Scans:
    """Return the input as checked `Scans`.

    Raises:
        DataError: A shape is wrong, there is no point, a stripe or view number is negative, or the
            poses are missing; the message names the array.
    """
    if isinstance(data, Scans):
        if normals is not None or stripe is not None or view is not None:
            raise DataError("give normals, stripe and view inside the scans, not beside them")
        scans = data
    else:
        scans = Scans(points=data, normals=normals, stripe=stripe, view=view)
    points = _rows("points", scans.points, None)
    if len(points) == 0:
        raise DataError("there are no points")
    n = len(points)
    checked: dict[str, Any] = {
        "points": points,
        "normals": None if scans.normals is None else _rows("normals", scans.normals, n),
        "stripe": _numbers("stripe", scans.stripe, n),
        "view": _numbers("view", scans.view, n),
    }
    if scans.frame not in ("world", "view"):
        raise DataError(f"frame must be 'world' or 'view', not {scans.frame!r}")
    views = 1 if checked["view"] is None else int(checked["view"].max()) + 1
    if scans.frame == "view" and scans.T_world_view is None:
        raise DataError("points in the frame of their view need T_world_view")
    for name, shape in (("T_world_view", (4, 4)), ("origin", (3,))):
        value = getattr(scans, name)
        if value is None:
            continue
        value = np.asarray(value, np.float64)
        if value.shape[1:] != shape or len(value) < views or not np.all(np.isfinite(value)):
            raise DataError(
                f"{name} must be finite and of shape ({views}, {', '.join(map(str, shape))}), "
                f"not {value.shape}"
            )
        checked[name] = value
    if scans.stripe_origin is not None:
        places = np.asarray(scans.stripe_origin, np.float64)
        stripe = checked["stripe"]
        stripes = 0 if stripe is None else int(stripe.max()) + 1
        if places.shape[1:] != (3,) or len(places) < stripes:
            raise DataError(f"stripe_origin must be of shape ({stripes}, 3), not {places.shape}")
        checked["stripe_origin"] = places
    return Scans(
        **checked, column=scans.column, time_ns=scans.time_ns, frame=scans.frame, name=scans.name
    )


def _rows(name: str, value: np.ndarray, n: int | None) -> np.ndarray:
    """Return an array of shape (N, 3), f64."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise DataError(f"{name} must be numbers, not {array.dtype}")
    if array.ndim != 2 or array.shape[1] != 3 or (n is not None and len(array) != n):
        raise DataError(
            f"{name} must have the shape ({'N' if n is None else n}, 3), not {array.shape}"
        )
    return np.ascontiguousarray(array, np.float64)


def _numbers(name: str, value: np.ndarray | None, n: int) -> np.ndarray | None:
    """Return an array of shape (n,), i32, without negative numbers."""
    if value is None:
        return None
    array = np.asarray(value)
    if array.shape != (n,) or array.dtype.kind not in "iu":
        raise DataError(f"{name} must be integers of shape ({n},), not {array.dtype} {array.shape}")
    if n and (array.min() < 0 or array.max() >= 2**31):
        raise DataError(f"{name} must be 0..2147483647")
    return np.ascontiguousarray(array, np.int32)


def arrange(scans: Scans) -> Arranged:
    """Return the finite points, stripe after stripe.

    Args:
        scans: Checked scans.

    Raises:
        DataError: Fewer than three usable points, or a single stripe.
    """
    usable = np.ones(len(scans.points), bool)
    for rows in (scans.points, scans.normals):
        if rows is not None:
            finite = np.isfinite(rows)
            if not finite.all():  # in rows of three that takes ten times as long
                usable &= finite.all(axis=1)
    whole = bool(usable.all())
    row = np.arange(len(usable)) if whole else np.flatnonzero(usable)
    _need_three(len(row), len(usable))
    view = np.zeros(len(row), np.int32)
    if scans.view is not None:
        view = scans.view if whole else scans.view[row]
    if scans.stripe is None:
        return _arranged(scans, row, view, None, None, whole)
    stripe = scans.stripe if whole else scans.stripe[row]
    first = _first_of_stripes(view, stripe)
    key = view[first].astype(np.int64) << 32 | stripe[first]
    if not (key[1:] > key[:-1]).all():
        whole = False
        order = np.lexsort((stripe, view))  # stable: the order along a stripe is kept
        row, view, stripe = row[order], view[order], stripe[order]
        first = _first_of_stripes(view, stripe)
    _need_two(len(first))
    start = np.append(first, len(row)).astype(np.int32)
    run = np.repeat(np.arange(len(first), dtype=np.int32), np.diff(start))
    return _arranged(scans, row, view, run, start, whole)


def _first_of_stripes(view: np.ndarray, stripe: np.ndarray) -> np.ndarray:
    """Return the rows where another stripe or view begins than that of the row before."""
    new = np.ones(len(stripe), bool)
    np.not_equal(stripe[1:], stripe[:-1], out=new[1:])
    new[1:] |= view[1:] != view[:-1]
    return np.flatnonzero(new)


def probe_positions(
    scans: Scans, arranged: Arranged, aligned: Registration | None
) -> np.ndarray | None:
    """Return where the probe was at every run of points [mm], world frame, shape (S, 3), f64.

    Args:
        scans: The scans, as `as_scans` returns them.
        arranged: Their usable points.
        aligned: How the views were moved, if they were: the probe moves with them.

    Returns:
        The positions, NaN where one is not known; None where none is. One position for a whole view
        (`Scans.origin`) is none: the probe moved on while it measured.
    """
    if scans.stripe_origin is None or scans.stripe is None or arranged.start is None:
        return None
    first = arranged.start[:-1]
    place: np.ndarray = scans.stripe_origin[scans.stripe[arranged.row[first]]]
    if aligned is not None:
        change = aligned.change()[arranged.view[first]]
        place = np.einsum("nij,nj->ni", change[:, :3, :3], place) + change[:, :3, 3]
    return place if np.isfinite(place).all(axis=1).any() else None


def without(arranged: Arranged, marked: np.ndarray, rows: int) -> Arranged:
    """Return the points that are not marked.

    Args:
        arranged: Points on stripes.
        marked: Which of them to leave out, shape (n,), bool.
        rows: Number of rows of the input.

    Raises:
        DataError: Fewer than three points are left, or a single stripe.
    """
    assert arranged.run is not None and arranged.start is not None
    cut = np.flatnonzero(marked)
    left = len(marked) - len(cut)
    _need_three(left, rows)
    counts = np.diff(arranged.start) - np.bincount(
        arranged.run[marked], minlength=len(arranged.start) - 1
    )
    there = counts > 0
    _need_two(int(there.sum()))
    stripes, counts = np.flatnonzero(there), counts[there]
    # Marked points are few: what lies between them is copied in one piece each.
    ends = np.append(cut, len(marked)).tolist()
    pieces = [slice(a, b) for a, b in zip([0, *(cut + 1).tolist()], ends, strict=True) if a < b]
    kept = np.flatnonzero(~marked) if len(pieces) * _LONG_PIECE > left else None

    def without_cut(array: np.ndarray) -> np.ndarray:
        if kept is not None:
            return array.take(kept, axis=0)
        return np.concatenate([array[piece] for piece in pieces])

    return Arranged(
        row=without_cut(arranged.row),
        points=without_cut(arranged.points),
        normals=None if arranged.normals is None else without_cut(arranged.normals),
        view=np.repeat(arranged.view[arranged.start[stripes]], counts),
        run=np.repeat(np.arange(len(stripes), dtype=np.int32), counts),
        start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
        whole=False,
    )


def _need_three(points: int, rows: int) -> None:
    if points < 3:
        raise DataError(
            f"{points} of {rows} points can be used, a segmentation needs at least 3",
            hint="check for NaN rows" if rows > 2 else "",
        )


def _need_two(stripes: int) -> None:
    if stripes < 2:
        raise DataError(
            "all points lie on one stripe, a surface needs two",
            hint="leave the stripe numbers out to treat the points as unorganised",
        )


def _arranged(
    scans: Scans,
    row: np.ndarray,
    view: np.ndarray,
    run: np.ndarray | None,
    start: np.ndarray | None,
    whole: bool,
) -> Arranged:
    """Pick the rows of every array."""
    normals = scans.normals
    if normals is not None:
        size = np.linalg.norm(normals, axis=1, keepdims=True)
        usable = np.isfinite(size) & (size > 0)
        normals = np.divide(normals, size, out=np.zeros_like(normals), where=usable)[row]
    return Arranged(
        row=row,
        points=scans.points if whole else scans.points.take(row, axis=0),
        normals=normals,
        view=np.ascontiguousarray(view, np.int32),
        run=run,
        start=start,
        whole=whole,
    )
