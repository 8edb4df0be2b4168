"""Which points that were left out a surface goes through, grown one ring after the other."""

from __future__ import annotations

import numpy as np

from reference.surfaces import distance_of


def readmit(
    outside: np.ndarray,
    point: np.ndarray,
    label: np.ndarray,
    surface: np.ndarray,
    kind: np.ndarray,
    parameters: np.ndarray,
    limit: float,
    gap: float,
) -> np.ndarray:
    """Return the patch of every point that was left out, the nearest of those it is linked to."""
    found, least = np.full(len(outside), -1), np.full(len(outside), limit)
    for patch, s in enumerate(surface):
        if s < 0:
            continue
        far = np.abs(distance_of(outside, int(kind[s]), parameters[s]))
        waiting = [i for i in range(len(outside)) if far[i] <= least[i]]
        ring = point[label == patch]
        while len(ring):
            reached = [
                i for i in waiting if np.min(np.linalg.norm(ring - outside[i], axis=1)) <= gap
            ]
            waiting = [i for i in waiting if i not in reached]
            found[reached], least[reached] = patch, far[reached]
            ring = outside[reached]
    return found
