"""Points of creases are members of all patches that meet there."""

import numpy as np

from octoseg_ti import SurfaceKind, segment
from octoseg_ti.evaluation.members import patch_members


def corner(steps: int) -> np.ndarray:
    """Return the points of three faces of a cube of this many steps, edges once."""
    i, j = np.meshgrid(np.arange(steps + 1), np.arange(steps + 1))
    i, j, zero = i.ravel(), j.ravel(), np.zeros(i.size, int)
    faces = [np.stack(face, axis=1) for face in ((i, j, zero), (i, zero, j), (zero, i, j))]
    return np.unique(np.concatenate(faces), axis=0).astype(float)


def test_points_of_edges_are_on_all_faces_that_meet() -> None:
    steps = 24
    points = corner(steps)
    result = segment(points)
    members = patch_members(result)
    assert result.patch_count == 3
    assert set(members.kind.tolist()) == {int(SurfaceKind.PLANE)}
    axes = set()
    for start, end in zip(members.start[:-1], members.start[1:], strict=True):
        rows = members.index[start:end]
        axis = int(np.argmin(np.ptp(points[rows], axis=0)))
        assert np.array_equal(rows, np.flatnonzero(points[:, axis] == 0.0))
        axes.add(axis)
    assert axes == {0, 1, 2}


def test_points_without_a_patch_are_on_none() -> None:
    random = np.random.default_rng(0)
    result = segment(random.normal(size=(40, 3)))
    members = patch_members(result)
    assert len(members.start) == result.patch_count + 1
    assert np.all(result.labels[members.index] >= 0)
