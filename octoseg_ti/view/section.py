"""A cross-section as a picture: points by class over two axes in mm, with a scale and a legend."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

_INK, _PALE, _BAND = (30, 34, 40), (222, 225, 230), (255, 238, 205)
_CLASS_COLORS = ((70, 110, 170), (225, 90, 30), (200, 20, 90), (120, 60, 160), (30, 140, 90))
_LEFT, _BOTTOM, _TOP, _RIGHT = 80, 56, 44, 24


def section(
    across: np.ndarray,
    height: np.ndarray,
    group: np.ndarray,
    *,
    names: Sequence[str],
    title: str,
    band: tuple[float, float] | None = None,
    band_name: str = "",
    labels: tuple[str, str] = ("x [mm]", "z [mm]"),
    width: int = 960,
    height_px: int = 640,
) -> np.ndarray:
    """Draw points of a cross-section.

    Args:
        across: Horizontal position [mm], shape (N,).
        height: Vertical position [mm], shape (N,).
        group: Class of every point, index into ``names``, shape (N,); higher ones are drawn later.
        names: Names of the classes, for the legend.
        title: Text above the picture.
        band: Strip between two horizontal positions to be shaded [mm].
        band_name: What it is, for the legend.
        labels: Texts of the axes.
        width: Width of the picture [pixels].
        height_px: Height of the picture [pixels].

    Returns:
        The picture, shape (height_px, width, 3), u8.

    Raises:
        ValueError: There are no finite points, more classes than colours, or no room.
    """
    if len(names) > len(_CLASS_COLORS):
        raise ValueError(f"{len(names)} classes; there are {len(_CLASS_COLORS)} colours")
    if width < 200 or height_px < 160:
        raise ValueError(f"a cross-section needs 200 x 160 pixels, not {width} x {height_px}")
    finite = np.isfinite(across) & np.isfinite(height)
    if not finite.any():
        raise ValueError("a cross-section needs points")
    x, z, kind = across[finite], height[finite], np.asarray(group)[finite]
    frame = (_LEFT, _TOP, width - _RIGHT, height_px - _BOTTOM)
    to_x = _Scale(*_padded(x, band), frame[0], frame[2])
    to_z = _Scale(*_padded(z, None), frame[3], frame[1])
    sheet = Image.new("RGB", (width, height_px), (255, 255, 255))
    pen = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=15)
    if band is not None:
        pen.rectangle((to_x(band[0]), frame[1], to_x(band[1]), frame[3]), fill=_BAND)
    for tick in to_x.ticks():
        pen.line((to_x(tick), frame[1], to_x(tick), frame[3]), fill=_PALE)
        pen.text((to_x(tick), frame[3] + 6), f"{tick:.4g}", fill=_INK, font=font, anchor="ma")
    for tick in to_z.ticks():
        pen.line((frame[0], to_z(tick), frame[2], to_z(tick)), fill=_PALE)
        pen.text((frame[0] - 8, to_z(tick)), f"{tick:.4g}", fill=_INK, font=font, anchor="rm")
    pen.rectangle(frame, outline=_INK)
    for k in range(len(names)):
        for a, b in zip(x[kind == k], z[kind == k], strict=True):
            u, v = to_x(a), to_z(b)
            pen.ellipse((u - 2, v - 2, u + 2, v + 2), fill=_CLASS_COLORS[k])
    pen.text((frame[0], 14), title, fill=_INK, font=font)
    pen.text((frame[2], height_px - 8), labels[0], fill=_INK, font=font, anchor="rs")
    pen.text((8, frame[1] - 6), labels[1], fill=_INK, font=font, anchor="ls")
    entries = [
        (_CLASS_COLORS[k], f"{name}: {np.count_nonzero(kind == k)}") for k, name in enumerate(names)
    ]
    if band is not None:
        entries.append((_BAND, band_name))
    at = float(frame[0])
    for color, text in entries:
        pen.rectangle((at, height_px - 20, at + 12, height_px - 8), fill=color, outline=_INK)
        pen.text((at + 18, height_px - 8), text, fill=_INK, font=font, anchor="ls")
        at += 34 + pen.textlength(text, font=font)
    return np.asarray(sheet)


class _Scale:
    """A linear axis from values to pixels."""

    def __init__(self, low: float, high: float, first: int, last: int) -> None:
        self.low, self.high = low, high
        self.first, self.last = first, last

    def __call__(self, value: float) -> float:
        """Return the pixel of a value."""
        share = (value - self.low) / (self.high - self.low)
        return self.first + share * (self.last - self.first)

    def ticks(self) -> np.ndarray:
        """Return round values within the axis."""
        rough = (self.high - self.low) / 6
        unit = 10.0 ** math.floor(math.log10(rough))
        step = next(unit * k for k in (1, 2, 5, 10) if unit * k >= rough)
        return step * np.arange(math.ceil(self.low / step), math.floor(self.high / step) + 1)


def _padded(values: np.ndarray, band: tuple[float, float] | None) -> tuple[float, float]:
    """Return the ends of an axis that shows all values and the band."""
    low, high = float(values.min()), float(values.max())
    if band is not None:
        low, high = min(low, band[0]), max(high, band[1])
    room = 0.06 * (high - low) or 0.5
    return low - room, high + room
