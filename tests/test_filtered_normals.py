"""When normals are filtered: with noise above the least tolerance, unless it is switched off."""

from dataclasses import replace

import numpy as np
import pytest
from reference.tent import make_tent

from octoseg_ti import Params, Scans, Truth, paper, segment
from octoseg_ti.defaults import LEAST_TOLERANCE, NOISE_FLOORS, SMOOTH_PASSES, passes_for
from octoseg_ti.params import NormalParams
from octoseg_ti.stages.neighbors import PASSES

OFF = Params(normals=NormalParams(smooth=0))


@pytest.fixture(scope="module")
def tents() -> dict[float, tuple[Scans, Truth]]:
    """The tent with different noise [mm]; the spacing is 0.5 mm."""
    return {noise: make_tent(noise=noise) for noise in (0.0, 0.005, 0.04, 0.1)}


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_clean_data_keep_every_bit(tents, noise: float) -> None:
    scans, _ = tents[noise]
    answer, off = segment(scans), segment(scans, OFF)
    assert answer.params.normals.smooth == 0 and answer.params.normals.weight == "unit"
    np.testing.assert_array_equal(answer.normals, off.normals)
    np.testing.assert_array_equal(answer.labels, off.labels)


@pytest.mark.parametrize("noise", [0.04, 0.1])
def test_noisy_normals_are_filtered_and_what_is_left_is_measured(tents, noise: float) -> None:
    scans, truth = tents[noise]
    answer, off = segment(scans), segment(scans, OFF)
    assert answer.params.normals.smooth >= SMOOTH_PASSES[0]
    assert answer.params.normals.weight == "area"
    inner = (truth.edge_distance > 2.0) & (answer.normals.any(axis=1))
    left, raw = (
        np.sqrt(np.mean(np.sum((r.normals - truth.normal)[inner] ** 2, axis=1)))
        for r in (answer, off)
    )
    assert left < raw / 3
    # A small part, of which a fifth lies at a border.
    assert answer.measured.normal_noise == pytest.approx(left, rel=0.35)
    assert answer.params.grid.tolerance < off.params.grid.tolerance
    assert answer.patch_count == 2


def test_it_can_be_asked_for_and_switched_off(tents) -> None:
    scans, _ = tents[0.1]
    asked = segment(scans, Params(normals=NormalParams(smooth=3, weight="unit")))
    assert (asked.params.normals.smooth, asked.params.normals.weight) == (3, "unit")
    off = segment(scans, OFF)
    assert (off.params.normals.smooth, off.params.normals.weight) == (0, "unit")
    assert np.abs(asked.normals - off.normals).max() > 0.05


@pytest.mark.parametrize("height", [0.0, 1.0])
def test_clean_normals_may_be_filtered_too(height: float) -> None:
    x, y = (a.ravel() for a in np.mgrid[0:20, 0:30] * 0.5)
    points = np.column_stack((x, y, height * np.sin(0.2 * y)))
    stripe = (2 * x).astype(np.int32)
    answer = segment(points, Params(normals=NormalParams(smooth=3)), stripe=stripe)
    assert answer.params.normals.smooth == 3
    assert np.all(np.isfinite(answer.normals))
    np.testing.assert_allclose(np.linalg.norm(answer.normals, axis=1), 1.0, atol=1e-6)


def test_the_paper_does_not_filter(tents) -> None:
    assert segment(tents[0.1][0], paper()).params.normals.smooth == 0


def test_given_normals_stay_as_given(tents) -> None:
    scans, truth = tents[0.1]
    noisy = truth.normal + 0.1 * np.random.default_rng(1).standard_normal(truth.normal.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    answer = segment(replace(scans, normals=noisy))
    np.testing.assert_array_equal(answer.normals, noisy.astype(np.float32))
    assert answer.params.normals.smooth == 0


def test_without_stripes_creases_are_sharpened_unless_switched_off(tents) -> None:
    points = tents[0.0][0].points
    for params, smooth in ((Params(), PASSES), (OFF, 0), (paper(), 0)):
        assert segment(points, params).params.normals.smooth == smooth
    given = segment(points, normals=np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    assert given.params.normals.smooth == 0
    assert np.all(given.normals == [0, 0, 1])


def test_more_noise_takes_more_passes() -> None:
    aim = LEAST_TOLERANCE / NOISE_FLOORS
    assert passes_for(0.0) == passes_for(aim) == 0
    passes = [passes_for(aim * times) for times in (1.01, 2, 5, 10, 20, 1000)]
    assert passes == sorted(passes)
    assert (passes[0], passes[-1]) == SMOOTH_PASSES
