"""Regions that are several flat faces joined by bends are cut along the bends.

A bend that is wider than the smallest cell leaves a chain of agreeing cells, through which the flood
passes from face to face. The paper's remedy is to remove the smallest cells by hand until the faces
come apart (section 3.4). Here each region is tried with every number of smallest sizes removed, and
the cut is accepted when the turning of the normals is concentrated in what was removed: every face
is flat compared with the angle to its nearest sister. A surface of even curvature never passes: the
sizes of its cells alternate with its direction in the grid, so that pieces that turn by t are left
with gaps of t between them; such a piece has the deviation t / sqrt(12), and its sister stands at
the angle 2 t: a ratio of 0.14.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.moments import HI, LEVEL, LO, NORMAL
from octoseg_ti.stages.regions import flood_fill
from octoseg_ti.types import NONE

# Well below the 0.14 of an evenly curved surface.
_FLAT = 0.08
# The faces must hold most of the region: else it is a curved surface with flat spots.
_COVERAGE = 0.6
# ... and most of what the faces hold must be flat, so that a face may still be cut further.
_FLAT_SHARE = 0.8
# Faces at a smaller angle are not told apart [rad].
_LEAST_ANGLE = 0.1


def _faces_are_flat(
    piece: np.ndarray,
    count: np.ndarray,
    normal: np.ndarray,
    *,
    noise: float,
    least_angle: float,
    signed: bool,
) -> bool:
    """Say whether the pieces are flat faces that stand at an angle to each other.

    Args:
        piece: Piece of every cell of the region, 0..K-1, -1 = removed, shape (c,).
        count: Points of every cell, shape (c,).
        normal: Mean normal of every cell, shape (c, 3).
        noise: Deviation of the normals that is noise [rad].
        least_angle: Pieces at a smaller angle are parallel; they say nothing about bends [rad].
        signed: Normals have a side.
    """
    pieces = int(piece.max(initial=NONE)) + 1
    inside = piece >= 0
    if pieces < 2 or count[inside].sum() < _COVERAGE * count.sum():
        return False
    tensor = np.zeros((pieces, 3, 3))
    size = np.bincount(piece[inside], weights=count[inside], minlength=pieces)
    n = normal[inside]
    np.add.at(tensor, piece[inside], count[inside, None, None] * n[:, :, None] * n[:, None, :])
    value, vector = np.linalg.eigh(tensor / size[:, None, None])
    axis = vector[:, :, 2]
    # What the noise of one point adds, spread over the points of a typical cell.
    cells = np.bincount(piece[inside], minlength=pieces)
    spread = np.maximum(1.0 - value[:, 2] - noise**2 * cells / size, 0.0)
    if signed:
        mean = np.zeros((pieces, 3))
        np.add.at(mean, piece[inside], count[inside, None] * n)
        axis = axis * np.where(np.einsum("ki,ki->k", axis, mean) < 0, -1.0, 1.0)[:, None]
        cosine = axis @ axis.T
    else:
        cosine = np.abs(axis @ axis.T)
    cosine[cosine > np.cos(least_angle)] = -1.0  # itself, and its parallels
    nearest = np.arccos(np.clip(cosine.max(axis=1), -1.0, 1.0))
    nearest[(cosine == -1.0).all(axis=1)] = 0.0
    flat = np.sqrt(spread) <= _FLAT * nearest
    return flat.sum() >= 2 and bool(size[flat].sum() >= _FLAT_SHARE * size.sum())


def split_at_bends(
    grid: Grid,
    group: np.ndarray,
    *,
    homogeneity: float,
    chord: float,
    slack: float,
    min_points: int,
    flat: float,
    noise: float,
) -> np.ndarray:
    """Cut the groups that are several flat faces.

    Args:
        grid: The sparse grid.
        group: Group of every node, named by its first node, -1 = none, shape (M,), i32.
        homogeneity: As for `flood_fill` [rad].
        chord: As for `flood_fill`.
        slack: As for `flood_fill` [mm].
        min_points: A piece with fewer points is no face.
        flat: Groups with a smaller deviation of their normals are left alone [rad].
        noise: Deviation of the normals that is noise [rad].

    Returns:
        Group of every node after the cuts, -1 for the cells that were removed: the bends.
    """
    node = runtime.download(grid.node)[: grid.count]
    mean = runtime.download(grid.mean)[: grid.count]
    count = node[:, HI] - node[:, LO]
    inside = np.flatnonzero(group >= 0)
    size = np.bincount(group[inside], weights=count[inside], minlength=grid.count)
    sums = np.stack(
        [
            np.bincount(
                group[inside], weights=count[inside] * mean[inside, NORMAL + k], minlength=grid.count
            )
            for k in range(3)
        ],
        axis=1,
    )
    length = np.linalg.norm(sums, axis=1) / np.maximum(size, 1)
    suspect = (size >= 2 * min_points) & (length < np.cos(flat))
    result = group.copy()
    takes_part = np.zeros(grid.count, bool)
    takes_part[inside] = suspect[group[inside]]
    while takes_part.any():
        # Remove the smallest size that is left of every suspect.
        part = np.flatnonzero(takes_part)
        finest = np.zeros(grid.count, np.int32)
        np.maximum.at(finest, result[part], node[part, LEVEL])
        takes_part[part] = node[part, LEVEL] < finest[result[part]]
        if not takes_part.any():
            break
        pieces = flood_fill(grid, takes_part, homogeneity=homogeneity, chord=chord, slack=slack)
        in_piece = np.flatnonzero(pieces >= 0)
        points = np.bincount(pieces[in_piece], weights=count[in_piece], minlength=grid.count)
        pieces[in_piece] = np.where(points[pieces[in_piece]] >= min_points, pieces[in_piece], NONE)
        for name in np.unique(result[part]):
            cells = np.flatnonzero(result == name)
            names, numbered = np.unique(pieces[cells], return_inverse=True)
            numbered = numbered - int(names[0] == NONE)
            normal = mean[cells, NORMAL : NORMAL + 3]
            if _faces_are_flat(
                numbered,
                count[cells],
                normal,
                noise=noise,
                least_angle=max(_LEAST_ANGLE, 2.0 * flat),
                signed=grid.signed,
            ):
                result[cells] = pieces[cells]
                takes_part[cells] &= pieces[cells] >= 0
    return result
