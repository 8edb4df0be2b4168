"""Acceptance figures: the fits on points with a known answer, and whole scanners."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from scanner_sim.acceptance import acceptance, fit_plane, fit_sphere, noise_at
from scanner_sim.presets import LIMITS, SCANNERS


def test_fits_find_what_they_are_given() -> None:
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(500, 3))
    direction[:, 2] = np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius, residual = fit_sphere(direction * 7.25 + [100.0, -50.0, 3.0])
    assert radius == pytest.approx(7.25, abs=1e-9) and np.abs(residual).max() < 1e-9
    noise = 0.01 * rng.normal(size=500)
    radius, residual = fit_sphere(direction * (7.25 + noise[:, None]))
    assert radius == pytest.approx(7.25, abs=0.005)
    assert residual.std() == pytest.approx(0.01, rel=0.1)
    flat = np.column_stack([rng.uniform(-5, 5, (500, 2)), noise])
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert np.abs(fit_plane(flat @ turn)).std() == pytest.approx(np.abs(noise).std(), rel=0.05)


@pytest.mark.parametrize("name", ["ideal", "surveyor-like", "modern"])
def test_scanners_measure_what_they_state(name: str) -> None:
    found, limits = acceptance(SCANNERS[name], seed=3), LIMITS[name]
    for figure in ("probing_form", "size_error", "flatness", "step_error"):
        low, high = getattr(limits, figure)
        assert low <= getattr(found, figure) <= high, figure
    if name == "ideal":
        assert max(found.probing_form_all, found.flatness_all) < 1e-4  # 0.1 um
        assert abs(found.step_error) < 1e-4 and abs(found.size_error) < 1e-4
        return
    assert len(found.noise) >= 7
    for line in found.noise:
        assert line.measured == pytest.approx(line.stated, rel=0.1), math.degrees(line.angle)
    assert found.noise[0].stated < found.noise[-1].stated


def test_figures_would_show_a_scanner_that_is_off() -> None:
    # Three times the noise is seen by the figure of form, though the law states it too.
    good = SCANNERS["modern"]
    bad = dataclasses.replace(good, range_noise=3.0 * good.range_noise)
    low, high = LIMITS["modern"].probing_form
    assert not low <= acceptance(bad).probing_form <= high
    assert noise_at(bad, 0.0).measured > 2.0 * noise_at(good, 0.0).measured
