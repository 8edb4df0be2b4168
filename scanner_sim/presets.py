"""Whole scanners by name, and the acceptance figures that each of them states."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

from octoseg_ti.errors import DataError
from scanner_sim.scanner import StripeScanner


class Limits(NamedTuple):
    """Ranges in which the acceptance figures of a scanner lie, (lowest, highest) [mm]."""

    probing_form: tuple[float, float]
    """Width of the shell that holds 95 % of the points on a 25 mm ball, around the fitted one."""
    size_error: tuple[float, float]
    """Diameter of the ball fitted to these points, minus the true one."""
    flatness: tuple[float, float]
    """Width of the slab that holds 95 % of the points on a plane, around the fitted one."""
    step_error: tuple[float, float]
    """Height of a step of 5 mm between two fitted planes, minus the true one."""


SCANNERS: dict[str, StripeScanner] = {
    "default": StripeScanner(),
    "ideal": StripeScanner(range_noise=0.0, dropout=0.0, lost_ends=0.0),
    "surveyor-like": StripeScanner(
        stand_off=150.0,
        range_noise=0.008,
        incidence_noise=0.5,
        line_width=0.15,
        pixel=0.05,
        quantisation=1.0 / 16.0,
        horizon=0.02,
        speckle=0.5,
        wavelength=0.00067,
        aperture=0.03,
        specular=0.03,
        saturation=1.5,
        threshold=0.1,
        encoder_jitter=0.002,
        encoder_error=0.003,
        backlash=0.003,
        dropout=0.01,
        lost_stripes=0.002,
        incidence_limit=math.radians(70.0),
        camera_limit=math.radians(80.0),
        stripe_rate=30.0,
    ),
    "modern": StripeScanner(
        stand_off=150.0,
        range_noise=0.003,
        incidence_noise=0.5,
        line_width=0.08,
        pixel=0.02,
        quantisation=1.0 / 32.0,
        horizon=0.005,
        speckle=0.3,
        wavelength=0.00045,
        aperture=0.05,
        specular=0.03,
        saturation=3.0,
        threshold=0.05,
        encoder_jitter=0.0005,
        encoder_error=0.001,
        backlash=0.0005,
        dropout=0.002,
        incidence_limit=math.radians(75.0),
        camera_limit=math.radians(80.0),
        stripe_rate=300.0,
    ),
    "harsh": StripeScanner(
        stand_off=150.0,
        range_noise=0.03,
        incidence_noise=1.0,
        line_width=0.3,
        pixel=0.1,
        quantisation=0.25,
        horizon=0.1,
        speckle=1.0,
        wavelength=0.00067,
        aperture=0.03,
        specular=0.2,
        saturation=1.0,
        threshold=0.12,
        encoder_jitter=0.01,
        encoder_error=0.01,
        backlash=0.02,
        dropout=0.05,
        lost_ends=3.0,
        lost_stripes=0.02,
        incidence_limit=math.radians(75.0),
        stripe_rate=30.0,
    ),
}
"""Scanners by name.

- ``default``: range noise of 0.01 mm and a few losses, no other effect.
- ``ideal``: exact hits, nothing lost.
- ``surveyor-like``: a line probe as of about the year 2000. Its values are assumptions: no data
  sheet of the Surveyor 1200 was at hand, only the claims of its time (about 0.025 mm, ten to
  fifteen thousand points a second).
- ``modern``: a blue line probe as of today, of which makers claim probing errors of about 10 um.
- ``harsh``: a shiny part, a wide line and a worn stage: more artefacts than a user should meet.
"""

LIMITS: dict[str, Limits] = {
    "default": Limits((0.03, 0.05), (-0.005, 0.005), (0.03, 0.05), (-0.001, 0.001)),
    "ideal": Limits((0.0, 1e-4), (-1e-4, 1e-4), (0.0, 1e-4), (-1e-4, 1e-4)),
    "surveyor-like": Limits((0.03, 0.06), (-0.01, 0.01), (0.025, 0.05), (-0.005, 0.005)),
    "modern": Limits((0.01, 0.02), (-0.003, 0.003), (0.008, 0.018), (-0.002, 0.002)),
    "harsh": Limits((0.1, 0.4), (-0.08, 0.08), (0.1, 0.3), (-0.03, 0.03)),
}
"""Stated acceptance figures by the name of the scanner."""


def scanner(name: str, **overrides: Any) -> StripeScanner:
    """Return a scanner by name, with other values where given.

    Raises:
        DataError: There is none of this name, it has no such parameter, or a value is outside its
            range.
    """
    if name not in SCANNERS:
        raise DataError(f"no scanner {name!r}", hint=f"scanners: {', '.join(SCANNERS)}")
    known = {field.name for field in dataclasses.fields(StripeScanner)}
    for key in overrides:
        if key not in known:
            raise DataError(f"StripeScanner: no parameter {key!r}")
    return dataclasses.replace(SCANNERS[name], **overrides)
