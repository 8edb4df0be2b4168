"""Random errors and the stage: laws, streams, known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from scanner_sim import StripeScanner
from scanner_sim.effects import Stream, grid_draws, quantised, range_errors, spot_size, stream
from scanner_sim.optics import depth_step, noise_law, project, speckle_deviation
from scanner_sim.stage import stage_error


def _errors(scanner: StripeScanner, cosine: float = 1.0, **changes: object) -> np.ndarray:
    shape = (100, 200)
    count = shape[0] * shape[1]
    values: dict[str, object] = {
        "seed": 3, "view": 0, "shape": shape, "chosen": np.arange(count), "along": 0.05,
        "cosine": np.full(count, cosine), "camera_cosine": np.full(count, cosine),
        "excess": np.full(count, cosine), **changes,
    }  # fmt: skip
    return range_errors(scanner, **values)  # type: ignore[arg-type]


@pytest.mark.parametrize("angle", [0, 20, 40, 60, 75, 80])
@pytest.mark.parametrize(
    "scanner",
    [
        StripeScanner(range_noise=0.02),
        StripeScanner(range_noise=0.02, incidence_noise=0.5),
        StripeScanner(range_noise=0.005, incidence_noise=1.0, horizon=0.05, speckle=1.0),
        StripeScanner(range_noise=0.01, saturation=0.3),
    ],
)
def test_noise_equals_its_law_at_every_angle(scanner: StripeScanner, angle: int) -> None:
    cosine = math.cos(math.radians(angle))
    stated = noise_law(scanner, np.array([cosine]), np.array([cosine]), cosine)[0]
    errors = _errors(scanner, cosine)
    assert errors.std() == pytest.approx(stated, rel=0.05)
    assert abs(errors.mean()) < 0.05 * stated


def test_speckle_is_alike_within_a_spot_and_not_beyond() -> None:
    scanner = StripeScanner(range_noise=0.0, speckle=1.0, line_width=0.4)
    assert spot_size(scanner) == 0.4
    lines = _errors(scanner).reshape(100, 200)  # 0.05 mm apart
    assert lines.std() == pytest.approx(speckle_deviation(scanner), rel=0.03)

    def alike(step: int) -> float:
        return float((lines[:, step:] * lines[:, :-step]).mean() / lines.var())

    assert alike(1) > 0.8 and alike(2) > 0.6  # 0.1 mm: well within
    assert abs(alike(12)) < 0.1
    assert abs((lines[1:] * lines[:-1]).mean() / lines.var()) < 0.1
    # The ends of a stripe are as noisy as its middle.
    assert lines[:, [0, -1]].std() == pytest.approx(lines.std(), rel=0.2)


def test_draws_of_a_ray_do_not_depend_on_the_others() -> None:
    every = np.arange(50 * 40)
    some = every[::7]
    for smooth in (0.0, 2.5):
        all_ = grid_draws(stream(1, 2, Stream.RANGE), 50, 40, every, smooth=smooth)
        few = grid_draws(stream(1, 2, Stream.RANGE), 50, 40, some, smooth=smooth)
        np.testing.assert_array_equal(few, all_[some])


def test_an_effect_that_is_off_leaves_the_others_alone() -> None:
    full = StripeScanner(range_noise=0.01, horizon=0.02, speckle=0.5)
    whole = _errors(full, 0.3)
    parts = [
        _errors(StripeScanner(range_noise=0.01), 0.3),
        _errors(StripeScanner(range_noise=0.0, horizon=0.02), 0.3),
        _errors(StripeScanner(range_noise=0.0, speckle=0.5), 0.3),
    ]
    np.testing.assert_allclose(whole, sum(parts), atol=1e-15)
    streams = [stream(4, 1, effect).random() for effect in Stream]
    assert len(set(streams)) == len(Stream)
    assert stream(4, 0, Stream.RANGE).random() != streams[0]


def test_quantisation_is_a_step_on_the_detector() -> None:
    scanner = StripeScanner(quantisation=0.25, pixel=0.1)
    rng = np.random.default_rng(0)
    length, fall = rng.uniform(290, 310, 4000), rng.uniform(0.97, 1.0, 4000)
    stepped = quantised(scanner, length, fall)
    place = project(scanner, stepped * fall, 0.0) / 0.25
    np.testing.assert_allclose(place, np.rint(place), atol=1e-6)
    error = (stepped - length) * fall
    assert np.abs(error).max() <= 0.55 * depth_step(scanner) * 1.1
    assert error.std() == pytest.approx(depth_step(scanner) / math.sqrt(12), rel=0.1)
    assert quantised(StripeScanner(), length, fall) is length


def test_stage_errors() -> None:
    x = -3.0 + 0.01 * np.arange(1000)

    def error(**values: float) -> np.ndarray:
        scanner = StripeScanner(**values)  # type: ignore[arg-type]
        return stage_error(scanner, x, np.random.default_rng(1), np.random.default_rng(2))

    assert (error() == 0.0).all()
    assert error(encoder_jitter=0.004).std() == pytest.approx(0.004, rel=0.1)
    wave = error(encoder_error=0.003, encoder_period=2.0)
    assert np.abs(wave).max() == pytest.approx(0.003, rel=1e-3)
    np.testing.assert_allclose(wave[200:], wave[:-200], atol=1e-12)
    lag = error(backlash=0.05)
    np.testing.assert_allclose(lag, -np.minimum(x - x[0], 0.05), atol=1e-12)
    both = error(encoder_jitter=0.004, backlash=0.05)
    np.testing.assert_allclose(both, error(encoder_jitter=0.004) + lag, atol=1e-15)
