"""The true edges of a part: where its faces end, traced on the surfaces themselves.

Every surface has parameters (u, v). On a grid of them the part says where the surface bounds it.
Between a node on the boundary and one off it the face ends; halving finds the place exactly, in
every cell two such places make a chord, and chords are split until they follow the edge. So no
scan and no direction of view is involved, and joints where faces touch smoothly are found like any other.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octoseg_ti.types import EdgeClass, SurfaceKind
from scanner_sim.quadric import Surfaces, distance, frames, gradient
from scanner_sim.raycast import classify

if TYPE_CHECKING:
    from scanner_sim.part import FlatPart

_CELL = 0.5  # cells of the parameter grid [mm]; smaller for small radii
_CELLS_PER_RADIUS = 4.0
_MARGIN = 0.05  # the grid reaches this far beyond the faces [mm], so that every face ends on it
_DEVIATION = 0.002  # chords are split until they follow the edge this closely [mm]
_SPLITS = 6
_HALVINGS = 40
_PROBE = 0.02  # the neighbour of a face is looked for this far from the edge [mm]
_TOUCH = 1e-6  # a surface this close to a point of an edge passes through it [mm]
_SMOOTH = math.radians(5.0)  # faces that meet at a smaller angle meet smoothly


class Edges(NamedTuple):
    """The edges of a part as short straight pieces; ``E`` pieces."""

    start: np.ndarray
    """One end [mm], shape (E, 3)."""
    end: np.ndarray
    """Other end [mm], shape (E, 3)."""
    kind: np.ndarray
    """`EdgeClass`: SHARP, FILLET where a patch runs into a fillet, SMOOTH where two patches meet
    without an angle, shape (E,), u8."""


class _Chords(NamedTuple):
    """Pieces of the border of faces, in scaled parameters (mm)."""

    surface: np.ndarray
    first: np.ndarray
    second: np.ndarray


def trace_edges(part: FlatPart) -> Edges:
    """Return all edges of a solid, hidden ones too, to about 0.002 mm."""
    surface, inner, outer, first, second = _border(part)
    place = _halve(part, surface, inner, outer)
    chords = _Chords(surface[first], place[first], place[second])
    chords = _follow(part, chords)
    kind = _kinds(part, chords)
    kept = kind != EdgeClass.NONE
    return Edges(
        start=_points(part.surfaces, chords.surface[kept], chords.first[kept]),
        end=_points(part.surfaces, chords.surface[kept], chords.second[kept]),
        kind=kind[kept],
    )


def nearest_edge(edges: Edges, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distance to the nearest edge [mm] and its class for every point.

    Args:
        edges: The edges; with none of them every distance is infinite.
        points: Positions [mm], shape (N, 3).

    Returns:
        Distances, shape (N,), f64; classes (`EdgeClass`), shape (N,), u8.
    """
    from scipy.spatial import cKDTree

    if len(edges.kind) == 0:
        return np.full(len(points), math.inf), np.full(len(points), EdgeClass.NONE, np.uint8)
    span = edges.end - edges.start
    tree = cKDTree(0.5 * (edges.start + edges.end))
    # Pieces are shorter than a cell, so the nearest one has one of the nearest middles.
    count = min(6, len(edges.kind))
    candidates = tree.query(points, k=count, workers=-1)[1].reshape(len(points), count)
    best = np.full(len(points), math.inf)
    kind = np.zeros(len(points), np.uint8)
    squared = np.maximum(np.einsum("ij,ij->i", span, span), 1e-30)
    for k in range(count):
        piece = candidates[:, k]
        offset = points - edges.start[piece]
        along = np.einsum("ij,ij->i", offset, span[piece]) / squared[piece]
        offset -= np.clip(along, 0.0, 1.0)[:, None] * span[piece]
        far = np.sqrt(np.einsum("ij,ij->i", offset, offset))
        nearer = far < best
        best[nearer], kind[nearer] = far[nearer], edges.kind[piece[nearer]]
    return best, kind


def _scales(surfaces: Surfaces) -> np.ndarray:
    """Return millimetres per unit of u and of v, shape (S, 2); 1 where the unit is a millimetre."""
    kind, a, b = surfaces.kind, surfaces.data[:, 6], surfaces.data[:, 7]
    scale = np.ones((len(kind), 2))
    scale[kind == SurfaceKind.CYLINDER, 0] = a[kind == SurfaceKind.CYLINDER]
    ball = kind == SurfaceKind.SPHERE
    scale[ball] = a[ball, None]
    ring = kind == SurfaceKind.TORUS
    scale[ring, 0], scale[ring, 1] = (a + b)[ring], b[ring]
    return scale


def _points(surfaces: Surfaces, index: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return positions [mm], shape (N, 3), from scaled parameters, shape (N, 2).

    u is a coordinate of a plane, else the angle about the axis; v is the other coordinate, the height
    (cylinder, cone), the latitude (sphere), or the angle about the tube (torus). The angle of a
    cone keeps its unit, radians.
    """
    kind, data = surfaces.kind[index], surfaces.data[index]
    e1, e2 = (f[index] for f in frames(surfaces))
    u, v = (place / _scales(surfaces)[index]).T
    a, b = data[:, 6], data[:, 7]
    kinds = [kind == SurfaceKind.CYLINDER, kind == SurfaceKind.CONE, kind == SurfaceKind.SPHERE]
    radius = np.select(kinds, [a, v * np.tan(a), a * np.cos(v)], a + b * np.cos(v))
    height = np.select(kinds, [v, v, a * np.sin(v)], b * np.sin(v))
    flat = kind == SurfaceKind.PLANE
    x = np.where(flat, u, radius * np.cos(u))
    y = np.where(flat, v, radius * np.sin(u))
    z = np.where(flat, 0.0, height)
    return data[:, :3] + x[:, None] * e1 + y[:, None] * e2 + z[:, None] * data[:, 3:6]


def _grid(surfaces: Surfaces, s: int, limits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes in u and in v of the grid on one surface, in scaled parameters.

    A full turn ends with the node where it began, so that the last cell closes it.
    """
    kind = surfaces.kind[s]
    a, b = surfaces.data[s, 6:8]
    scale = _scales(surfaces)[s]
    e1, e2 = (f[s] for f in frames(surfaces))
    corners = np.array([[limits[i, 0], limits[j, 1], limits[k, 2]]
                        for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip
    local = (corners - surfaces.data[s, :3]) @ np.stack([e1, e2, surfaces.data[s, 3:6]], axis=1)
    low, high = local.min(axis=0) - _MARGIN, local.max(axis=0) + _MARGIN
    turn = np.array([0.0, 2.0 * math.pi])
    cell = _CELL
    if kind == SurfaceKind.PLANE:
        ranges, steps = ((low[0], high[0]), (low[1], high[1])), (cell, cell)
    elif kind == SurfaceKind.CYLINDER:
        ranges, steps = (turn * scale[0], (low[2], high[2])), (min(cell, a / _CELLS_PER_RADIUS), cell)
    elif kind == SurfaceKind.CONE:
        top = max(high[2], _MARGIN)
        widest = top * math.tan(a)
        ranges = (turn, (max(low[2], 0.0), top))
        steps = (min(cell / widest, 1.0 / _CELLS_PER_RADIUS), cell)
    elif kind == SurfaceKind.SPHERE:
        step = min(cell, a / _CELLS_PER_RADIUS)
        ranges, steps = (turn * a, (-math.pi / 2 * a, math.pi / 2 * a)), (step, step)
    else:
        step = min(cell, b / _CELLS_PER_RADIUS)
        ranges, steps = (turn * scale[0], turn * b), (min(cell, a / _CELLS_PER_RADIUS), step)
    u, v = (
        np.linspace(r[0], r[1], max(int(math.ceil((r[1] - r[0]) / step)), 4) + 1)
        for r, step in zip(ranges, steps, strict=True)
    )
    return u, v


def _border(
    part: FlatPart,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the crossings of all grid lines with borders of faces, and the chords between them.

    Returns:
        surface, shape (X,); the two nodes around every crossing, shapes (X, 2); the numbers of the two
        crossings of every chord, shapes (D,).
    """
    count = len(part.surfaces.kind)
    grids = [_grid(part.surfaces, s, part.surface_boxes[s]) for s in range(count)]
    places = [np.stack(np.meshgrid(u, v, indexing="ij"), axis=2) for u, v in grids]
    index = np.repeat(np.arange(count, dtype=np.int32), [p.size // 2 for p in places])
    flat = np.concatenate([p.reshape(-1, 2) for p in places])
    status = classify(part, _points(part.surfaces, index, flat), index)
    surface, inner, outer, first, second = [], [], [], [], []
    start = crossings = 0
    for s, place in enumerate(places):
        shape = place.shape[:2]
        sides = status[start : start + shape[0] * shape[1]].reshape(shape)
        start += sides.size
        _close(part.surfaces.kind[s], sides)
        a, b, one, two = _march(place, sides)
        surface.append(np.full(len(a), s, np.int32))
        inner.append(a)
        outer.append(b)
        first.append(one + crossings)
        second.append(two + crossings)
        crossings += len(a)
    return (
        np.concatenate(surface), np.concatenate(inner), np.concatenate(outer),
        np.concatenate(first), np.concatenate(second),
    )  # fmt: skip


def _close(kind: int, sides: np.ndarray) -> None:
    """Give the two ends of a full turn the same sides, in place: rounding must not open the seam."""
    if kind != SurfaceKind.PLANE:
        sides[-1] = sides[0]
    if kind == SurfaceKind.TORUS:
        sides[:, -1] = sides[:, 0]


def _march(
    place: np.ndarray, sides: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the crossings of one grid, as pairs of nodes, and the chords, as pairs of crossings."""
    cross_u = sides[1:] != sides[:-1]
    cross_v = sides[:, 1:] != sides[:, :-1]
    number_u = np.where(cross_u, np.cumsum(cross_u).reshape(cross_u.shape) - 1, -1)
    number_v = np.where(cross_v, np.cumsum(cross_v).reshape(cross_v.shape) - 1, -1)
    number_v[cross_v] += int(cross_u.sum())
    a = np.concatenate([place[:-1][cross_u], place[:, :-1][cross_v]])
    b = np.concatenate([place[1:][cross_u], place[:, 1:][cross_v]])
    # Around every cell: below, right, above, left. Two crossings make a chord, four make two.
    ring = np.stack([number_u[:, :-1], number_v[1:], number_u[:, 1:], number_v[:-1]], axis=2)
    cells = ring[(ring >= 0).sum(axis=2) >= 2]
    order = np.argsort(cells < 0, axis=1, kind="stable")
    cells = np.take_along_axis(cells, order, axis=1)
    pairs = [cells[:, :2], cells[cells[:, 3] >= 0][:, 2:]]
    three = (cells[:, 2] >= 0) & (cells[:, 3] < 0)
    pairs.append(cells[three][:, 1:3])
    chords = np.concatenate(pairs)
    return a, b, chords[:, 0], chords[:, 1]


def _halve(
    part: FlatPart, surface: np.ndarray, inner: np.ndarray, outer: np.ndarray
) -> np.ndarray:
    """Return where between two places the face ends, shape (X, 2)."""
    low, high = inner.copy(), outer.copy()
    side = classify(part, _points(part.surfaces, surface, low), surface)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        same = classify(part, _points(part.surfaces, surface, middle), surface) == side
        low[same], high[~same] = middle[same], middle[~same]
    return 0.5 * (low + high)


def _follow(part: FlatPart, chords: _Chords) -> _Chords:
    """Split chords where the edge leaves them, until none is further off than the limit."""
    done: list[_Chords] = []
    for _ in range(_SPLITS):
        middle = 0.5 * (chords.first + chords.second)
        run = chords.second - chords.first
        # The edge lies within half a chord beside the middle, if it does not turn back.
        aside = 0.5 * np.stack([-run[:, 1], run[:, 0]], axis=1)
        left, right = middle + aside, middle - aside
        across = [classify(part, _points(part.surfaces, chords.surface, p), chords.surface)
                  for p in (left, right)]  # fmt: skip
        open_ = across[0] != across[1]
        found = middle.copy()
        found[open_] = _halve(part, chords.surface[open_], left[open_], right[open_])
        off = np.linalg.norm(
            _points(part.surfaces, chords.surface, found)
            - 0.5 * (_points(part.surfaces, chords.surface, chords.first)
                     + _points(part.surfaces, chords.surface, chords.second)),
            axis=1,
        )  # fmt: skip
        split = open_ & (off > _DEVIATION)
        done.append(_Chords(*(values[~split] for values in chords)))
        kept = _Chords(*(values[split] for values in chords))
        chords = _Chords(
            np.concatenate([kept.surface, kept.surface]),
            np.concatenate([kept.first, found[split]]),
            np.concatenate([found[split], kept.second]),
        )
        if len(chords.surface) == 0:
            break
    done.append(chords)
    return _Chords(*(np.concatenate(values) for values in zip(*done, strict=True)))


def _kinds(part: FlatPart, chords: _Chords) -> np.ndarray:
    """Return the `EdgeClass` of every chord; NONE where two fillets meet smoothly."""
    surfaces = part.surfaces
    point = _points(surfaces, chords.surface, chords.first)
    run = _points(surfaces, chords.surface, chords.second) - point
    run /= np.maximum(np.linalg.norm(run, axis=1, keepdims=True), 1e-30)
    normal = gradient(surfaces, chords.surface, point)
    normal *= _side_near(part, chords.surface, point, run)[:, None]
    kind = np.full(len(point), EdgeClass.NONE, np.uint8)
    widest = np.full(len(point), -1.0)
    for s in range(len(surfaces.kind)):
        # Where does this surface pass through the edge of another one, and bound the part?
        limits = part.surface_boxes[s]
        close = ((point >= limits[0] - _PROBE) & (point <= limits[1] + _PROBE)).all(axis=1)
        near = np.flatnonzero(close & (chords.surface != s))
        other = np.full(len(near), s, np.int32)
        touch = np.abs(distance(surfaces, other, point[near])) < _TOUCH
        near, other = near[touch], other[touch]
        side = _side_near(part, other, point[near], run[near])
        near, other, side = near[side != 0], other[side != 0], side[side != 0]
        neighbour = gradient(surfaces, other, point[near]) * side[:, None]
        cosine = np.einsum("ij,ij->i", normal[near], neighbour)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        fillets = surfaces.fillet[chords.surface[near]].astype(int) + surfaces.fillet[s]
        found = np.select(
            [angle > _SMOOTH, fillets == 1, fillets == 0],
            [EdgeClass.SHARP, EdgeClass.FILLET, EdgeClass.SMOOTH], EdgeClass.NONE,
        )  # fmt: skip
        wider = angle > widest[near]
        kind[near[wider]], widest[near[wider]] = found[wider], angle[wider]
    return kind


def _side_near(
    part: FlatPart, surface: np.ndarray, point: np.ndarray, run: np.ndarray
) -> np.ndarray:
    """Return on which side of its surface the part lies, close to a point of an edge; 0 = it does not.

    Args:
        part: The solid.
        surface: Surface of every point, shape (N,).
        point: Points on it [mm], shape (N, 3).
        run: Direction of the edge, shape (N, 3).
    """
    across = np.cross(run, gradient(part.surfaces, surface, point))
    side = np.zeros(len(point), np.int32)
    for sign in (-_PROBE, _PROBE):
        probe = point + sign * across
        for _ in range(2):
            step = distance(part.surfaces, surface, probe)
            probe -= step[:, None] * gradient(part.surfaces, surface, probe)
        there = classify(part, probe, surface)
        side = np.where(side == 0, there, side)
    return side
