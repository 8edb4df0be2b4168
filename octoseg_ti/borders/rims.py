"""Rims: sharp edges of which only one face was scanned.

The bottom rim of a part, whose underside no view sees; the top of a step seen from above only.
Where a face ends at an open border and what the probe saw beyond shows that it goes on no further,
there is an edge. The rim of a shadow is none, nor is the end of the field of view. That a pass ends
at the end of the part, not before, is taken for granted unless its stripes run from one end of the
field of view to the other.
"""

from __future__ import annotations

import numpy as np

from octoseg_ti.arrange import Arranged
from octoseg_ti.borders.base import find_base
from octoseg_ti.borders.zones import CAP, EDGE, Search
from octoseg_ti.device.surfaces import evaluate_surfaces
from octoseg_ti.stages.normals import stripe_axes
from octoseg_ti.stages.rims import (
    BEHIND,
    ENDED,
    HIDDEN,
    PASSED,
    Lines,
    look_beyond,
    open_sides,
)
from octoseg_ti.stages.surroundings import FREE, SECTORS, Surroundings
from octoseg_ti.types import EdgeClass, Scans

_GAP = 3.0  # neighbours in scan order are at most so many spacings apart
_AROUND = 2.5  # ... and neighbours among all points
_OFF = 0.06  # what lies so many spacings off a face is behind it, plus a cap of noise
# The edge lies up to a spacing beyond the last points, or two where the last of a stripe is lost.
_INSIDE = 0.75
# A face ends straight when on the way outwards it turns by less than this share of its turn aside.
_STRAIGHT = 0.3
_LIMIT = 3.0  # a stripe that ends so many lanes from the longest of its view may have been cut
_CUT = 0.5  # stripes run across the whole field of view when this share of them ends at its limit


def scan_lines(
    scans: Scans,
    arranged: Arranged,
    point: np.ndarray,
    order: np.ndarray,
    place: np.ndarray,
    probe: np.ndarray | None,
) -> Lines:
    """Return the points in scan order, with the ray that saw each.

    Args:
        scans: The input.
        arranged: Its usable points, on stripes.
        point: Their positions in the world [mm], shape (n, 3), f64.
        order: Place in scan order of every sorted point, shape (n,).
        place: The sorted point that every point is, shape (n,).
        probe: Where the probe was at every run [mm], world frame, shape (S, 3); None = not known.
    """
    start, run = arranged.start, arranged.run
    assert start is not None and run is not None
    first, last = start[:-1], start[1:] - 1
    view = arranged.view[first]
    source = probe
    if source is None and scans.origin is not None:
        source = scans.origin[view]
    if source is not None and not np.isfinite(source).all():
        source = None
    views = int(view.max(initial=0)) + 1
    if scans.column is not None:
        column = scans.column if arranged.whole else scans.column.take(arranged.row)
        lane = column.astype(np.float64)
    else:
        axis = stripe_axes(point, start, view[run], views)[view[run]]
        away = point if source is None else point - source[run]
        lane = np.einsum("ij,ij->i", away, axis)
        if source is not None:
            lane /= np.maximum(np.linalg.norm(away, axis=1), 1e-12)
        step = np.diff(lane)[run[1:] == run[:-1]]
        lane /= max(float(np.median(np.abs(step))) if len(step) else 1.0, 1e-12)
    rise = np.bincount(view, lane[last] - lane[first], views)
    if (rise < 0.0).any():
        lane *= np.where(rise < 0.0, -1.0, 1.0)[view][run]
    return Lines(point, start, run, view, lane, source, order, place)


def mark_rims(search: Search, lines: Lines, edge: np.ndarray) -> None:
    """Mark the points at rims as sharp, in place, where they are at no other edge."""
    label, spacing = search.label, search.spacing
    around = Surroundings(search.device[0], search.leaves, _AROUND * spacing)
    point, normal, outward = find_rims(search, lines, edge, around)
    leaf = search.leaf_of(point)
    place = search.points[point]
    base = find_base(place, normal, outward, label[point], search.leaves.box, spacing, search.noise)
    wall = np.zeros(search.count, bool)
    if base is not None:
        wall[base.walls] = True
    stands = wall[label[point]]
    near = around.near(label, point[~stands], leaf[~stands], (EDGE - _INSIDE) * spacing)
    if base is not None:
        low = np.flatnonzero(around.near(label, point[stands], leaf[stands], EDGE * spacing))
        near[low[base.above(search.points[low]) <= EDGE * spacing]] = True
    edge[near & (edge == int(EdgeClass.NONE))] = int(EdgeClass.SHARP)


def find_rims(
    search: Search, lines: Lines, edge: np.ndarray, around: Surroundings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the last points of faces at rims, their normals, and where the faces end there.

    Args:
        search: What is known.
        lines: The points in scan order.
        edge: `EdgeClass` of every sorted point so far, shape (n,), u8.
        around: The surroundings of points.
    """
    label, spacing = search.label, search.spacing
    # Points at no edge yet: 2 on an analytic surface, 1 elsewhere.
    state = np.append(np.where(search.analytic, 2, 1), 1).astype(np.uint8).take(label)
    state *= edge == int(EdgeClass.NONE)
    in_order = state.take(lines.place)
    side = open_sides(lines, in_order == 2, _GAP * spacing)
    point = np.sort(lines.place[np.flatnonzero(side > 0)])
    outward, free = around.free_sectors(
        search.device[1], point, search.leaf_of(point), _AROUND * spacing
    )
    there = np.flatnonzero((free >= FREE) & (free < SECTORS))
    point, outward = point[there], outward[there]
    field, cut = fields(lines, in_order == 0)
    normal = normals_of(search, point, search.points[point])
    place = lines.order[point]
    found = look_beyond(
        lines, field, place, side[place], normal, outward,
        gap=_GAP * spacing, off=_OFF * spacing + CAP * search.noise,
    )  # fmt: skip
    real = (found & (ENDED | BEHIND)) > 0
    real |= ((found & PASSED) > 0) & ~cut[lines.view[lines.run[place]]]
    real &= (found & HIDDEN) == 0
    real[real] = ends_straight(search, point[real], normal[real], outward[real], _GAP * spacing)
    return point[real], normal[real], outward[real]


def fields(lines: Lines, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the stripes of every view end amid its field of view, and where none does.

    Args:
        lines: The points in scan order.
        known: Which of them are at edges, where stripes end for another reason, shape (n,), bool.

    Returns:
        Lowest and highest lane of such an end, shape (V, 2); views whose stripes run from one limit
        to the other, so that their first and last stripe may as well have cut the part, (V,) bool.
    """
    first, last = lines.start[:-1], lines.start[1:] - 1
    views = int(lines.view.max(initial=0)) + 1
    low, high = np.full(views, np.inf), np.full(views, -np.inf)
    np.minimum.at(low, lines.view, lines.lane[first])
    np.maximum.at(high, lines.view, lines.lane[last])
    low, high = low + _LIMIT, high - _LIMIT
    stripes = np.maximum(np.bincount(lines.view, minlength=views), 1)
    at_low = (lines.lane[first] <= low[lines.view]) & ~known[first]
    at_high = (lines.lane[last] >= high[lines.view]) & ~known[last]
    share = np.minimum(
        np.bincount(lines.view, at_low, views), np.bincount(lines.view, at_high, views)
    )
    return np.column_stack([low, high]), share >= _CUT * stripes


def normals_of(search: Search, point: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the normals of the surfaces of some points, at other places, shape (E, 3)."""
    label = search.label[point]
    _, normal = evaluate_surfaces(place, label, search.table[:, 8], search.table[:, :8])
    normal[np.isnan(normal)] = 0.0
    outward: np.ndarray = normal * search.table[label, 9:]
    return outward


def ends_straight(
    search: Search, point: np.ndarray, normal: np.ndarray, outward: np.ndarray, way: float
) -> np.ndarray:
    """Say which faces would go on without turning away from the probe, (E,) bool.

    A face that does may end because the probe sees it too flat from the side.
    """
    ways = (outward, np.cross(outward, normal))
    at = np.concatenate([search.points[point] + way * to for to in ways])
    change = normals_of(search, np.tile(point, 2), at) - np.tile(normal, (2, 1))
    on, across = np.split(np.sqrt(np.square(change).sum(axis=1)), 2)
    straight: np.ndarray = on <= _STRAIGHT * across + 1e-9
    return straight
