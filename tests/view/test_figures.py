"""The pictures show what they claim: colours of labels, of errors, of levels."""

import io

import numpy as np
import pytest

from octoseg_ti import palette
from octoseg_ti.view import figures, scene


def hues(picture):
    """Return the share of drawn pixels whose colour points the same way as each palette entry."""
    drawn = picture[(picture < 250).any(axis=2)].astype(float)
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def share(picture, color):
    """Return the share of drawn pixels that have the hue of a colour, however shaded."""
    color = np.asarray(color[:3], float)
    return float((hues(picture) @ (color / np.linalg.norm(color)) > 0.9995).mean())


def test_all_pictures(made):
    _, truth, result = made
    pictures = figures.figures(result, truth=truth, width=160, height=110)
    assert list(pictures) == list(figures.TITLES)
    for name, picture in pictures.items():
        assert picture.shape == (110, 160, 3), name
        assert 0.15 < (picture < 250).any(axis=2).mean() < 0.95, name
    assert list(figures.figures(result, width=80, height=60)) == list(figures.TITLES)[:-2]
    sheet = figures.contact_sheet(pictures, columns=4)
    assert sheet.shape == (3 * (110 + 20), 4 * 160, 3)


def test_segments_have_the_colours_of_their_labels(made):
    _, truth, result = made
    picture = figures.draw("segments", result, width=240, height=160)
    for label in range(3):
        assert share(picture, palette.colors(np.array([label]))[0]) > 0.03
    assert share(picture, palette.colors(np.array([17]))[0]) < 0.01
    true = figures.draw("truth", result, truth=truth, width=240, height=160)
    assert share(true, palette.colors(np.array([0]))[0]) > 0.3


def test_errors_are_red(made):
    _, truth, result = made
    picture = figures.draw("errors", result, truth=truth, width=240, height=160)
    wrong = share(picture, scene.ERROR_COLORS[1])
    assert 0.01 < wrong < 0.08  # a corner of 10 x 6 mm of 60 x 40


def test_edges_removed_has_holes_where_edge_points_were(made):
    _, _, result = made
    whole = figures.draw("scan", result, width=240, height=160)
    holed = figures.draw("edges-removed", result, width=240, height=160)
    assert (whole < 250).any(axis=2).sum() > (holed < 250).any(axis=2).sum()
    edges = figures.draw("edge-points", result, width=240, height=160)
    assert share(edges, scene.EDGE_COLORS[1]) > 0.001


def test_png_round_trip(made, tmp_path):
    from PIL import Image

    picture = figures.draw("scan", made[2], width=50, height=40)
    assert (np.asarray(Image.open(io.BytesIO(figures.png(picture)))) == picture).all()
    figures.save_png(tmp_path / "scan.png", picture)
    assert (np.asarray(Image.open(tmp_path / "scan.png")) == picture).all()


def test_what_cannot_be_drawn(made):
    with pytest.raises(ValueError, match="no picture is called 'x'"):
        figures.draw("x", made[2])
    with pytest.raises(ValueError, match="needs the truth"):
        figures.draw("errors", made[2])
    with pytest.raises(ValueError, match="at least one"):
        figures.contact_sheet({})
