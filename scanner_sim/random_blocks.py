"""Random blocks of machined features, each the same for its seed for ever: `random:SEED:FAMILY`.

A block is a body (a slab, steps, slopes, an S-blend) with features on its decks: bosses, ribs,
domes and pins that stand on it, holes, pockets, slots and dimples cut into it. The families differ
in how edges are finished:

* ``sharp``: sharp edges, and chamfers.
* ``filleted``: rounds with radii from 0.75 to 3 mm, which are fillets: no patches.
* ``smooth``: blends with radii above 3 mm, which are patches that meet their neighbours smoothly.
* ``mixed``: each of these in places.

Sizes follow one rule: every patch is at least `WIDE` wide where the scanner sees it. A wall inside
of a hole is seen from the sides only, to a depth of about `SIGHT` times half the width of the hole.
Features keep clear of each other, of the rims, and of the steps above them, the further the higher
they are, so that no shadow parts a face in two.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octoseg_ti.errors import DataError
from scanner_sim.bodies import random_body
from scanner_sim.draw import FAMILIES, SIGHT, WIDE, Draw
from scanner_sim.features import Shape, upside_down
from scanner_sim.menu import WALL, Feature, random_feature
from scanner_sim.part import Part, difference, union
from scanner_sim.scanner import View, around

if TYPE_CHECKING:
    from octoseg_ti.types import SurfaceKind
    from scanner_sim.bases import Deck

__all__ = ["FAMILIES", "SIGHT", "WIDE", "BlockPart", "describe_block", "parse_name", "random_block"]

POINTS = 90_000

VIEWS = (
    View(azimuth=math.radians(70.0)),
    View(azimuth=math.radians(250.0)),
    *around((math.radians(61.0), 6)),
)
"""Twice from above, with the camera on opposite sides, so that what one camera does not see behind
a boss the other one does; and from six sides, beyond the incidence limit of the decks."""

_MARGIN = 3.0  # from a feature to the end of its deck or to the next feature [mm]
_SHADOW = math.tan(math.radians(30.0))  # length of the camera's shadow of a thing 1 mm high
_GLANCE = math.tan(math.radians(29.0))  # fall of the laser from a side, 1 mm on
_TRIES = 60  # features that are drawn for a block, and places that are tried for each
_PLACES = 12
_FEATURES = (5, 12)  # from .. to, one less


class BlockPart(NamedTuple):
    """What a block consists of: its body or a feature of it."""

    name: str
    """Such as "blind hole"."""
    kinds: tuple[SurfaceKind, ...]
    """Kind of every patch that it adds, all of them visible; fillets are no patches."""
    at: tuple[float, float, float]
    """Where it stands on the body [mm]."""


class _Spot(NamedTuple):
    """Where a feature stands on its deck."""

    x: float
    y: float
    extent: tuple[float, float]
    height: float


def random_block(seed: int, family: str = "mixed") -> Part:
    """Return a random block.

    Args:
        seed: Seed, 0 or more; the same seed gives the same block.
        family: "sharp", "filleted", "smooth" or "mixed".

    Raises:
        DataError: The seed is negative or too large, or there is no such family.
    """
    return _build(seed, family)[0]


def describe_block(seed: int, family: str = "mixed") -> tuple[BlockPart, ...]:
    """Return what `random_block` put together: the body first, then its features.

    Raises:
        DataError: The seed is negative or too large, or there is no such family.
    """
    return _build(seed, family)[1]


def parse_name(name: str) -> tuple[int, str]:
    """Return seed and family of a name such as ``random:17`` or ``random:17:filleted``.

    Raises:
        DataError: The name has another form, or there is no such family.
    """
    words = name.split(":")
    if words[0] != "random" or not 2 <= len(words) <= 3:
        raise DataError(f"{name!r} names no random block", hint="write random:SEED[:FAMILY]")
    if not (words[1].isascii() and words[1].isdigit() and len(words[1]) <= 20):
        raise DataError(
            f"the seed of a random block is a whole number from 0 to 2^64 - 1, not {words[1]!r}",
            hint="for example random:17",
        )
    family = words[2] if len(words) == 3 else "mixed"
    _check_family(family)
    return int(words[1]), family


def _check_family(family: str) -> None:
    if family not in FAMILIES:
        raise DataError(
            f"there is no family {family!r} of random blocks",
            hint=f"known families: {', '.join(FAMILIES)}",
        )


def _build(seed: int, family: str) -> tuple[Part, tuple[BlockPart, ...]]:
    _check_family(family)
    if not 0 <= seed < 2**64:
        raise DataError(f"the seed of a random block must be at least 0 and below 2^64, not {seed}")
    # Families are independent, and so are what is drawn for the body and for the features.
    root = np.random.SeedSequence(seed, spawn_key=(FAMILIES.index(family),))
    draws = [Draw(np.random.default_rng(child), family) for child in root.spawn(2)]
    name, body = random_body(draws[0])
    notes = [BlockPart(name, body.kinds, (0.0, 0.0, 0.0))]
    standing: list[Part] = []
    cut: list[Part] = []
    taken: list[list[_Spot]] = [[] for _ in body.decks]
    wanted = int(draws[1].generator.integers(*_FEATURES))
    for _ in range(_TRIES):
        if len(notes) > wanted:
            break
        room = np.array([deck.half[0] * deck.half[1] for deck in body.decks])
        k = int(draws[1].generator.choice(len(room), p=room / room.sum()))
        feature = random_feature(draws[1])
        placed = _place(feature, body.decks[k], taken[k], draws[1])
        if placed is None:
            continue
        spot, transform = placed
        taken[k].append(spot)
        _carve(feature.shape, transform, feature.is_cut, standing, cut)
        kinds = feature.shape.kinds
        if feature.bore is not None:
            on_top = transform @ _shift(0.0, 0.0, feature.shape.height)
            _carve(feature.bore, on_top, True, standing, cut)
            kinds += feature.bore.kinds
        x, y, z = transform[:3, 3]
        notes.append(BlockPart(feature.name, kinds, (float(x), float(y), float(z))))
    solid = union(body.solid, *standing) if standing else body.solid
    if cut:
        solid = difference(solid, *cut)
    part = dataclasses.replace(
        solid, name=f"random:{seed}:{family}", nominal_points=POINTS, views=VIEWS
    )
    return part, tuple(notes)


def _carve(
    shape: Shape, transform: np.ndarray, is_cut: bool, standing: list[Part], cut: list[Part]
) -> None:
    """Add a shape to what stands on the body, or to what is cut out of it."""
    if is_cut:
        cut.append(upside_down(shape).moved(transform))
    else:
        standing.append(shape.solid.moved(transform))


def _place(
    feature: Feature, deck: Deck, taken: list[_Spot], draw: Draw
) -> tuple[_Spot, np.ndarray] | None:
    """Return a free place for a feature, and its transform; None if none was found."""
    if feature.depth > deck.depth - _MARGIN:
        return None
    angle = draw.angle() if feature.turns else 0.0
    c, s = abs(math.cos(angle)), abs(math.sin(angle))
    a, b = feature.shape.extent
    extent = (a * c + b * s, a * s + b * c)
    height = 0.0 if feature.is_cut else feature.shape.height
    near = [_clear_of_step(feature, height, rise) for rise in deck.rise]
    low = np.array([-deck.half[0] + near[0], -deck.half[1] + _MARGIN]) + extent
    high = np.array([deck.half[0] - near[1], deck.half[1] - _MARGIN]) - extent
    if (low > high).any():
        return None
    for _ in range(_PLACES):
        x, y = (draw.number(lowest, highest) for lowest, highest in zip(low, high, strict=True))
        spot = _Spot(x, y, extent, height)
        if all(_gap(spot, other) >= _clearance(spot, other) for other in taken):
            return spot, deck.place @ _shift(x, y, 0.0) @ _turn(angle)
    return None


def _clear_of_step(feature: Feature, height: float, rise: float) -> float:
    """Return how far a feature stays away from an end of its deck where the body rises."""
    if rise == 0.0:
        return _MARGIN
    # Seen from aside, a boss must leave the upper part of the step's wall free; and the step must
    # not hide what is cut into the deck.
    aside = (height - rise + WIDE) / _GLANCE
    if feature.turns and not feature.is_cut:
        # Nor may the step hide the whole of a flat wall that faces it.
        aside = max(aside, (rise - WALL + WIDE) / _GLANCE)
    return _MARGIN + max(_SHADOW * max(height, rise), aside)


def _gap(one: _Spot, other: _Spot) -> float:
    """Return the distance between the rectangles around two features [mm]; 0 if they overlap."""
    across = abs(one.x - other.x) - one.extent[0] - other.extent[0]
    along = abs(one.y - other.y) - one.extent[1] - other.extent[1]
    return math.hypot(max(across, 0.0), max(along, 0.0))


def _clearance(one: _Spot, other: _Spot) -> float:
    """Return how far two features of one deck stay away from each other [mm]."""
    return _MARGIN + _SHADOW * max(one.height, other.height)


def _shift(x: float, y: float, z: float) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, 3] = x, y, z
    return transform


def _turn(angle: float) -> np.ndarray:
    transform = np.eye(4)
    c, s = math.cos(angle), math.sin(angle)
    transform[:2, :2] = [[c, -s], [s, c]]
    return transform
