"""What is true about simulated points: their patches, surfaces, and distances to the part's edges."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from octoseg_ti.types import NONE, EdgeClass, Truth
from scanner_sim.quadric import distance, gradient
from scanner_sim.raycast import classify

if TYPE_CHECKING:
    from scanner_sim.part import FlatPart

_SLIVER = 30  # a smaller piece is no patch: too few points to fit a surface to
_BETWEEN = np.array([0.2, 0.4, 0.6, 0.8])


def build_truth(
    part: FlatPart,
    *,
    position: np.ndarray,
    normal: np.ndarray,
    surface: np.ndarray,
    pitch: float,
    reach: float,
    info: dict[str, str],
) -> Truth:
    """Return the truth about points that lie exactly on the part.

    Args:
        part: The solid.
        position: True positions [mm], world, shape (N, 3).
        normal: True outward normals, world, shape (N, 3).
        surface: Surface of every point, shape (N,), i32.
        pitch: Larger one of stripe and point pitch [mm].
        reach: Pieces of a face that come this close to each other [mm] are one piece, if the face goes
            on between them.
        info: How the points came about.
    """
    patch = find_patches(part, position, surface, pitch, reach)
    return Truth(
        patch=patch,
        surface=surface,
        kind=part.surfaces.kind[surface].astype(np.int8),
        position=position,
        normal=normal,
        info=info,
    )


def find_patches(
    part: FlatPart, position: np.ndarray, surface: np.ndarray, pitch: float, reach: float
) -> np.ndarray:
    """Return the patch of every point: connected visible pieces of faces, by size; -1 on fillets.

    Points of one face that are about a pitch apart are connected. So are pieces that come within
    ``reach`` of each other (a lost point, a slanted wall), unless the face ends between them.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    patch = np.full(len(position), NONE, np.int32)
    chosen = np.flatnonzero(~part.surfaces.fillet[surface])
    if len(chosen) == 0:
        return patch
    points, faces = position[chosen], surface[chosen]
    pairs = cKDTree(points).query_pairs(1.5 * pitch, output_type="ndarray")
    pairs = pairs[faces[pairs[:, 0]] == faces[pairs[:, 1]]]
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (len(points),) * 2)
    count, piece = connected_components(graph, directed=False)
    bridges = _bridges(part, points, faces, piece, reach)
    graph = coo_matrix((np.ones(len(bridges), bool), (bridges[:, 0], bridges[:, 1])), (count,) * 2)
    _, merged = connected_components(graph, directed=False)
    piece = merged[piece]
    sizes = np.bincount(piece)
    rank = np.full(len(sizes), NONE, np.int32)
    order = np.argsort(-sizes, kind="stable")
    large = order[sizes[order] >= _SLIVER]
    rank[large] = np.arange(len(large))
    patch[chosen] = rank[piece]
    return patch


def _bridges(
    part: FlatPart, points: np.ndarray, faces: np.ndarray, piece: np.ndarray, reach: float
) -> np.ndarray:
    """Return pairs of pieces that belong together, shape (B, 2)."""
    from scipy.spatial import cKDTree

    # One point for each small cell of each piece is enough to find out which pieces are close.
    cell = np.floor(points / (reach / 4)).astype(np.int64)
    _, kept = np.unique(np.column_stack([piece, cell]), axis=0, return_index=True)
    pairs = kept[cKDTree(points[kept]).query_pairs(reach, output_type="ndarray")]
    first, second = pairs[:, 0], pairs[:, 1]
    near = (piece[first] != piece[second]) & (faces[first] == faces[second])
    first, second = first[near], second[near]
    joined = np.ones(len(first), bool)
    for share in _BETWEEN:
        middle = (1.0 - share) * points[first] + share * points[second]
        for _ in range(2):
            step = distance(part.surfaces, faces[first], middle)
            middle -= step[:, None] * gradient(part.surfaces, faces[first], middle)
        joined &= classify(part, middle, faces[first]) != 0
    return np.column_stack([piece[first[joined]], piece[second[joined]]])
