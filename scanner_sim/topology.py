"""What belongs together in a triangle mesh: corners, neighbours, faces, normals, edge curves.

A mesh of a CAD system says little more than positions. Its faces are found again as smooth groups:
connected triangles between which the normal turns by less than a limit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from octoseg_ti.types import EdgeClass
from scanner_sim.nearest import Edges

SMOOTH = math.radians(5.0)
"""Faces that meet at a smaller angle than this meet smoothly [rad], as in `trace_edges`."""
_NEEDLE = 1e-5  # a triangle lower than this, relative to the part, has no normal of its own
_ANGLES = (math.radians(10.0), math.radians(60.0))
_CREASE = math.radians(30.0)
_GAP = math.radians(5.0)


class Mesh(NamedTuple):
    """Triangles on shared vertices; ``V`` vertices, ``T`` triangles."""

    vertices: np.ndarray
    """Positions [mm], shape (V, 3), f64."""
    triangles: np.ndarray
    """Vertices of every triangle, anticlockwise seen from outside, shape (T, 3), i64."""

    def corners(self) -> np.ndarray:
        """Return the corners of all triangles [mm], shape (T, 3, 3)."""
        return self.vertices[self.triangles]

    def size(self) -> float:
        """Return the length of the diagonal of the box [mm]."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))


class Links(NamedTuple):
    """Edges of triangles at which two of them meet, and those that bound only one."""

    first: np.ndarray
    """One triangle of every pair, shape (P,)."""
    second: np.ndarray
    """The other one, shape (P,)."""
    first_place: np.ndarray
    """Which corner of the first triangle the edge starts at, 0..2, shape (P,)."""
    second_place: np.ndarray
    """The same in the second one, shape (P,)."""
    aligned: np.ndarray
    """True where the two run along the edge the same way: one of them is turned, shape (P,)."""
    border: np.ndarray
    """Triangles at open edges, shape (B,)."""
    border_place: np.ndarray
    """Which corner the open edge starts at, shape (B,)."""
    clear: int
    """The first so many pairs are at edges of two triangles; at the other edges more meet."""


def weld(corners: np.ndarray, tolerance: float) -> tuple[Mesh, np.ndarray]:
    """Return a mesh with one vertex for all corners at one place, and which triangles it keeps.

    Args:
        corners: Corners of the triangles [mm], shape (T, 3, 3).
        tolerance: Corners this close are one [mm].

    Returns:
        The mesh, and flags of the triangles that were kept, shape (T,): those that lose a corner
        or have no area are dropped.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    flat = np.ascontiguousarray(corners.reshape(-1, 3), np.float64) + 0.0  # no minus zero
    rows = flat.view(np.dtype((np.void, 24)))[:, 0]
    _, first, number = np.unique(rows, return_index=True, return_inverse=True)
    vertices = flat[first]
    pairs = cKDTree(vertices).query_pairs(tolerance, output_type="ndarray")
    if len(pairs):
        shape = (len(vertices), len(vertices))
        graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape)
        group = connected_components(graph, directed=False)[1]
        _, chief = np.unique(group, return_index=True)
        vertices, number = vertices[chief], group[number]
    triangles = number.reshape(-1, 3).astype(np.int64)
    kept = triangles[:, 0] != triangles[:, 1]
    kept &= (triangles[:, 1] != triangles[:, 2]) & (triangles[:, 2] != triangles[:, 0])
    area = np.zeros(len(triangles))
    area[kept] = np.linalg.norm(_area_vectors(vertices[triangles[kept]]), axis=1)
    kept &= area > 0.0
    used, number = np.unique(triangles[kept], return_inverse=True)
    return Mesh(vertices[used], number.reshape(-1, 3)), kept


def link(mesh: Mesh) -> Links:
    """Return which triangles meet at which edges."""
    ends = np.stack([mesh.triangles, np.roll(mesh.triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    low, high = ends.min(axis=1), ends.max(axis=1)
    key = low * len(mesh.vertices) + high
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.concatenate([[True], np.diff(key[order]) > 0]))
    count = np.diff(np.append(starts, len(order)))
    one, two = order[starts[count == 2]], order[starts[count == 2] + 1]
    lone = order[starts[count == 1]]
    # Where three or more meet, each is linked with the next: none of them is a border.
    many = np.flatnonzero(count > 2)
    more_one = np.concatenate([np.empty(0, np.int64), *(
        order[starts[m] : starts[m] + count[m] - 1] for m in many)])  # fmt: skip
    more_two = np.concatenate([np.empty(0, np.int64), *(
        order[starts[m] + 1 : starts[m] + count[m]] for m in many)])  # fmt: skip
    one, two = np.concatenate([one, more_one]), np.concatenate([two, more_two])
    return Links(
        first=one // 3, second=two // 3, first_place=one % 3, second_place=two % 3,
        aligned=ends[one, 0] == ends[two, 0], border=lone // 3, border_place=lone % 3,
        clear=int((count == 2).sum()),
    )  # fmt: skip


def orient(mesh: Mesh, links: Links) -> Mesh:
    """Return the mesh with triangles that agree on what is outside.

    Neighbours agree first; then every closed piece is turned so that it holds a positive volume.
    Edges of more than two triangles say nothing, and in a one-sided band what comes first wins.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    count = len(mesh.triangles)
    one, two = links.first[: links.clear], links.second[: links.clear]
    aligned = links.aligned[: links.clear]
    graph = coo_matrix((np.ones(len(one), np.int8), (one, two)), (count, count)).tocsr()
    pieces, piece = connected_components(graph, directed=False)
    turned = np.zeros(count, bool)
    key = np.concatenate([one * count + two, two * count + one])
    order = np.argsort(key, kind="stable")
    key, opposite = key[order], np.tile(aligned, 2)[order]
    for p in np.unique(piece[one[aligned]]):
        line, before = breadth_first_order(graph, int(np.argmax(piece == p)), directed=False)
        change = opposite[np.searchsorted(key, before[line[1:]] * count + line[1:])]
        for t, flipped in zip(line[1:], change, strict=True):
            turned[t] = turned[before[t]] ^ flipped
    triangles = mesh.triangles.copy()
    triangles[turned] = triangles[turned][:, ::-1]
    corners = mesh.vertices[triangles] - mesh.vertices.mean(axis=0)
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    inverted = np.bincount(piece, weights=volume, minlength=pieces) < 0.0
    inverted[np.unique(piece[links.border])] = False
    triangles[inverted[piece]] = triangles[inverted[piece]][:, ::-1]
    return Mesh(mesh.vertices, triangles)


def _area_vectors(corners: np.ndarray) -> np.ndarray:
    """Return a vector along the normal of every triangle, twice its area long, shape (T, 3)."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def facet_normals(mesh: Mesh, links: Links) -> np.ndarray:
    """Return the unit normal of every triangle, shape (T, 3).

    A needle is as good as flat: its own normal is rounding error. It takes the one of its neighbour
    across its longest side.
    """
    corners = mesh.corners()
    vectors = _area_vectors(corners)
    double = np.linalg.norm(vectors, axis=1)
    normals = vectors / np.maximum(double, 1e-300)[:, None]
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    longest = np.argmax(sides, axis=1)
    needle = double / sides.max(axis=1) < _NEEDLE * mesh.size()
    across = np.full(len(corners), -1)
    for one, place, two in ((links.first, links.first_place, links.second),
                            (links.second, links.second_place, links.first)):  # fmt: skip
        here = needle[one] & (longest[one] == place)
        across[one[here]] = two[here]
    for _ in range(4):  # a needle may lie beside another
        open_ = np.flatnonzero(needle & (across >= 0))
        open_ = open_[~needle[across[open_]]]
        normals[open_] = normals[across[open_]]
        needle[open_] = False
    return normals


def crease_angle(angles: np.ndarray) -> float:
    """Return the angle that parts smooth joints from creases [rad], from all angles of a mesh.

    It is the middle of the widest range between 10 and 60 degrees in which no angle of the mesh
    lies; 30 degrees when no such range is 5 degrees wide.
    """
    inner = angles[(angles > _ANGLES[0]) & (angles < _ANGLES[1])]
    values = np.concatenate([[_ANGLES[0]], np.sort(inner), [_ANGLES[1]]])
    widest = int(np.argmax(np.diff(values)))
    if values[widest + 1] - values[widest] < _GAP:
        return _CREASE
    return float(0.5 * (values[widest] + values[widest + 1]))


def angles_between(normals: np.ndarray, links: Links) -> np.ndarray:
    """Return the angle between the two triangles at every edge [rad], shape (P,)."""
    sign = np.where(links.aligned, -1.0, 1.0)
    first, second = normals[links.first], normals[links.second]
    sine = np.linalg.norm(np.cross(first, second), axis=1)
    return np.arctan2(sine, sign * np.einsum("ij,ij->i", first, second))


def smooth_groups(count: int, links: Links, joined: np.ndarray) -> np.ndarray:
    """Return the group of every triangle, shape (T,): connected through the edges that join."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = (links.first[joined], links.second[joined])
    graph = coo_matrix((np.ones(len(pairs[0]), bool), pairs), (count, count))
    groups: np.ndarray = connected_components(graph, directed=False)[1]
    return groups


def corner_normals(mesh: Mesh, normals: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return a unit normal for every corner, shape (T, 3, 3).

    It is the mean of the normals of the triangles of one group around the vertex, each weighted by
    its angle there (Thürmer and Wüthrich, Journal of Graphics Tools 3(1), 1998).
    """
    corners = mesh.corners()
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(ahead, behind), axis=2)
    angle = np.arctan2(sine, np.einsum("ijk,ijk->ij", ahead, behind))
    key = group[:, None].astype(np.int64) * len(mesh.vertices) + mesh.triangles
    _, place = np.unique(key, return_inverse=True)
    place = place.reshape(-1)
    weighted = (angle[:, :, None] * normals[:, None, :]).reshape(-1, 3)
    total = np.stack([np.bincount(place, weights=weighted[:, k]) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    mean = (total / np.maximum(length, 1e-300))[place].reshape(-1, 3, 3)
    return np.where((length[place] > 1e-12).reshape(-1, 3, 1), mean, normals[:, None, :])


def edge_curves(
    mesh: Mesh,
    links: Links,
    surface: np.ndarray,
    normals: np.ndarray,
    fillet: np.ndarray,
    smooth: float = SMOOTH,
) -> Edges:
    """Return the pieces at which two surfaces meet, or one ends.

    Args:
        mesh: The mesh.
        links: Its neighbours.
        surface: Surface of every triangle, shape (T,).
        normals: Normals of the surfaces at the corners of every triangle, shape (T, 3, 3).
        fillet: True for the surfaces that are fillets, shape (S,).
        smooth: Surfaces that meet at a smaller angle meet smoothly [rad].
    """
    apart = np.flatnonzero(surface[links.first] != surface[links.second])
    one, two = links.first[apart], links.second[apart]
    begin, place = links.first_place[apart], links.second_place[apart]
    here = normals[one, begin] + normals[one, (begin + 1) % 3]
    there = normals[two, place] + normals[two, (place + 1) % 3]
    there *= np.where(links.aligned[apart], -1.0, 1.0)[:, None]
    sine = np.linalg.norm(np.cross(here, there), axis=1)
    angle = np.arctan2(sine, np.einsum("ij,ij->i", here, there))
    fillets = fillet[surface[one]].astype(int) + fillet[surface[two]]
    kind = np.select(
        [angle > smooth, fillets == 1, fillets == 0],
        [EdgeClass.SHARP, EdgeClass.FILLET, EdgeClass.SMOOTH], EdgeClass.NONE,
    )  # fmt: skip
    triangle = np.concatenate([one, links.border])
    begin = np.concatenate([begin, links.border_place])
    kind = np.concatenate([kind, np.full(len(links.border), EdgeClass.SHARP)]).astype(np.uint8)
    kept = kind != EdgeClass.NONE
    start = mesh.vertices[mesh.triangles[triangle, begin]]
    end = mesh.vertices[mesh.triangles[triangle, (begin + 1) % 3]]
    return Edges(start[kept], end[kept], kind[kept])
