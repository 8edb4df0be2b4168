"""Regions that are several flat faces joined by bends are cut along the bends.

A bend that is wider than the smallest cell leaves a chain of agreeing cells, through which the
flood passes from face to face. The paper's remedy is to remove the smallest cells by hand until the
faces come apart (section 3.4). Here the turning of the normals from cell to cell tells where a
region bends: the cells that turn most are removed, and the cut is accepted when the turning is
concentrated in what was removed: every face is flat compared with the angle to its nearest sister.
A surface of even curvature never passes: removing any half of it leaves pieces that turn by t with
gaps of t between them; such a piece has the deviation t / sqrt(12), and its sister stands at the
angle 2 t: a ratio of 0.14.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, I64Rows, ti
from octoseg_ti.stages.adjacency import Adjacency
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.moments import HI, LO, NORMAL, POINT
from octoseg_ti.stages.regions import flood_fill
from octoseg_ti.types import NONE

_ONE = 1048576.0  # 2^20
# Well below the 0.14 of an evenly curved surface.
_FLAT = 0.08
# The faces must hold most of the region: else it is a curved surface with flat spots.
_COVERAGE = 0.6
# ... and so much of what the faces hold must be flat; the rest may be cut further.
_FLAT_SHARE = 0.4
# A cell belongs to a face when its normal is within this share of the angle to the next face.
_RIM = 0.25
# ... and the rims of two faces are half that angle apart: this share keeps them from joining.
_APART = 0.4
# A cut that leaves one piece with more than this share is none.
_WHOLE = 0.95
# Faces at a smaller angle are not told apart [rad].
_LEAST_ANGLE = 0.1


def _flat_faces(
    piece: np.ndarray,
    count: np.ndarray,
    normal: np.ndarray,
    *,
    noise: float,
    least_angle: float,
    signed: bool,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the flat faces among the pieces of a region, if the region consists of such.

    Args:
        piece: Piece of every cell of the region, 0..K-1, -1 = removed, shape (c,).
        count: Points of every cell, shape (c,).
        normal: Mean normal of every cell, shape (c, 3).
        noise: Deviation of the normals that is noise [rad].
        least_angle: Pieces at a smaller angle are parallel; they say nothing about bends [rad].
        signed: Normals have a side.

    Returns:
        Normals of the flat faces, shape (F, 3), and the angle of each to its nearest sister, shape
        (F,); None when the turning is not concentrated in what was removed.
    """
    pieces = int(piece.max(initial=NONE)) + 1
    inside = piece >= 0
    if pieces < 2 or count[inside].sum() < _COVERAGE * count.sum():
        return None
    piece, count, normal = piece[inside], count[inside], normal[inside]
    size, mean, tensor = _means(piece, count, normal, pieces)
    value, vector = np.linalg.eigh(tensor)
    axis = vector[:, :, 2]
    # What the noise of one point adds, spread over the points of a typical cell.
    cells = np.bincount(piece, minlength=pieces)
    spread = np.maximum(1.0 - value[:, 2] - noise**2 * cells / size, 0.0)
    if signed:
        axis = axis * np.where((axis * mean).sum(axis=1) < 0, -1.0, 1.0)[:, None]
        cosine = axis @ axis.T
    else:
        cosine = np.abs(axis @ axis.T)
    cosine[cosine > np.cos(least_angle)] = -1.0  # itself, and its parallels
    nearest = np.arccos(np.clip(cosine.max(axis=1), -1.0, 1.0))
    nearest[(cosine == -1.0).all(axis=1)] = 0.0
    flat = np.sqrt(spread) <= _FLAT * nearest
    if flat.sum() < 2 or size[flat].sum() < _FLAT_SHARE * size.sum():
        return None
    return axis[flat], nearest[flat]


@ti.kernel
def _sum_turns(
    variance: ti.f64,
    finest: ti.f64,
    # In:
    node_in: I32Rows,
    count_in: I32Array,
    neighbor_in: I32Rows,
    mean_in: F64Rows,
    group_in: I32Array,
    # Out:
    sum_inout: I64Rows,
):
    """Add up squared turning and squared distance to the touching cells of the same group."""
    for c in group_in:
        if group_in[c] >= 0:
            n = row(mean_in, c)
            own_turn = ti.i64(0)
            own_far = ti.i64(0)
            for k in range(count_in[c]):
                b = neighbor_in[c, k]
                if group_in[b] == group_in[c]:
                    m = row(mean_in, b)
                    if n.dot(m) < 0.0:
                        m = -m
                    d = vec3(
                        mean_in[b, POINT] - mean_in[c, POINT],
                        mean_in[b, POINT + 1] - mean_in[c, POINT + 1],
                        mean_in[b, POINT + 2] - mean_in[c, POINT + 2],
                    )
                    count = 1.0 / (node_in[c, HI] - node_in[c, LO])
                    count += 1.0 / (node_in[b, HI] - node_in[b, LO])
                    # What the noise of the mean normals adds is taken off, also where that leaves
                    # less than nothing: the sum over the pairs is right. Every pair has one vote
                    # on the curvature, or large cells would drown the bend beside them.
                    square = d.norm_sqr() / (finest * finest)
                    weight = 1.0 / ti.max(1.0, square)
                    change = weight * ((n - m).norm_sqr() - variance * count)
                    turn = ti.cast(change * _ONE, ti.i64)
                    far = ti.cast(weight * square * _ONE, ti.i64)
                    own_turn += turn
                    own_far += far
                    ti.atomic_add(sum_inout[b, 0], turn)
                    ti.atomic_add(sum_inout[b, 1], far)
            ti.atomic_add(sum_inout[c, 0], own_turn)
            ti.atomic_add(sum_inout[c, 1], own_far)


def turning(grid: Grid, touching: Adjacency, group: np.ndarray, noise: float) -> np.ndarray:
    """Return how far the normal turns over one smallest cell, around every cell of a group.

    Args:
        grid: The sparse grid.
        touching: Its touching pairs of leaves.
        group: Group of every node, -1 = none, shape (M,), i32.
        noise: Deviation of the normals that is noise [rad].

    Returns:
        Root mean square turning [rad], shape (M,); 0 for cells without a neighbour in their group.
    """
    runtime.ensure_started()
    sums = runtime.zeros((grid.count, 2), np.int64)
    _sum_turns(
        noise**2,
        grid.size / 2.0**grid.depth,
        grid.node,
        touching.count,
        touching.neighbor,
        grid.mean,
        runtime.upload(group),
        sums,
    )
    turn, far = runtime.download(sums).T.astype(np.float64)
    return np.sqrt(np.maximum(turn, 0.0) / np.maximum(far, 1.0))


def split_at_bends(
    grid: Grid,
    touching: Adjacency,
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
        touching: Its touching pairs of leaves.
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
    mean = runtime.download(grid.mean)[: grid.count]
    count = grid.holds
    result = group.copy()
    suspects = _suspects(group, count, mean[:, NORMAL : NORMAL + 3], 2 * min_points, flat)
    if not suspects:
        return result
    named = np.full(grid.count, NONE, np.int32)
    for name, cells in suspects.items():
        named[cells] = name
    turn = turning(grid, touching, named, noise)
    # The highest valley may only part the worst cells from the rest: then the next one below it.
    bound = dict.fromkeys(suspects, np.inf)
    while suspects:
        straight = {}
        for name, cells in suspects.items():
            below = turn[cells] <= bound[name]
            limit = _valley(turn[cells[below]], count[cells[below]])
            if limit >= bound[name]:
                continue  # what is left turns all alike: no valley below
            bound[name] = limit
            kept = turn[cells] <= limit
            if not kept.all() and count[cells[kept]].sum() >= _COVERAGE * count[cells].sum():
                straight[name] = cells[kept]
        if not straight:
            break
        takes_part = np.zeros(grid.count, bool)
        takes_part[np.concatenate(list(straight.values()))] = True
        pieces = flood_fill(
            grid, touching, takes_part, homogeneity=homogeneity, chord=chord, slack=slack
        )
        inside = np.flatnonzero(pieces >= 0)
        points = np.bincount(pieces[inside], weights=count[inside], minlength=grid.count)
        pieces[inside] = np.where(points[pieces[inside]] >= min_points, pieces[inside], NONE)
        cut = {}
        narrow = homogeneity
        for name in straight:
            cells = suspects[name]
            numbered = np.full(len(cells), NONE)
            left = pieces[cells] >= 0
            numbered[left] = _numbered(pieces[cells][left])[1]
            normal = mean[cells, NORMAL : NORMAL + 3]
            faces = _flat_faces(
                numbered,
                count[cells],
                normal,
                noise=noise,
                least_angle=max(_LEAST_ANGLE, 2.0 * flat),
                signed=grid.signed,
            )
            if faces is not None:
                # What turns by chance alone, and the rim of a bend, go back to the faces.
                cosine = np.abs(normal @ faces[0].T)
                near = (cosine >= np.cos(_RIM * faces[1])).any(axis=1)
                takes_part[cells] = (pieces[cells] >= 0) | near
                cut[name] = cells
                narrow = min(narrow, _APART * float(faces[1].min()))
            else:
                takes_part[cells] = False
        suspects = {name: suspects[name] for name in straight if name not in cut}
        if not cut:
            continue
        pieces = flood_fill(
            grid, touching, takes_part, homogeneity=narrow, chord=chord, slack=slack
        )
        for name, cells in cut.items():
            sizes = np.bincount(pieces[cells] + 1, weights=count[cells])[1:]
            if sizes.max() > _WHOLE * count[cells].sum():
                suspects[name] = cells  # the rims closed the gaps again
                continue
            result[cells] = pieces[cells]
            normal = mean[cells, NORMAL : NORMAL + 3]
            for piece, part in _suspects(
                pieces[cells], count[cells], normal, 2 * min_points, flat
            ).items():
                suspects[piece] = cells[part]
                bound[piece] = np.inf
    return result


def _valley(turn: np.ndarray, count: np.ndarray) -> float:
    """Return the limit that parts the turning best into little and much (Otsu's criterion)."""
    order = np.argsort(turn)
    turn, count = turn[order], count[order].astype(np.float64)
    weight, sums = np.cumsum(count), np.cumsum(count * turn)
    cut = np.flatnonzero(turn[1:] > turn[:-1])  # between equal values there is no limit
    if len(cut) == 0:
        return float("inf")
    low, below = weight[cut], sums[cut]
    high, above = weight[-1] - low, sums[-1] - below
    apart = (below / low - above / high) ** 2 * low * high
    return float(turn[cut[int(np.argmax(apart))]])


def _suspects(
    group: np.ndarray, count: np.ndarray, normal: np.ndarray, min_points: int, flat: float
) -> dict[int, np.ndarray]:
    """Return the cells of every group that is large and not flat, by the name of the group."""
    large = np.bincount(group + 1, weights=count)[1:] >= max(min_points, 1)
    names, inside = np.flatnonzero(large), np.flatnonzero(np.append(large, False)[group])
    owner = (np.cumsum(large) - 1)[group[inside]]
    # Axes, not directions: without sides a mean of directions means nothing.
    _, _, tensor = _means(owner, count[inside], normal[inside], len(names))
    doubtful = 1.0 - np.linalg.eigvalsh(tensor)[:, 2] > flat**2
    asked = np.flatnonzero(doubtful[owner])
    order = asked[np.argsort(owner[asked], kind="stable")]
    ends = np.cumsum(np.bincount(owner[asked], minlength=len(names)))
    return {
        int(names[g]): inside[order[ends[g - 1] if g else 0 : ends[g]]]
        for g in np.flatnonzero(doubtful)
    }


def _means(
    owner: np.ndarray, count: np.ndarray, normal: np.ndarray, groups: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, mean normal and mean of its products by itself of every group of cells.

    Args:
        owner: Group of every cell, 0..groups-1, none without a cell, shape (c,).
        count: Points of every cell, shape (c,).
        normal: Mean normal of every cell, shape (c, 3).
        groups: Number of groups K.

    Returns:
        Shapes (K,), (K, 3) and (K, 3, 3), f64.
    """
    weight = count.astype(np.float64)
    size = np.bincount(owner, weight, groups)
    mean, tensor = np.empty((groups, 3)), np.empty((groups, 3, 3))
    for i, a in enumerate(np.ascontiguousarray(normal.T)):
        part = weight * a
        mean[:, i] = np.bincount(owner, part, groups) / size
        for j in range(i + 1):
            tensor[:, i, j] = np.bincount(owner, part * normal[:, j], groups) / size
            tensor[:, j, i] = tensor[:, i, j]
    return size, mean, tensor


def _numbered(names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the different names, ascending, and the place of every name among them."""
    there = np.zeros(int(names.max(initial=-1)) + 1, bool)
    there[names] = True
    return np.flatnonzero(there), (np.cumsum(there) - 1)[names]
