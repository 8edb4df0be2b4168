"""Matches between views and their equations, point by point: plain NumPy and loops."""

from __future__ import annotations

import numpy as np

ANGLE = np.radians(20.0)


def matches(
    points: tuple[np.ndarray, np.ndarray],
    normals: tuple[np.ndarray, np.ndarray],
    moves: tuple[np.ndarray, np.ndarray],
    reach: float,
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Return (place, normal, gap) of every match, both ways, points moved by their motions."""
    place = [p @ m[:3, :3].T + m[:3, 3] for p, m in zip(points, moves, strict=True)]
    facing = [n @ m[:3, :3].T for n, m in zip(normals, moves, strict=True)]
    found = []
    for a, b in ((0, 1), (1, 0)):
        for p, n in zip(place[a], facing[a], strict=True):
            distance = np.linalg.norm(place[b] - p, axis=1)
            near = int(np.argmin(distance))
            q, m = place[b][near], facing[b][near]
            if distance[near] >= reach or n @ m < np.cos(ANGLE):
                continue
            mean = (n + m) / np.linalg.norm(n + m)
            first, second = (p, q) if a == 0 else (q, p)
            found.append(((p + q) / 2.0, mean, float((second - first) @ mean)))
    return found


def best_twist(found: list[tuple[np.ndarray, np.ndarray, float]], radius: float) -> np.ndarray:
    """Return the small motion of the first view that closes the gaps best, unweighted, (6,)."""
    rows = np.array([np.append(np.cross(place, n) / radius, n) for place, n, _ in found])
    gaps = np.array([gap for _, _, gap in found])
    return np.linalg.lstsq(rows, gaps, rcond=None)[0]
