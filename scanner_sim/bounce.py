"""The second spot: laser light that the part mirrors once, and that hits it again.

The camera takes every spot for one in the laser plane. Where the mirrored spot falls into a row in
which it outshines the line, the row's point is a spike; where it touches the line on the detector,
it pulls the peak.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octoseg_ti.types import Artefact
from scanner_sim.line_profile import Fan, Peaks, visible
from scanner_sim.optics import merging, mirrored_share, project, triangulate

if TYPE_CHECKING:
    from scanner_sim.scanner import StripeScanner
    from scanner_sim.target import Target

_FAINTEST = 0.02  # a mirrored spot below this brightness is lost in the dark of the detector
_CHUNK = 1 << 19


class _Second(NamedTuple):
    """Mirrored spots, one a row at most, by row."""

    ray: np.ndarray
    """Stripe x columns + the row that the camera sees it in, shape (M,)."""
    place: np.ndarray
    """Where on the detector [pixel], shape (M,)."""
    light: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    surface: np.ndarray


def add_bounces(
    target: Target, scanner: StripeScanner, fan: Fan, rows: np.ndarray, found: Peaks
) -> tuple[Peaks, np.ndarray]:  # fmt: skip
    """Return the peaks as mirrored light changes them, and the artefact of each.

    Only the middle ray of the line is followed on. Of a spike the true position is where the laser
    of its row meets the part; where it meets nothing, the mirrored spot.

    Args:
        target: The solid.
        scanner: The scanner; ``specular`` is the share that is mirrored.
        fan: The rays.
        rows: Where the rays meet the plane z = 0, evenly spaced [mm], shape (C,).
        found: The peaks without mirrored light.

    Returns:
        The peaks in scan order, shape (P',) each; `Artefact.SPIKE`, `Artefact.MULTI_BOUNCE` or
        `Artefact.CLEAN`, shape (P',), u8.
    """
    second = _second_spots(target, scanner, fan, rows)
    mark = np.zeros(len(found.ray), np.uint8)
    if len(second.ray) == 0:
        return found, mark
    fall = -(fan.ray @ fan.rotation[:, 2])
    columns = len(fan.ray)
    at = np.searchsorted(found.ray, second.ray)
    known = at < len(found.ray)
    known[known] = found.ray[at[known]] == second.ray[known]
    own, other = at[known], np.flatnonzero(known)
    line = project(scanner, found.length[own] * fall[found.ray[own] % columns], 0.0)
    bright, light = found.light[own], second.light[other]
    touch = np.abs(second.place[other] - line) <= merging(scanner)
    wins = ~touch & (light > bright)
    # One peak of both.
    pulled = (line * bright + second.place[other] * light) / (bright + light)
    place = np.where(touch, pulled, second.place[other])
    changed = touch | wins
    length, total, excess = found.length.copy(), found.light.copy(), found.excess.copy()
    row = found.ray[own] % columns
    length[own[changed]] = (triangulate(scanner, place) / fall[row])[changed]
    total[own[wins]] = excess[own[wins]] = light[wins]
    total[own[touch]] += light[touch]
    mark[own[touch]] = Artefact.MULTI_BOUNCE
    mark[own[wins]] = Artefact.SPIKE
    new = _alone(target, scanner, fan, second, np.flatnonzero(~known))
    merged = Peaks(*(np.concatenate([a, b]) for a, b in zip(
        found._replace(length=length, light=total, excess=excess), new, strict=True)))  # fmt: skip
    mark = np.concatenate([mark, np.full(len(new.ray), Artefact.SPIKE, np.uint8)])
    order = np.argsort(merged.ray, kind="stable")
    return Peaks(*(column[order] for column in merged)), mark[order]


def _alone(
    target: Target, scanner: StripeScanner, fan: Fan, second: _Second, chosen: np.ndarray
) -> Peaks:
    """Return the peaks of rows in which there is no light but the mirrored one."""
    ray = second.ray[chosen]
    column = ray % len(fan.ray)
    direction = fan.ray[column]
    origin = fan.source[ray // len(fan.ray)]
    hits = target.trace(origin, direction, np.full(len(ray), math.inf))
    position, normal = second.position[chosen], second.normal[chosen]
    surface = second.surface[chosen]
    met = np.flatnonzero(hits.surface >= 0)
    surface[met] = hits.surface[met]
    position[met] = origin[met] + hits.distance[met, None] * direction[met]
    normal[met] = hits.normal[met]
    fall = -(direction @ fan.rotation[:, 2])
    length = triangulate(scanner, second.place[chosen]) / fall
    light = second.light[chosen]
    return Peaks(ray, length, position, normal, surface, light, light)


def _second_spots(target: Target, scanner: StripeScanner, fan: Fan, rows: np.ndarray) -> _Second:
    """Follow the middle rays over one mirror; return the brightest spot of every detector row."""
    columns = len(fan.ray)
    step = max(_CHUNK // columns, 1)
    pieces = []
    for start in range(0, len(fan.source), step):
        part = fan._replace(source=fan.source[start : start + step])
        spots = _mirrored(target, scanner, part, rows)
        pieces.append(spots._replace(ray=spots.ray + start * columns))
    spots = _Second(*(np.concatenate(column) for column in zip(*pieces, strict=True)))
    order = np.lexsort((-spots.light, spots.ray))  # stable: of equals the first ray's
    first = np.ones(len(order), bool)
    first[1:] = np.diff(spots.ray[order]) > 0
    return _Second(*(column[order[first]] for column in spots))


def _mirrored(target: Target, scanner: StripeScanner, fan: Fan, rows: np.ndarray) -> _Second:
    """Return all mirrored spots of some stripes that the camera can see."""
    columns = len(fan.ray)
    directions = np.tile(fan.ray, (len(fan.source), 1))
    origins = np.repeat(fan.source, columns, axis=0)
    hits = target.trace(origins, directions, np.full(len(origins), math.inf))
    met = np.flatnonzero(hits.surface >= 0)
    sight, normal = directions[met], hits.normal[met]
    position = origins[met] + hits.distance[met, None] * sight
    cosine = -np.einsum("ij,ij->i", normal, sight)
    share = mirrored_share(scanner, np.clip(cosine, 0.0, 1.0))
    strong = np.flatnonzero(share >= max(_FAINTEST, scanner.threshold))
    away = sight[strong] + 2.0 * cosine[strong, None] * normal[strong]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    stripe = met[strong] // columns
    cameras = fan.source[stripe] + fan.rotation @ scanner.camera
    start = position[strong] + target.lift * normal[strong]
    spots = visible(target, scanner, start, away, cameras, fan.rotation[:, 2])
    local = (spots.position - fan.source[stripe[spots.ray]]) @ fan.rotation
    depth = -local[:, 2]
    place = project(scanner, depth, local[:, 0])
    # The row that sees it: where the line from the laser's height meets the plane z = 0.
    pitch = (rows[-1] - rows[0]) / max(len(rows) - 1, 1)
    row = np.rint((local[:, 1] / depth * scanner.stand_off - rows[0]) / max(pitch, 1e-12))
    second_cosine = -np.einsum("ij,ij->i", spots.normal, away[spots.ray])
    light = share[strong][spots.ray] * (1.0 - scanner.specular) * second_cosine
    # Light that would mean a depth outside the measuring range falls beside the detector.
    reach = (scanner.depth_of_field or scanner.stand_off) / 2
    meant = triangulate(scanner, place)
    fine = light >= max(_FAINTEST, scanner.threshold)
    fine &= np.abs(meant - scanner.stand_off) <= reach
    fine &= (row >= 0) & (row < len(rows))
    chosen = np.flatnonzero(fine)
    return _Second(
        ray=stripe[spots.ray[chosen]] * columns + row[chosen].astype(np.int64),
        place=place[chosen], light=light[chosen], position=spots.position[chosen],
        normal=spots.normal[chosen], surface=spots.surface[chosen],
    )  # fmt: skip
