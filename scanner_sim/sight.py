"""The two questions of a scanner to what it scans: what a ray meets first, and what hides a point.

All measurement goes through these, but for the kernels of `scanner_sim.line_kernel`, which know
solids.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from scanner_sim.quadric import gradient
from scanner_sim.raycast import cast

if TYPE_CHECKING:
    from scanner_sim.part import FlatPart

LIFT = 1e-6  # shadow rays start this far above the surface [mm]


class Met(NamedTuple):
    """What rays meet; ``N`` rays."""

    distance: np.ndarray
    """Distance along the ray [mm], shape (N,), f64; infinite without a hit."""
    surface: np.ndarray
    """Number of the surface, shape (N,), i32; -1 without a hit."""
    normal: np.ndarray
    """Unit normal, away from the material, shape (N, 3), f64; 0 without a hit."""


def trace(target: FlatPart, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> Met:
    """Follow rays to the first surface.

    Args:
        target: The solid.
        origins: Starting points [mm], shape (N, 3).
        directions: Unit vectors, shape (N, 3).
        reach: Length of every ray [mm], shape (N,); hits beyond it do not count.
    """
    hits = cast(target, origins, directions, reach)
    found = np.flatnonzero(hits.surface >= 0)
    position = origins[found] + hits.distance[found, None] * directions[found]
    normal = np.zeros((len(origins), 3))
    normal[found] = gradient(target.surfaces, hits.surface[found], position)
    normal[found] *= hits.side[found, None]
    return Met(hits.distance, hits.surface, normal)


def hidden(
    target: FlatPart,
    positions: np.ndarray,
    normals: np.ndarray,
    directions: np.ndarray,
    reach: np.ndarray,
) -> np.ndarray:
    """Return whether something stands in the way of points that `trace` has found.

    Args:
        target: The solid.
        positions: Points on the solid [mm], shape (N, 3).
        normals: Their normals, shape (N, 3).
        directions: Unit vectors, shape (N, 3).
        reach: Length of the way [mm], shape (N,).

    Returns:
        Flags, shape (N,), bool.
    """
    lifted = positions + LIFT * normals
    blocked: np.ndarray = cast(target, lifted, directions, reach, any_hit=True).surface >= 0
    return blocked
