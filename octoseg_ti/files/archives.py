"""Small NPZ archives that travel inside a recording: poses, truth, and the rest of a result.

They hold bit for bit what the topics show rounded to single-precision metres.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from octoseg_ti.alignment import Registration
from octoseg_ti.params import Params
from octoseg_ti.types import Cells, Fillets, Measurement, Scans, Segmentation, Truth

_SAMPLE = 2048
_NOISE = 0.95  # deflate would save less than this leaves


def pack(arrays: Mapping[str, Any]) -> bytes:
    """Return the bytes of an NPZ file with fixed time stamps: equal arrays give equal bytes.

    Arrays that a sample shows to be noise are stored, the others deflated at the lowest level: many
    times faster than the default of NumPy, and hardly larger.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, value in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(value), allow_pickle=False)
            data = content.getvalue()
            step = max(len(data) // 16, _SAMPLE)
            sample = b"".join(data[at : at + _SAMPLE] for at in range(0, len(data), step))
            noise = len(zlib.compress(sample, 1)) > _NOISE * len(sample)
            entry.compress_type = zipfile.ZIP_STORED if noise else zipfile.ZIP_DEFLATED
            archive.writestr(entry, data, compresslevel=1)
    return buffer.getvalue()


def unpack(data: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of an NPZ file in memory; every member's CRC is checked."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _planes(
    name: str, values: np.ndarray, reference: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Return f64 rows as eight arrays (N, 3) u8, lowest byte first, each XOR the reference.

    Where truth and measurement agree the upper bytes become zero, and compress to nothing; the step
    is exact for every bit pattern.
    """
    bits = np.ascontiguousarray(values, np.float64).view(np.uint64)
    if reference is not None:
        bits = bits ^ _reference_bits(reference)
    octets = np.ascontiguousarray(bits.astype("<u8")).view(np.uint8).reshape(len(values), 3, 8)
    return {f"{name}_byte{k}": np.ascontiguousarray(octets[..., k]) for k in range(8)}


def _from_planes(
    name: str, arrays: Mapping[str, np.ndarray], reference: np.ndarray | None = None
) -> np.ndarray:
    """Undo `_planes`."""
    octets = np.stack([arrays[f"{name}_byte{k}"] for k in range(8)], axis=-1).astype(np.uint8)
    bits = octets.view("<u8")[..., 0].astype(np.uint64)
    if reference is not None:
        bits = bits ^ _reference_bits(reference)
    return np.ascontiguousarray(bits).view(np.float64)


def _reference_bits(reference: np.ndarray) -> np.ndarray:
    """Return the bits of f64 rows, with not-a-number as zero (its payload is not portable)."""
    clean = np.where(np.isfinite(reference), reference, 0.0)
    return np.ascontiguousarray(clean, np.float64).view(np.uint64)


def pack_truth(truth: Truth, points: np.ndarray) -> bytes:
    """Return ``ground_truth.npz``: every array of the truth in point order, without loss.

    ``patch``, ``surface``, ``kind``, ``edge_distance``, ``edge_class``, ``radius``,
    ``artefact`` and
    ``T_world_view`` are stored as they are; ``position_byte0`` to 7 and ``normal_byte0`` to 7, each
    (N, 3) u8, hold the bytes of the f64 rows, lowest first, the positions XOR those of ``points``.
    This halves the file.

    Args:
        truth: The truth.
        points: Positions as a reader of the recording sees them [mm], world frame, shape (N, 3).
    """
    arrays: dict[str, Any] = {"patch": truth.patch, "info": json.dumps(truth.info)}
    for name in ("surface", "kind", "edge_distance", "edge_class", "radius", "artefact",
                 "T_world_view"):  # fmt: skip
        if getattr(truth, name) is not None:
            arrays[name] = getattr(truth, name)
    if truth.position is not None:
        arrays |= _planes("position", truth.position, points)
    if truth.normal is not None:
        arrays |= _planes("normal", truth.normal)
    return pack(arrays)


def unpack_truth(data: bytes, points: np.ndarray) -> dict[str, Any]:
    """Return the fields of `Truth` from the bytes of `pack_truth`."""
    arrays: dict[str, Any] = unpack(data)
    fields = {name: value for name, value in arrays.items() if "_byte" not in name}
    fields["info"] = str(arrays["info"]) if "info" in arrays else "{}"
    if "position_byte0" in arrays:
        fields["position"] = _from_planes("position", arrays, points)
    if "normal_byte0" in arrays:
        fields["normal"] = _from_planes("normal", arrays)
    return fields


def result_arrays(result: Segmentation, *, per_point: bool) -> dict[str, Any]:
    """Return a segmentation as named arrays.

    Args:
        result: The segmentation.
        per_point: With the arrays that have a row per point, as the NPZ output has them; a
            recording keeps these in its topics.
    """
    arrays: dict[str, Any] = {}
    if per_point:
        for name in ("points", "normals", "labels", "edge", "level", "outlier"):
            arrays[name] = getattr(result, name)
        for name in ("stripe", "view"):
            if getattr(result, name) is not None:
                arrays[name] = getattr(result, name)
    for name in ("kind", "surface", "parameters", "covariance", "residual"):
        arrays[name] = getattr(result, name)
    cells = result.cells
    for name in _CELL_FIELDS:
        arrays[f"cell_{name}"] = getattr(cells, name)
    arrays["initial_size"] = np.float64(cells.initial_size)
    arrays["params"] = json.dumps(result.params.to_dict())
    arrays["measured"] = np.array(
        [getattr(result.measured, name) for name in _MEASURED_FIELDS], np.float64
    )
    if result.fillets is not None:
        for name in _FILLET_FIELDS:
            arrays[f"fillet_{name}"] = getattr(result.fillets, name)
    if result.registration is not None:
        for name in _REGISTRATION_FIELDS:
            arrays[f"registration_{name}"] = getattr(result.registration, name)
    arrays["passes"] = np.int64(result.passes)
    arrays["stage_names"] = np.array(list(result.seconds), dtype=np.str_)
    arrays["stage_seconds"] = np.array(list(result.seconds.values()), np.float64)
    arrays["name"] = np.str_(result.name)
    return arrays


_CELL_FIELDS = ("corner", "size", "level", "count", "normal", "sigma", "stop", "edge", "label")
_FILLET_FIELDS = {
    "patches": np.int32, "radius": np.float64, "deviation": np.float64, "concave": np.uint8,
    "points": np.int32, "strip": np.int32, "point": np.int32,
}  # fmt: skip
_REGISTRATION_FIELDS = {
    "recorded": np.float64, "refined": np.float64, "datum": np.int32, "left": np.int32,
    "open": np.int32, "pairs": np.int32, "matches": np.int32, "before": np.float64,
    "after": np.float64,
}  # fmt: skip
_MEASURED_FIELDS = ("spacing_along", "spacing_across", "noise", "normal_noise")


def result_from_arrays(arrays: Mapping[str, Any]) -> Segmentation:
    """Build the segmentation of `result_arrays`, points included.

    Raises:
        KeyError: An array is missing.
        ValueError: Arrays of one group differ in length, or a parameter is unknown.
    """
    points = np.asarray(arrays["points"], np.float64)
    per_point = {
        "normals": np.float32,
        "labels": np.int32,
        "edge": np.uint8,
        "level": np.int8,
        "outlier": np.uint8,
    }
    fields: dict[str, Any] = {
        name: np.ascontiguousarray(arrays[name], dtype) for name, dtype in per_point.items()
    }
    for name in ("stripe", "view"):
        if arrays.get(name) is not None:
            fields[name] = np.ascontiguousarray(arrays[name], np.int32)
    for name, value in fields.items():
        if len(value) != len(points):
            raise ValueError(f"{name} has {len(value)} rows for {len(points)} points")
    for name, dtype in (("kind", np.int8), ("surface", np.int32), ("parameters", np.float64)):
        fields[name] = np.ascontiguousarray(arrays[name], dtype)
    fields["residual"] = np.ascontiguousarray(arrays["residual"], np.float64)
    patches = len(fields["kind"])
    if arrays.get("covariance") is None:  # a file of an earlier version
        fields["covariance"] = np.full((patches, 8, 8), np.nan)
    else:
        fields["covariance"] = np.ascontiguousarray(arrays["covariance"], np.float64)
        if fields["covariance"].shape[1:] != (8, 8):
            raise ValueError(f"covariance has shape {fields['covariance'].shape}, not (K, 8, 8)")
    for name in ("surface", "parameters", "covariance", "residual"):
        if len(fields[name]) != patches:
            raise ValueError(f"{name} has {len(fields[name])} rows for {patches} patches")
    labels = fields["labels"]
    if labels.size and (labels.min() < -1 or labels.max() >= patches):
        raise ValueError(f"labels reach beyond the {patches} patches")
    cells = {name: np.asarray(arrays[f"cell_{name}"]) for name in _CELL_FIELDS}
    if len({len(value) for value in cells.values()}) != 1:
        raise ValueError("the arrays of the cells differ in length")
    aligned = None
    if "registration_refined" in arrays:
        stored = {
            name: np.ascontiguousarray(arrays[f"registration_{name}"], dtype)
            for name, dtype in _REGISTRATION_FIELDS.items()
        }
        shape, pairs = stored["recorded"].shape, len(stored["pairs"])
        if (
            shape[1:] != (4, 4)
            or stored["refined"].shape != shape
            or len(stored["open"]) != len(stored["recorded"])
        ):
            raise ValueError("the poses of the registration do not belong together")
        if any(len(stored[name]) != pairs for name in ("matches", "before", "after")):
            raise ValueError(f"the registration differs in length from its {pairs} pairs")
        aligned = Registration(**stored)
    fillets = None
    if "fillet_radius" in arrays:
        fillets = Fillets(
            **{
                name: np.ascontiguousarray(arrays[f"fillet_{name}"], dtype)
                for name, dtype in _FILLET_FIELDS.items()
            }
        )
        of_fillet = (fillets.patches, fillets.deviation, fillets.concave, fillets.points)
        if any(len(values) != len(fillets) for values in of_fillet):
            raise ValueError(f"the arrays of the {len(fillets)} fillets differ in length")
        if len(fillets.strip) != patches or len(fillets.point) != len(points):
            raise ValueError("the fillets belong to other patches or points")
    names = [str(name) for name in np.asarray(arrays["stage_names"])]
    seconds = np.asarray(arrays["stage_seconds"], np.float64).tolist()
    measured = np.asarray(arrays["measured"], np.float64).tolist()
    return Segmentation(
        points=points,
        cells=Cells(initial_size=float(arrays["initial_size"]), **cells),
        params=Params.from_dict(json.loads(str(arrays["params"]))),
        measured=Measurement(**dict(zip(_MEASURED_FIELDS, measured, strict=True))),
        fillets=fillets,
        registration=aligned,
        passes=int(arrays["passes"]),
        seconds=dict(zip(names, seconds, strict=True)),
        name=str(arrays["name"]),
        **fields,
    )


def scan_extras(scans: Scans) -> dict[str, Any]:
    """Return what the topics of a recording cannot hold exactly: poses and probe positions."""
    names = ("T_world_view", "origin", "stripe_origin")
    return {name: getattr(scans, name) for name in names if getattr(scans, name) is not None}
