"""Planes and quadrics through a group of points, by general least squares."""

from __future__ import annotations

import numpy as np


def fit_quadric(point: np.ndarray, normal: np.ndarray) -> dict[str, np.ndarray | float]:
    """Return what `octoseg_ti.fitting.quadrics` tells of one group, by names."""
    centre = point.mean(axis=0)
    q = point - centre
    axes = np.linalg.svd(q)[2]
    u, v, w = (q @ axis for axis in axes)
    design = np.column_stack([np.ones(len(u)), u, v, u**2, u * v, v**2])
    height = np.linalg.lstsq(design, w, rcond=None)[0]
    slope_u = height[1] + 2.0 * height[3] * u + height[4] * v
    slope_v = height[2] + height[4] * u + 2.0 * height[5] * v
    along = np.stack([-slope_u, -slope_v, np.ones(len(u))], axis=1) @ axes
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    known = normal.any(axis=1)

    def tilt(surface: np.ndarray) -> float:
        cosine = np.sum(normal[known] * surface, axis=1)
        return float(np.sqrt(np.mean(1.0 - cosine**2)))

    curvature = np.linalg.eigvalsh([[2 * height[3], height[4]], [height[4], 2 * height[5]]])
    return {
        "centre": centre,
        "rms": np.array([np.sqrt(np.mean(w**2)), np.sqrt(np.mean((w - design @ height) ** 2))]),
        "tilt": np.array([tilt(axes[2]), tilt(along[known])]),
        "side": abs(float(np.mean(normal[known] @ axes[2]))),
        "bend": float(np.abs(curvature).max() * np.sqrt(np.mean(np.sum(q**2, axis=1)))),
    }
