"""The linear stage: where it really is when its scale says something else."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scanner_sim.scanner import StripeScanner


def stage_error(
    scanner: StripeScanner,
    nominal: np.ndarray,
    jitter: np.random.Generator,
    period: np.random.Generator,
) -> np.ndarray:
    """Return true minus nominal position of the stage at every stripe.

    White jitter, a sine over the travel with a random phase a pass, and backlash: every pass begins
    after the way back, so the drive first takes up its play while the stage stands still.

    Args:
        scanner: The scanner.
        nominal: Positions by the scale, rising [mm], shape (S,).
        jitter: Draws the jitter.
        period: Draws the phase of the periodic error.

    Returns:
        Errors [mm], shape (S,); zeros when all three effects are off.
    """
    travel = nominal - nominal[0]
    phase = period.uniform(0.0, 2.0 * math.pi)
    error = scanner.encoder_jitter * jitter.standard_normal(len(nominal))
    error += scanner.encoder_error * np.sin(2.0 * math.pi * travel / scanner.encoder_period + phase)
    error -= np.minimum(travel, scanner.backlash)
    return error
