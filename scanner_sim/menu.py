"""The features of random blocks, with random sizes that leave every patch wide enough to be seen.

Lengths in mm. The limits that are drawn from say what has to remain: a flat end of `WIDE`, a wall
of `WALL` between the finish of its foot and that of its end, the part of a hole's wall that is in
sight.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from scanner_sim.draw import BLEND, SIGHT, WIDE, Draw
from scanner_sim.features import (
    FILLET_LIMIT,
    SHARP,
    Rim,
    Shape,
    block_shape,
    dome_shape,
    drill_shape,
    pin_shape,
    round_shape,
)

if TYPE_CHECKING:
    from collections.abc import Callable

WALL = 2.5
"""Of walls is left at least this height [mm]."""

_THROUGH = 60.0  # longer than any body is thick [mm]


class Feature(NamedTuple):
    """A feature, before it has its place."""

    name: str
    shape: Shape
    is_cut: bool = False
    """It is cut away, not added."""
    turns: bool = False
    """It is not round: how it is turned matters."""
    through: bool = False
    """It goes through the part."""
    bore: Shape | None = None
    """What is cut into its flat end."""

    @property
    def depth(self) -> float:
        """Thickness of the body that it needs [mm]."""
        return self.shape.height if self.is_cut and not self.through else 0.0


def random_feature(draw: Draw) -> Feature:
    """Return a feature of random kind and size, of the family that is drawn for."""
    name = draw.pick(_SMOOTH_MENU if draw.family == "smooth" else _MENU)
    return _MAKERS[name](draw)


def _round_boss(draw: Draw) -> Feature:
    radius, height = draw.number(5.0, 11.0), draw.number(4.5, 10.0)
    end, foot = _round_rims(draw, radius, height)
    return Feature("round boss", round_shape(radius, height, end=end, foot=foot))


def _bored_boss(draw: Draw) -> Feature:
    radius, height = draw.number(9.0, 13.0), draw.number(4.5, 9.0)
    end, foot = _round_rims(draw, radius, height, flat=6.5)
    shape = round_shape(radius, height, end=end, foot=foot)
    widest = radius - end.reach - 2.5
    bore_radius = draw.number(4.0, widest)
    if draw.chance(0.4):
        bore = dome_shape(bore_radius, draw.number(0.25, 0.45) * bore_radius)
    else:
        bore = round_shape(bore_radius, draw.number(3.0, min(0.9 * bore_radius, 6.0)))
    return Feature("bored boss", shape, bore=bore)


def _round_rims(draw: Draw, radius: float, height: float, flat: float = WIDE) -> tuple[Rim, Rim]:
    """Return the finish of end and foot of a round boss; chamfers are not for feet."""
    room = height - WALL
    # The ring of a torus has to be wider than its tube.
    end = draw.rim(min(room, radius - flat, 0.45 * radius), blend=min(room, 0.45 * radius))
    if radius - end.reach < flat:
        end = SHARP
    foot = draw.rim(room - end.reach, blend=room - end.reach)
    return end, SHARP if foot.chamfer else foot


def _conical_boss(draw: Draw) -> Feature:
    lean = math.radians(draw.number(10.0, 32.0))
    height = draw.number(4.5, 8.0)
    radius = draw.number(4.0, 6.5) + height * math.tan(lean)
    top = radius - height * math.tan(lean)
    end = draw.rim(min(height - WALL, 0.45 * top, top - WIDE))
    foot = draw.rim(height - WALL - end.reach)
    end, foot = (SHARP if rim.chamfer else rim for rim in (end, foot))
    return Feature("conical boss", round_shape(radius, height, lean=lean, end=end, foot=foot))


def _dome(draw: Draw) -> Feature:
    radius = draw.number(5.0, 11.0)
    height = round(draw.number(0.3, 0.75) * radius, 2)
    # The blend is as long as the dome is steep.
    steep = 2.0 * math.atan(height / radius)
    foot = draw.rim(2.0, blend=BLEND[1] if steep * BLEND[0] >= WIDE else 0.0)
    return Feature("dome", dome_shape(radius, height, foot=SHARP if foot.chamfer else foot))


def _dimple(draw: Draw) -> Feature:
    radius = draw.number(4.0, 9.0)
    height = round(draw.number(0.25, 0.45) * radius, 2)
    rim = draw.rim(2.0, blend=BLEND[1] if 2 * math.atan(0.25) * BLEND[0] >= WIDE else 0.0)
    shape = dome_shape(radius, height, foot=SHARP if rim.chamfer else rim)
    return Feature("dimple", shape, is_cut=True)


def _pin(draw: Draw) -> Feature:
    radius, height = draw.number(3.5, 6.5), draw.number(3.0, 7.0)
    foot = draw.rim(height - WALL, blend=height - WALL)
    return Feature("capped pin", pin_shape(radius, height, foot=SHARP if foot.chamfer else foot))


def _blind_hole(draw: Draw) -> Feature:
    radius = draw.number(4.5, 9.5)
    depth = draw.number(3.5, min(radius, 8.0))
    floor, rim = _hole_rims(draw, radius, depth)
    shape = round_shape(radius, depth, end=floor, foot=rim)
    return Feature("blind hole", shape, is_cut=True)


def _hole_rims(draw: Draw, half: float, depth: float) -> tuple[Rim, Rim]:
    """Return the finish of floor and rim of a hole or pocket, half of whose width is given."""
    rim = draw.rim(min(depth - WALL, SIGHT * half - WIDE), blend=depth - WALL)
    floor = draw.rim(min(depth - rim.reach - WALL, 0.4 * half))
    return SHARP if floor.chamfer else floor, rim


def _drilled_hole(draw: Draw) -> Feature:
    radius = draw.number(3.5, 7.0)
    rim = draw.rim(2.5)
    depth = rim.reach + draw.number(2.5, max(0.9 * radius, 3.0))
    return Feature("drilled hole", drill_shape(radius, depth, foot=rim, tip=True), is_cut=True)


def _through_hole(draw: Draw) -> Feature:
    radius = draw.number(3.5, 9.0)
    rim = draw.rim(max(SIGHT * radius - WIDE, 0.0))
    shape = drill_shape(radius, _THROUGH, foot=SHARP if rim.chamfer else rim)
    return Feature("through hole", shape, is_cut=True, through=True)


def _countersunk_hole(draw: Draw) -> Feature:
    radius, sink = draw.number(3.5, 6.0), draw.number(2.0, 3.0)
    shape = drill_shape(radius, _THROUGH, foot=Rim(chamfer=sink))
    return Feature("countersunk hole", shape, is_cut=True, through=True)


def _pad(draw: Draw) -> Feature:
    half = draw.number(6.0, 13.0), draw.number(5.0, 9.0)
    height = draw.number(4.5, 9.0)
    corner, end, foot = _block_rims(draw, half, height)
    return Feature("pad", block_shape(half, height, corner=corner, end=end, foot=foot), turns=True)


def _pocket(draw: Draw) -> Feature:
    half = draw.number(6.0, 14.0), draw.number(5.5, 10.0)
    depth = draw.number(3.5, 6.5)
    corner, floor, rim = _block_rims(draw, half, depth)
    if floor.chamfer:  # a cutter breaks the rim, not the floor
        floor, rim = SHARP, floor
    shape = block_shape(half, depth, corner=corner, end=floor, foot=rim)
    return Feature("pocket", shape, is_cut=True, turns=True)


def _block_rims(draw: Draw, half: tuple[float, float], height: float) -> tuple[float, Rim, Rim]:
    """Return the corner radius and the finish of end and foot, as `block_shape` wants them."""
    least, room = min(half), height - WALL
    end = draw.rim(min(room, least - WIDE), blend=min(room, least - WIDE))
    if end.chamfer:
        return 0.0, end, SHARP
    if end.round:
        foot = draw.rim(room - end.round)
        return end.round, end, foot if foot.round else SHARP
    if draw.family == "sharp" or draw.chance(0.3):
        return 0.0, SHARP, SHARP
    # Between round corners is left a wall that is wide enough, and more so since it is low.
    corner = draw.number(1.5, 3.0)
    if draw.family == "smooth":
        corner = draw.number(FILLET_LIMIT + 0.2, least - 0.8 * WIDE)
    foot = draw.rim(room)
    return corner, SHARP, foot if foot.round else SHARP


def _rib(draw: Draw) -> Feature:
    half = draw.number(8.0, 17.0), draw.number(2.0, 2.75)
    height = draw.number(4.5, 8.0)
    rim = draw.rim(half[1] - 0.5 * WIDE - 0.25)
    if not rim.round:
        return Feature("rib", block_shape(half, height), turns=True)
    foot = draw.rim(min(height - rim.round - WALL, 2.0))
    foot = foot if foot.round else SHARP
    shape = block_shape(half, height, corner=rim.round, end=rim, foot=foot)
    return Feature("rib", shape, turns=True)


def _slot(draw: Draw) -> Feature:
    # The round ends are wider than a fillet: they are patches.
    b = draw.number(FILLET_LIMIT + 0.2, 5.0)
    half, depth = (b + draw.number(4.0, 12.0), b), draw.number(3.0, 5.0)
    rim = draw.rim(min(depth - WALL, SIGHT * b - WIDE))
    floor = draw.rim(min(depth - rim.round - WALL, 0.4 * b, b - WIDE))
    rim, floor = (r if r.round else SHARP for r in (rim, floor))
    shape = block_shape(half, depth, corner=b, end=floor, foot=rim)
    return Feature("slot", shape, is_cut=True, turns=True)


_MAKERS: dict[str, Callable[[Draw], Feature]] = {
    "round boss": _round_boss,
    "bored boss": _bored_boss,
    "conical boss": _conical_boss,
    "dome": _dome,
    "dimple": _dimple,
    "capped pin": _pin,
    "blind hole": _blind_hole,
    "drilled hole": _drilled_hole,
    "through hole": _through_hole,
    "countersunk hole": _countersunk_hole,
    "pad": _pad,
    "pocket": _pocket,
    "rib": _rib,
    "slot": _slot,
}

_MENU = {
    "round boss": 1.2, "bored boss": 0.8, "conical boss": 1.0, "dome": 1.0, "dimple": 1.0,
    "capped pin": 0.4, "blind hole": 1.2, "drilled hole": 0.8, "through hole": 1.2,
    "countersunk hole": 0.8, "pad": 1.2, "pocket": 1.4, "rib": 1.2, "slot": 1.2,
}  # fmt: skip
"""How often each feature is drawn."""

_SMOOTH_MENU = {
    "round boss": 1.2, "conical boss": 0.4, "dome": 1.6, "dimple": 1.2, "capped pin": 1.6,
    "blind hole": 0.8, "through hole": 0.8, "pad": 1.4, "pocket": 1.2, "rib": 0.4, "slot": 1.4,
}  # fmt: skip
"""The same for the family ``smooth``."""
