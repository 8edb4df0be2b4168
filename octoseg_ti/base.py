"""The plane that a part stands on: the rims of its walls lie in it, though nobody scanned it.

The last points of a wall are up to a spacing from its rim, and a rim along the stripes is as far
from them everywhere: by that much the edge is unknown. But walls stand on one plane, and each has
its points at other distances from it.
"""

from __future__ import annotations

import numpy as np

_ALIKE = 0.9  # cosine of the angle between the outward directions of rims of one plane
_FEWEST = 20  # rim points of a wall
_WALLS = 3
_OUTER = 0.95  # quantile of the rim points that stands for the outermost ones
_STEP = 1.25  # the outermost points are this near the plane [spacings]
_EVEN = 0.25  # a rim whose points scatter less [spacings] runs along the stripes
_BELOW = 0.25  # no point is so far beyond the plane [spacings]


def distance_to_base(
    point: np.ndarray,
    normal: np.ndarray,
    outward: np.ndarray,
    label: np.ndarray,
    every: np.ndarray,
    spacing: float,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the plane that walls stand on.

    Args:
        point: Rim points [mm], shape (R, 3).
        normal: Normals of their faces, shape (R, 3).
        outward: Directions in which the faces end there, shape (R, 3).
        label: Their patches, shape (R,).
        every: All points [mm], shape (n, 3).
        spacing: The larger of the two point spacings [mm].

    Returns:
        The distance from the plane of every point [mm], shape (n,); the patches that stand on it,
        ascending. None where there is no such plane.
    """
    if len(point) < _WALLS * _FEWEST:
        return None
    down = _mode(outward)
    mine = outward @ down >= _ALIKE
    names, of = np.unique(label[mine], return_inverse=True)
    count = np.bincount(of)
    place, facing = point[mine], normal[mine]
    if np.count_nonzero(count >= _FEWEST) < _WALLS:
        return None
    # Walls have their rims at other distances from the plane; in its tilt all agree.
    middle = place.mean(axis=0)
    basis = np.linalg.svd(down[None])[2][1:]
    flat, high = (place - middle) @ basis.T, (place - middle) @ down
    inner = [np.bincount(of, column)[of] / count[of] for column in (*flat.T, high)]
    matrix = flat - np.column_stack(inner[:2])
    if np.linalg.svd(matrix, compute_uv=False)[1] < len(place) ** 0.5 * spacing:
        return None
    tilt = np.linalg.lstsq(matrix, high - inner[2], rcond=None)[0]
    down = down - tilt @ basis
    down /= np.linalg.norm(down)
    high = (place - middle) @ down
    order = np.lexsort((high, of))
    ends = np.cumsum(count)
    outer = high[order][ends - 1 - ((1.0 - _OUTER) * count).astype(int)]
    low = high[order][ends - count + ((1.0 - _OUTER) * count).astype(int)]
    walls = count >= _FEWEST
    near = walls & (outer >= outer[walls].max() - _STEP * spacing)
    even = near & (outer - low < _EVEN * spacing)
    base = outer[near].max()
    if not (near & ~even).any():
        # No wall shows the plane itself; it is above the next stripe of each.
        base += 0.5 * max(outer[even].min() + spacing - base, 0.0)
    slope = np.bincount(of, np.abs(facing @ down)) / count
    near &= slope < 0.5
    far: np.ndarray = base - (every - middle) @ down
    if np.count_nonzero(near) < _WALLS or far.min() < -_BELOW * spacing:
        return None
    return far, names[near]


def _mode(outward: np.ndarray) -> np.ndarray:
    """Return the direction that most of the directions are near."""
    some = outward[:: max(len(outward) // 200, 1)]
    support = (outward @ some.T >= _ALIKE).sum(axis=0)
    best = some[support.argmax()]
    mean: np.ndarray = outward[outward @ best >= _ALIKE].mean(axis=0)
    return mean / np.linalg.norm(mean)
