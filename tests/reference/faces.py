"""Plain NumPy versions of what kernels say about charts and faces."""

from __future__ import annotations

import math

import numpy as np

from octoseg_ti.types import SurfaceKind
from reference.rays import solid
from scanner_sim.part import FlatPart, Part
from scanner_sim.quadric import distance, frames, gradient

BESIDE = 1e-6  # how far beside a face the part is asked [mm]


def chart_points(part: FlatPart, index: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Positions of parameters (u, v), not scaled, one after the other."""
    first, second = frames(part.surfaces)
    points = []
    for s, (u, v) in zip(index, angles, strict=True):
        kind, (a, b) = part.surfaces.kind[s], part.surfaces.data[s, 6:8]
        origin, axis = part.surfaces.data[s, :3], part.surfaces.data[s, 3:6]
        radius, height = {
            SurfaceKind.PLANE: (0.0, 0.0),
            SurfaceKind.CYLINDER: (a, v),
            SurfaceKind.CONE: (v * math.tan(a), v),
            SurfaceKind.SPHERE: (a * math.cos(v), a * math.sin(v)),
            SurfaceKind.TORUS: (a + b * math.cos(v), b * math.sin(v)),
        }[kind]
        x, y = radius * math.cos(u), radius * math.sin(u)
        if kind == SurfaceKind.PLANE:
            x, y = u, v
        points.append(origin + x * first[s] + y * second[s] + height * axis)
    return np.array(points)


def sides(part: Part, flat: FlatPart, surface: np.ndarray, points: np.ndarray) -> np.ndarray:
    """1 where only the inside of the surface is solid, -1 where only its outside is, else 0."""
    outward = gradient(flat.surfaces, surface, points)
    inner = solid(part, points - BESIDE * outward)
    outer = solid(part, points + BESIDE * outward)
    return inner.astype(int) - outer.astype(int)


def onto(flat: FlatPart, surface: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The nearest place on the surface."""
    for _ in range(2):
        slope = gradient(flat.surfaces, surface, points)
        points = points - distance(flat.surfaces, surface, points)[:, None] * slope
    return points


def goes_on(
    part: Part, flat: FlatPart, surface: np.ndarray, first: np.ndarray, second: np.ndarray
) -> np.ndarray:
    """Whether the face bounds the part at four places between two of its points."""
    whole = np.ones(len(surface), bool)
    for share in (0.2, 0.4, 0.6, 0.8):
        place = onto(flat, surface, (1 - share) * first + share * second)
        whole &= sides(part, flat, surface, place) != 0
    return whole


def side_near(
    part: Part,
    flat: FlatPart,
    surface: np.ndarray,
    points: np.ndarray,
    run: np.ndarray,
    probe: float,
) -> np.ndarray:
    """On which side of its surface the part lies beside an edge: one way, else the other."""
    across = np.cross(run, gradient(flat.surfaces, surface, points))
    one, other = (
        sides(part, flat, surface, onto(flat, surface, points + sign * probe * across))
        for sign in (-1.0, 1.0)
    )
    return np.where(one != 0, one, other)


def passing(
    flat: FlatPart,
    surface: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    touch: float,
    slack: float,
) -> list[tuple[int, int]]:
    """Pairs of pieces and other surfaces that pass through an end and the middle."""
    pairs = []
    for s, (low, high) in enumerate(flat.surface_boxes):
        index = np.full(len(surface), s)
        middle = 0.5 * (start + end)
        gaps = [np.abs(distance(flat.surfaces, index, p)) for p in (start, middle, end)]
        near = ((middle >= low - slack) & (middle <= high + slack)).all(axis=1)
        near &= (surface != s) & (np.minimum(gaps[0], gaps[2]) < touch) & (gaps[1] < slack)
        pairs += [(int(i), s) for i in np.flatnonzero(near)]
    return sorted(pairs)
