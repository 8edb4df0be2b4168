"""The parts by name: random blocks, and three after the examples of Woo et al. 2002, section 4.

The paper gives sizes, point counts and the number of patches; the shapes are ours. Every joint of
two patches is either an edge of 20 degrees or more, or a fillet, which belongs to no patch.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

from octoseg_ti.errors import DataError
from scanner_sim.part import (
    Part,
    box,
    cylinder,
    difference,
    half_space,
    intersection,
    outside,
    rod,
    sphere,
    torus,
    union,
)
from scanner_sim.random_blocks import describe_block, parse_name, random_block
from scanner_sim.scanner import View, around

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = [
    "PARTS",
    "by_name",
    "describe_block",
    "phone",
    "random_block",
    "test_block",
    "two_planes",
]

_SIDES = (View(azimuth=math.radians(70.0)), *around((math.radians(62.5), 4)))
"""From above, with stripes that run askew of the part, and so steeply from four sides that the top
is beyond the incidence limit."""


def two_planes() -> Part:
    """Return the part of Fig. 8: two planes that meet in a ridge; 20,000 points, 2 patches.

    A block of 40 x 40 mm whose top falls by 15 degrees to either side.
    """
    slope = math.tan(math.radians(15.0))
    part = intersection(
        box((-20.0, -20.0, 0.0), (20.0, 20.0, 16.0)),
        half_space((0.0, 0.0, 15.0), (slope, 0.0, 1.0)),
        half_space((0.0, 0.0, 15.0), (-slope, 0.0, 1.0)),
    )
    return _named(part, "two-planes", 20_000, (View(azimuth=math.radians(70.0)),))


def test_block() -> Part:
    """Return the part of Figs. 11 and 12: 100 x 60 x 33 mm; 92,000 points, 11 patches.

    Four sides, a top and a slope; a boss (wall and top), a dome, a blind hole (wall and floor).
    """
    fall = math.radians(22.0)
    body = intersection(
        box((-50.0, -30.0, 0.0), (50.0, 30.0, 22.0)),
        half_space((17.0, 0.0, 22.0), (math.sin(fall), 0.0, math.cos(fall))),
    )
    boss = rod((-30.0, 12.0, 10.0), (-30.0, 12.0, 33.0), 12.0)
    dome = intersection(
        sphere((0.0, 14.0, 19.0), 11.0), box((-12.0, 2.0, 10.0), (12.0, 26.0, 31.0))
    )
    hole = rod((-14.0, -15.0, 16.0), (-14.0, -15.0, 24.0), 10.0)
    return _named(union(difference(body, hole), boss, dome), "test-block", 92_000, _SIDES)


def phone() -> Part:
    """Return the part of Figs. 13 and 14: 120 x 45 x 20 mm; 215,288 points, 32 patches.

    The upper casing of a mobile phone: top, four walls and a slanted chin; a screen (floor and four
    slanted walls), twelve keys, a navigation key (ring and dome), an ear dish, a lens dome, a
    button on either side, an antenna (barrel and two round ends). Fillets: the upright corners (3
    mm), the long rims (2 mm), the ear dish and the navigation key (1 mm), the keys (0.75 mm).
    """
    body = difference(_casing(), _screen(), _ear(42.0, -1.0, 8.0, 6.0, 1.0))
    keys = union(
        *(
            union(*(_key(x, y, 4.25, 0.75) for y in (-12.5, 0.0, 12.5)))
            for x in (-46.0, -36.0, -26.0, -16.0)
        )
    )
    dome = _cap(-2.0, 0.0, 5.0, 3.5, 15.0)
    lens = _cap(43.0, -14.0, 6.0, 4.0, 14.0)
    buttons = union(_button(-10.0, 1.0), _button(20.0, -1.0))
    part = union(body, keys, _key(-2.0, 0.0, 8.0, 1.0), dome, lens, buttons, _antenna())
    return _named(part, "phone", 215_288, _SIDES)


def _casing() -> Part:
    """Return the body: 110 mm of the length, top at 14 mm, long rims and corners rounded."""
    low, high, half, top, rim, corner = -60.0, 50.0, 21.0, 14.0, 2.0, 3.0
    chin = half_space(
        (-51.0, 0.0, top), (-math.sin(math.radians(30)), 0, math.cos(math.radians(30)))
    )
    cuts = []
    for sign in (-1.0, 1.0):
        y, z = sign * (half - rim), top - rim
        cuts.append(
            intersection(
                half_space((0, y, 0), (0, -sign, 0)),
                half_space((0, 0, z), (0, 0, -1)),
                outside(cylinder((0, y, z), (1, 0, 0), rim, fillet=True)),
                box((low, min(y, 2 * y), z), (high, max(y, 2 * y), top)),
            )
        )
        for end, side in ((low, -1.0), (high, 1.0)):
            x, y = end - side * corner, sign * (half - corner)
            cuts.append(
                intersection(
                    half_space((x, 0, 0), (-side, 0, 0)),
                    half_space((0, y, 0), (0, -sign, 0)),
                    outside(cylinder((x, y, 0), (0, 0, 1), corner, fillet=True)),
                    box((min(x, end), min(y, 2 * y), 0), (max(x, end), max(y, 2 * y), top)),
                )
            )
    return difference(intersection(box((low, -half, 0), (high, half, top)), chin), *cuts)


def _screen() -> Part:
    """Return what the screen window cuts away: 3 mm deep, walls at 45 degrees."""
    low, high, half, top, depth = 9.5, 33.5, 17.0, 14.0, 3.0
    walls = [
        half_space((low, 0, top), (-1, 0, -1)),
        half_space((high, 0, top), (1, 0, -1)),
        half_space((0, -half, top), (0, -1, -1)),
        half_space((0, half, top), (0, 1, -1)),
    ]
    reach = box((low - 1, -half - 1, top - depth), (high + 1, half + 1, top + 1))
    return intersection(*walls, reach)


def _key(x: float, y: float, radius: float, fillet: float) -> Part:
    """Return a round key on the top: as high as its rim is rounded, so that it has no wall."""
    top = 14.0
    plate = rod((x, y, top - 1.0), (x, y, top + fillet), radius - fillet)
    rim = torus((x, y, top), (0, 0, 1), radius - fillet, fillet, fillet=True)
    return union(plate, rim)


def _cap(x: float, y: float, ball: float, radius: float, base: float) -> Part:
    """Return a dome: the cap of a ball that is ``radius`` wide at height ``base``."""
    center = base - math.sqrt(ball**2 - radius**2)
    limits = box((x - ball, y - ball, base - 1.0), (x + ball, y + ball, base + ball))
    return intersection(sphere((x, y, center), ball), limits)


def _ear(x: float, y: float, ball: float, radius: float, fillet: float) -> Part:
    """Return what a dish with a rounded rim cuts away.

    The dish is a ball that reaches ``radius`` at the top. The rim's tube touches the top from
    below and the ball from outside: its centre lies ``fillet`` below the top, ``ball + fillet``
    from the ball's centre.
    """
    top = 14.0
    center = top + math.sqrt(ball**2 - radius**2)
    ring = math.sqrt((ball + fillet) ** 2 - (center - (top - fillet)) ** 2)
    touch = top - fillet + fillet * (center - top + fillet) / (ball + fillet)
    reach = box((x - ring, y - ring, top - ball), (x + ring, y + ring, top + 1.0))
    dish = intersection(sphere((x, y, center), ball), reach)
    flare = difference(
        rod((x, y, touch), (x, y, top + 1.0), ring),
        torus((x, y, top - fillet), (0, 0, 1), ring, fillet, fillet=True),
    )
    return union(dish, flare)


def _button(x: float, sign: float) -> Part:
    """Return a round button on the wall at y = sign * 21: the cap of a ball, 8 mm wide.

    Nowhere is it parallel to the wall beside it. A flat button would hide its lower rim from all
    views: two parallel faces with no point between them, nearer than a cell of the paper is wide.
    """
    wall, radius, height, z = 21.0, 4.0, 1.5, 6.25
    ball = (radius**2 + height**2) / (2.0 * height)
    root, deep, outer = height + 1.0, sign * (wall - 1.0), sign * (wall + height)
    reach = math.sqrt(ball**2 - (ball - root) ** 2)
    limits = box((x - reach, min(deep, outer), z - reach), (x + reach, max(deep, outer), z + reach))
    return intersection(sphere((x, outer - sign * ball, z), ball), limits)


def _antenna() -> Part:
    """Return the antenna: a barrel half sunk into the top, its ends are caps of balls."""
    y, z, radius, ball = 12.5, 14.0, 6.0, 8.0
    height = ball - math.sqrt(ball**2 - radius**2)
    tail, nose = 40.0, 60.0
    barrel = rod((tail, y, z), (nose - height, y, z), radius)
    caps = [
        intersection(
            sphere((tip - side * ball, y, z), ball),
            box(
                (min(tip, tip - side * height), y - radius, z - radius),
                (max(tip, tip - side * height), y + radius, z + radius),
            ),
        )
        for tip, side in ((tail - height, -1.0), (nose, 1.0))
    ]
    return union(barrel, *caps)


def _named(part: Part, name: str, points: int, views: tuple[View, ...]) -> Part:
    return dataclasses.replace(part, name=name, nominal_points=points, views=views)


PARTS: dict[str, Callable[[], Part]] = {
    "two-planes": two_planes,
    "test-block": test_block,
    "phone": phone,
}
"""The parts by their names on the command line; random blocks are named by `parse_name`."""


def by_name(name: str) -> Part:
    """Return a named part: one of `PARTS`, ``random:SEED`` or ``random:SEED:FAMILY``.

    Raises:
        DataError: There is no part of that name; the message lists the names.
    """
    if name.partition(":")[0] == "random":
        return random_block(*parse_name(name))
    if name not in PARTS:
        known = ", ".join([*PARTS, "random:SEED[:FAMILY]"])
        raise DataError(f"there is no part {name!r}", hint=f"known parts: {known}")
    return PARTS[name]()
