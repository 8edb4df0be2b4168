"""Colours of labels."""

import numpy as np

from octoseg_ti.palette import colors


def test_colors_are_fixed_and_grey_means_none():
    labels = np.array([3, -1, 3, 0, -7], np.int32)
    out = colors(labels)
    assert out.shape == (5, 4) and out.dtype == np.uint8
    assert (out[0] == out[2]).all()
    assert (out[1] == out[4]).all() and len(set(out[1, :3])) == 1
    assert (out[:, 3] == 255).all()
    assert colors(np.zeros(0, np.int32)).shape == (0, 4)


def test_the_first_forty_labels_can_be_told_apart():
    rgb = colors(np.arange(-1, 40))[:, :3].astype(int)
    gap = np.abs(rgb[:, None] - rgb[None]).max(axis=2)[np.triu_indices(41, 1)]
    assert gap.min() > 12
