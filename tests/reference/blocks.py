"""Plain NumPy answers about parts, for many rays at once: no boxes around solids, no kernels."""

from __future__ import annotations

import numpy as np

from octoseg_ti.types import SurfaceKind
from reference.rays import implicit, leaves
from scanner_sim.part import Op, Part
from scanner_sim.quadric import Surface

_BESIDE = 1e-4  # how far inside and outside of a face the part is asked [mm]


def polynomial(surface: Surface, points: np.ndarray) -> np.ndarray:
    """A function that is zero on the surface, and of degree 1, 2 or 4 along every line."""
    q = points - np.array(surface.point)
    h = q @ np.array(surface.axis)
    square = np.sum(q * q, axis=-1)
    a, b = surface.a, surface.b
    if surface.kind == SurfaceKind.PLANE:
        return h
    if surface.kind == SurfaceKind.SPHERE:
        return square - a**2
    if surface.kind == SurfaceKind.CYLINDER:
        return square - h**2 - a**2
    if surface.kind == SurfaceKind.CONE:
        return square - h**2 / np.cos(a) ** 2
    return (square + a**2 - b**2) ** 2 - 4 * a**2 * (square - h**2)


def crossings(surface: Surface, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Where rays cross a surface, shape (N, 1, 2 or 4); NaN = nowhere.

    The polynomial along each ray follows from its values at a few places around the one nearest to
    the surface's point.
    """
    degree = {SurfaceKind.PLANE: 1, SurfaceKind.TORUS: 4}.get(surface.kind, 2)
    middle = np.einsum("ij,ij->i", np.array(surface.point) - origins, directions)
    size = surface.a + surface.b if surface.kind == SurfaceKind.TORUS else 10.0
    steps = np.linspace(-1.0, 1.0, degree + 1)
    times = middle[:, None] + size * steps
    values = polynomial(surface, origins[:, None] + times[..., None] * directions[:, None])
    factors = np.linalg.solve(np.vander(steps), values.T).T  # highest power first
    leading = factors[:, 0]
    scale = np.abs(factors).max(axis=1)
    # A ray along a flank has one crossing less; it is moved off the matrix, not divided by zero.
    thin = np.abs(leading) < 1e-12 * scale
    companion = np.zeros((len(origins), degree, degree))
    companion[:, np.arange(1, degree), np.arange(degree - 1)] = 1.0
    companion[:, 0] = -factors[:, 1:] / np.where(thin, 1.0, leading)[:, None]
    roots = np.linalg.eigvals(companion)
    real = np.where(np.abs(roots.imag) < 1e-6, roots.real, np.nan)
    real[thin] = np.nan
    if degree == 2:
        single = thin & (np.abs(factors[:, 1]) > 1e-12 * scale)
        real[single, 0] = -factors[single, 2] / factors[single, 1]
    return middle[:, None] + size * real


def solid(part: Part, points: np.ndarray) -> np.ndarray:
    """Whether points (..., 3) are in the part; children are asked only about what is open."""
    if part.surface is not None:
        return (implicit(part.surface, points) <= 0) != part.outside
    flat = points.reshape(-1, 3)
    answer = solid(part.children[0], flat)
    for child in part.children[1:]:
        open_ = np.flatnonzero(answer != (part.operation == Op.UNION))
        if len(open_) == 0:
            break
        answer[open_] = solid(child, flat[open_]) != (part.operation == Op.DIFFERENCE)
    return answer.reshape(points.shape[:-1])


def first_hits(
    part: Part, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray
) -> np.ndarray:
    """Distance at which every ray first enters the part or leaves it, shape (N,); inf = nowhere."""
    surfaces = list({s.key(): s for s in leaves(part)}.values())
    times = np.concatenate([crossings(s, origins, directions) for s in surfaces], axis=1)
    times[~((times > 1e-9) & (times < reach[:, None]))] = np.nan
    times = np.sort(times, axis=1)  # NaN last
    times = times[:, : max(int(np.isfinite(times).sum(axis=1).max()), 1)]
    ends = np.where(np.isfinite(times), times, reach[:, None])
    bounds = np.concatenate([np.zeros((len(ends), 1)), ends, reach[:, None]], axis=1)
    middle = 0.5 * (bounds[:, 1:] + bounds[:, :-1])
    inside = solid(part, origins[:, None] + middle[..., None] * directions[:, None])
    # Pieces without length (a double crossing, the end of the reach) say nothing.
    for k in range(1, inside.shape[1]):
        empty = bounds[:, k + 1] - bounds[:, k] < 1e-7
        inside[empty, k] = inside[empty, k - 1]
    change = inside[:, 1:] != inside[:, :-1]
    place = np.argmax(change, axis=1)
    found = bounds[np.arange(len(bounds)), place + 1]
    return np.where(change.any(axis=1), found, np.inf)


def on_part(part: Part, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Whether the part is solid just below every point and not just above it, shape (N,)."""
    below = solid(part, points - _BESIDE * normals)
    return below & ~solid(part, points + _BESIDE * normals)
