"""Plain answers to compare with: balls that touch two surfaces, and nearest points with a mark."""

from __future__ import annotations

import math

import numpy as np

from octoseg_ti.types import SurfaceKind

BALL, FIRST, SECOND, NOWHERE = range(4)


def height(surface: np.ndarray, p: np.ndarray) -> tuple[float, np.ndarray]:
    """Height of a point above a plane, cylinder or sphere, and the normal, on the air's side."""
    kind, side = int(surface[8]), surface[9]
    q = p - surface[:3]
    axis = surface[3:6]
    if kind == SurfaceKind.PLANE:
        return side * float(q @ axis), side * axis
    away = q - (q @ axis) * axis if kind == SurfaceKind.CYLINDER else q
    size = float(np.linalg.norm(away))
    return side * (size - surface[6]), side * away / size


def profile(
    a: np.ndarray, b: np.ndarray, p: np.ndarray, radius: float
) -> tuple[float, float, int, float]:
    """Distance from the profile, distance from the line of contact, region, angle of the turn."""
    hollow = -1.0 if radius < 0 else 1.0
    c = p.copy()
    for _ in range(30):
        (da, na), (db, nb) = height(a, c), height(b, c)
        step = np.linalg.lstsq(np.array([na, nb]), [radius - da, radius - db], rcond=None)[0]
        c = c + step
    (_, na), (_, nb) = height(a, c), height(b, c)
    turn = math.acos(np.clip(na @ nb, -1, 1))
    u, size = p - c, abs(radius)
    toward = np.linalg.lstsq(np.array([-hollow * na, -hollow * nb]).T, u, rcond=None)[0]
    if (toward >= 0).all():
        return -hollow * (float(np.linalg.norm(u)) - size), 0.0, BALL, turn
    region, n, s = (FIRST, na, a) if toward[0] >= toward[1] else (SECOND, nb, b)
    return height(s, p)[0], float(np.linalg.norm(u - (u @ n) * n)), region, turn


def nearest(points: np.ndarray, mark: np.ndarray, i: int, wanted: int, reach: float) -> float:
    """Distance from a point to the nearest other point with a mark, infinite beyond the reach."""
    far = np.linalg.norm(points - points[i], axis=1)
    far[(mark != wanted) | (np.arange(len(points)) == i)] = np.inf
    return float(far.min()) if far.min() < reach else math.inf


def beside(
    faces: np.ndarray, edge: tuple[int, int, str], strips: set[int], label: int, p: np.ndarray,
    radius: float, reach: float, on_ball: float, on_side: float,
) -> float:  # fmt: skip
    """Distance of a point from an edge along the surface, infinite where it is not beside that."""
    a, b, form = edge
    allowed = {a, b} if form != "fillet" else {a, b, -1} | strips
    if label not in allowed:
        return math.inf
    if form == "smooth":
        return 0.0
    if form == "sharp" and abs(height(faces[b if label == a else a], p)[0]) > reach:
        return math.inf
    off, along, region, _ = profile(faces[a], faces[b], p, radius)
    if region == BALL and abs(radius) < 1e-9:
        along = abs(off)
    fits = abs(off) <= (on_ball if region == BALL else on_side)
    fits |= region == BALL and form == "sharp"
    return along if fits and along <= reach else math.inf
