"""The plane that a part stands on: the rims of its walls lie in it, though nobody scanned it.

The last points of a wall are up to a spacing from its rim, and a rim along the stripes is as far
from them everywhere: by that much the edge is unknown. But walls stand on one plane, and each has
its points at other distances from it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoseg_ti.fitting.starts import across

_ALIKE = 0.9  # cosine of the angle between the outward directions of rims of one plane
_ROUNDS = 4  # after which their mean does not depend on where it began
_FEWEST = 20  # rim points of a wall
_WALLS = 3
_OUTER = 0.95  # quantile of the rim points that stands for the outermost ones
_STEP = 1.25  # the outermost points are this near the plane [spacings]
_EVEN = 0.25  # a rim whose points scatter less [spacings] runs along the stripes
_SLOPE = 0.5  # a wall is no more inclined to the normal of the plane (cosine)
_BELOW, _NOISES = 0.25, 4.0  # no point is so far beyond the plane [spacings, plus noises]


class Base(NamedTuple):
    """A plane, and the patches that stand on it."""

    down: np.ndarray
    """Its normal, out of the part, shape (3,)."""
    height: float
    """Its place along the normal [mm]."""
    walls: np.ndarray
    """The patches, ascending."""

    def above(self, point: np.ndarray) -> np.ndarray:
        """Return how far points are above the plane [mm], shape (n,)."""
        far: np.ndarray = self.height - np.einsum("ij,j->i", point, self.down)
        return far


def find_base(
    point: np.ndarray,
    normal: np.ndarray,
    outward: np.ndarray,
    label: np.ndarray,
    box: np.ndarray,
    spacing: float,
    noise: float = 0.0,
) -> Base | None:
    """Find the plane that walls stand on; None where there is no such plane.

    Args:
        point: Rim points [mm], shape (R, 3).
        normal: Normals of their faces, shape (R, 3).
        outward: Directions in which the faces end there, shape (R, 3).
        label: Their patches, shape (R,).
        box: Lower and upper corner of boxes that hold all points [mm], shape (C, 6).
        spacing: The larger of the two point spacings [mm].
        noise: Deviation of a point from its surface [mm].
    """
    if len(point) < _WALLS * _FEWEST:
        return None
    down = _mode(outward)
    mine = _along(outward, down) >= _ALIKE
    count = np.bincount(label[mine])
    names, of = np.flatnonzero(count), (np.cumsum(count > 0) - 1)[label[mine]]
    count = count[names]
    place, facing = point[mine], normal[mine]
    if np.count_nonzero(count >= _FEWEST) < _WALLS:
        return None
    # Walls have their rims at other distances from the plane; in its tilt all agree.
    off = place - place.mean(axis=0)
    one = across(down)
    other = np.cross(down, one)
    x, y, z = (
        side - (np.bincount(of, side) / count)[of]
        for side in (_along(off, to) for to in (one, other, down))
    )
    xx, xy, yy, xz, yz = (float((a * b).sum()) for a, b in ((x, x), (x, y), (y, y), (x, z), (y, z)))
    whole = xx * yy - xy * xy
    if whole < (len(place) * spacing**2) * (xx + yy):  # rims in one direction leave the tilt open
        return None
    down = down - ((yy * xz - xy * yz) * one + (xx * yz - xy * xz) * other) / whole
    down /= np.linalg.norm(down)
    high = _along(place, down)
    order = np.lexsort((high, of))
    ends = np.cumsum(count)
    outer = high[order][ends - 1 - ((1.0 - _OUTER) * count).astype(int)]
    low = high[order][ends - count + ((1.0 - _OUTER) * count).astype(int)]
    walls = count >= _FEWEST
    near = walls & (outer >= outer[walls].max() - _STEP * spacing)
    even = near & (outer - low < _EVEN * spacing)
    # Where points end at any distance up to a spacing, the rest of them is beyond the quantile;
    # but the largest of several quantiles is above their mean by about its error.
    beyond = 1.0 - _OUTER - np.sqrt(_OUTER * (1.0 - _OUTER) / count)
    outer = outer + np.where(even, 0.0, np.maximum(beyond, 0.0) * spacing)
    base = outer[near].max()
    if not (near & ~even).any():
        # No wall shows the plane itself; it is above the next stripe of each.
        base += 0.5 * max(outer[even].min() + spacing - base, 0.0)
    near &= np.bincount(of, np.abs(_along(facing, down))) / count < _SLOPE
    lowest = np.concatenate([np.minimum(down, 0.0), np.maximum(down, 0.0)])
    goes_on = _along(box, lowest).max() > base + _BELOW * spacing + _NOISES * noise
    if np.count_nonzero(near) < _WALLS or goes_on:
        return None
    return Base(down, float(base), names[near])


def _along(rows: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Return the components of vectors in a direction: few rows, for which threads do not pay."""
    part: np.ndarray = np.einsum("ij,j->i", rows, to)
    return part


def _mode(outward: np.ndarray) -> np.ndarray:
    """Return the direction that most of the directions are near."""
    some = outward[:: max(len(outward) // 50, 1)]
    long = np.ascontiguousarray(outward.T)  # long rows, or the loops over three would take longer
    support = np.count_nonzero(np.einsum("ji,kj->ki", long, some) >= _ALIKE, axis=1)
    mode = some[int(np.argmax(support))]
    for _ in range(_ROUNDS):
        mode = outward.compress(_along(outward, mode) >= _ALIKE, axis=0).mean(axis=0)
        mode /= np.linalg.norm(mode)
    return mode
