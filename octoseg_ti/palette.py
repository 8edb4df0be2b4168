"""Colours of labels: the same patch has the same colour in every picture, file and viewer."""

from __future__ import annotations

import colorsys

import numpy as np

# Hues that advance by the golden angle stay apart however many there are.
_GOLDEN = 0.6180339887498949
_PERIOD = 96
_UNLABELLED = (150, 150, 150, 255)


def _table() -> np.ndarray:
    rows = []
    for k in range(_PERIOD):
        hue = (0.58 + k * _GOLDEN) % 1.0
        # Lightness and saturation alternate, so that hues that come round again still differ.
        red, green, blue = colorsys.hls_to_rgb(hue, (0.52, 0.68, 0.38)[k % 3], (0.75, 0.5)[k % 2])
        rows.append((round(255 * red), round(255 * green), round(255 * blue), 255))
    return np.array([*rows, _UNLABELLED], np.uint8)


_TABLE = _table()


def colors(labels: np.ndarray) -> np.ndarray:
    """Return a colour for every label.

    Args:
        labels: Integer labels, shape (N,); negative = none, drawn grey.

    Returns:
        Red, green, blue, alpha, shape (N, 4), u8.
    """
    labels = np.asarray(labels)
    return _TABLE[np.where(labels >= 0, labels % _PERIOD, _PERIOD)]
