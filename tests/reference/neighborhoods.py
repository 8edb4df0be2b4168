"""Normals of points without stripes, by looking at every other point."""

from __future__ import annotations

import math

import numpy as np


def neighbor_normals(
    points: np.ndarray, outward: np.ndarray, neighbors: int, passes: int = 0
) -> tuple[np.ndarray, float, float, float]:
    """Return normals, spacing [mm], noise [mm] and noise of the normals [rad].

    A neighbourhood is the point itself and all that are strictly nearer than its k-th neighbour. In
    every pass a point takes the mean of the planes of its neighbourhood by how well each holds its
    own points and this one.
    """
    n = len(points)
    k = min(neighbors, n - 1)
    normals = np.zeros((n, 3))
    nearest, radii, heights, around = [], [], [], []
    middle, height = points.copy(), np.full(n, -1.0)
    for i in range(n):
        distance = np.linalg.norm(points - points[i], axis=1)
        others = np.sort(np.delete(distance, i))
        if others[k - 1] > 0:
            nearest.append(next(d for d in others if d > 0))
        radius = others[k - 1] if others[k - 1] > 0 else 1.0
        radii.append(radius)
        around.append(np.flatnonzero(distance < radius))
        near = points[around[i]]
        if len(near) < 3:
            continue
        centred = near - near.mean(axis=0)
        value, vector = np.linalg.eigh(centred.T @ centred / len(near))
        if value[1] <= 1e-6 * value[2]:
            continue  # on a line, or in one place
        normal = vector[:, 0]
        normals[i] = normal if normal @ outward[i] >= 0 else -normal
        middle[i] = near.mean(axis=0)
        height[i] = math.sqrt(max(0.0, value[0]))
        heights.append(height[i])
    if not heights:
        return normals, float(np.median(nearest)) if nearest else 0.0, 0.0, 0.0
    heights = sorted(heights)[: max(1, 3 * len(heights) // 4)]
    rms = math.sqrt(math.fsum(h * h for h in heights) / len(heights))
    count = k + 1
    noise = rms * math.sqrt(count / max(1, count - 3))  # a plane takes three degrees of freedom
    # The slope of a plane over a disc of radius r with its n points spread evenly has the deviation
    # 2 noise / (r sqrt(n)) in each of two directions, more where n is small.
    tilt = 2.0 * math.sqrt(2.0 / max(1, count - 4)) * noise / float(np.median(radii))
    spacing = float(np.median(nearest)) if nearest else 0.0
    equal = max(0.5 * noise, 0.001 * spacing) ** 2
    for _ in range(passes):
        new_normals, new_height = normals.copy(), height.copy()
        for i in np.flatnonzero(height >= 0):
            planes = [j for j in around[i] if height[j] >= 0]
            off = np.array([normals[j] @ (points[i] - middle[j]) for j in planes])
            misfit = off**2 + height[planes] ** 2 + equal
            weight = (misfit.min() / misfit) ** 2
            side = np.where(normals[planes] @ normals[i] < 0, -1.0, 1.0)
            total = (weight * side) @ normals[planes]
            new_normals[i] = total / np.linalg.norm(total)
            new_height[i] = math.sqrt(weight @ height[planes] ** 2 / weight.sum())
        normals, height, middle = new_normals, new_height, points
    normals = np.where(np.einsum("ni,ni->n", normals, outward)[:, None] < 0, -normals, normals)
    return normals, spacing, noise, (1.0, 0.64, 0.53, 0.48)[passes] * tilt
