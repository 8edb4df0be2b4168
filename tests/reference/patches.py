"""Edge classes, the way of edge points to patches, and planes, one thing at a time."""

from __future__ import annotations

import itertools
import math

import numpy as np

from octoseg_ti.types import EdgeClass, StopReason
from reference.graph import Leaf


def edges_by_reason(stop: list[int]) -> list[int]:
    """Every cell that stopped although it is rough is an edge."""
    return [int(EdgeClass.NONE if s == StopReason.HOMOGENEOUS else EdgeClass.SHARP) for s in stop]


def edges_by_level(level: list[int], smallest_levels: int, fillet_levels: int) -> list[int]:
    """The smallest sizes that occur are edges; the largest of these are fillets."""
    sizes = sorted(set(level), reverse=True)
    answer = []
    for value in level:
        place = sizes.index(value)  # 0 = the smallest cells
        if place >= smallest_levels:
            answer.append(int(EdgeClass.NONE))
        elif place >= smallest_levels - fillet_levels:
            answer.append(int(EdgeClass.FILLET))
        else:
            answer.append(int(EdgeClass.SHARP))
    return answer


def edges_by_radius(size: list[float], tolerance: float, radius: float) -> list[int]:
    """A homogeneous cell of size s lies on a radius s / (sqrt(12) tolerance) or more."""
    return [
        int(EdgeClass.SHARP if s / (math.sqrt(12) * tolerance) < radius else EdgeClass.NONE)
        for s in size
    ]


def leaf_at(box: np.ndarray, leaves: list[Leaf], depth: int) -> Leaf | None:
    """Return the leaf that holds a smallest box, given by its whole-numbered place."""
    for c in leaves:
        if np.array_equal(box >> (depth - c.level), c.place):
            return c
    return None


def candidates(
    p: np.ndarray,
    reach: int,
    leaves: list[Leaf],
    label: dict[int, int],
    bend: Leaf | None,
    *,
    size: float,
    shape: tuple[int, ...],
    depth: int,
    limit: float,
    tight: float,
    angle: float,
) -> list[tuple[float, float, int]]:
    """Return (distance from the plane, distance from the mean point, label) of the cells that fit.

    The cells are those at so many smallest boxes from the box of the point, in 26 directions.
    """
    last = np.array(shape) * 2**depth - 1
    box = np.minimum(np.floor(p / (size / 2.0**depth)).astype(int), last)
    found = []
    for step in itertools.product((-1, 0, 1), repeat=3):
        place = box + reach * np.array(step)
        if np.any(place < 0) or np.any(place > last):
            continue
        c = leaf_at(place, leaves, depth)
        if c is None or label.get(c.node, -1) < 0:
            continue
        off = abs(float((p - c.point) @ c.normal))
        # A point of a bend must lie on the plane, or its cell must look the same way.
        other_way = bend is not None and abs(float(bend.normal @ c.normal)) < math.cos(angle)
        if off <= (tight if other_way else limit):
            found.append((off, float(np.linalg.norm(p - c.point)), label[c.node]))
    return sorted(found)


def plane_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean point, normal and rms distance of the best plane."""
    middle = points.mean(axis=0)
    _, value, vector = np.linalg.svd(points - middle, full_matrices=False)
    smallest = value[2] if len(value) == 3 else 0.0
    normal = vector[2] if len(vector) == 3 else np.full(3, np.nan)
    return middle, normal, float(smallest / math.sqrt(len(points)))
