"""Plain NumPy answers for triangles: every ray against every triangle, and points to segments."""

from __future__ import annotations

import numpy as np


def first_hits(
    corners: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance and triangle of the nearest hit of every ray; inf and -1 without (Cramer's rule)."""
    a, b, c = corners.transpose(1, 0, 2)
    one, two = b - a, c - a
    far = np.full(len(origins), np.inf)
    which = np.full(len(origins), -1)
    for i, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        across = np.cross(direction, two)
        whole = np.einsum("ij,ij->i", one, across)
        with np.errstate(divide="ignore", invalid="ignore"):
            away = origin - a
            u = np.einsum("ij,ij->i", away, across) / whole
            turned = np.cross(away, one)
            v = turned @ direction / whole
            t = np.einsum("ij,ij->i", two, turned) / whole
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0)
        if hit.any():
            which[i] = np.flatnonzero(hit)[np.argmin(t[hit])]
            far[i] = t[which[i]]
    return far, which


def segment_distance(start: np.ndarray, end: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of every point to the nearest of all segments."""
    span = end - start
    best = np.full(len(points), np.inf)
    for a, s in zip(start, span, strict=True):
        share = np.clip((points - a) @ s / (s @ s), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(points - a - share[:, None] * s, axis=1))
    return best
