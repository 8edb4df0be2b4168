"""Normals of stripes in one call, for tests that need no more."""

from __future__ import annotations

import numpy as np

from octoseg_ti.stages.normals import edge_pair_sums, oriented_normals


def edge_pair_normals(
    points: np.ndarray,
    start: np.ndarray,
    view: np.ndarray,
    *,
    gap: float,
    rule: str = "diagonal",
    weight: str = "unit",
    origin: np.ndarray | None = None,
) -> np.ndarray:
    """Return `oriented_normals` of `edge_pair_sums`."""
    sums = edge_pair_sums(points, start, view, gap=gap, rule=rule)
    return oriented_normals(sums, points, start, view, weight=weight, origin=origin)
