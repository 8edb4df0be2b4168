"""Leaves and their points, plainly: samples, near surfaces, and the choice of every point."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from reference.surfaces import PLANE, distance_of

_MIX = (0x6A09E667F3BCC909, 0x5DB3D742C265539D, 0x1E3779B97F4A7C15)


def _signed(x: int) -> int:
    """Return the lowest 64 bits as a signed number."""
    x &= (1 << 64) - 1
    return x - (1 << 64) if x >> 63 else x


def hash_of(point: np.ndarray, fine: float) -> int:
    """Return the hash of a point by its finely rounded coordinates."""
    h = 0
    for x, factor in zip(point.tolist(), _MIX, strict=True):
        h = _signed((h ^ math.trunc(x * fine)) * factor)
        h ^= h >> 29
    return h


def pick(
    point: np.ndarray, free: np.ndarray, span: tuple[int, int], most: int, fine: float
) -> list[int]:
    """Return the points of a leaf with the smallest hashes, of those that are free."""
    first: dict[int, int] = {}
    for i in range(*span):
        if free[i]:
            first.setdefault(hash_of(point[i], fine), i)
    return [first[h] for h in sorted(first)[:most]]


def near_surfaces(
    own: list[set[int]], closed: np.ndarray, touching: list[set[int]], most: int
) -> list[list[int]]:
    """Return the surfaces of every leaf and of those that touch it."""
    near = []
    for c, mine in enumerate(own):
        found = set() if closed[c] else set(mine).union(*(own[b] for b in touching[c]))
        near.append(sorted(found)[:most])
    return near


def normal_at(point: np.ndarray, kind: int, parameters: np.ndarray) -> np.ndarray:
    """Return the normal of the surface, by differences of the distance."""
    if kind == PLANE:
        return parameters[3:6]
    step = 1e-5 * np.eye(3)
    slope = distance_of(point + step, kind, parameters) - distance_of(
        point - step, kind, parameters
    )
    return slope / np.linalg.norm(slope)


class Chosen(NamedTuple):
    """What a point chooses."""

    label: int
    """Surface that costs least of those it may take, -1 = none."""
    second: int
    """Of all others near it the one that costs least, -1 = none."""
    off: tuple[float, float, float]
    """Distance and angle of the second, and by how much it costs more."""
    margin: float
    """How near the label is to another."""
    close: float
    """How near the second is to another."""


def choose(
    point: np.ndarray,
    normal: np.ndarray,
    near: list[int],
    kind: np.ndarray,
    parameters: np.ndarray,
    handicap: np.ndarray,
    rule: tuple[float, float, float, float],
) -> Chosen:
    """Return the surface that a point takes, and the one that would come next."""
    noise, tilt, reach, turn = rule
    cost: dict[int, float] = {}
    what: dict[int, tuple[float, float]] = {}
    allowed: set[int] = set()
    margin = np.inf
    for s in near:
        off = abs(float(distance_of(point[None], kind[s], parameters[s])[0])) / noise
        n = normal_at(point, kind[s], parameters[s])
        angle = math.acos(min(1.0, abs(float(n @ normal)))) if normal.any() else 0.0
        margin = min(margin, abs(off - reach), abs(angle - turn))
        tilts = angle / tilt
        what[s] = off, tilts
        cost[s] = off**2 + handicap[s] + (tilts if tilts < 6.0 else 6.0 + 0.1 * (tilts - 6.0)) ** 2
        if off <= reach and angle <= turn:
            allowed.add(s)
    ordered = sorted(cost[s] for s in allowed)
    if len(ordered) > 1:
        margin = min(margin, ordered[1] - ordered[0])
    label = min(allowed, key=lambda s: (cost[s], s), default=-1)
    others = sorted((s for s in near if s != label), key=lambda s: (cost[s], s))
    if not others:
        return Chosen(label, -1, (1e30, 1e30, 1e30), margin, np.inf)
    close = cost[others[1]] - cost[others[0]] if len(others) > 1 else np.inf
    gap = cost[others[0]] - (cost[label] if label >= 0 else 1e30)
    return Chosen(label, others[0], (*what[others[0]], gap), margin, close)
