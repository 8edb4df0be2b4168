"""Filtered normals of stripes, point by point."""

from __future__ import annotations

import numpy as np

from .stripes import runs


def neighbors(
    points: np.ndarray,
    normals: np.ndarray,
    start: np.ndarray,
    view: np.ndarray,
    gap: float,
    lag: int,
) -> list[list[int]]:
    """Return the neighbours of every point, the four near ones first, -1 where one is missing."""
    stripes = runs(start)

    def usable(i: int, j: int, stripe: range) -> int:
        there = j in stripe and np.linalg.norm(points[j] - points[i]) <= gap
        return j if there and normals[j].any() else -1

    rings = []
    for s, stripe in enumerate(stripes):
        for i in stripe:
            near, far = [usable(i, i - lag, stripe), usable(i, i + lag, stripe)], []
            for t in (s - 1, s + 1):
                if not (0 <= t < len(stripes) and view[stripes[t][0]] == view[stripe[0]]):
                    near.append(-1)
                    far += [-1, -1]
                    continue
                beside = stripes[t]
                j = beside[int(np.argmin(np.linalg.norm(points[list(beside)] - points[i], axis=1)))]
                near.append(usable(i, j, beside))
                far += [usable(i, j - lag, beside), usable(i, j + lag, beside)]
            rings.append(near + far)
    return rings


def filter_normals(
    points: np.ndarray,
    normals: np.ndarray,
    start: np.ndarray,
    view: np.ndarray,
    *,
    passes: int,
    gap: float,
    noise: float,
    lag: int = 1,
) -> np.ndarray:
    """Return normals smoothed within faces; every point is a sample of what spread noise leaves."""

    def mean(weight: np.ndarray, limit: float) -> np.ndarray:
        result = n.copy()
        for i, ring in enumerate(rings):
            total = weight[i] * n[i]
            for place, j in enumerate(ring):
                if j >= 0:
                    near = max(0.0, 1.0 - float(np.sum((n[j] - n[i]) ** 2)) / limit**2) ** 2
                    total = total + (1.0 if place < 4 else 0.7) * weight[j] * near * n[j]
            if total.any():
                result[i] = total / np.linalg.norm(total)
        return result

    def extreme(value: np.ndarray, choose) -> np.ndarray:
        return np.array(
            [choose(value[[i, *(j for j in r if j >= 0)]]) for i, r in enumerate(rings)]
        )

    n = normals.copy()
    step = 1
    while step <= lag:
        rings = neighbors(points, normals, start, view, gap, step)
        n = mean(np.ones(len(n)), 8.5 * noise)
        step *= 2
    curved = np.zeros(0)
    for again in range(passes):
        spread = np.zeros(len(n))
        for i, ring in enumerate(rings):
            parts = [(1.0 if p < 4 else 0.5, j) for p, j in enumerate(ring) if j >= 0]
            if parts:
                total = sum(w * float(np.sum((n[j] - n[i]) ** 2)) for w, j in parts)
                spread[i] = total / sum(w for w, _ in parts)
        if again == 0:
            # An opening: what is narrower than five points disappears.
            curved = spread
            for choose in (np.min, np.min, np.max, np.max):
                curved = extreme(curved, choose)
        lower = np.sort(spread)[: max(1, int(0.75 * len(spread)))]
        least = 4.0 * lower.mean() + 4.0 * curved
        n = mean((least / (least + np.maximum(0.0, spread - curved))) ** 2, 1e9)
    n[~normals.any(axis=1)] = 0.0
    return n
