"""Surfaces are fitted anew where their samples are others, and stay where they hardly move."""

import numpy as np
import pytest
from reference.device_grid import samples_of
from reference.surfaces import CYLINDER, patch_of

from octoseg_ti.stages.refitting import fitted_to_others, refitted
from octoseg_ti.stages.sets import Surfaces

NOISE = 0.02


def test_what_counts_as_other_samples() -> None:
    fitted = np.repeat([0, 1, 2, -1], 100)
    label = fitted.copy()
    label[90:100] = -1  # a tenth was lost
    label[300:330] = 2  # and nearly a third is new
    label[330:350] = 1
    assert fitted_to_others(fitted, label, 3).tolist() == [True, False, True]
    nothing = np.full(400, -1)
    assert fitted_to_others(nothing, nothing, 2).tolist() == [False, False]
    assert fitted_to_others(nothing, label, 3).tolist() == [True, True, True]


@pytest.mark.parametrize(("asked", "off", "moves"), [
    (True, 2.0, True), (False, 2.0, False), (True, 0.0, False),
])  # fmt: skip
def test_what_is_asked_for_and_off_moves(asked: bool, off: float, moves: bool) -> None:
    rng = np.random.default_rng(0)
    points, normals, parameters = patch_of(CYLINDER, rng, 300)
    points += rng.normal(0.0, NOISE, (300, 3))
    # A larger radius, and as many samples as tell the true one within a fraction of the noise.
    parameters = np.stack([parameters, parameters])
    parameters[0, 6] += off * NOISE
    surfaces = Surfaces(kind=np.full(2, CYLINDER, np.int32), parameters=parameters.copy())
    samples = samples_of(points, normals)
    members = [np.arange(300), np.arange(5)]  # of the second one too few
    found = refitted(samples, members, np.array([asked, True]), surfaces, 3.0 * NOISE)
    assert (found.parameters[0, 6] != parameters[0, 6]) == moves
    np.testing.assert_array_equal(found.parameters[1], parameters[1])
    if moves:
        np.testing.assert_allclose(found.parameters[0, 6], parameters[1, 6], atol=NOISE)
