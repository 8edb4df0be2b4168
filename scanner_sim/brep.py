"""Faces of a boundary representation as a part: one surface of the truth for each true surface.

CAD systems split what is one surface to its user (a cylinder into halves, a plane into pieces), and
write every face with a copy of its surface. Here equal surfaces become one, as in a CSG part, and
what rounds an edge is told from what is a face in its own right.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.types import SurfaceKind
from scanner_sim.mesh import MeshPart
from scanner_sim.quadric import Surfaces, distance, gradient
from scanner_sim.topology import (
    SMOOTH,
    Links,
    Mesh,
    corner_normals,
    edge_curves,
    facet_normals,
    link,
    smooth_groups,
    weld,
)

_WELD = 1e-8  # corners this close are one, relative to the part
_SAME = 1e-6  # surfaces whose numbers differ by less are one, relative to the part
_FILLET = 1 / 40  # default limit of a fillet's radius, relative to the diagonal of the box
_SMOOTH_SHARE = 0.9  # a joint is smooth when this share of its length is
_BORDER_SHARE = 1 / 3  # a fillet joins smoothly along this share of its border at least
_TURN = 0.4  # mean of the unit normals of a cylinder; less = it goes around more than half way


class Faces(NamedTuple):
    """Faces laid out in triangles; ``T`` triangles, ``F`` faces."""

    corners: np.ndarray
    """Corners of all triangles [mm], anticlockwise seen from outside, shape (T, 3, 3)."""
    normals: np.ndarray
    """Normals of the surface at the corners, of either sign; 0 = not known, shape (T, 3, 3)."""
    face: np.ndarray
    """Face of every triangle, shape (T,)."""
    kind: np.ndarray
    """`SurfaceKind` of every face, shape (F,), i32."""
    data: np.ndarray
    """point (3), axis (3), a, b of every face; NaN where it is free-form, shape (F, 8)."""


def brep_part(
    faces: Faces,
    *,
    deflection: float,
    fillet_radius: float | None = None,
    name: str = "solid",
    path: Path | None = None,
) -> MeshPart:
    """Return the part that faces bound.

    Args:
        faces: The faces.
        deflection: Largest distance of the triangles from their surfaces [mm].
        fillet_radius: Limit of the radius of a fillet [mm]; None = 1/40 of the diagonal of the box.
        name: Name of the part.
        path: The file, for messages.

    Raises:
        DataError: No triangle has an area.
    """
    flat = faces.corners.reshape(-1, 3)
    size = float(np.linalg.norm(np.ptp(flat, axis=0)))
    mesh, kept = weld(faces.corners, _WELD * size)
    if len(mesh.triangles) == 0:
        raise DataError("no face has an area", path=path)
    face = faces.face[kept]
    kind, data, off = _checked(faces, face, mesh, 2.0 * deflection + _SAME * size)
    opened = _opened(kind, data, mesh, face)
    form = _same_forms(kind, opened, flat.mean(axis=0), size)
    links = link(mesh)
    facets = facet_normals(mesh, links)
    normals = _normals(Surfaces(kind, opened, np.zeros(len(kind), bool)), mesh, face,
                       faces.normals[kept], corner_normals(mesh, facets, face))  # fmt: skip
    limit = _FILLET * size if fillet_radius is None else fillet_radius
    fillet = _fillets(mesh, links, normals, face, form, kind, opened, limit)
    # A face and a fillet on one surface stay two, as in a CSG part.
    _, first, surface = np.unique(2 * form + fillet, return_index=True, return_inverse=True)
    surface = surface.astype(np.int32)[face]
    surfaces = Surfaces(kind=kind[first], data=opened[first], fillet=fillet[first])
    info = {
        "triangles": str(len(mesh.triangles)),
        "brep_faces": str(len(kind)),
        "faces_off_their_surface": str(off),
        "dropped_triangles": str(int((~kept).sum())),
        "open_edges": str(len(links.border)),
        "deflection_mm": f"{deflection:.6g}",
        "fillet_radius_mm": f"{limit:.6g}",
    }
    return MeshPart(
        mesh=mesh, surface=surface, normals=normals, surfaces=surfaces, name=name, info=info,
        edges=edge_curves(mesh, links, surface, normals, surfaces.fillet), deflection=deflection,
        curved=(faces.kind == SurfaceKind.FREE_FORM)[first],
    )  # fmt: skip


def _checked(
    faces: Faces, face: np.ndarray, mesh: Mesh, tolerance: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return kind and data of all faces; one that leaves its surface counts as free-form.

    The exact form is used only where every vertex lies on it. The number of faces where one does
    not, is returned too.
    """
    kind, data = faces.kind.copy(), faces.data.copy()
    exact = np.flatnonzero(np.isfinite(data[face, 0]))
    flat = Surfaces(kind, _opened(kind, data, mesh, face), np.zeros(len(kind), bool))
    index = np.repeat(face[exact], 3)
    gap = np.abs(distance(flat, index, mesh.corners()[exact].reshape(-1, 3)))
    off = np.unique(index[~(gap <= tolerance)])
    kind[off], data[off] = SurfaceKind.FREE_FORM, np.nan
    return kind, data, len(off)


def _opened(kind: np.ndarray, data: np.ndarray, mesh: Mesh, face: np.ndarray) -> np.ndarray:
    """Return the data with cones that open to the side where their faces are."""
    data = data.copy()
    cone = kind[face] == SurfaceKind.CONE
    middle = mesh.corners()[cone].mean(axis=1)
    height = np.einsum("ij,ij->i", middle - data[face[cone], :3], data[face[cone], 3:6])
    wrong = np.bincount(face[cone], weights=height, minlength=len(kind)) < 0.0
    data[wrong, 3:6] *= -1.0
    return data


def _same_forms(kind: np.ndarray, data: np.ndarray, middle: np.ndarray, size: float) -> np.ndarray:
    """Return the number of the surface of every face, shape (F,): equal for equal surfaces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    point, axis = data[:, :3] - middle, data[:, 3:6]
    height = np.einsum("ij,ij->i", point, axis)[:, None] * axis
    plane, cylinder = kind == SurfaceKind.PLANE, kind == SurfaceKind.CYLINDER
    place = np.where(plane[:, None], height, np.where(cylinder[:, None], point - height, point))
    # A direction and its opposite are one, unless a cone opens along it; a sphere has none.
    dyad = (axis[:, :, None] * axis[:, None, :]).reshape(-1, 9)
    cone = (kind == SurfaceKind.CONE)[:, None]
    turn = np.where((kind == SurfaceKind.SPHERE)[:, None], 0.0, np.where(cone, np.tile(axis, 3),
                                                                          dyad))  # fmt: skip
    angle = np.where(kind == SurfaceKind.CONE, size, 1.0)
    rows = np.column_stack([place, size * turn, data[:, 6] * angle, data[:, 7], 1e9 * size * kind])
    exact = np.flatnonzero(np.isfinite(rows).all(axis=1))
    pairs = cKDTree(rows[exact]).query_pairs(_SAME * size, output_type="ndarray")
    ends = (exact[pairs[:, 0]], exact[pairs[:, 1]])
    graph = coo_matrix((np.ones(len(pairs), bool), ends), (len(kind), len(kind)))
    form: np.ndarray = connected_components(graph, directed=False)[1]
    return form


def _normals(
    surfaces: Surfaces, mesh: Mesh, face: np.ndarray, given: np.ndarray, facets: np.ndarray
) -> np.ndarray:
    """Return the outward normal of the surface at every corner, shape (T, 3, 3)."""
    normals = given.copy()
    exact = np.flatnonzero(np.isfinite(surfaces.data[face, 0]))
    index = np.repeat(face[exact], 3)
    place = mesh.corners()[exact].reshape(-1, 3)
    normals[exact] = gradient(surfaces, index, place).reshape(-1, 3, 3)
    cosine = np.einsum("ijk,ijk->ij", normals, facets)
    normals *= np.sign(cosine)[:, :, None]
    # At the apex of a cone or the pole of a patch there is no normal but that of the triangles.
    return np.where((np.abs(cosine) > 0.5)[:, :, None], normals, facets)


def _fillets(
    mesh: Mesh, links: Links, normals: np.ndarray, face: np.ndarray, form: np.ndarray,
    kind: np.ndarray, data: np.ndarray, limit: float,
) -> np.ndarray:  # fmt: skip
    """Return which faces are fillets, shape (F,), bool.

    A fillet is a piece of a cylinder, sphere or torus of a small radius that joins two other
    surfaces or more smoothly, along a third of its border at least. A cylinder that goes around
    more than half way is a pin or a hole.
    """
    own = form[face]
    same = own[links.first] == own[links.second]
    piece = smooth_groups(len(face), links, same)
    count = int(piece.max()) + 1
    example = np.zeros(count, np.int64)
    example[piece] = face
    radius = np.where(kind == SurfaceKind.TORUS, data[:, 7], data[:, 6])[example]
    kinds = kind[example]
    small = np.isin(kinds, (SurfaceKind.CYLINDER, SurfaceKind.SPHERE, SurfaceKind.TORUS))
    small &= radius <= limit
    joint = ~same
    first, second = links.first[joint], links.second[joint]
    begin, other = links.first_place[joint], links.second_place[joint]
    here = normals[first, begin] + normals[first, (begin + 1) % 3]
    there = normals[second, other] + normals[second, (other + 1) % 3]
    sine = np.linalg.norm(np.cross(here, there), axis=1)
    smooth = np.arctan2(sine, np.einsum("ij,ij->i", here, there)) <= SMOOTH
    ends = mesh.vertices[mesh.triangles[first, begin]]
    length = np.linalg.norm(mesh.vertices[mesh.triangles[first, (begin + 1) % 3]] - ends, axis=1)
    couple = np.concatenate([piece[first] * count + piece[second],
                             piece[second] * count + piece[first]])  # fmt: skip
    joints, place = np.unique(couple, return_inverse=True)
    whole = np.bincount(place, weights=np.tile(length, 2))
    even = np.bincount(place, weights=np.tile(length * smooth, 2))
    owner = joints // count
    neighbours = np.bincount(owner, weights=even >= _SMOOTH_SHARE * whole, minlength=count)
    border = np.bincount(owner, weights=whole, minlength=count)
    joined = np.bincount(owner, weights=even, minlength=count)
    area = np.linalg.norm(np.cross(*np.diff(mesh.corners(), axis=1).transpose(1, 0, 2)), axis=1)
    mean = np.stack([np.bincount(piece, weights=area * normals.mean(axis=1)[:, k])
                     for k in range(3)], axis=1)  # fmt: skip
    turned = np.linalg.norm(mean, axis=1) / np.maximum(np.bincount(piece, weights=area), 1e-300)
    fillet = small & (neighbours >= 2) & (joined >= _BORDER_SHARE * border)
    fillet &= (kinds != SurfaceKind.CYLINDER) | (turned >= _TURN)
    answer = np.zeros(len(kind), bool)
    answer[face] = fillet[piece]
    return answer
