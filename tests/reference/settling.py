"""How the points around a point settle which of two surfaces it is on, one point at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from reference.labelling import normal_at
from reference.surfaces import PLANE, distance_of

DOUBT, ACROSS = 9.0, 0.35


class Answer(NamedTuple):
    """What was settled for a point."""

    label: int
    """Its surface."""
    how: str
    """Nobody was asked (""), or by surfaces that "cross" or "touch"."""
    margin: float
    """How near the answer is to another one."""


def settle_one(
    i: int,
    point: np.ndarray,
    around: np.ndarray,
    label: np.ndarray,
    second: np.ndarray,
    off: np.ndarray,
    kind: np.ndarray,
    parameters: np.ndarray,
    reach: float,
    farthest: float,
) -> Answer:
    """Return what the points around point i settle; the point itself is one of these."""
    a, b = int(label[i]), int(second[i])
    if a < 0 or b < 0 or off[i, 0] > farthest:
        return Answer(a, "", np.inf)
    across = np.linalg.norm(
        np.cross(*(normal_at(point[i], int(kind[s]), parameters[s]) for s in (a, b)))
    )
    planes = kind[a] == PLANE and kind[b] == PLANE
    margin = np.inf if planes else abs(across - ACROSS)
    crossing = planes or across > ACROSS
    if not crossing and off[i, 2] >= DOUBT:
        return Answer(a, "", margin)
    far = np.linalg.norm(point[around] - point[i], axis=1)
    around, weight = around[far < reach], 1.0 - (far[far < reach] / reach) ** 2
    lead, ahead = 0.0, {a: 0.0, b: 0.0}
    for j, w in zip(around, weight, strict=True):
        mine = int(label[j])
        if mine not in (a, b):
            continue
        other = b if mine == a else a
        sure = min(float(off[j, 2]), DOUBT) if second[j] == other else DOUBT
        lead += w * (sure if mine == a else -sure)
        ahead[mine] += w * float(distance_of(point[j : j + 1], kind[other], parameters[other])[0])
    if crossing and ahead[a] * ahead[b] != 0.0:
        margin = min(margin, abs(ahead[a]), abs(ahead[b]))
        to_a, to_b = (
            float(distance_of(point[i : i + 1], kind[s], parameters[s])[0]) for s in (a, b)
        )
        lead = np.sign(ahead[a]) * to_b - np.sign(ahead[b]) * to_a
    how = "cross" if crossing else "touch"
    return Answer(b if lead < 0.0 else a, how, min(margin, abs(lead)))
