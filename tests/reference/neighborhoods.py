"""Normals of points without stripes, by looking at every other point."""

from __future__ import annotations

import math

import numpy as np


def neighbor_normals(
    points: np.ndarray, outward: np.ndarray, neighbors: int
) -> tuple[np.ndarray, float, float, float]:
    """Return normals, spacing [mm], noise [mm] and noise of the normals [rad].

    A neighbourhood is the point itself and all that are strictly nearer than its k-th neighbour.
    """
    n = len(points)
    k = min(neighbors, n - 1)
    normals = np.zeros((n, 3))
    nearest, radii, heights = [], [], []
    for i in range(n):
        distance = np.linalg.norm(points - points[i], axis=1)
        others = np.sort(np.delete(distance, i))
        if others[k - 1] > 0:
            nearest.append(next(d for d in others if d > 0))
        radius = others[k - 1] if others[k - 1] > 0 else 1.0
        radii.append(radius)
        near = points[distance < radius]
        if len(near) < 3:
            continue
        centred = near - near.mean(axis=0)
        value, vector = np.linalg.eigh(centred.T @ centred / len(near))
        if value[1] <= 1e-6 * value[2]:
            continue  # on a line, or in one place
        normal = vector[:, 0]
        normals[i] = normal if normal @ outward[i] >= 0 else -normal
        heights.append(math.sqrt(max(0.0, value[0])))
    if not heights:
        return normals, float(np.median(nearest)) if nearest else 0.0, 0.0, 0.0
    heights = sorted(heights)[: max(1, 3 * len(heights) // 4)]
    rms = math.sqrt(math.fsum(h * h for h in heights) / len(heights))
    count = k + 1
    noise = rms * math.sqrt(count / max(1, count - 3))  # a plane takes three degrees of freedom
    # The slope of a plane over a disc of radius r with its points spread evenly has the deviation
    # 2 noise / (r sqrt(count)) in each of two directions.
    tilt = 2.0 * math.sqrt(2.0 / count) * noise / float(np.median(radii))
    return normals, float(np.median(nearest)), noise, tilt
