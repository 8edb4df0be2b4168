"""World positions, points of view, initial cells."""

import dataclasses

import numpy as np
import pytest

from octoseg_ti import DataError, Scans
from octoseg_ti.view import scene


def test_world_points_of_view_frames():
    turn = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])
    scans = Scans(
        points=np.array([[1.0, 2, 3], [1, 2, 3]]), view=np.array([0, 1], np.int32),
        T_world_view=np.stack([np.eye(4), turn]), frame="view",
    )  # fmt: skip
    assert scene.world_points(scans).tolist() == [[1, 2, 3], [8, 21, 33]]
    with pytest.raises(DataError, match="poses"):
        scene.world_points(dataclasses.replace(scans, T_world_view=None))


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_scanned_side_faces_the_eye(axis, sign):
    rng = np.random.default_rng(0)
    points = rng.random((500, 3)) * [50, 30, 20]
    points[:, axis] = 0
    normals = np.zeros((500, 3))
    normals[:, axis] = sign
    view = scene.viewpoint(points, normals)
    assert view.direction[axis] * sign < -0.4
    assert view.up[axis] == sign
    assert np.linalg.norm(view.direction) == pytest.approx(1)
    # The longer side runs across the picture.
    right = np.cross(view.direction, view.up)
    longest = int(np.argmax(np.ptp(points, axis=0)))
    assert abs(right[longest]) > 0.7 * np.linalg.norm(right)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((2, 3), np.nan), np.ones((3, 3))])
def test_a_point_of_view_exists_always(points):
    view = scene.viewpoint(points)
    assert np.isfinite(view.direction).all() and np.isfinite(view.center).all()
    assert view.radius > 0


def test_stripe_bounds():
    assert scene.stripe_bounds(np.array([4, 4, 7, 7, 7, 9])).tolist() == [0, 2, 5, 6]
    assert scene.stripe_bounds(np.zeros(0, int)).tolist() == [0]


def test_initial_cells_hold_all_leaves(made):
    cells = made[2].cells
    corners = scene.initial_corners(cells)
    inside = (cells.corner[:, None] > corners - 1e-6).all(axis=2) & (
        (cells.corner + cells.size[:, None])[:, None] < corners + cells.initial_size + 1e-6
    ).all(axis=2)
    assert (inside.sum(axis=1) == 1).all()
    assert inside.any(axis=0).all()


def test_colours_of_levels_and_normals():
    level = scene.level_colors(np.array([-1, 0, 4, 8]), 8)
    assert tuple(level[0]) == scene.REST_COLOR
    assert len({tuple(c) for c in level}) == 4
    brightness = level[1:, :3].astype(int).sum(axis=1)
    assert (np.diff(brightness) > 0).all()
    normal = scene.normal_colors(np.array([[0, 0, 1.0], [0, 0, 0], [np.nan, 0, 1]]))
    assert normal[0].tolist() == [127, 127, 255, 255]
    assert tuple(normal[1]) == scene.REST_COLOR
