"""Cells of one size as leaves."""

from __future__ import annotations

import numpy as np

from octoseg_ti.stages.leaves import Leaves


def leaves_of(points: np.ndarray, size: float) -> tuple[Leaves, np.ndarray]:
    """Cells of one size as leaves, and the order of the points by cells."""
    cell = np.floor(points / size).astype(np.int64)
    cell -= cell.min(axis=0)
    shape = tuple(cell.max(axis=0) + 1)
    key = np.ravel_multi_index(tuple(cell.T), shape)
    order = np.argsort(key, kind="stable")
    name, first, count = np.unique(key[order], return_index=True, return_counts=True)
    at = np.array(np.unravel_index(name, shape)).T
    touch = (np.abs(at[:, None] - at[None]) <= 1).all(axis=2) & ~np.eye(len(at), dtype=bool)
    one, other = np.nonzero(touch)
    start = np.concatenate([[0], np.cumsum(touch.sum(axis=1))]).astype(np.int32)
    low = np.array([points[order[f : f + c]].min(axis=0) for f, c in zip(first, count)])  # noqa: B905
    high = np.array([points[order[f : f + c]].max(axis=0) for f, c in zip(first, count)])  # noqa: B905
    box = np.column_stack([low, high])
    a, b = one[one < other], other[one < other]
    leaves = Leaves(
        node=np.arange(len(name), dtype=np.int32), first=first.astype(np.int32),
        count=count.astype(np.int32), size=np.full(len(name), size), box=box, a=a.astype(np.int32),
        b=b.astype(np.int32), start=start, neighbor=other.astype(np.int32),
    )  # fmt: skip
    return leaves, order
