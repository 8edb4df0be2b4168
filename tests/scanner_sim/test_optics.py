"""Projection, brightness, noise laws: known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference.profiles import on_detector

from scanner_sim import StripeScanner
from scanner_sim.optics import (
    brightness,
    depth_step,
    merging,
    mirrored_share,
    noise_law,
    project,
    range_deviation,
    speckle_deviation,
    sub_rays,
    triangulate,
)


def test_sub_rays_lie_within_the_width_and_weigh_as_a_gaussian() -> None:
    scanner = StripeScanner(line_width=0.2, sub_rays=9)
    offsets, shares = sub_rays(scanner)
    assert np.abs(offsets).max() < 0.1 and offsets[4] == 0.0
    np.testing.assert_allclose(offsets, -offsets[::-1], atol=1e-15)
    assert shares.sum() == pytest.approx(1.0)
    # At 1/e^2 is half the width, 0.1 mm: the intensity is exp(-2 (x / 0.1)^2).
    np.testing.assert_allclose(shares / shares[4], np.exp(-2.0 * (offsets / 0.1) ** 2))
    alone = sub_rays(StripeScanner())
    assert alone[0].tolist() == [0.0] and alone[1].tolist() == [1.0]


def test_projection_is_that_of_a_camera_that_looks_at_the_middle() -> None:
    scanner = StripeScanner(stand_off=150.0, triangulation_angle=math.radians(27.0), pixel=0.03)
    rng = np.random.default_rng(1)
    depth, aside = rng.uniform(100, 220, 200), rng.uniform(-1, 1, 200)
    expected = [on_detector(scanner, x, z) for x, z in zip(aside, depth, strict=True)]
    np.testing.assert_allclose(project(scanner, depth, aside), expected, atol=1e-8)
    assert project(scanner, np.array([150.0]), 0.0)[0] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(
        triangulate(scanner, project(scanner, depth, 0.0)), depth, rtol=1e-13
    )
    # Depth per pixel at the middle is the pixel over the sine of the angle.
    step = triangulate(scanner, np.array([1e-3]))[0] - triangulate(scanner, np.array([0.0]))[0]
    assert step / 1e-3 == pytest.approx(0.03 / math.sin(math.radians(27.0)), rel=1e-4)


def test_brightness_is_lambert_and_a_lobe() -> None:
    angles = np.radians([0.0, 30.0, 60.0])
    ray = np.tile([0.0, 0.0, -1.0], (3, 1))
    normal = np.column_stack([np.sin(angles), np.zeros(3), np.cos(angles)])
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    matte = brightness(StripeScanner(), ray, normal, up)
    np.testing.assert_allclose(matte, np.cos(angles))
    glossy = StripeScanner(specular=0.1, lobe=math.radians(10.0))
    lobe = 0.1 / (2 * math.radians(10.0) ** 2)
    expected = 0.9 * np.cos(angles) + lobe * np.exp(-0.5 * (2 * angles / math.radians(10.0)) ** 2)
    np.testing.assert_allclose(brightness(glossy, ray, normal, up), expected)
    assert mirrored_share(glossy, np.array([1.0, 0.0])).tolist() == [0.1, 1.0]


def test_noise_laws() -> None:
    scanner = StripeScanner(
        range_noise=0.01, incidence_noise=0.5, speckle=0.4, wavelength=0.0006, aperture=0.05,
        triangulation_angle=math.radians(30.0), quantisation=0.1, pixel=0.05, horizon=0.03,
        saturation=2.0,
    )  # fmt: skip
    assert range_deviation(scanner, np.array([1.0]))[0] == 0.01
    assert range_deviation(scanner, np.array([0.25]))[0] == pytest.approx(0.02)
    assert range_deviation(scanner, np.array([1.0]), 8.0)[0] == pytest.approx(0.02)
    speckle = 0.4 * 0.0006 / (2 * math.pi * 0.05 * 0.5)
    assert speckle_deviation(scanner) == pytest.approx(speckle)
    assert depth_step(scanner) == pytest.approx(0.01)
    law = noise_law(scanner, np.array([0.2]), np.array([0.5]))[0]
    squares = 0.01**2 / 0.2 + (0.03 * math.exp(-1.0)) ** 2 + speckle**2 + 0.01**2 / 12
    assert law == pytest.approx(math.sqrt(squares))
    assert noise_law(StripeScanner(range_noise=0.02), np.array([0.3]), np.array([0.3]))[0] == 0.02


def test_rays_of_one_line_always_touch_on_a_face() -> None:
    coarse = StripeScanner(line_width=0.5, sub_rays=3, pixel=0.01, blur=0.0)
    x = np.array([-0.5 / 3, 0.0])
    for slope in (0.0, 1.0, math.tan(math.radians(55.0))):
        place = project(coarse, coarse.stand_off + slope * x, x)
        assert abs(np.diff(place)[0]) <= merging(coarse)
