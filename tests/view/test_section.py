"""Cross-sections: every point is drawn, in its colour, at its place."""

from __future__ import annotations

import numpy as np
import pytest

from octoseg_ti.view.section import section

NAMES = ("clean", "mixed")


def _color(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Rows and columns of a colour, the legend below left aside."""
    return np.argwhere((picture == color).all(axis=2) & (np.arange(len(picture)) < 580)[:, None])


def test_points_stand_where_they_are() -> None:
    x, z = np.array([0.0, 1.0, 0.5]), np.array([0.0, 2.0, 1.0])
    picture = section(x, z, np.array([0, 0, 1]), names=NAMES, title="t", band=(0.4, 0.6))
    assert picture.shape == (640, 960, 3) and picture.dtype == np.uint8
    clean, mixed = _color(picture, (70, 110, 170)), _color(picture, (225, 90, 30))
    assert len(mixed) > 5 and len(clean) > 10
    middle = mixed.mean(axis=0)
    np.testing.assert_allclose(middle, clean.mean(axis=0), atol=2)  # amid the other two
    lowest = clean[clean[:, 0] > middle[0]]
    assert lowest[:, 1].mean() < middle[1]  # up is up, right is right
    band = _color(picture, (255, 238, 205))
    width = np.ptp(clean[:, 1])
    assert np.ptp(band[:, 1]) == pytest.approx(0.2 * width, rel=0.1)


def test_what_cannot_be_drawn_is_refused() -> None:
    one = np.zeros(1)
    with pytest.raises(ValueError, match="needs points"):
        section(one * np.nan, one, np.zeros(1, int), names=NAMES, title="t")
    with pytest.raises(ValueError, match="classes"):
        section(one, one, np.zeros(1, int), names=("a",) * 9, title="t")
    with pytest.raises(ValueError, match="200 x 160"):
        section(one, one, np.zeros(1, int), names=NAMES, title="t", width=20)
    picture = section(one, one, np.zeros(1, int), names=NAMES, title="one point")
    assert len(_color(picture, (70, 110, 170))) > 5
