"""Blends: patches that are fillets themselves, where those of several edges meet.

At a corner the ball that rolls along one edge goes over into that of the next; what it leaves is a
piece of a torus or a sphere between fillets, and no two faces have it as their edge.
"""

from __future__ import annotations

import numpy as np

from octoseg_ti.borders.fillets import SLACK, smooth_pairs
from octoseg_ti.borders.zones import Search, Zones
from octoseg_ti.types import SurfaceKind

# A blend joins at least so many others smoothly, along this share of its border.
_JOINED, _SHARE = 2, 0.5
# Length of the mean of its normals: a quarter of a tube has 0.9, half a tube 0.64, a boss none.
_OPEN = 0.7


def ball_radii(search: Search) -> np.ndarray:
    """Return the radius of the ball that touches every patch along a line [mm], shape (K,).

    That of a cylinder, of a sphere, of the tube of a torus; infinite for other surfaces.
    """
    kind = search.table[:, 8].astype(np.int32)
    radius = np.full(search.count, np.inf)
    ball = (kind == int(SurfaceKind.CYLINDER)) | (kind == int(SurfaceKind.SPHERE))
    ring = kind == int(SurfaceKind.TORUS)
    radius[ball], radius[ring] = search.table[ball, 6], search.table[ring, 7]
    radius[~search.analytic] = np.inf
    return radius


def find_blends(search: Search, zones: Zones, turn: np.ndarray) -> np.ndarray:
    """Say which patches are fillets between fillets, shape (K,), bool.

    Args:
        search: What is known.
        zones: The pairs of patches.
        turn: Mean angle by which the surface turns over the edge of every pair [rad], shape (P,).
    """
    small = ball_radii(search) <= SLACK * search.limit
    smooth = smooth_pairs(search, zones.pairs, turn)
    sides = zones.pairs.T.ravel()
    joined = np.bincount(sides, np.tile(smooth & (zones.contact > 0), 2), search.count)
    border = np.bincount(sides, np.tile(zones.contact, 2), search.count)
    along = np.bincount(sides, np.tile(smooth * zones.contact, 2), search.count)
    there = np.flatnonzero(search.label >= 0)
    there = there[small[search.label[there]]]
    mean = [
        np.bincount(search.label[there], search.normals[there, k], search.count) for k in range(3)
    ]
    length = np.linalg.norm(mean, axis=0) / np.maximum(search.size, 1)
    blends: np.ndarray = (
        small & (joined >= _JOINED) & (along >= _SHARE * border) & (length >= _OPEN)
    )
    return blends
