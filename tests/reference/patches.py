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


def leaf_at(q: np.ndarray, leaves: list[Leaf], low: np.ndarray, high: np.ndarray) -> Leaf | None:
    """Return the leaf whose half-open box holds a place, relative to the corner of the grid."""
    holds = np.flatnonzero(np.all((q >= low) & (q < high), axis=1))
    return leaves[int(holds[0])] if len(holds) else None


def candidates(
    p: np.ndarray,
    distance: float,
    leaves: list[Leaf],
    label: dict[int, int],
    bend: Leaf | None,
    *,
    size: float,
    limit: float,
    tight: float,
    angle: float,
) -> list[tuple[float, float, int]]:
    """Return (distance from the plane, distance from the mean point, label) of the cells that fit."""
    low = np.array([size / 2.0**c.level * c.place for c in leaves])
    high = np.array([size / 2.0**c.level * (c.place + 1) for c in leaves])
    found = []
    for step in itertools.product((-1, 0, 1), repeat=3):
        c = leaf_at(p + distance * np.array(step), leaves, low, high)
        if c is None or label.get(c.node, -1) < 0:
            continue
        off = abs(float((p - c.point) @ c.normal))
        if off >= limit:
            continue
        # A point of a bend must lie on the plane, or its cell must look the same way.
        if bend is not None and off > tight:
            if abs(float(bend.normal @ c.normal)) < math.cos(angle):
                continue
        found.append((off, float(np.linalg.norm(p - c.point)), label[c.node]))
    return sorted(found)


def plane_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean point, normal and rms distance of the best plane."""
    middle = points.mean(axis=0)
    _, value, vector = np.linalg.svd(points - middle, full_matrices=False)
    smallest = value[2] if len(value) == 3 else 0.0
    normal = vector[2] if len(vector) == 3 else np.full(3, np.nan)
    return middle, normal, float(smallest / math.sqrt(len(points)))
