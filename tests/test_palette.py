"""Labels keep their colours, and neighbours are told apart."""

from __future__ import annotations

import numpy as np

from octoseg_ti.palette import NONE_COLOR, colors, level_colors, normal_colors


def test_no_label_is_grey_and_labels_are_not():
    rgba = colors(np.array([-1, -7, 0, 1, 2]))
    assert rgba.dtype == np.uint8 and rgba.shape == (5, 4)
    assert rgba[0].tolist() == rgba[1].tolist() == list(NONE_COLOR)
    assert all(np.ptp(row[:3].astype(int)) > 40 for row in rgba[2:])
    assert (rgba[:, 3] == 255).all()


def test_first_labels_stay_apart():
    rgb = colors(np.arange(32))[:, :3].astype(float)
    distance = np.linalg.norm(rgb[:, None] - rgb[None], axis=2)
    assert distance[~np.eye(32, dtype=bool)].min() > 15
    assert np.linalg.norm(np.diff(rgb, axis=0), axis=1).min() > 60


def test_colour_depends_on_the_label_alone():
    np.testing.assert_array_equal(colors(np.array([5, 3, 5]))[[0, 2]], colors(np.array([5, 5])))
    np.testing.assert_array_equal(colors(np.array([5000])), colors(np.array([5000 - 4096])))


def test_levels_run_from_blue_to_red():
    rgba = level_colors(np.array([0, 1, 2, -1]))
    assert rgba[0, 2] > rgba[0, 0] and rgba[2, 0] > rgba[2, 2]
    assert rgba[3].tolist() == list(NONE_COLOR)
    np.testing.assert_array_equal(level_colors(np.array([0]), 3), rgba[:1])
    assert level_colors(np.array([], np.int8)).shape == (0, 4)


def test_normal_map():
    normals = np.array([[0, 0, 1.0], [0, 0, 0], [np.nan, 0, 1], [-1, 0, 0]])
    expected = [[128, 128, 255, 255], [*NONE_COLOR], [*NONE_COLOR], [0, 128, 128, 255]]
    assert normal_colors(normals).tolist() == expected
