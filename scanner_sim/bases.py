"""Bodies of random blocks: outlines of straight lines and arcs, drawn out along y.

An outline runs from the lower left to the lower right corner of the body, over its top. It is cut
into upright slabs, one for each line and each arc; slabs side by side share their faces exactly, so
that nothing is left of them inside of the body.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octoseg_ti.types import SurfaceKind
from scanner_sim.features import FILLET_LIMIT
from scanner_sim.part import Part, box, cylinder, difference, half_space, intersection, union

if TYPE_CHECKING:
    from collections.abc import Sequence

_LEAST = 1e-9
_DECK_LENGTH = 14.0  # a shorter line of an outline bears no features [mm]
_DECK_SLOPE = math.radians(30.0)  # nor does a steeper one


class Deck(NamedTuple):
    """A rectangle of a body's surface on which features may stand."""

    place: np.ndarray
    """Maps the frame of the deck (x along the outline, z outwards) to that of the body, (4, 4)."""
    half: tuple[float, float]
    """Half of its size along x and y [mm]."""
    rise: tuple[float, float]
    """How far the body rises beyond its two ends along x [mm]; 0 = it does not."""
    depth: float
    """Thickness of the body below it, where it is thinnest [mm]."""


class Body(NamedTuple):
    """A body without features."""

    solid: Part
    kinds: tuple[SurfaceKind, ...]
    """Kind of every patch; the bottom is none, it lies on the table."""
    decks: tuple[Deck, ...]


class Corner(NamedTuple):
    """A corner of an outline."""

    x: float
    """[mm]."""
    z: float
    """[mm]."""
    round: float = 0.0
    """Radius of the arc that replaces it [mm]; 0 = sharp."""


class _Line(NamedTuple):
    start: np.ndarray
    end: np.ndarray


class _Arc(NamedTuple):
    start: np.ndarray
    end: np.ndarray
    middle: np.ndarray
    radius: float
    convex: bool


def drawn_body(outline: Sequence[Corner], width: float) -> Body:
    """Return the body under an outline.

    Args:
        outline: Corners from left to right, starting and ending at z = 0; x must not fall, and no
            line may overhang.
        width: Size along y [mm].
    """
    half = width / 2.0
    slabs, kinds = [], [SurfaceKind.PLANE] * 2
    elements = _elements(outline)
    for element in elements:
        (x0, z0), (x1, z1) = element.start, element.end
        arc = isinstance(element, _Arc)
        if not arc or element.radius > FILLET_LIMIT:  # type: ignore[union-attr]
            kinds.append(SurfaceKind.CYLINDER if arc else SurfaceKind.PLANE)
        if x1 - x0 < _LEAST:
            continue
        low, high = (x0, -half, 0.0), (x1, half, max(z0, z1))
        if isinstance(element, _Line):
            slab = box(low, high)
            if abs(z1 - z0) > _LEAST:
                slab = intersection(slab, half_space((x0, 0, z0), (z0 - z1, 0, x1 - x0)))
        else:
            slab = _arc_slab(element, half)
        slabs.append(slab)
    decks = [d for k in range(len(elements)) for d in _deck(elements, k, half)]
    return Body(union(*slabs), tuple(kinds), tuple(decks))


def _arc_slab(arc: _Arc, half: float) -> Part:
    """Return the slab under an arc of at most a quarter turn."""
    (x0, z0), (x1, z1) = arc.start, arc.end
    (x, z), fillet = arc.middle, arc.radius <= FILLET_LIMIT
    tube = cylinder((x, 0, z), (0, 1, 0), arc.radius, fillet=fillet)
    top = max(z0, z1)
    if not arc.convex:
        return difference(box((x0, -half, 0.0), (x1, half, top)), tube)
    # Between the lower end and the arc the cylinder is wider than the slab.
    foot = min(z0, z1)
    crown = intersection(tube, box((x0, -half, foot), (x1, half, z + arc.radius)))
    return union(box((x0, -half, 0.0), (x1, half, foot)), crown)


def _elements(outline: Sequence[Corner]) -> list[_Line | _Arc]:
    """Return the lines and arcs of an outline, in order."""
    places = [np.array([corner.x, corner.z]) for corner in outline]
    found: list[_Line | _Arc] = []
    start = places[0]
    for k in range(1, len(outline)):
        here = places[k]
        arc = None
        if k + 1 < len(outline) and outline[k].round:
            arc = _rounded(places[k - 1], here, places[k + 1], outline[k].round)
        end = here if arc is None else arc.start
        if np.linalg.norm(end - start) > _LEAST:
            found.append(_Line(start, end))
        start = end
        if arc is not None:
            found.append(arc)
            start = arc.end
    return found


def _rounded(before: np.ndarray, here: np.ndarray, after: np.ndarray, radius: float) -> _Arc:
    """Return the arc that touches both lines of a corner."""
    into = (here - before) / np.linalg.norm(here - before)
    out = (after - here) / np.linalg.norm(after - here)
    turn = math.acos(float(np.clip(into @ out, -1.0, 1.0)))
    convex = bool(into[0] * out[1] - into[1] * out[0] < 0.0)
    reach = radius * math.tan(turn / 2.0)
    start = here - reach * into
    inwards = np.array([into[1], -into[0]]) if convex else np.array([-into[1], into[0]])
    return _Arc(start, here + reach * out, start + radius * inwards, radius, convex)


def _deck(elements: list[_Line | _Arc], k: int, half: float) -> list[Deck]:
    """Return the deck on a line of an outline, if it is long and flat enough."""
    line = elements[k]
    if not isinstance(line, _Line):
        return []
    run = line.end - line.start
    length = float(np.linalg.norm(run))
    if length < _DECK_LENGTH or abs(run[1]) > length * math.sin(_DECK_SLOPE):
        return []
    (c, s), (x, z) = run / length, (line.start + line.end) / 2.0
    place = np.array([[c, 0, -s, x], [0, 1, 0, 0], [s, 0, c, z], [0, 0, 0, 1.0]])
    highest = [
        max((max(e.start[1], e.end[1]) for e in side), default=0.0)
        for side in (elements[:k], elements[k + 1 :])
    ]
    rise = tuple(
        max(top - end[1], 0.0) for top, end in zip(highest, (line.start, line.end), strict=True)
    )
    depth = float(min(line.start[1], line.end[1]))
    return [Deck(place, (length / 2.0, half), (rise[0], rise[1]), depth)]
