"""Points that cleaning left out come back where a surface goes through them.

Where a surface is seen at a grazing angle its points are far apart, and cleaning, which knows no
surface yet, finds nothing that holds them. A point that lies on the surface of a patch within the
noise, no farther from the points of that patch than these may be from each other, is no outlier;
nor is the next one, so that patches grow to where they end.
"""

from __future__ import annotations

import numpy as np

from octoseg_ti.device.surfaces import evaluate_surfaces
from octoseg_ti.device.unionfind import components
from octoseg_ti.types import NONE

_ON = 2.5  # a point lies on a surface within so many noises
_MOST = 1 << 20  # points and surfaces that are compared at a time


def readmit(
    outside: np.ndarray,
    point: np.ndarray,
    label: np.ndarray,
    surface: np.ndarray,
    kind: np.ndarray,
    parameters: np.ndarray,
    *,
    noise: float,
    gap: float,
) -> np.ndarray:
    """Return the patch of every point that was left out.

    Args:
        outside: Positions of the points that were left out [mm], shape (m, 3), f64.
        point: Positions of the others [mm], shape (n, 3), f64.
        label: Their patches, -1 = none, shape (n,).
        surface: Surface of every patch, -1 = free form, shape (K,).
        kind: `SurfaceKind` of every surface, shape (M,).
        parameters: As in `Segmentation.parameters`, in the frame of the points, shape (M, 8).
        noise: Deviation of a point from its surface [mm].
        gap: Points of one patch are linked over this distance [mm].

    Returns:
        Shape (m,), i32: -1 = stays out.
    """
    found = np.full(len(outside), NONE, np.int32)
    patches = np.flatnonzero(surface >= 0)
    there = np.flatnonzero(np.isfinite(outside).all(axis=1))
    if len(there) == 0 or len(patches) == 0:
        return found
    least = np.full(len(outside), _ON * noise)
    for patch, mine, far in _near(outside, there, surface[patches], patches, kind, parameters,
                                  _ON * noise):  # fmt: skip
        better = far <= least[mine]
        mine, far = mine[better], far[better]
        if len(mine) == 0:
            continue
        linked = _linked(outside[mine], point[label == patch], gap)
        found[mine[linked]], least[mine[linked]] = patch, far[linked]
    return found


def _near(
    outside: np.ndarray,
    there: np.ndarray,
    surface: np.ndarray,
    patches: np.ndarray,
    kind: np.ndarray,
    parameters: np.ndarray,
    limit: float,
) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Return for every patch the points near its surface, if any, and their distances."""
    near = []
    step = max(_MOST // len(there), 1)
    for lo in range(0, len(patches), step):
        part = surface[lo : lo + step]
        which = np.repeat(part, len(there))
        far, _ = evaluate_surfaces(np.tile(outside[there], (len(part), 1)), which, kind, parameters)
        far = np.abs(far).reshape(len(part), len(there))
        for k, row in enumerate(far):
            mine = np.flatnonzero(row <= limit)
            if len(mine):
                near.append((int(patches[lo + k]), there[mine], row[mine]))
    return near


def _linked(point: np.ndarray, members: np.ndarray, gap: float) -> np.ndarray:
    """Say which points are linked to members, or to each other and so to members, bool."""
    from scipy.spatial import cKDTree

    low, high = point.min(axis=0) - gap, point.max(axis=0) + gap
    members = members[((members >= low) & (members <= high)).all(axis=1)]
    if len(members) == 0:
        return np.zeros(len(point), bool)
    tree = cKDTree(point)
    held = np.isfinite(cKDTree(members).query(point, distance_upper_bound=gap)[0])
    pair = tree.query_pairs(gap, output_type="ndarray").astype(np.int32)
    root = components(len(point), pair[:, 0], pair[:, 1])
    anchored = np.zeros(len(point), bool)
    anchored[root[held]] = True
    return anchored[root]
