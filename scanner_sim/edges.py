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
from scanner_sim.charts import Chart, corners, make_chart
from scanner_sim.faces import passing, side_near
from scanner_sim.nearest import Edges
from scanner_sim.quadric import gradient

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
_PROBE = 0.02  # the neighbour of a face is looked for this far from the edge [mm]
_TOUCH = 1e-5  # a surface this close to a point of an edge passes through it [mm]
_SMOOTH = math.radians(5.0)  # faces that meet at a smaller angle meet smoothly


class _Chords(NamedTuple):
    """Pieces of the border of faces, in scaled parameters (mm)."""

    surface: np.ndarray
    first: np.ndarray
    second: np.ndarray


def trace_edges(part: FlatPart) -> Edges:
    """Return all edges of a solid, hidden ones too, to about 0.002 mm."""
    chart = make_chart(part)
    surface, inner, outer, first, second = _border(chart)
    place = chart.ends(surface, inner, outer)
    chords = _follow(chart, _Chords(surface[first], place[first], place[second]))
    start = chart.points(chords.surface, chords.first)
    end = chart.points(chords.surface, chords.second)
    kind = _kinds(part, chords.surface, start, end)
    kept = kind != EdgeClass.NONE
    return Edges(start[kept], end[kept], kind[kept])


def _grid(chart: Chart, s: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes in u and in v of the grid on one surface, in scaled parameters.

    A full turn ends with the node where it began, so that the last cell closes it.
    """
    surfaces = chart.part.surfaces
    kind = surfaces.kind[s]
    a, b = surfaces.data[s, 6:8]
    axes = np.stack([chart.axes[s, :3], chart.axes[s, 3:6], surfaces.data[s, 3:6]], axis=1)
    local = (corners(chart.part.surface_boxes[s]) - surfaces.data[s, :3]) @ axes
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
    chart: Chart,
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
    status = chart.sides(index, flat)
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


def _follow(chart: Chart, chords: _Chords) -> _Chords:
    """Split chords where the edge leaves them, until none is further off than the limit."""
    done: list[_Chords] = []
    for _ in range(_SPLITS):
        run = chords.second - chords.first
        middle = 0.5 * (chords.first + chords.second)
        aside = np.stack([-run[:, 1], run[:, 0]], axis=1)
        length = np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-30)
        near = aside * (_DEVIATION / length)
        bent = chart.sides(chords.surface, middle + near) == chart.sides(
            chords.surface, middle - near
        )
        moved = np.zeros(len(bent), bool)
        low, high = middle.copy(), middle.copy()
        for share in _ASIDE:
            left = np.flatnonzero(bent & ~moved)
            low[left] = middle[left] + share * aside[left]
            high[left] = middle[left] - share * aside[left]
            on = chords.surface[left]
            moved[left] = chart.sides(on, low[left]) != chart.sides(on, high[left])
        place = middle.copy()
        place[moved] = chart.ends(chords.surface[moved], low[moved], high[moved])
        # Straight in the parameters may still be an arc in space.
        ends = [chart.points(chords.surface, end) for end in (chords.first, chords.second)]
        sag = chart.points(chords.surface, place) - 0.5 * (ends[0] + ends[1])
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
    normal *= side_near(part, surface, middle, run, _PROBE)[:, None]
    near, other = passing(part, surface, (start, end), _TOUCH, 2.0 * _DEVIATION)
    side = side_near(part, other, middle[near], run[near], _PROBE)
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
