"""Reading and writing scans, truth and results; the format follows from the suffix.

Files in metres become arrays in millimetres here and nowhere else. Only the module of the format in
question is imported.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from octoseg_ti.errors import DataError

if TYPE_CHECKING:
    from octoseg_ti.types import Scans, Segmentation, Truth

Unit = Literal["mm", "m"]

READABLE = {
    ".mcap": "recording_read",
    ".npz": "npz",
    ".ply": "ply",
    ".ply.gz": "ply",
    ".pcd": "pcd",
    ".xyz": "xyz",
    ".txt": "xyz",
    ".csv": "xyz",
    ".asc": "xyz",
    ".las": "las",
    ".laz": "las",
    ".e57": "e57",
}
"""Module of every suffix that can be read."""

WRITABLE = (".mcap", ".npz", ".ply", ".pcd", ".xyz", ".rrd")
"""Suffixes that can be written."""

_SELF_DESCRIBING = (".mcap", ".npz")


def suffix_of(path: str | Path) -> str:
    """Return the lower-case suffix, with ``.gz`` as part of the one before."""
    suffixes = [suffix.lower() for suffix in Path(path).suffixes]
    return "".join(suffixes[-2:]) if suffixes[-1:] == [".gz"] else "".join(suffixes[-1:])


def read(path: str | Path, *, unit: Unit | None = None, topic: str | None = None) -> Scans:
    """Read scans.

    Args:
        path: .mcap .npz .ply .ply.gz .pcd .xyz .txt .csv .asc .las .laz .e57
        unit: Unit of the file, for formats that do not know theirs. Default: mm; LAS and E57 are in
            metres by their standards. Recordings and NPZ files have a fixed unit.
        topic: Point cloud topic of a recording; default: ours, or the only one.

    Returns:
        The scans, in mm. Rows that are not finite are kept in their places.

    Raises:
        DataError: Unknown suffix, missing or damaged file, no points, arrays that do not fit.
        MissingPackageError: LAS or E57 without their extra.
    """
    suffix = suffix_of(path)
    module = _reader(path)
    if topic is not None and suffix != ".mcap":
        raise DataError("topic= is for recordings (.mcap)", path=path, hint="leave it out")
    if unit not in (None, "mm", "m"):
        raise DataError(f"unknown unit {unit!r}", path=path, hint='use "mm" or "m"')
    if suffix in _SELF_DESCRIBING:
        if unit is not None and unit != ("m" if suffix == ".mcap" else "mm"):
            what = f"a {suffix} file has a fixed unit"
            raise DataError(what, path=path, hint="leave the unit out")
        return (
            module.read_scans(path, topic=topic) if suffix == ".mcap" else module.read_scans(path)
        )
    return module.read_scans(path, unit=unit)


def read_truth(path: str | Path) -> Truth | None:
    """Read the truth of a recording or an NPZ file; None when the file has none.

    Raises:
        DataError: Unknown suffix, missing or damaged file, arrays that do not fit.
    """
    module = _reader(path)
    return module.read_truth(path) if suffix_of(path) in _SELF_DESCRIBING else None


def read_with_truth(
    path: str | Path, *, unit: Unit | None = None, topic: str | None = None
) -> tuple[Scans, Truth | None]:
    """Read scans and their truth, as `read` and `read_truth` do; a recording is read only once."""
    if suffix_of(path) == ".mcap" and unit in (None, "m"):
        return _reader(path).read_scans_and_truth(path, topic=topic)  # type: ignore[no-any-return]
    return read(path, unit=unit, topic=topic), read_truth(path)


def read_segmentation(path: str | Path) -> Segmentation:
    """Read a result that `write` has made.

    Raises:
        DataError: Missing or damaged file, no result in it, or a format that keeps only part of it.
    """
    module = _reader(path)
    if suffix_of(path) not in _SELF_DESCRIBING:
        what = f"a {suffix_of(path)} file does not keep a whole result"
        raise DataError(what, path=path, hint="write the result as .mcap or .npz")
    return module.read_segmentation(path)


def write(
    path: str | Path,
    what: Scans | Segmentation,
    *,
    truth: Truth | None = None,
    scans: Scans | None = None,
    report: str | None = None,
    scores: Mapping[str, Any] | None = None,
    run: Mapping[str, str] | None = None,
    overwrite: bool = True,
) -> None:
    """Write scans or a result; the file is whole or absent.

    Args:
        path: .mcap .npz .ply .pcd .xyz .rrd
        what: The scans, or the result.
        truth: The truth, in the order of the points.
        scans: The scans of a result, for formats that keep both (.mcap, .rrd).
        report: Markdown that a recording carries as ``report.md``.
        scores: Figures against the truth that a recording carries as metadata.
        run: How the data came about, for the metadata of a recording.
        overwrite: False refuses a file that exists.

    Raises:
        DataError: Unknown suffix, arrays that do not fit each other, or an output that cannot be
            written; an older file of that name then stays as it was.
    """
    from octoseg_ti.files.validation import make_scans
    from octoseg_ti.types import Scans

    suffix = suffix_of(path)
    if suffix not in WRITABLE:
        what_suffix = f"cannot write {suffix or 'a file without suffix'}"
        raise DataError(what_suffix, path=path, hint=f"known: {' '.join(WRITABLE)}")
    segmentation = None if isinstance(what, Scans) else what
    if isinstance(what, Scans):
        what = scans = make_scans(None, {f: getattr(what, f) for f in what.__slots__})
    elif scans is None and truth is not None:
        # Truth travels with scan lines, which a result is able to give.
        scans = Scans(points=what.points, stripe=what.stripe, view=what.view, name=what.name)
    for other in (truth, scans):
        if other is not None and len(other) != len(what):
            text = f"{type(other).__name__.lower()} has {len(other)} points, not {len(what)}"
            raise DataError(text, path=path, hint="write what belongs together")
    if suffix == ".mcap":
        from octoseg_ti.files.recording import write_recording

        write_recording(
            path, scans=scans, truth=truth, segmentation=segmentation, report=report,
            scores=scores, run=run, overwrite=overwrite,
        )  # fmt: skip
    elif suffix == ".rrd":
        from octoseg_ti.files.atomic import replacing

        viewer = import_module("octoseg_ti.view.rerun_log")
        with replacing(path, overwrite=overwrite) as output:
            output.file.close()  # the logger opens the part under its name
            viewer.save_rrd(output.part, scans=scans, segmentation=segmentation, truth=truth)
    else:
        module = import_module(f"octoseg_ti.files.{READABLE[suffix]}")
        module.write(path, what, truth=truth, overwrite=overwrite)


def _reader(path: str | Path) -> Any:
    """Return the module that reads a file."""
    suffix = suffix_of(path)
    if suffix not in READABLE:
        what = f"cannot read {suffix or 'a file without suffix'}"
        raise DataError(what, path=path, hint=f"known: {' '.join(READABLE)}")
    return import_module(f"octoseg_ti.files.{READABLE[suffix]}")
