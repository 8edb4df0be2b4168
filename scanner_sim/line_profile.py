"""What the camera sees of the laser line: one peak a detector row, from the rays over its width.

`peaks` is the plain road, ray by ray in NumPy, for any target; `scanner_sim.line_kernel` does the
same for solids in kernels. A row's profile is the light of all rays over the line's width that
laser and camera both reach. The peak is the centroid of the brightest group of spots that touch
each other on the detector, and is triangulated as if it lay in the middle of the laser plane: so
edges get round, points appear between the two sides of a step, and shadows end a little off.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from scanner_sim.optics import brightness, merging, project, sub_rays, triangulate

if TYPE_CHECKING:
    from scanner_sim.scanner import StripeScanner
    from scanner_sim.target import Target


class Fan(NamedTuple):
    """The rays of some stripes of a view, in world coordinates."""

    source: np.ndarray
    """True position of the laser at every stripe [mm], shape (S, 3)."""
    ray: np.ndarray
    """Unit vectors of the laser's rays, shape (C, 3)."""
    rotation: np.ndarray
    """From the view to the world, shape (3, 3)."""


class Peaks(NamedTuple):
    """Peaks in scan order; ``P`` of them."""

    ray: np.ndarray
    """Stripe x number of columns + column, shape (P,), i64."""
    length: np.ndarray
    """Measured distance from the laser along the ray, without noise [mm], shape (P,)."""
    position: np.ndarray
    """Where the ray that stands for the peak meets the part [mm], world, shape (P, 3): the middle
    one of the line if its light is in the peak, else the brightest one that is."""
    normal: np.ndarray
    """Outward normal there, shape (P, 3)."""
    surface: np.ndarray
    """Surface there, shape (P,), i32."""
    light: np.ndarray
    """Brightness of the peak, shape (P,): 1 = the whole line on a matte surface, seen straight."""
    excess: np.ndarray
    """Brightness at its brightest place, before the pixels are full, shape (P,)."""


class Spots(NamedTuple):
    """Rays that laser and camera both see."""

    ray: np.ndarray
    """Which rays, shape (P,), i64."""
    distance: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    surface: np.ndarray
    to_camera: np.ndarray


def visible(
    target: Target,
    scanner: StripeScanner,
    origins: np.ndarray,
    directions: np.ndarray,
    cameras: np.ndarray,
    up: np.ndarray,
) -> Spots:
    """Return where rays first meet the part, if that is within all limits and the camera sees it.

    Args:
        target: The solid.
        scanner: The scanner, for its limits.
        origins: Where rays start [mm], world, shape (N, 3).
        directions: Unit vectors, shape (N, 3).
        cameras: Position of the camera of every ray [mm], world, shape (N, 3).
        up: z axis of the view, world, shape (3,).
    """
    hits = target.trace(origins, directions, np.full(len(origins), math.inf))
    found = np.flatnonzero(hits.surface >= 0)
    surface, sight = hits.surface[found], directions[found]
    position = origins[found] + hits.distance[found, None] * sight
    normal = hits.normal[found]
    to_camera = cameras[found] - position
    height = scanner.stand_off - to_camera @ up  # the camera is as high as the laser
    far = np.linalg.norm(to_camera, axis=1)
    to_camera /= far[:, None]
    seen = -np.einsum("ij,ij->i", normal, sight) >= math.cos(scanner.incidence_limit)
    seen &= np.einsum("ij,ij->i", normal, to_camera) >= math.cos(scanner.camera_limit)
    if scanner.depth_of_field is not None:
        seen &= np.abs(height) <= scanner.depth_of_field / 2
    open_ = np.flatnonzero(seen)
    chosen = open_[~target.hidden(position[open_], normal[open_], to_camera[open_], far[open_])]
    return Spots(
        ray=found[chosen], distance=hits.distance[found[chosen]], position=position[chosen],
        normal=normal[chosen], surface=surface[chosen], to_camera=to_camera[chosen],
    )  # fmt: skip


def peaks(target: Target, scanner: StripeScanner, fan: Fan) -> Peaks:
    """Return the peaks of some stripes.

    Args:
        target: The solid.
        scanner: The scanner.
        fan: The rays.
    """
    offsets, shares = sub_rays(scanner)
    origins = np.repeat(fan.source, len(fan.ray), axis=0)
    directions = np.tile(fan.ray, (len(fan.source), 1))
    cameras = origins + fan.rotation @ scanner.camera
    across, up = fan.rotation[:, 0], fan.rotation[:, 2]
    spots = [
        visible(target, scanner, origins + offset * across if offset else origins, directions,
                cameras, up)
        for offset in offsets
    ]  # fmt: skip
    light = [brightness(scanner, directions[s.ray], s.normal, s.to_camera) for s in spots]
    if len(spots) == 1:
        only, bright = spots[0], light[0]
        return Peaks(only.ray, only.distance, only.position, only.normal, only.surface, bright,
                     bright)  # fmt: skip
    fall = -(directions @ fan.rotation[:, 2])
    place = np.full((len(origins), len(offsets)), np.nan)
    bright = np.zeros_like(place)
    index = np.full(place.shape, -1, np.int64)
    for k, spot in enumerate(spots):
        place[spot.ray, k] = project(scanner, spot.distance * fall[spot.ray], offsets[k])
        bright[spot.ray, k] = light[k]
        index[spot.ray, k] = np.arange(len(spot.ray))
    rows = np.flatnonzero((index >= 0).any(axis=1))
    centre, chosen, total, excess = centroids(scanner, place[rows], bright[rows], shares)
    lengths = triangulate(scanner, centre) / fall[rows]
    position, normal = np.empty((len(rows), 3)), np.empty((len(rows), 3))
    surface = np.empty(len(rows), np.int32)
    for k, spot in enumerate(spots):
        own = np.flatnonzero(chosen == k)
        at = index[rows[own], k]
        position[own], normal[own] = spot.position[at], spot.normal[at]
        surface[own] = spot.surface[at]
    return Peaks(rows, lengths, position, normal, surface, total, excess)


def centroids(
    scanner: StripeScanner, place: np.ndarray, bright: np.ndarray, shares: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Find the peak of every row's profile.

    Args:
        scanner: The scanner.
        place: Where every spot lies on the detector [pixel], shape (R, K); NaN = not seen. Every
            row has one at least.
        bright: Brightness of every spot's surface, shape (R, K).
        shares: Share of the line's light in every spot, shape (K,).

    Returns:
        The centroid [pixel]; the number of the spot that stands for it; the brightness of the peak,
        and of its brightest place; shape (R,) each.
    """
    count = len(shares)
    order = np.argsort(place, axis=1, kind="stable")
    sorted_ = np.take_along_axis(place, order, axis=1)
    seen = ~np.isnan(sorted_)
    shown = np.take_along_axis(bright, order, axis=1) * seen
    relative = (shares / shares.max())[order]
    full = np.inf if scanner.saturation is None else scanner.saturation
    weight = shares.max() * np.minimum(shown * relative, full)
    with np.errstate(invalid="ignore"):
        group = np.cumsum(np.diff(sorted_, axis=1, prepend=sorted_[:, :1]) > merging(scanner), 1)
    rows = np.arange(len(place))
    sums = np.zeros((len(place), count))
    for k in range(count):
        sums[rows, group[:, k]] += weight[:, k]
    inside = seen & (group == np.argmax(sums, axis=1)[:, None])
    weight, shown = weight * inside, shown * inside
    origin = sorted_[rows, np.argmax(inside, axis=1)]
    moment = (weight * np.where(inside, sorted_ - origin[:, None], 0.0)).sum(axis=1)
    centre = origin + moment / weight.sum(axis=1)
    brightest = np.argmax(weight, axis=1)
    is_middle = inside & (order == count // 2)
    best = np.where(is_middle.any(axis=1), np.argmax(is_middle, axis=1), brightest)
    total = (shown * shares[order]).sum(axis=1)
    return centre, order[rows, best], total, (shown * relative).max(axis=1)
