"""Parts with rounded edges of which all is known."""

import math

from scanner_sim.part import Part, box, cylinder, half_space, intersection, sphere, union


def bend(radius: float, turn_deg: float, *, fillet: bool, wide: float = 8.0) -> Part:
    """A ridge of two planes along x, rounded by a cylinder."""
    limits = box((-wide, -wide, -20), (wide, wide, 5))
    half = math.radians(turn_deg) / 2.0
    sides = [half_space((0, 0, 0), (0, sign * math.sin(half), math.cos(half))) for sign in (-1, 1)]
    wedge = intersection(*sides)
    if radius == 0.0:
        return intersection(wedge, limits)
    top = -radius * math.tan(half) * math.sin(half)
    roll = cylinder((0, 0, -radius / math.cos(half)), (1, 0, 0), radius, fillet=fillet)
    below = intersection(wedge, half_space((0, 0, top), (0, 0, 1)))
    above = intersection(wedge, roll, half_space((0, 0, top), (0, 0, -1)))
    return intersection(union(below, above), limits)


def rounded_block(wide: float, deep: float, high: float, radius: float) -> Part:
    """A block on z = 0 whose edges are rounded by cylinders and its corners by spheres."""
    x, y, z = wide - radius, deep - radius, high - radius
    parts = [
        box((-x, -y, -1), (x, y, high)),
        box((-wide, -y, -1), (wide, y, z)),
        box((-x, -deep, -1), (x, deep, z)),
    ]
    for one in (-x, x):
        side = cylinder((one, 0, z), (0, 1, 0), radius, fillet=True)
        parts.append(intersection(side, box((-wide, -y, z - radius), (wide, y, high + 1))))
        for other in (-y, y):
            post = cylinder((one, other, 0), (0, 0, 1), radius, fillet=True)
            parts.append(intersection(post, box((-wide, -deep, -1), (wide, deep, z))))
            parts.append(sphere((one, other, z), radius, fillet=True))
    for other in (-y, y):
        side = cylinder((0, other, z), (1, 0, 0), radius, fillet=True)
        parts.append(intersection(side, box((-x, -deep, z - radius), (x, deep, high + 1))))
    return intersection(union(*parts), box((-wide, -deep, 0), (wide, deep, high)))
