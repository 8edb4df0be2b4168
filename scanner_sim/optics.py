"""Optics of the probe: where a spot lies on the detector, and what depth its image means.

Laser and camera stand side by side at one height, a baseline apart; the camera looks at the middle
of the part. Lengths are those of the view: depth below the laser, distance from the laser plane.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scanner_sim.scanner import StripeScanner

_FADE = 0.2  # cosine of the angle at which the scatter at silhouettes has fallen to 1/e


def sub_rays(scanner: StripeScanner) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays over the width of the laser line.

    They stand amid equal shares of the width, so all of them lie within it.

    Args:
        scanner: The scanner.

    Returns:
        Distances from the middle of the line [mm] and shares of its light (their sum is 1), shape
        (K,) each; K = 1 without a width.
    """
    if scanner.line_width == 0.0:
        return np.zeros(1), np.ones(1)
    share = (np.arange(scanner.sub_rays) + 0.5) / scanner.sub_rays - 0.5
    share[scanner.sub_rays // 2] = 0.0
    # The width is four standard deviations.
    light = np.exp(-0.5 * (4.0 * share) ** 2)
    return scanner.line_width * share, light / light.sum()


def merging(scanner: StripeScanner) -> float:
    """Return the distance on the detector within which spots have one peak [pixel].

    The rays over the line's width are samples of it, so their own distance counts as touching, also
    on a slope that doubles it.
    """
    gap = scanner.blur
    if scanner.line_width > 0.0:
        gap += 2.0 * scanner.line_width / (scanner.sub_rays * scanner.pixel)
    return gap


def pixels_per_slope(scanner: StripeScanner) -> float:
    """Return the pixels for a unit of the tangent of the angle off the camera's axis."""
    return scanner.stand_off / math.cos(scanner.triangulation_angle) / scanner.pixel


def project(scanner: StripeScanner, depth: np.ndarray, aside: np.ndarray | float) -> np.ndarray:
    """Return where spots appear on the detector, from the middle of it [pixel], shape (N,).

    Args:
        scanner: The scanner.
        depth: Depth below the laser [mm], shape (N,).
        aside: Distance from the laser plane towards the camera [mm], shape (N,) or a number.
    """
    s, c = math.sin(scanner.triangulation_angle), math.cos(scanner.triangulation_angle)
    across = scanner.camera[0] - aside
    slope: np.ndarray = (depth * s - across * c) / (across * s + depth * c)
    return slope * pixels_per_slope(scanner)


def triangulate(scanner: StripeScanner, place: np.ndarray) -> np.ndarray:
    """Return the depth below the laser [mm] of spots in the laser plane, the inverse of `project`.

    Args:
        scanner: The scanner.
        place: Places on the detector [pixel], shape (N,).
    """
    s, c = math.sin(scanner.triangulation_angle), math.cos(scanner.triangulation_angle)
    slope = np.asarray(place) / pixels_per_slope(scanner)
    depth: np.ndarray = scanner.camera[0] * (c + slope * s) / (s - slope * c)
    return depth


def brightness(
    scanner: StripeScanner, ray: np.ndarray, normal: np.ndarray, to_camera: np.ndarray
) -> np.ndarray:
    """Return how bright spots are; a matte surface at normal incidence has 1.

    The matte share follows Lambert's cosine of the angle of incidence. The share that is reflected
    like a mirror makes a Gaussian lobe around the mirrored ray, as bright as follows from the
    energy in it: 1 / (2 lobe^2) times the matte surface's.

    Args:
        scanner: The scanner.
        ray: Unit vectors from the laser, shape (N, 3).
        normal: Unit normals, shape (N, 3).
        to_camera: Unit vectors to the camera, shape (N, 3).

    Returns:
        Brightness, shape (N,).
    """
    cosine = -np.einsum("ij,ij->i", normal, ray)
    result: np.ndarray = (1.0 - scanner.specular) * cosine
    if scanner.specular > 0.0:
        mirrored = ray + 2.0 * cosine[:, None] * normal
        off = np.arccos(np.clip(np.einsum("ij,ij->i", mirrored, to_camera), -1.0, 1.0))
        result = result + shine(scanner) * np.exp(-0.5 * (off / scanner.lobe) ** 2)
    return result


def shine(scanner: StripeScanner) -> float:
    """Return the brightness in the middle of the glossy lobe."""
    return scanner.specular / (2.0 * scanner.lobe**2)


def mirrored_share(scanner: StripeScanner, cosine: np.ndarray) -> np.ndarray:
    """Return the share of light that goes on as in a mirror, shape (N,): it grows towards grazing.

    Schlick's formula (1994) for the angle of incidence with the given cosine.
    """
    share: np.ndarray = scanner.specular + (1.0 - scanner.specular) * (1.0 - cosine) ** 5
    return share


def speckle_deviation(scanner: StripeScanner) -> float:
    """Return the standard deviation of depth by speckle [mm] (Dorsch, Häusler, Herrmann 1994)."""
    angle = math.sin(scanner.triangulation_angle)
    return scanner.speckle * scanner.wavelength / (2.0 * math.pi * scanner.aperture * angle)


def depth_step(scanner: StripeScanner) -> float:
    """Return the step of depth at the middle of the part by quantisation [mm]."""
    return scanner.quantisation * scanner.pixel / math.sin(scanner.triangulation_angle)


def range_deviation(
    scanner: StripeScanner, cosine: np.ndarray, excess: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return the standard deviation of the range noise alone [mm], shape (N,).

    ``range_noise * cos(a)^-incidence_noise``, times the root of brightness over saturation where
    the pixels are full.

    Args:
        scanner: The scanner.
        cosine: Cosine of the angle of incidence, shape (N,).
        excess: Brightness at the middle of the peak, shape (N,) or a number.
    """
    base: np.ndarray = scanner.range_noise * np.asarray(cosine) ** -scanner.incidence_noise
    if scanner.saturation is not None:
        base = base * np.sqrt(np.maximum(np.asarray(excess) / scanner.saturation, 1.0))
    return base


def horizon_deviation(
    scanner: StripeScanner, cosine: np.ndarray, camera_cosine: np.ndarray
) -> np.ndarray:
    """Return the standard deviation of the scatter at silhouettes [mm], shape (N,)."""
    grazing = np.minimum(cosine, camera_cosine)
    return scanner.horizon * np.exp(-((grazing / _FADE) ** 2))


def noise_law(
    scanner: StripeScanner,
    cosine: np.ndarray,
    camera_cosine: np.ndarray,
    excess: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Return the stated standard deviation of a clean point along the line of sight [mm].

    The root of the squares of range noise, scatter at silhouettes, speckle and quantisation. Errors
    of the stage come on top: they shift whole stripes.

    Args:
        scanner: The scanner.
        cosine: Cosine between the laser and the surface's normal, shape (N,).
        camera_cosine: Cosine between the line to the camera and the normal, shape (N,).
        excess: Brightness at the middle of the peak, shape (N,) or a number.

    Returns:
        Standard deviations, shape (N,).
    """
    squares = range_deviation(scanner, cosine, excess) ** 2
    squares = squares + horizon_deviation(scanner, cosine, camera_cosine) ** 2
    squares = squares + speckle_deviation(scanner) ** 2 + depth_step(scanner) ** 2 / 12.0
    return np.sqrt(squares)
