"""One pass of the probe over a part: what is measured, what arrives, and how it is off."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.types import Artefact
from scanner_sim.bounce import add_bounces
from scanner_sim.effects import Stream, quantised, range_errors, stream
from scanner_sim.line_kernel import peaks_of_solid
from scanner_sim.line_profile import Fan, Peaks, peaks
from scanner_sim.optics import noise_law
from scanner_sim.scanner import StripeScanner, View
from scanner_sim.stage import stage_error
from scanner_sim.target import CsgTarget, Target

_CHUNK = 1 << 18  # rays that are followed at once, where arrays of them all exist
_SHARE = 0.5  # a point this share of the stated noise off its place has an artefact
_EXACT = 1e-3  # ... but no point that is closer than this [mm]


class Pass(NamedTuple):
    """The points of one view, in scan order; frame of the view unless it says world."""

    stripe: np.ndarray
    column: np.ndarray
    source: np.ndarray
    """Position of the laser at every stripe [mm], world, shape (stripes, 3)."""
    position: np.ndarray
    """True position [mm], world."""
    normal: np.ndarray
    """True normal, world."""
    surface: np.ndarray
    sight: np.ndarray
    """Direction of the laser's ray, world, unit."""
    length: np.ndarray
    """Measured distance from the laser [mm], without noise."""
    fall: np.ndarray
    """Depth below the laser for a unit of the ray's length."""
    cosine: np.ndarray
    """Cosine between laser and normal."""
    camera_cosine: np.ndarray
    """Cosine between the line to the camera and the normal."""
    excess: np.ndarray
    """Brightness at the middle of the peak."""
    artefact: np.ndarray
    """`Artefact` of the point."""
    shape: tuple[int, int]
    """Stripes and rays of a stripe."""


def extent(limits: np.ndarray, scanner: StripeScanner, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest stage and ray position that meet the part's box, shape (3,) each.

    x = stage, y = where the ray meets the plane z = 0, seen from the laser, z = height; all in the
    frame of the view [mm].
    """
    middle = limits.mean(axis=0)
    corners = np.array([[limits[i, 0], limits[j, 1], limits[k, 2]]
                        for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip
    local = (corners - middle) @ view.rotation() - (0.0, view.offset, 0.0)
    if local[:, 2].max() >= scanner.stand_off:
        raise DataError(
            f"the part reaches the probe: its box ends {local[:, 2].max():.0f} mm above its "
            f"middle, the laser stands at {scanner.stand_off:.0f} mm",
            hint="raise stand_off",
        )
    local[:, 1] *= scanner.stand_off / (scanner.stand_off - local[:, 2])
    low, high = local.min(axis=0), local.max(axis=0)
    if scanner.field_of_view is not None:
        half = scanner.field_of_view / 2
        low[1], high[1] = max(low[1], -half), min(high[1], half)
    return low, high


def scan_pass(
    target: Target,
    scanner: StripeScanner,
    view: View,
    across: float,
    along: float,
    seeds: tuple[int, int],
) -> Pass:
    """Return all points that laser and camera both see, in scan order, without noise and losses.

    Args:
        target: The solid.
        scanner: The scanner.
        view: The direction of the pass.
        across: Distance of the stripes [mm].
        along: Distance of the rays [mm].
        seeds: Seed of the simulation and number of the view, for the errors of the stage.
    """
    rotation = view.rotation()
    middle = target.box.mean(axis=0)
    low, high = extent(target.box, scanner, view)
    x = _spread(low[0], high[0], across)
    y = _spread(low[1], high[1], along)
    stripes, columns = len(x), len(y)
    ray = np.stack([np.zeros(columns), y, np.full(columns, -scanner.stand_off)], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    nominal = _sources(x, scanner, view, middle)
    off = stage_error(scanner, x, stream(*seeds, Stream.JITTER), stream(*seeds, Stream.PERIOD))
    fan = Fan(_sources(x + off, scanner, view, middle), ray @ rotation.T, rotation)
    found = _peaks(target, scanner, fan)
    mark = np.zeros(len(found.ray), np.uint8)
    if scanner.specular > 0.0:
        found, mark = add_bounces(target, scanner, fan, y, found)
    if scanner.threshold > 0.0:
        bright = found.light >= scanner.threshold
        found, mark = Peaks(*(column[bright] for column in found)), mark[bright]
    stripe, column = found.ray // columns, found.ray % columns
    sight = fan.ray[column]
    to_camera = fan.source[stripe] + rotation @ scanner.camera - found.position
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    # A spike's true place may be one that could not be measured, edge on.
    cosine = np.maximum(-np.einsum("ij,ij->i", found.normal, sight), 0.02)
    camera_cosine = np.maximum(np.einsum("ij,ij->i", found.normal, to_camera), 0.02)
    reached = fan.source[stripe] + found.length[:, None] * sight
    off_surface = np.abs(np.einsum("ij,ij->i", reached - found.position, found.normal)) / cosine
    law = noise_law(scanner, cosine, camera_cosine, found.excess)
    wrong = off_surface > np.maximum(_SHARE * law, _EXACT)
    mark = np.where(wrong & (mark == Artefact.CLEAN), np.uint8(Artefact.MIXED), mark)
    return Pass(
        stripe=stripe.astype(np.int32), column=column.astype(np.int32), source=nominal,
        position=found.position, normal=found.normal, surface=found.surface, sight=sight,
        length=found.length, fall=-sight @ rotation[:, 2], cosine=cosine,
        camera_cosine=camera_cosine, excess=found.excess,
        artefact=np.where(wrong, mark, np.uint8(Artefact.CLEAN)), shape=(stripes, columns),
    )  # fmt: skip


def _sources(x: np.ndarray, scanner: StripeScanner, view: View, middle: np.ndarray) -> np.ndarray:
    """Return positions of the laser [mm], world, shape (S, 3)."""
    count = len(x)
    source = np.stack([x, np.full(count, view.offset), np.full(count, scanner.stand_off)], axis=1)
    world: np.ndarray = source @ view.rotation().T + middle
    return world


def _peaks(target: Target, scanner: StripeScanner, fan: Fan) -> Peaks:
    """Return the peaks of all stripes, in bounded memory."""
    if scanner.effects and isinstance(target, CsgTarget):
        return peaks_of_solid(target, scanner, fan)
    columns = len(fan.ray)
    step = max(_CHUNK // columns, 1)
    pieces = []
    for start in range(0, len(fan.source), step):
        part = fan._replace(source=fan.source[start : start + step])
        found = peaks(target, scanner, part)
        pieces.append(found._replace(ray=found.ray + start * columns))
    return Peaks(*(np.concatenate(column) for column in zip(*pieces, strict=True)))


def _spread(low: float, high: float, pitch: float) -> np.ndarray:
    """Return places at a pitch, amid a range: no ray then runs along a side of the part."""
    count = max(int((high - low) / pitch), 1)
    return 0.5 * (low + high) + pitch * (np.arange(count) - 0.5 * (count - 1))


def arrivals(
    scan: Pass, scanner: StripeScanner, generator: np.random.Generator, seeds: tuple[int, int]
) -> np.ndarray:
    """Return which points arrive: without lost stripes, ragged ends and single losses.

    A scanner without further effects draws them and the noise from one generator; the others have
    a stream for each loss, with a draw for every ray.
    """
    count, stripes = len(scan.stripe), len(scan.source)
    if scanner.effects:
        lines = stream(*seeds, Stream.STRIPES).random(stripes) >= scanner.lost_stripes
        trim = stream(*seeds, Stream.ENDS).poisson(scanner.lost_ends, (2, stripes))
        draws = stream(*seeds, Stream.SINGLE).random(scan.shape)
        single = draws[scan.stripe, scan.column] >= scanner.dropout
    else:
        lines = generator.random(stripes) >= scanner.lost_stripes
        trim = generator.poisson(scanner.lost_ends, (2, stripes))
        single = generator.random(count) >= scanner.dropout
    starts = np.searchsorted(scan.stripe, np.arange(stripes))
    ends = np.searchsorted(scan.stripe, np.arange(stripes), side="right")
    place = np.arange(count)
    keep = place - starts[scan.stripe] >= trim[0][scan.stripe]
    keep &= ends[scan.stripe] - 1 - place >= trim[1][scan.stripe]
    return keep & lines[scan.stripe] & single


def measured(
    scan: Pass, chosen: np.ndarray, scanner: StripeScanner, seeds: tuple[int, int], along: float
) -> np.ndarray:
    """Return where the scanner says that points are [mm], world, shape (N, 3).

    Random errors come first, then the steps of the detector; the stage is where its scale says.
    """
    key = scan.stripe[chosen].astype(np.int64) * scan.shape[1] + scan.column[chosen]
    error = range_errors(
        scanner, seed=seeds[0], view=seeds[1], shape=scan.shape, chosen=key, along=along,
        cosine=scan.cosine[chosen], camera_cosine=scan.camera_cosine[chosen],
        excess=scan.excess[chosen],
    )  # fmt: skip
    length = quantised(scanner, scan.length[chosen] + error, scan.fall[chosen])
    measured: np.ndarray = scan.source[scan.stripe[chosen]] + length[:, None] * scan.sight[chosen]
    return measured
