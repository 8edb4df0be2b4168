"""The true edges of a part: where its faces end, traced on the surfaces themselves.

Every surface has parameters (u, v). On a grid of them the part says where the surface bounds it.
Between a node on the boundary and one off it the face ends; halving finds the place exactly, in
every cell two such places make a chord, and chords are split until they follow the edge. So no
scan and no direction of view is involved, and joints where faces touch smoothly are found like any
other.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octoseg_ti.types import EdgeClass, SurfaceKind
from scanner_sim.quadric import distance, frames, gradient
from scanner_sim.raycast import classify

if TYPE_CHECKING:
    from scanner_sim.part import FlatPart

_CELL = 0.5  # cells of the parameter grid [mm]; smaller for small radii
_CELLS_PER_RADIUS = 4.0
_MARGIN = 0.05  # the grid reaches this far beyond the faces [mm], so that every face ends on it
_DEVIATION = 0.002  # chords are split until they follow the edge this closely [mm]
_SPLITS = 9
_ASIDE = (0.6, 1.2)
"""How far beside a chord its edge is looked for, in lengths of the chord: a corner of 53 degrees
is as far away as the chord is long."""
_HALVINGS = 18  # from a cell's size to some nanometres
_PROBE = 0.02  # the neighbour of a face is looked for this far from the edge [mm]
_TOUCH = 1e-5  # a surface this close to a point of an edge passes through it [mm]
_SAMPLE = 0.04  # spacing of the places by which the nearest edge is looked up [mm]
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


class _Chart(NamedTuple):
    """Parameters (u, v) of all surfaces, scaled so that a unit is about a millimetre."""

    part: FlatPart
    first: np.ndarray
    """Direction from which angles count, or of u, shape (S, 3)."""
    second: np.ndarray
    """Direction of a quarter turn, or of v, shape (S, 3)."""
    scale: np.ndarray
    """Millimetres per unit of u and v, at the widest place, shape (S, 2)."""


class _Chords(NamedTuple):
    """Pieces of the border of faces, in scaled parameters (mm)."""

    surface: np.ndarray
    first: np.ndarray
    second: np.ndarray


def trace_edges(part: FlatPart) -> Edges:
    """Return all edges of a solid, hidden ones too, to about 0.002 mm."""
    chart = _chart(part)
    surface, inner, outer, first, second = _border(chart)
    place = _halve(chart, surface, inner, outer)
    chords = _follow(chart, _Chords(surface[first], place[first], place[second]))
    start = _points(chart, chords.surface, chords.first)
    end = _points(chart, chords.surface, chords.second)
    kind = _kinds(part, chords.surface, start, end)
    kept = kind != EdgeClass.NONE
    return Edges(start[kept], end[kept], kind[kept])


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
    # The nearest of dense samples names the piece to measure to; two of them, because around a
    # corner the nearest sample may lie on the wrong side.
    counts = np.ceil(np.linalg.norm(span, axis=1) / _SAMPLE).astype(np.int64).clip(1)
    owner = np.repeat(np.arange(len(span)), counts)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (place + 0.5) / counts[owner]
    tree = cKDTree(edges.start[owner] + share[:, None] * span[owner])
    count = min(2, len(owner))
    candidates = owner[tree.query(points, k=count, workers=-1)[1].reshape(len(points), count)]
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


def _chart(part: FlatPart) -> _Chart:
    """Return the parameters of all surfaces of a part."""
    kind, a, b = part.surfaces.kind, part.surfaces.data[:, 6], part.surfaces.data[:, 7]
    first, second = frames(part.surfaces)
    scale = np.ones((len(kind), 2))
    scale[kind == SurfaceKind.CYLINDER, 0] = a[kind == SurfaceKind.CYLINDER]
    ball = kind == SurfaceKind.SPHERE
    scale[ball] = a[ball, None]
    ring = kind == SurfaceKind.TORUS
    scale[ring, 0], scale[ring, 1] = (a + b)[ring], b[ring]
    for s in np.flatnonzero(kind == SurfaceKind.CONE):
        apex, axis = part.surfaces.data[s, :3], part.surfaces.data[s, 3:6]
        highest = ((_corners(part.surface_boxes[s]) - apex) @ axis).max()
        scale[s, 0] = max(highest, _MARGIN) * math.tan(a[s])
    return _Chart(part, first, second, scale)


def _corners(limits: np.ndarray) -> np.ndarray:
    """Return the corners of a box, shape (8, 3)."""
    return np.array([[limits[i, 0], limits[j, 1], limits[k, 2]]
                     for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip


def _points(chart: _Chart, index: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return positions [mm], shape (N, 3), from scaled parameters, shape (N, 2).

    u is a coordinate of a plane, else the angle about the axis; v is the other coordinate, the
    height (cylinder, cone), the latitude (sphere), or the angle about the tube (torus).
    """
    kind, data = chart.part.surfaces.kind[index], chart.part.surfaces.data[index]
    u, v = (place / chart.scale[index]).T
    a, b = data[:, 6], data[:, 7]
    kinds = [kind == SurfaceKind.CYLINDER, kind == SurfaceKind.CONE, kind == SurfaceKind.SPHERE]
    radius = np.select(kinds, [a, v * np.tan(a), a * np.cos(v)], a + b * np.cos(v))
    height = np.select(kinds, [v, v, a * np.sin(v)], b * np.sin(v))
    flat = kind == SurfaceKind.PLANE
    x = np.where(flat, u, radius * np.cos(u))
    y = np.where(flat, v, radius * np.sin(u))
    z = np.where(flat, 0.0, height)
    return (
        data[:, :3] + x[:, None] * chart.first[index] + y[:, None] * chart.second[index]
        + z[:, None] * data[:, 3:6]
    )  # fmt: skip


def _side(chart: _Chart, index: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return on which side of its surface the part lies at every place; 0 = on none or on both."""
    return classify(chart.part, _points(chart, index, place), index)


def _grid(chart: _Chart, s: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes in u and in v of the grid on one surface, in scaled parameters.

    A full turn ends with the node where it began, so that the last cell closes it.
    """
    surfaces = chart.part.surfaces
    kind = surfaces.kind[s]
    a, b = surfaces.data[s, 6:8]
    axes = np.stack([chart.first[s], chart.second[s], surfaces.data[s, 3:6]], axis=1)
    local = (_corners(chart.part.surface_boxes[s]) - surfaces.data[s, :3]) @ axes
    low, high = local.min(axis=0) - _MARGIN, local.max(axis=0) + _MARGIN
    turn = 2.0 * math.pi * chart.scale[s]
    if kind == SurfaceKind.PLANE:
        ranges, radii = ((low[0], high[0]), (low[1], high[1])), (math.inf, math.inf)
    elif kind == SurfaceKind.CYLINDER:
        ranges, radii = ((0.0, turn[0]), (low[2], high[2])), (a, math.inf)
    elif kind == SurfaceKind.CONE:
        ranges = ((0.0, turn[0]), (max(low[2], 0.0), max(high[2], _MARGIN)))
        radii = (float(chart.scale[s, 0]), math.inf)
    elif kind == SurfaceKind.SPHERE:
        ranges, radii = ((0.0, turn[0]), (-turn[1] / 4, turn[1] / 4)), (a, a)
    else:
        ranges, radii = ((0.0, turn[0]), (0.0, turn[1])), (a, b)
    u, v = (
        np.linspace(
            low, high, max(math.ceil((high - low) / min(_CELL, r / _CELLS_PER_RADIUS)), 4) + 1
        )
        for (low, high), r in zip(ranges, radii, strict=True)
    )
    return u, v


def _border(
    chart: _Chart,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the crossings of all grid lines with borders of faces, and the chords between them.

    Returns:
        surface, shape (X,); the two nodes around every crossing, shapes (X, 2); the numbers of the
        two crossings of every chord, shapes (D,).
    """
    kinds = chart.part.surfaces.kind
    grids = [_grid(chart, s) for s in range(len(kinds))]
    places = [np.stack(np.meshgrid(u, v, indexing="ij"), axis=2) for u, v in grids]
    index = np.repeat(np.arange(len(kinds), dtype=np.int32), [p.size // 2 for p in places])
    flat = np.concatenate([p.reshape(-1, 2) for p in places])
    status = _side(chart, index, flat)
    surface, inner, outer, first, second = [], [], [], [], []
    start = crossings = 0
    for s, place in enumerate(places):
        shape = place.shape[:2]
        sides = status[start : start + shape[0] * shape[1]].reshape(shape)
        start += sides.size
        _close(kinds[s], sides)
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
    """Give both ends of a full turn the same sides, in place: rounding must not open the seam."""
    if kind != SurfaceKind.PLANE:
        sides[-1] = sides[0]
    if kind == SurfaceKind.TORUS:
        sides[:, -1] = sides[:, 0]


def _march(
    place: np.ndarray, sides: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the crossings of a grid, as pairs of nodes, and the chords, as pairs of crossings."""
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


def _halve(chart: _Chart, surface: np.ndarray, inner: np.ndarray, outer: np.ndarray) -> np.ndarray:
    """Return where between two places the face ends, shape (X, 2)."""
    low, high = inner.copy(), outer.copy()
    side = _side(chart, surface, low)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        same = _side(chart, surface, middle) == side
        low[same], high[~same] = middle[same], middle[~same]
    return 0.5 * (low + high)


def _follow(chart: _Chart, chords: _Chords) -> _Chords:
    """Split chords where the edge leaves them, until none is further off than the limit."""
    done: list[_Chords] = []
    for _ in range(_SPLITS):
        run = chords.second - chords.first
        middle = 0.5 * (chords.first + chords.second)
        aside = np.stack([-run[:, 1], run[:, 0]], axis=1)
        length = np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-30)
        near = aside * (_DEVIATION / length)
        bent = _side(chart, chords.surface, middle + near) == _side(
            chart, chords.surface, middle - near
        )
        moved = np.zeros(len(bent), bool)
        low, high = middle.copy(), middle.copy()
        for share in _ASIDE:
            left = np.flatnonzero(bent & ~moved)
            low[left] = middle[left] + share * aside[left]
            high[left] = middle[left] - share * aside[left]
            on = chords.surface[left]
            moved[left] = _side(chart, on, low[left]) != _side(chart, on, high[left])
        place = middle.copy()
        place[moved] = _halve(chart, chords.surface[moved], low[moved], high[moved])
        # Straight in the parameters may still be an arc in space.
        ends = [_points(chart, chords.surface, end) for end in (chords.first, chords.second)]
        sag = _points(chart, chords.surface, place) - 0.5 * (ends[0] + ends[1])
        split = moved | (np.linalg.norm(sag, axis=1) > _DEVIATION)
        done.append(_Chords(*(values[~split] for values in chords)))
        if not split.any():
            break
        surface, first, second = (values[split] for values in chords)
        place = place[split]
        chords = _Chords(
            np.concatenate([surface, surface]),
            np.concatenate([first, place]),
            np.concatenate([place, second]),
        )
    else:
        done.append(chords)
    return _Chords(*(np.concatenate(values) for values in zip(*done, strict=True)))


def _kinds(part: FlatPart, surface: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the `EdgeClass` of every chord; NONE where two fillets meet smoothly."""
    surfaces = part.surfaces
    # The ends lie exactly on the edge, but may be corners; the middle lies on this edge alone.
    run = end - start
    run /= np.maximum(np.linalg.norm(run, axis=1, keepdims=True), 1e-30)
    middle = 0.5 * (start + end)
    normal = gradient(surfaces, surface, middle)
    normal *= _side_near(part, surface, middle, run)[:, None]
    near, other = _passing(part, surface, start, middle, end)
    side = _side_near(part, other, middle[near], run[near])
    near, other, side = near[side != 0], other[side != 0], side[side != 0]
    neighbour = gradient(surfaces, other, middle[near]) * side[:, None]
    cosine = np.einsum("ij,ij->i", normal[near], neighbour)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    fillets = surfaces.fillet[surface[near]].astype(int) + surfaces.fillet[other]
    found = np.select(
        [angle > _SMOOTH, fillets == 1, fillets == 0],
        [EdgeClass.SHARP, EdgeClass.FILLET, EdgeClass.SMOOTH], EdgeClass.NONE,
    )  # fmt: skip
    # Where three faces meet, the sharpest joint counts: it is written last.
    order = np.argsort(angle, kind="stable")
    kind = np.full(len(start), EdgeClass.NONE, np.uint8)
    kind[near[order]] = found[order]
    return kind


def _passing(
    part: FlatPart, surface: np.ndarray, start: np.ndarray, middle: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return chords, and for each the other surfaces that pass through an end and the middle."""
    near, other = [], []
    for s, limits in enumerate(part.surface_boxes):
        close = ((middle >= limits[0] - _PROBE) & (middle <= limits[1] + _PROBE)).all(axis=1)
        chosen = np.flatnonzero(close & (surface != s))
        index = np.full(len(chosen), s, np.int32)
        gaps = [np.abs(distance(part.surfaces, index, p[chosen])) for p in (start, middle, end)]
        chosen = chosen[(np.minimum(gaps[0], gaps[2]) < _TOUCH) & (gaps[1] < 2.0 * _DEVIATION)]
        near.append(chosen)
        other.append(np.full(len(chosen), s, np.int32))
    return np.concatenate(near), np.concatenate(other)


def _side_near(
    part: FlatPart, surface: np.ndarray, point: np.ndarray, run: np.ndarray
) -> np.ndarray:
    """Return on which side of its surface the part lies, close to a point of an edge; 0 = none.

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
