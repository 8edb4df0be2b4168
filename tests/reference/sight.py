"""Plain version of `octoseg_ti.stages.sight`: every place is looked up among all leaves."""

from __future__ import annotations

import math

import numpy as np

GRAZING, STEPS = 0.2, 4096


def blocked(
    leaves: list[tuple[np.ndarray, float, np.ndarray, np.ndarray, slice]],
    points: np.ndarray,
    normals: np.ndarray,
    heavy: np.ndarray,
    line: tuple[np.ndarray, np.ndarray],
    box: tuple[np.ndarray, float],
    clear: float,
    reach: float,
) -> bool:
    """Say whether a line of sight passes through a surface.

    Args:
        leaves: Lower corner, edge length, mean point, mean normal and points of every leaf.
        points: Positions [mm], shape (n, 3).
        normals: Their normals, shape (n, 3).
        heavy: Whether a point may block the line, shape (n,).
        line: Where it starts and ends [mm].
        box: Upper corner of the grid, and the edge length of its smallest cells [mm].
        clear: What is nearer to its end does not block it [mm].
        reach: A point stands for the surface around it, so far [mm].
    """
    start, end = line
    high, finest = box
    length = float(np.linalg.norm(end - start))
    way = (end - start) / length
    enters = [0.0]
    for c in range(3):
        if way[c] > 0 and start[c] < 0:
            enters.append(-start[c] / way[c])
        if way[c] < 0 and start[c] > high[c]:
            enters.append((high[c] - start[c]) / way[c])
    first, last = max(enters), length - clear
    lower = np.array([low for low, *_ in leaves])
    upper = lower + np.array([[side] for _, side, *_ in leaves])
    steps = math.ceil(max(0.0, min((last - first) / finest, STEPS)))
    for k in range(steps):
        step = (last - first) / steps
        p = start + (first + (k + 0.5) * step) * way
        for c in np.flatnonzero(np.all((p >= lower) & (p < upper), axis=1)):
            *_, mean, normal, held = leaves[c]
            if abs(float((p - mean) @ normal)) <= step + reach:
                down = normals[held] @ way
                steep = (np.abs(down) > GRAZING) & heavy[held]
                far = ((points[held] - start) * normals[held]).sum(axis=1)[steep] / down[steep]
                off = np.linalg.norm(start + far[:, None] * way - points[held][steep], axis=1)
                if np.any((far < last) & (off < reach)):
                    return True
    return False
