"""Random errors of a measured point, each drawn from a stream of its own.

Draws are made for every ray of a pass, hit or not, in the order of the scan: so the noise of a
point does not depend on which other points there are, and an effect that is switched off leaves
the draws of the others as they are.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

from scanner_sim.optics import (
    horizon_deviation,
    project,
    range_deviation,
    speckle_deviation,
    triangulate,
)

if TYPE_CHECKING:
    from scanner_sim.scanner import StripeScanner

_AIRY = 1.22
_BLOCK = 1 << 20


class Stream(IntEnum):
    """Number of the child seed of every effect; numbers are never given away again."""

    RANGE = 0
    SPECKLE = 1
    HORIZON = 2
    JITTER = 3
    PERIOD = 4
    STRIPES = 5
    ENDS = 6
    SINGLE = 7


def stream(seed: int, view: int, effect: Stream) -> np.random.Generator:
    """Return the generator of an effect in a view, independent of all others."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(view, int(effect))))


def grid_draws(
    generator: np.random.Generator, stripes: int, columns: int, chosen: np.ndarray,
    *, smooth: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """Return standard normal draws of the chosen rays of a pass.

    Args:
        generator: The stream.
        stripes: Stripes of the pass.
        columns: Rays of a stripe.
        chosen: Stripe x columns + column of the wanted rays, rising, shape (N,).
        smooth: Length over which neighbours on a stripe are alike [columns], as the standard
            deviation of a Gaussian window; 0 = independent.

    Returns:
        Draws, shape (N,), each with mean 0 and variance 1.
    """
    window = np.ones(1)
    if smooth > 0.0:
        reach = int(np.ceil(4.0 * smooth))
        window = np.exp(-0.5 * (np.arange(-reach, reach + 1) / smooth) ** 2)
        window /= np.sqrt((window**2).sum())
    # Some columns more on either side: the ends of a stripe are as noisy as its middle.
    width = columns + len(window) - 1
    result = np.empty(len(chosen))
    step = max(_BLOCK // width, 1)
    for first in range(0, stripes, step):
        rows = min(step, stripes - first)
        white = generator.standard_normal((rows, width))
        drawn = np.zeros((rows, columns))
        for k, weight in enumerate(window):
            drawn += weight * white[:, k : k + columns]
        start, stop = np.searchsorted(chosen, [first * columns, (first + rows) * columns])
        result[start:stop] = drawn.ravel()[chosen[start:stop] - first * columns]
    return result


def spot_size(scanner: StripeScanner) -> float:
    """Return the length on the part over which speckle is one and the same [mm].

    The wider of the laser line and the smallest spot that the lens resolves.
    """
    return max(scanner.line_width, _AIRY * scanner.wavelength / scanner.aperture)


def range_errors(
    scanner: StripeScanner,
    *,
    seed: int,
    view: int,
    shape: tuple[int, int],
    chosen: np.ndarray,
    along: float,
    cosine: np.ndarray,
    camera_cosine: np.ndarray,
    excess: np.ndarray,
) -> np.ndarray:
    """Return the random error of points along the line of sight [mm], shape (N,).

    Args:
        scanner: The scanner.
        seed: Seed of the simulation.
        view: Number of the view.
        shape: Stripes of the pass, rays of a stripe.
        chosen: Stripe x columns + column of every point, rising, shape (N,).
        along: Distance of the rays [mm].
        cosine: Cosine of the angle of incidence, shape (N,).
        camera_cosine: Cosine between normal and line to the camera, shape (N,).
        excess: Brightness at the middle of the peak, shape (N,).
    """

    def draws(effect: Stream, smooth: float = 0.0) -> np.ndarray:
        return grid_draws(stream(seed, view, effect), *shape, chosen, smooth=smooth)

    error = np.zeros(len(chosen))
    if scanner.range_noise > 0.0:
        error += range_deviation(scanner, cosine, excess) * draws(Stream.RANGE)
    if scanner.horizon > 0.0:
        error += horizon_deviation(scanner, cosine, camera_cosine) * draws(Stream.HORIZON)
    if scanner.speckle > 0.0:
        # A quarter of the size as deviation: neighbours within the spot are alike.
        smooth = 0.25 * spot_size(scanner) / along
        error += speckle_deviation(scanner) * draws(Stream.SPECKLE, smooth)
    return error


def quantised(scanner: StripeScanner, length: np.ndarray, fall: np.ndarray) -> np.ndarray:
    """Return distances along the rays as the detector's steps allow them [mm], shape (N,).

    Args:
        scanner: The scanner.
        length: Distances from the laser [mm], shape (N,).
        fall: Depth for a unit of every ray's length, shape (N,).
    """
    if scanner.quantisation == 0.0:
        return length
    place = project(scanner, length * fall, 0.0)
    steps = np.rint(place / scanner.quantisation) * scanner.quantisation
    result: np.ndarray = triangulate(scanner, steps) / fall
    return result
