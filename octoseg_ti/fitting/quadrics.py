"""Planes and quadrics through many groups of points, in closed form.

A quadric is a height over the plane: a + b u + c v + d u^2 + e u v + f v^2. Every smooth surface is
nearly one over a neighbourhood that is small beside its radii, so its residual tells how far points
scatter, and how much any curved surface could gain over the plane.
"""

from typing import NamedTuple

import numpy as np

QUADRIC_FREEDOM = 6
"""Degrees of freedom of a quadric."""

_RIDGE = 1e-12


class Quadrics(NamedTuple):
    """Planes and quadrics through ``G`` groups; of two columns the plane comes first."""

    centre: np.ndarray
    """Centre of every group [mm], shape (G, 3)."""
    normal: np.ndarray
    """Unit normal of its plane, shape (G, 3)."""
    rms: np.ndarray
    """Root mean square height over plane and quadric [mm], shape (G, 2)."""
    tilt: np.ndarray
    """Root mean square sine between measured normals and those of plane and quadric, (G, 2)."""
    side: np.ndarray
    """Mean cosine between measured normals and that of the plane, shape (G,)."""
    bend: np.ndarray
    """Largest curvature of the quadric, times the root mean square distance of the points from
    their centre, shape (G,)."""


def fit_quadrics(point: np.ndarray, normal: np.ndarray, start: np.ndarray) -> Quadrics:
    """Fit a plane and a quadric to every group of points.

    Args:
        point: Points of the groups, one group after the other [mm], shape (S, 3), f64.
        normal: Measured unit normals, zero where there is none, shape (S, 3), f64.
        start: First point of every group, and S at the end, ascending, shape (G + 1,); no group is
            empty.
    """
    first, count = start[:-1], np.diff(start)

    def each(value: np.ndarray) -> np.ndarray:
        return np.repeat(value, count, axis=-1)

    def mean(value: np.ndarray) -> np.ndarray:
        return np.add.reduceat(value, first) / count

    centre = np.stack([mean(np.ascontiguousarray(column)) for column in point.T], axis=1)
    q = point.T - each(centre.T)
    spread = np.empty((len(count), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            spread[:, i, j] = spread[:, j, i] = mean(q[i] * q[j])
    extent = np.sqrt(np.maximum(np.trace(spread, axis1=1, axis2=2), 1e-300))
    value, axes = np.linalg.eigh(spread / extent[:, None, None] ** 2)
    frame = each(axes.transpose(1, 2, 0))  # by coordinate and axis
    w, u, v = np.einsum("is,iks->ks", q / each(extent), frame)
    nw, nu, nv = np.einsum("is,iks->ks", normal.T, frame)
    height = _heights(w, (np.ones(len(u)), u, v, u * u, u * v, v * v), mean)
    a, b, c, d, e, f = each(height.T)
    square = mean((w - a - b * u - c * v - d * u * u - e * u * v - f * v * v) ** 2)
    slope_u, slope_v = b + 2.0 * d * u + e * v, c + e * u + 2.0 * f * v
    cosine = (nw - slope_u * nu - slope_v * nv) ** 2 / (1.0 + slope_u**2 + slope_v**2)
    known = np.maximum(mean(nw * nw + nu * nu + nv * nv), 1e-300)
    shared = np.stack([mean(nw * nw), mean(cosine)], axis=1) / known[:, None]
    middle, apart = height[:, 3] + height[:, 5], height[:, 3] - height[:, 5]
    return Quadrics(
        centre=centre,
        normal=axes[:, :, 0],
        rms=np.sqrt(np.maximum(np.stack([value[:, 0], square], axis=1), 0.0)) * extent[:, None],
        tilt=np.sqrt(np.maximum(1.0 - shared, 0.0)),
        side=mean(nw) / known,
        bend=np.abs(middle) + np.hypot(apart, height[:, 4]),
    )


def _heights(w: np.ndarray, terms: tuple[np.ndarray, ...], mean) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Return the factors of the terms whose sum comes nearest to the heights, shape (G, 6)."""
    size = len(terms)
    right = np.stack([mean(t * w) for t in terms], axis=1)
    normal = np.empty((len(right), size, size))
    for i in range(size):
        for j in range(i + 1):
            normal[:, i, j] = normal[:, j, i] = mean(terms[i] * terms[j])
    normal += _RIDGE * np.eye(size)
    return np.linalg.solve(normal, right[..., None])[..., 0]
