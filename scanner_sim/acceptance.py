"""Acceptance tests of a scanner: what it measures on a ball, a plane, a step and tilted plates.

As users do with a real probe (ISO 10360-8, VDI/VDE 2617-6.2): least squares fits to the measured
points, which are compared with what the scanner states. Points near edges are left out.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from scanner_sim import measure, simulate
from scanner_sim.optics import brightness, noise_law
from scanner_sim.part import Part, box, sphere, union
from scanner_sim.scanner import StripeScanner, View

if TYPE_CHECKING:
    from octoseg_ti.types import Scans, Truth

BALL = 12.5
"""Radius of the ball [mm]."""
STEP = 5.0
"""Height of the step [mm]."""
_SHARE = 0.95  # of the points, in the figures of form (P_Form.Sph.D95%)
_MARGIN = 2.0  # points closer to an edge are left out [mm]
_TILTS = tuple(math.radians(a) for a in (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0))


class NoiseRow(NamedTuple):
    """Noise on a plate under one angle of incidence."""

    angle: float
    """Angle of incidence [rad]."""
    measured: float
    """Standard deviation of the points from the fitted plane, along the line of sight [mm]."""
    stated: float
    """What `scanner_sim.optics.noise_law` says [mm]."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Acceptance:
    """The figures of a scanner; see `scanner_sim.presets.Limits`."""

    probing_form: float
    """Width of the shell that holds 95 % of the points on the ball [mm]."""
    probing_form_all: float
    """Width of the shell that holds all of them [mm]."""
    size_error: float
    """Diameter of the fitted ball minus the true one [mm]."""
    flatness: float
    """Width of the slab that holds 95 % of the points on the plane [mm]."""
    flatness_all: float
    """Width of the slab that holds all of them [mm]."""
    step_error: float
    """Measured minus true height of the step [mm]."""
    noise: tuple[NoiseRow, ...]
    """Noise by angle of incidence, as far as the scanner bears."""


def acceptance(scanner: StripeScanner | None = None, *, seed: int = 0) -> Acceptance:
    """Measure a scanner as its users would.

    Args:
        scanner: The scanner; its pitches and views are replaced by those of the tests.
        seed: Seed of noise and losses.
    """
    scanner = scanner or StripeScanner()
    points = _scan(sphere((0.0, 0.0, 0.0), BALL), scanner, 0.3, seed)[0]
    radius, residual = fit_sphere(points)
    flat = _interior(_scan(box((-20, -20, 0), (20, 20, 10)), scanner, 0.4, seed)[0], 20.0)
    level = fit_plane(flat)
    return Acceptance(
        probing_form=_width(residual, _SHARE),
        probing_form_all=_width(residual, 1.0),
        size_error=2.0 * (radius - BALL),
        flatness=_width(level, _SHARE),
        flatness_all=_width(level, 1.0),
        step_error=_step_error(scanner, seed),
        noise=tuple(
            noise_at(scanner, tilt, seed=seed)
            for tilt in _TILTS
            if tilt < min(scanner.incidence_limit, scanner.camera_limit) - 0.05
        ),
    )


def step_part() -> Part:
    """Return the step: 5 mm up at x = 0, away from the camera of a view from above."""
    return _step(20.0)


def _step(half: float) -> Part:
    """Return the step between two plates of a width [mm]."""
    high = box((0.0, -10.0, -STEP), (half, 10.0, STEP))
    return union(high, box((-half, -10.0, -STEP), (0.0, 10.0, 0.0)))


def scan_of_step(scanner: StripeScanner, *, seed: int = 0) -> tuple[Scans, Truth]:
    """Return a scan of the step from above, its stripes along the step and close together."""
    fine = dataclasses.replace(
        scanner, stripe_pitch=max(scanner.line_width / 12.0, 0.01), point_pitch=1.0, points=None,
        views=(View(),), aspect=1.0,
    )  # fmt: skip
    return simulate(_step(2.0), fine, seed=seed)


def noise_at(scanner: StripeScanner, tilt: float, *, seed: int = 0) -> NoiseRow:
    """Measure the noise on a plate that is tilted along the stripes.

    Tilted so, the errors of the stage move the points within the plate.

    Args:
        scanner: The scanner.
        tilt: Angle of incidence [rad].
        seed: Seed of noise and losses.
    """
    plate = box((-12.0, -8.0, -1.0), (12.0, 8.0, 0.0)).turned("x", tilt)
    points, scans = _scan(plate, scanner, 0.12, seed)
    assert scans.stripe_origin is not None and scans.stripe is not None
    normal = np.array([0.0, -math.sin(tilt), math.cos(tilt)])
    along = points @ np.array([0.0, math.cos(tilt), math.sin(tilt)])
    # The other faces of the plate are at least half a millimetre off.
    inner = (np.abs(points @ normal) < 0.5) & (np.abs(along) < 6.0) & (np.abs(points[:, 0]) < 10.0)
    source = scans.stripe_origin[scans.stripe[inner]]
    sight = points[inner] - source
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    back = source + View().rotation() @ scanner.camera - points[inner]
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    cosine = -sight @ normal
    facing = np.tile(normal, (len(sight), 1))
    law = noise_law(scanner, cosine, back @ normal, brightness(scanner, sight, facing, back))
    residual = fit_plane(points[inner]) / cosine
    return NoiseRow(tilt, float(np.sqrt((residual**2).mean())), float(np.sqrt((law**2).mean())))


def fit_sphere(points: np.ndarray) -> tuple[float, np.ndarray]:
    """Fit a ball by least squares of the distances.

    Args:
        points: Positions [mm], shape (N, 3).

    Returns:
        The radius [mm], and the distance of every point from the ball [mm], shape (N,).
    """
    from scipy.optimize import least_squares

    middle = points.mean(axis=0)
    q = points - middle
    # The algebraic fit is close, and its centre a good start.
    start = np.linalg.lstsq(np.column_stack([2.0 * q, np.ones(len(q))]), (q**2).sum(axis=1), None)
    centre = start[0][:3]
    radius = math.sqrt(start[0][3] + centre @ centre)
    fit = least_squares(
        lambda v: np.linalg.norm(q - v[:3], axis=1) - v[3],
        [*centre, radius],
        xtol=1e-15,
        ftol=1e-15,
    )
    return float(fit.x[3]), fit.fun


def fit_plane(points: np.ndarray) -> np.ndarray:
    """Fit a plane by least squares; return every point's distance from it [mm], shape (N,)."""
    q = points - points.mean(axis=0)
    residual: np.ndarray = q @ np.linalg.eigh(q.T @ q)[1][:, 0]
    return residual


def _step_error(scanner: StripeScanner, seed: int) -> float:
    """Return the error of the distance between two planes with one direction [mm]."""
    points = _scan(step_part(), scanner, 0.25, seed)[0]
    upper = points[:, 2] > STEP / 2
    x, y = np.abs(points[:, 0]), np.abs(points[:, 1])
    flat = (x > _MARGIN) & (x < 20.0 - _MARGIN) & (y < 10.0 - _MARGIN)
    flat &= np.minimum(np.abs(points[:, 2]), np.abs(points[:, 2] - STEP)) < 0.5
    matrix = np.column_stack([points[flat, :2], np.ones(flat.sum()), upper[flat]])
    a, b, _, height = np.linalg.lstsq(matrix, points[flat, 2], None)[0]
    return float(height / math.sqrt(1.0 + a * a + b * b) - STEP)


def _interior(points: np.ndarray, half: float) -> np.ndarray:
    inner: np.ndarray = points[(np.abs(points[:, :2]) < half - _MARGIN).all(axis=1)]
    return inner


def _width(residual: np.ndarray, share: float) -> float:
    """Return the smallest range that holds a share of the residuals [mm]."""
    ordered = np.sort(residual)
    count = max(math.ceil(share * len(ordered)), 1)
    return float((ordered[count - 1 :] - ordered[: len(ordered) - count + 1]).min())


def _scan(part: Part, scanner: StripeScanner, pitch: float, seed: int) -> tuple[np.ndarray, Scans]:
    """Scan a part once from above; return world points too."""
    once = dataclasses.replace(
        scanner, stripe_pitch=1.25 * pitch, point_pitch=pitch, points=None, views=(View(),)
    )
    scans = measure(part, once, seed=seed)
    assert scans.T_world_view is not None
    pose = scans.T_world_view[0]
    return scans.points @ pose[:3, :3].T + pose[:3, 3], scans
