"""One colour for every label, the same in recordings, point clouds, viewers and pictures."""

from __future__ import annotations

import numpy as np

NONE_COLOR = (128, 128, 128, 255)
"""Grey: a point without a patch."""

SCAN_COLOR = (184, 196, 212, 255)
"""Pale blue: a point that has not been judged yet."""

_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
# Neighbouring labels differ in brightness as well as in hue, so that they stay apart in grey print.
_VALUES = np.array([0.95, 0.72, 0.85])
_SATURATIONS = np.array([0.68, 0.80, 0.48])
_TABLE_SIZE = 4096


def _hsv_to_rgb(hue: np.ndarray, saturation: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Convert arrays in 0..1 to 8-bit RGB, shape (N, 3), by the usual piecewise linear rule."""
    offset = np.array([5.0, 3.0, 1.0])
    k = (offset + 6.0 * hue[:, None]) % 6.0
    ramp = np.clip(np.minimum(k, 4.0 - k), 0.0, 1.0)
    rgb = value[:, None] * (1.0 - saturation[:, None] * ramp)
    return np.rint(255.0 * rgb).astype(np.uint8)


def _table() -> np.ndarray:
    """Return the colours of labels 0.._TABLE_SIZE-1, then the one of "none", RGBA u8."""
    label = np.arange(_TABLE_SIZE)
    table = np.full((_TABLE_SIZE + 1, 4), 255, np.uint8)
    table[:-1, :3] = _hsv_to_rgb(
        (0.58 + label * _GOLDEN) % 1.0, _SATURATIONS[label % 3], _VALUES[(label // 3) % 3]
    )
    table[-1] = NONE_COLOR
    return table


_COLORS = _table()


def colors(labels: np.ndarray) -> np.ndarray:
    """Return the colour of every label.

    Hues step by the golden angle, so that any first K labels lie well apart on the circle. Labels
    from 4096 on repeat the colours of the first ones.

    Args:
        labels: Integers of any shape (...); negative = no patch.

    Returns:
        RGBA, shape (..., 4), u8.
    """
    labels = np.asarray(labels)
    index = np.where(labels < 0, _TABLE_SIZE, labels % _TABLE_SIZE)
    return _COLORS[index]


def level_colors(levels: np.ndarray, count: int | None = None) -> np.ndarray:
    """Return the colour of every grid level, from blue (0, coarse) to red (the finest).

    Args:
        levels: Levels of any shape (...), 0 = initial cells; negative = in no cell (grey).
        count: Number of levels of the grid; default: the largest level + 1.

    Returns:
        RGBA, shape (..., 4), u8.
    """
    levels = np.asarray(levels)
    if count is None:
        count = int(levels.max(initial=0)) + 1
    ramp = np.full((count + 1, 4), 255, np.uint8)
    hue = 0.64 * (1.0 - np.arange(count) / max(count - 1, 1))
    ramp[:-1, :3] = _hsv_to_rgb(hue, np.full(count, 0.75), np.full(count, 0.92))
    ramp[-1] = NONE_COLOR
    return ramp[np.where(levels < 0, count, np.minimum(levels, count - 1))]


def normal_colors(normals: np.ndarray) -> np.ndarray:
    """Return the normal map: x, y, z of -1..1 as red, green, blue; grey where there is no normal.

    Args:
        normals: Unit normals or zero rows, shape (N, 3).

    Returns:
        RGBA, shape (N, 4), u8.
    """
    normals = np.asarray(normals, np.float32)
    known = np.isfinite(normals).all(axis=1) & (np.abs(normals).sum(axis=1) > 0)
    rgba = np.empty((len(normals), 4), np.uint8)
    rgba[:] = NONE_COLOR
    rgba[known, :3] = np.rint(127.5 * (np.clip(normals[known], -1.0, 1.0) + 1.0))
    return rgba
