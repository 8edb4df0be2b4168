"""Random bodies: slabs, steps, slopes and S-blends, before features are put on them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from scanner_sim.bases import Body, Corner, Deck, drawn_body
from scanner_sim.features import SHARP, block_shape

if TYPE_CHECKING:
    from scanner_sim.draw import Draw

_LEAST_HEIGHT = 12.0


def random_body(draw: Draw) -> tuple[str, Body]:
    """Return the name of a body and the body, of the family that is drawn for."""
    kinds = {"slab": 0.3, "stepped body": 0.35, "sloped body": 0.35}
    if draw.family in ("smooth", "mixed"):
        kinds["S-blended body"] = 0.5 if draw.family == "smooth" else 0.2
    name = draw.pick(kinds)
    size = draw.number(60.0, 120.0), draw.number(45.0, 80.0)
    if name == "slab":
        return name, _slab(draw, size)
    outline = {
        "stepped body": _steps, "sloped body": _slopes, "S-blended body": _bends
    }[name](draw, size[0])  # fmt: skip
    return name, drawn_body(_finished_ends(draw, outline), size[1])


def _slab(draw: Draw, size: tuple[float, float]) -> Body:
    half = size[0] / 2.0, size[1] / 2.0
    height = draw.number(_LEAST_HEIGHT, 24.0)
    rim = draw.rim(4.0, blend=6.0)
    corner = rim.round
    if draw.family == "smooth" and draw.chance(0.4):
        # Only the upright corners are round.
        rim, corner = SHARP, draw.number(5.0, 12.0)
    shape = block_shape(half, height, corner=corner, end=rim, root=0.0)
    deck = half[0] - max(rim.reach, 0.3 * corner), half[1] - max(rim.reach, 0.3 * corner)
    place = np.eye(4)
    place[2, 3] = height
    return Body(shape.solid, shape.kinds, (Deck(place, deck, (0.0, 0.0), height),))


def _steps(draw: Draw, length: float) -> list[Corner]:
    """Return a step, or two of them up, or one on either side."""
    high = draw.number(_LEAST_HEIGHT + 8.0, 30.0)
    drop = draw.number(5.0, 8.0)
    half = length / 2.0
    inner, outer = (_step_radius(draw, drop) for _ in range(2))
    places = [draw.number(-0.3 * half, 0.3 * half)]
    if length > 85.0 and draw.chance(0.4):
        places = [draw.number(-0.45 * half, -0.25 * half), draw.number(0.25 * half, 0.45 * half)]
    ridge = len(places) == 2 and draw.chance(0.5)
    levels = [high - drop, high, high - drop] if ridge else [
        high - k * drop for k in range(len(places) + 1)
    ]  # fmt: skip
    corners = [Corner(-half, 0.0), Corner(-half, levels[0])]
    for x, before, after in zip(places, levels[:-1], levels[1:], strict=True):
        rounds = (outer, inner) if before > after else (inner, outer)
        corners += [Corner(x, before, rounds[0]), Corner(x, after, rounds[1])]
    return [*corners, Corner(half, levels[-1]), Corner(half, 0.0)]


def _step_radius(draw: Draw, drop: float) -> float:
    """Return the radius at one edge of a step; both together leave enough of its wall."""
    return draw.rim(0.5 * drop - 1.25).round


def _slopes(draw: Draw, length: float) -> list[Corner]:
    """Return a top that falls to one side or to both."""
    half = length / 2.0
    smooth = draw.style() == "smooth"
    angles = [draw.number(14.0, 20.0) if smooth else draw.number(6.0, 20.0) for _ in range(2)]
    falls = [math.tan(math.radians(angle)) for angle in angles]
    both = draw.chance(0.4)
    left = draw.number(-0.5 * half, -0.25 * half) if both else -half
    right = draw.number(0.0, 0.35 * half)
    drops = [(left + half) * falls[0], (half - right) * falls[1]]
    high = _LEAST_HEIGHT - 2.0 + max(drops) + draw.number(0.0, 6.0)
    # A blend over so small an angle needs a large radius to be wide enough.
    rounds = [draw.number(2.5 / math.radians(angle), 12.0) if smooth else 0.0 for angle in angles]
    corners = [Corner(-half, 0.0), Corner(-half, round(high - drops[0], 2) if both else high)]
    if both:
        corners.append(Corner(left, high, rounds[0]))
    corners.append(Corner(right, high, rounds[1]))
    return [*corners, Corner(half, round(high - drops[1], 2)), Corner(half, 0.0)]


def _bends(draw: Draw, length: float) -> list[Corner]:
    """Return a top that goes down in an S: two arcs that a slanted plane joins smoothly."""
    half = length / 2.0
    drop, angle = draw.number(7.0, 11.0), math.radians(draw.number(25.0, 40.0))
    high = _LEAST_HEIGHT + drop + draw.number(0.0, 5.0)
    run = drop / math.tan(angle)
    start = draw.number(-0.35 * half, 0.1 * half) - run / 2.0
    radii = [draw.number(7.0, 12.0) for _ in range(2)]
    return [
        Corner(-half, 0.0), Corner(-half, high), Corner(start, high, radii[0]),
        Corner(start + run, high - drop, radii[1]), Corner(half, high - drop), Corner(half, 0.0),
    ]  # fmt: skip


def _finished_ends(draw: Draw, outline: list[Corner]) -> list[Corner]:
    """Return the outline with its two upper end corners finished."""
    ends = _finished(draw, outline[1], outline[2]), _finished(draw, outline[-2], outline[-3])
    return [outline[0], *ends[0], *outline[2:-2], *reversed(ends[1]), outline[-1]]


def _finished(draw: Draw, corner: Corner, inner: Corner) -> list[Corner]:
    """Return what replaces an upper end corner; a chamfer has equal legs along the end and in x."""
    rim = draw.rim(3.0, blend=6.0)
    if rim.chamfer:
        share = rim.chamfer / abs(inner.x - corner.x)
        x, z = ((1.0 - share) * a + share * b for a, b in zip(corner[:2], inner[:2], strict=True))
        return [Corner(corner.x, corner.z - rim.chamfer), Corner(x, z)]
    return [Corner(corner.x, corner.z, rim.round)]
