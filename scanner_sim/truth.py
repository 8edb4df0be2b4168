"""What is true about simulated points: patches, surfaces, distances to the part's edges."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from octoseg_ti.types import NONE, EdgeClass, SurfaceKind, Truth
from scanner_sim.edges import trace_edges
from scanner_sim.faces import goes_on
from scanner_sim.links import components, in_doubt, link_mesh
from scanner_sim.nearest import nearest_edge

if TYPE_CHECKING:
    from collections.abc import Callable

    from scanner_sim.mesh import MeshPart
    from scanner_sim.part import FlatPart

_SLIVER = 30  # a smaller piece is no patch: too few points to fit a surface to
_LINKS = 16


def build_truth(
    part: FlatPart,
    *,
    position: np.ndarray,
    normal: np.ndarray,
    surface: np.ndarray,
    stripe: np.ndarray,
    column: np.ndarray,
    reach: float,
    info: dict[str, str],
) -> Truth:
    """Return the truth about points that lie exactly on the part.

    Args:
        part: The solid.
        position: True positions [mm], world, shape (N, 3).
        normal: True outward normals, world, shape (N, 3).
        surface: Surface of every point, shape (N,), i32.
        stripe: Stripe of every point, shape (N,), i32.
        column: Number of the laser's ray of every point, shape (N,), i32.
        reach: Pieces of a face that come this close to each other [mm] are one piece, if the face
            goes on between them.
        info: How the points came about.
    """
    edge_distance, edge_class = nearest_edge(trace_edges(part), position)
    patch = find_patches(part, position, surface, stripe, column, edge_distance, reach)
    on_fillet = part.surfaces.fillet[surface]
    edge_distance[on_fillet] = 0.0
    edge_class[on_fillet] = EdgeClass.FILLET
    return Truth(
        patch=patch,
        surface=surface,
        kind=part.surfaces.kind[surface].astype(np.int8),
        position=position,
        normal=normal,
        edge_distance=edge_distance.astype(np.float32),
        edge_class=edge_class,
        radius=_radii(part)[surface] if part.surfaces.fillet.any() else None,
        info=info,
    )


def _radii(part: FlatPart) -> np.ndarray:
    """Return the radius of every fillet surface [mm], NaN for others, shape (S,), f32."""
    surfaces = part.surfaces
    tube = surfaces.kind == int(SurfaceKind.TORUS)
    radius = np.where(tube, surfaces.data[:, 7], surfaces.data[:, 6])
    return np.where(surfaces.fillet, radius, np.nan).astype(np.float32)


def find_patches(
    part: FlatPart | MeshPart,
    position: np.ndarray,
    surface: np.ndarray,
    stripe: np.ndarray,
    column: np.ndarray,
    edge_distance: np.ndarray,
    reach: float,
    goes_on: Callable[[np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:
    """Return the patch of every point: connected visible pieces of faces, by size; -1 on fillets.

    Neighbours in the mesh of a view are connected when they lie on one face, and so are pieces that
    come within ``reach`` of each other, in one view (a lost point) or in two; unless the face ends
    between them. Fewer than 30 points are no patch.

    Args:
        part: The solid.
        position: True positions [mm], shape (N, 3), stripe after stripe, in order along each.
        surface: Surface of every point, shape (N,), i32.
        stripe: Stripe of every point, unique over all views, shape (N,), i32.
        column: Number of the laser's ray of every point, shape (N,), i32.
        edge_distance: Distance of every point to the nearest edge [mm], shape (N,).
        reach: Distance that connects pieces [mm].
        goes_on: Says for pairs of points of one face, shape (P, 2), whether the face goes on
            between them; None asks the CSG part.

    Returns:
        Patch of every point, 0..K-1, shape (N,), i32; -1 = none.
    """
    faces = _Faces(part, position, surface, edge_distance, goes_on)
    piece, doubtful = link_mesh(position, surface, stripe, column, edge_distance, reach)
    piece = components(piece[doubtful[faces.connect(doubtful)]], piece.max() + 1)[piece]
    # Most pieces overlap far from any edge; what is left to bridge are few points near edges.
    piece = components(_overlaps(faces, piece, reach), piece.max() + 1)[piece]
    piece = components(_bridges(faces, piece, reach), piece.max() + 1)[piece]
    size = np.bincount(piece)
    size[piece[part.surfaces.fillet[surface]]] = 0
    rank = np.full(len(size), NONE, np.int32)
    order = np.argsort(-size, kind="stable")
    large = order[size[order] >= _SLIVER]
    rank[large] = np.arange(len(large))
    return rank[piece]


class _Faces(NamedTuple):
    """Points on the faces of a part, and what is known about them."""

    part: FlatPart | MeshPart
    position: np.ndarray
    surface: np.ndarray
    edge_distance: np.ndarray
    goes_on: Callable[[np.ndarray], np.ndarray] | None

    def length(self, pairs: np.ndarray) -> np.ndarray:
        """Return the distance between the points of every pair [mm], shape (P,)."""
        step: np.ndarray = self.position[pairs[:, 0]] - self.position[pairs[:, 1]]
        return np.sqrt(np.einsum("ij,ij->i", step, step))

    def connect(self, pairs: np.ndarray) -> np.ndarray:
        """Return whether the face goes on between two of its points, shape (P,), bool."""
        whole = np.ones(len(pairs), bool)
        clear = self.edge_distance[pairs[:, 0]] + self.edge_distance[pairs[:, 1]]
        # Where the edges are too far to come between the points, there is nothing to test.
        doubtful = np.flatnonzero(in_doubt(clear, self.length(pairs)))
        if self.goes_on is not None:
            whole[doubtful] = self.goes_on(pairs[doubtful])
            return whole
        first, second = self.position[pairs[doubtful]].transpose(1, 0, 2)
        surface = self.surface[pairs[doubtful, 0]]
        whole[doubtful] = goes_on(cast("FlatPart", self.part), surface, first, second)
        return whole


def _overlaps(faces: _Faces, piece: np.ndarray, reach: float) -> np.ndarray:
    """Return pairs of pieces of one face that share a small cell with no edge near it."""
    size = reach / 3.0
    inner = np.flatnonzero(faces.edge_distance > 2.0 * size)
    cell = np.floor((faces.position[inner] - faces.position.min(axis=0)) / size).astype(np.int64)
    shape = (*(cell.max(axis=0, initial=0) + 1), len(faces.part.surfaces.kind))
    key = np.ravel_multi_index((*cell.T, faces.surface[inner]), shape)
    order = np.argsort(key, kind="stable")
    key, own = key[order], piece[inner[order]]
    same = np.flatnonzero((key[1:] == key[:-1]) & (own[1:] != own[:-1]))
    return np.column_stack([own[same], own[same + 1]])


def _bridges(faces: _Faces, piece: np.ndarray, reach: float) -> np.ndarray:
    """Return pairs of pieces that belong together, shape (B, 2)."""
    from scipy.spatial import cKDTree

    part, points, surface = faces.part, faces.position, faces.surface
    # Faces in one piece need no bridge, nor do fillets. Of the others, one point for each small
    # cell of each piece is enough to find out which pieces are close.
    face = np.empty(piece.max() + 1, np.int32)
    face[piece] = surface
    pieces = np.bincount(face, minlength=len(part.surfaces.kind))
    open_ = np.flatnonzero((pieces[surface] > 1) & ~part.surfaces.fillet[surface])
    cell = np.floor((points[open_] - points.min(axis=0)) / (reach / 3)).astype(np.int64)
    extent = cell.max(axis=0, initial=0) + 1
    key = np.ravel_multi_index(tuple(cell.T), tuple(extent)) + extent.prod() * piece[open_]
    kept = open_[np.unique(key, return_index=True)[1]]
    if len(kept) == 0:
        return np.empty((0, 2), np.int64)
    pairs = kept[cKDTree(points[kept]).query_pairs(reach, output_type="ndarray")]
    ends, on = piece[pairs], surface[pairs]
    pairs = pairs[(ends[:, 0] != ends[:, 1]) & (on[:, 0] == on[:, 1])]
    couple = np.sort(piece[pairs], axis=1).astype(np.int64) @ [piece.max() + 1, 1]
    order = np.lexsort((faces.length(pairs), couple))
    pairs, couple = pairs[order], couple[order]
    # The shortest links of a couple are tried first; where one holds, the others need no test.
    rank = np.arange(len(couple)) - np.searchsorted(couple, couple)
    tried, bridges = _LINKS, [np.empty((0, 2), np.int64)]
    while len(couple):
        batch = rank < tried
        holds = faces.connect(pairs[batch])
        bridges.append(piece[pairs[batch][holds]])
        left = ~batch & ~np.isin(couple, couple[batch][holds])
        pairs, couple, rank = pairs[left], couple[left], rank[left]
        tried *= 4
    return np.concatenate(bridges)
