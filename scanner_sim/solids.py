"""Parts from files: STEP by OpenCASCADE, and triangle meshes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from octoseg_ti.errors import DataError
from scanner_sim.mesh import MeshPart, no_form
from scanner_sim.mesh_files import Soup, read_obj, read_ply, read_stl
from scanner_sim.mesh_forms import kinds_of
from scanner_sim.quadric import Surfaces
from scanner_sim.solid_options import MM, SUFFIXES, SolidOptions
from scanner_sim.topology import (
    angles_between,
    corner_normals,
    crease_angle,
    edge_curves,
    facet_normals,
    link,
    orient,
    smooth_groups,
    weld,
)

MESHES: dict[str, Callable[[Path], Soup]] = {".stl": read_stl, ".obj": read_obj, ".ply": read_ply}
_WELD = 1e-7  # corners this close are one, relative to the part: single precision
_FLAT = 5e-6  # vertices of a plane may be this far off, relative to the part


def read_part(path: str | Path, options: SolidOptions | None = None) -> MeshPart:
    """Read a STEP file or a triangle mesh as a part that `simulate` can scan.

    The faces of a STEP file are the surfaces of the truth; halves of one cylinder are one surface.
    A mesh has the faces that it names itself (groups of an OBJ file, labels of PLY faces), or its
    smooth groups. Normals on curved faces of a mesh are interpolated between its vertices. A file
    with several solids is one part.

    Args:
        path: .step or .stp (needs the extra ``cad``), .stl, .obj or .ply
        options: How to read it.

    Raises:
        DataError: Missing, damaged, not of this format, or without a face.
        MissingPackageError: OpenCASCADE is not installed.
    """
    path, options = Path(path), options or SolidOptions()
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        known = ", ".join(SUFFIXES)
        raise DataError(f"unknown suffix {suffix!r}", path=path, hint=f"parts are {known}")
    if path.is_dir() or not path.exists():
        raise DataError("this is a folder" if path.is_dir() else "no such file", path=path)
    if path.stat().st_size == 0:
        raise DataError("the file is empty", path=path, hint="write or fetch it again")
    try:
        if suffix in MESHES:
            return _mesh(path, MESHES[suffix](path), options)
        from scanner_sim.step import read_step

        return read_step(
            path, deflection=options.deflection, angular=options.angular_deflection,
            fillet_radius=options.fillet_radius,
        )  # fmt: skip
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", path=path) from error


def _mesh(path: Path, soup: Soup, options: SolidOptions) -> MeshPart:
    """Return the part of a file's triangles."""
    part = mesh_part(
        soup.corners * MM[options.unit], label=soup.label if options.face_labels else None,
        smooth_angle=options.smooth_angle, name=path.name, path=path,
    )  # fmt: skip
    info = {"format": path.suffix[1:].lower(), "unit": options.unit, **part.info}
    return dataclasses.replace(part, info=info)


def mesh_part(
    corners: np.ndarray,
    *,
    label: np.ndarray | None = None,
    smooth_angle: float | None = None,
    name: str = "mesh",
    path: Path | None = None,
) -> MeshPart:
    """Return a part made of triangles.

    Args:
        corners: Corners of the triangles [mm], shape (T, 3, 3); equal corners are one vertex.
        label: Face of every triangle, 0..F-1, shape (T,); None = smooth groups are the faces.
        smooth_angle: Triangles that meet at a smaller angle belong to one face [rad]; None = as in
            `SolidOptions`.
        name: Name of the part.
        path: The file, for messages.

    Raises:
        DataError: A coordinate is not finite, or no triangle has an area.
    """
    if len(corners) == 0:
        raise DataError("the mesh has no triangles", path=path, hint="a mesh with faces is wanted")
    if not np.isfinite(corners).all():
        raise DataError("a coordinate of the mesh is not finite", path=path)
    flat = corners.reshape(-1, 3)
    tolerance = _WELD * float(np.linalg.norm(np.ptp(flat, axis=0)))
    mesh, kept = weld(corners, tolerance)
    if len(mesh.triangles) == 0:
        raise DataError(f"none of the {len(kept)} triangles has an area", path=path)
    mesh = orient(mesh, link(mesh))
    links = link(mesh)
    normals = facet_normals(mesh, links)
    angles = angles_between(normals, links)
    limit = crease_angle(angles) if smooth_angle is None else smooth_angle
    joined = angles < limit
    group = smooth_groups(len(normals), links, joined)
    if label is not None:
        label = np.unique(label[kept], return_inverse=True)[1]
    surface = (group if label is None else label).astype(np.int32)
    # Files hold single precision: far from the origin its rounding is what counts.
    rounding = float(np.finfo(np.float32).eps * np.abs(mesh.vertices).max())
    tolerance = max(_FLAT * mesh.size(), 2.0 * rounding)
    kinds = kinds_of(mesh, normals, surface, tolerance)
    count = len(kinds)
    fillet = np.zeros(count, bool)
    # Within a labelled face, creases stay creases for the normals.
    both = group if label is None else smooth_groups(
        len(normals), links, joined & (surface[links.first] == surface[links.second])
    )  # fmt: skip
    shading = corner_normals(mesh, normals, both)
    plane = kinds[surface] == 0
    shading[plane] = normals[plane, None, :]
    info = {
        "triangles": str(len(normals)),
        "dropped_triangles": str(int((~kept).sum())),
        "open_edges": str(len(links.border)),
        "faces": "labels of the file" if label is not None else "smooth groups",
        "smooth_angle_deg": f"{math.degrees(limit):.4g}",
    }
    return MeshPart(
        mesh=mesh, surface=surface, normals=shading, info=info, name=name,
        curved=np.zeros(count, bool),
        surfaces=Surfaces(kind=kinds, data=no_form(count), fillet=fillet),
        edges=edge_curves(mesh, links, surface, np.repeat(normals[:, None], 3, axis=1), fillet,
                          smooth=limit),
    )  # fmt: skip
