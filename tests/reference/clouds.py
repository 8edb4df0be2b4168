"""Small seeded clouds: ragged stripes, and surfaces with known normals."""

from __future__ import annotations

import math

import numpy as np


def ragged_stripes(
    seed: int, stripes: int, length: int, *, views: int = 1, noise: float = 0.02, gaps: float = 0.05
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return (points, start, run, view) of a bumpy surface in stripes of unequal length.

    The stripes of a view lie in planes of nearly constant x and run along y; points are lost, ends
    are ragged, and there is a step of 6 mm in the surface.
    """
    rng = np.random.default_rng(seed)
    points, start, view = [], [0], []
    for v in range(views):
        for s in range(stripes):
            low, high = rng.integers(0, max(1, length // 5), 2)
            y = 0.4 * np.arange(low, max(low + 1, length - high), dtype=float)
            y = y[rng.random(len(y)) >= gaps] if len(y) > 1 else y
            if len(y) == 0:
                y = np.array([0.4 * low])
            x = 0.5 * s + 0.02 * rng.standard_normal(len(y))
            y = y + 0.05 * rng.standard_normal(len(y))
            z = 2.0 * np.sin(0.3 * x) + 0.05 * y**2 / (1 + 0.1 * y) + 6.0 * (y > 0.25 * length)
            z = z + noise * rng.standard_normal(len(y)) + 30.0 * v
            points.append(np.column_stack((x, np.sort(y), z)))
            start.append(start[-1] + len(y))
            view.append(np.full(len(y), v, np.int32))
    run = np.repeat(np.arange(len(points), dtype=np.int32), np.diff(start))
    return (
        np.ascontiguousarray(np.concatenate(points)),
        np.array(start, np.int32),
        run,
        np.concatenate(view),
    )


def lattice_stripes(
    x: np.ndarray, y: np.ndarray, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return (points, start, run, view) of a full lattice: a row of the arrays is a stripe."""
    rows, columns = z.shape
    points = np.stack(np.broadcast_arrays(x, y, z), axis=-1).reshape(-1, 3).astype(np.float64)
    start = (columns * np.arange(rows + 1)).astype(np.int32)
    run = np.repeat(np.arange(rows, dtype=np.int32), columns)
    return np.ascontiguousarray(points), start, run, np.zeros(len(points), np.int32)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return rows of unit length."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_surface(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points and normals of a plane, a cylinder and a ball, in random order."""
    rng = np.random.default_rng(seed)
    kind = rng.integers(0, 3, n)
    u, v = rng.uniform(0, 30, n), rng.uniform(-1, 1, n)
    turn = rng.uniform(0, math.pi, n)
    points, normals = np.empty((n, 3)), np.empty((n, 3))
    flat, pipe, ball = kind == 0, kind == 1, kind == 2
    points[flat] = np.column_stack((u, 12 * v, 0 * u))[flat]
    normals[flat] = [0.0, 0.0, 1.0]
    round_ = np.column_stack((0 * u, np.cos(turn), np.sin(turn)))
    points[pipe] = (np.column_stack((u, 0 * u, 0 * u)) + 6.0 * round_)[pipe]
    normals[pipe] = round_[pipe]
    height = np.abs(v)
    wide = np.sqrt(1 - height**2)
    shell = np.column_stack((wide * np.cos(2 * turn), wide * np.sin(2 * turn), height))
    points[ball] = ([40.0, 0.0, 0.0] + 8.0 * shell)[ball]
    normals[ball] = shell[ball]
    return points, normals


def random_cloud(seed: int, n: int, *, missing: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return points anywhere in a box with normals in any direction, some of them zero."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, [10.0, 4.0, 7.0], (n, 3))
    normals = unit(rng.standard_normal((n, 3)))
    normals[rng.random(n) < missing] = 0.0
    return points, normals


def rotation(seed: int) -> np.ndarray:
    """Return a random rotation."""
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] = -q[:, 0]
    return q
