"""What is true about simulated points: their patches, surfaces, and distances to the part's edges."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from octoseg_ti.types import NONE, EdgeClass, Truth
from scanner_sim.edges import nearest_edge, trace_edges
from scanner_sim.quadric import distance, gradient
from scanner_sim.raycast import classify

if TYPE_CHECKING:
    from scanner_sim.part import FlatPart

_SLIVER = 30  # a smaller piece is no patch: too few points to fit a surface to
_LINKS = 16
_BETWEEN = np.array([0.2, 0.4, 0.6, 0.8])


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
        reach: Pieces of a face that come this close to each other [mm] are one piece, if the face goes
            on between them.
        info: How the points came about.
    """
    patch = find_patches(part, position, surface, stripe, column, reach)
    edge_distance, edge_class = nearest_edge(trace_edges(part), position)
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
        info=info,
    )


def find_patches(
    part: FlatPart,
    position: np.ndarray,
    surface: np.ndarray,
    stripe: np.ndarray,
    column: np.ndarray,
    reach: float,
) -> np.ndarray:
    """Return the patch of every point: connected visible pieces of faces, by size; -1 on fillets.

    Neighbours in the mesh of a view are connected when they lie on one face. So are pieces that come
    within ``reach`` of each other, in one view (a lost point) or in two, unless the face ends
    between them. Fewer than 30 points are no patch.

    Args:
        part: The solid.
        position: True positions [mm], shape (N, 3), stripe after stripe, in order along each.
        surface: Surface of every point, shape (N,), i32.
        stripe: Stripe of every point, unique over all views, shape (N,), i32.
        column: Number of the laser's ray of every point, shape (N,), i32.
        reach: Distance that connects pieces [mm].

    Returns:
        Patch of every point, 0..K-1, shape (N,), i32; -1 = none.
    """
    pairs = _mesh_pairs(stripe, column)
    same = surface[pairs[:, 0]] == surface[pairs[:, 1]]
    step = np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1)
    piece = _components(pairs[same & (step <= reach)], len(position))
    piece = _components(_bridges(part, position, surface, piece, reach), piece.max() + 1)[piece]
    size = np.bincount(piece)
    size[piece[part.surfaces.fillet[surface]]] = 0
    rank = np.full(len(size), NONE, np.int32)
    order = np.argsort(-size, kind="stable")
    large = order[size[order] >= _SLIVER]
    rank[large] = np.arange(len(large))
    return rank[piece]


def _mesh_pairs(stripe: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return pairs of close points, along the stripes and across them, shape (P, 2)."""
    width = int(column.max()) + 3
    key = stripe.astype(np.int64) * width + column
    pairs = []
    for step in (1, 2, width - 1, width, width + 1, 2 * width):
        place = np.minimum(np.searchsorted(key, key + step), len(key) - 1)
        near = np.flatnonzero(key[place] == key + step)
        pairs.append(np.column_stack([near, place[near]]))
    return np.concatenate(pairs)


def _components(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return the connected component of every node, shape (count,)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (count, count))
    labels: np.ndarray = connected_components(graph, directed=False)[1]
    return labels


def _bridges(
    part: FlatPart, points: np.ndarray, surface: np.ndarray, piece: np.ndarray, reach: float
) -> np.ndarray:
    """Return pairs of pieces that belong together, shape (B, 2)."""
    from scipy.spatial import cKDTree

    # Faces in one piece need no bridge, nor do fillets. Of the others, one point for each small cell
    # of each piece is enough to find out which pieces are close.
    face = np.empty(piece.max() + 1, np.int32)
    face[piece] = surface
    pieces = np.bincount(face, minlength=len(part.surfaces.kind))
    open_ = np.flatnonzero((pieces[surface] > 1) & ~part.surfaces.fillet[surface])
    cell = np.floor((points[open_] - points.min(axis=0)) / (reach / 4)).astype(np.int64)
    extent = cell.max(axis=0, initial=0) + 1
    key = np.ravel_multi_index(tuple(cell.T), tuple(extent)) + extent.prod() * piece[open_]
    kept = open_[np.unique(key, return_index=True)[1]]
    if len(kept) == 0:
        return np.empty((0, 2), np.int64)
    pairs = kept[cKDTree(points[kept]).query_pairs(reach, output_type="ndarray")]
    first, second = pairs[:, 0], pairs[:, 1]
    near = (piece[first] != piece[second]) & (surface[first] == surface[second])
    first, second = first[near], second[near]
    swap = piece[first] > piece[second]
    first, second = np.where(swap, second, first), np.where(swap, first, second)
    couple = piece[first].astype(np.int64) * (piece.max() + 1) + piece[second]
    length = np.linalg.norm(points[first] - points[second], axis=1)
    order = np.lexsort((length, couple))
    first, second, couple = first[order], second[order], couple[order]
    # The shortest links of a couple are tried first; where one holds, the others need no test.
    rank = np.arange(len(couple)) - np.searchsorted(couple, couple)
    tried, bridges = 0, []
    while len(couple):
        batch = rank < tried + _LINKS
        holds = _face_between(
            part, points[first[batch]], points[second[batch]], surface[first[batch]]
        )
        bridges.append(np.column_stack([piece[first[batch]], piece[second[batch]]])[holds])
        left = ~batch & ~np.isin(couple, couple[batch][holds])
        first, second, couple, rank = first[left], second[left], couple[left], rank[left]
        tried = (tried + _LINKS) * 4
    return np.concatenate([np.empty((0, 2), np.int64), *bridges])


def _face_between(
    part: FlatPart, first: np.ndarray, second: np.ndarray, surface: np.ndarray
) -> np.ndarray:
    """Return whether the face goes on between two of its points, shape (P,), bool."""
    whole = np.ones(len(first), bool)
    for share in _BETWEEN:
        middle = (1.0 - share) * first + share * second
        for _ in range(2):
            step = distance(part.surfaces, surface, middle)
            middle -= step[:, None] * gradient(part.surfaces, surface, middle)
        whole &= classify(part, middle, surface) != 0
    return whole
