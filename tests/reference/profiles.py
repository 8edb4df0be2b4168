"""Plain answers about laser lines: the peak of one row at a time, and one ray at a time."""

from __future__ import annotations

import math

import numpy as np

from reference.rays import first_hit
from scanner_sim.part import Part
from scanner_sim.scanner import StripeScanner


def peak(
    place: list[float], bright: list[float], shares: list[float], gap: float, full: float
) -> tuple[float, int, float, float]:
    """Centroid of the brightest group, its spot, its brightness, that of its brightest place."""
    top = max(shares)
    spots = sorted((p, k) for k, p in enumerate(place) if not math.isnan(p))
    groups: list[list[int]] = []
    for n, (p, k) in enumerate(spots):
        if n and p - spots[n - 1][0] <= gap:
            groups[-1].append(k)
        else:
            groups.append([k])

    def weight(k: int) -> float:
        return top * min(bright[k] * shares[k] / top, full)

    best = max(groups, key=lambda group: sum(weight(k) for k in group))
    total = sum(weight(k) for k in best)
    centre = sum(weight(k) * place[k] for k in best) / total
    spot = len(shares) // 2 if len(shares) // 2 in best else max(best, key=weight)
    light = sum(bright[k] * shares[k] for k in best)
    return centre, spot, light, max(bright[k] * shares[k] / top for k in best)


def on_detector(scanner: StripeScanner, x: float, depth: float) -> float:
    """Angle off the camera's axis as a place on the detector [pixel]."""
    angle = math.atan2(scanner.camera[0] - x, depth)
    off = scanner.triangulation_angle - angle
    distance = scanner.stand_off / math.cos(scanner.triangulation_angle)
    return math.tan(off) * distance / scanner.pixel


def sees(part: Part, place: np.ndarray, camera: np.ndarray) -> bool:
    """Whether nothing lies between a place just off the part and the camera."""
    way = camera - place
    far = float(np.linalg.norm(way))
    return not np.isfinite(first_hit(part, place, way / far, far))
