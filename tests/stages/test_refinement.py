"""Views are aligned to each other, and what the data leave open is left alone."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from reference import alignment as plain
from reference.clouds import rotation

from octoseg_ti.errors import MissingPackageError
from octoseg_ti.stages import refinement
from octoseg_ti.stages.refinement import refine_poses

small_gicp = pytest.importorskip("small_gicp")


def motion(seed: int, shift: float, angle: float) -> np.ndarray:
    """Return a small random rigid motion."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(angle * rng.standard_normal(3)).as_matrix()
    matrix[:3, 3] = shift * rng.standard_normal(3)
    return matrix


def corner(seed: int, count: int = 1500, side: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    """Return random points on three faces that meet in a corner, and their normals."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(1.0, side, (3, count, 3))
    normals = np.zeros((3, count, 3))
    for k in range(3):
        points[k, :, k] = 0.0
        normals[k, :, k] = 1.0
    return points.reshape(-1, 3), normals.reshape(-1, 3)


def carried(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def several(makers: list, motions: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, normals and views of clouds that are displaced by motions."""
    points = np.concatenate([carried(m, p) for (p, _), m in zip(makers, motions, strict=True)])
    normals = np.concatenate([n @ m[:3, :3].T for (_, n), m in zip(makers, motions, strict=True)])
    view = np.repeat(np.arange(len(makers), dtype=np.int32), [len(p) for p, _ in makers])
    return points, normals, view


@pytest.mark.parametrize("seed", range(3))
def test_matches_and_equations_equal_the_reference(seed: int) -> None:
    clouds = [corner(10 * seed + k, 150) for k in range(2)]
    moves = np.stack([motion(seed + 5, 0.05, 0.01), motion(seed + 6, 0.05, 0.01)])
    views = [refinement._smooth_points(*cloud) for cloud in clouds]
    expected = plain.matches(
        (views[0].points, views[1].points), (views[0].normals, views[1].normals), tuple(moves), 2.0
    )
    found = refinement._match(views[0], views[1], moves, 2.0)
    assert len(found.gap) == len(expected) > 300
    for got, at in ((found.place, 0), (found.normal, 1), (found.gap, 2)):
        np.testing.assert_allclose(got, np.array([one[at] for one in expected]), atol=1e-12)
    # On true planes all weights are alike, so that one step is that of plain least squares.
    exact = refinement._equations(found, 10.0)
    step = refinement._solve([(0, 1)], [exact], np.array([False, True]))[0]
    assert exact.open.shape == (6, 0)
    after = np.abs(found.gap - _jacobian(found, 10.0) @ step[0])
    best = np.abs(found.gap - _jacobian(found, 10.0) @ plain.best_twist(expected, 10.0))
    assert np.median(after) <= np.median(best) + 1e-9
    np.testing.assert_allclose(exact.matrix, exact.matrix.T, atol=1e-9)


def _jacobian(found: refinement._Matches, radius: float) -> np.ndarray:
    return np.concatenate([np.cross(found.place, found.normal) / radius, found.normal], axis=1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_a_known_motion_is_found(seed: int, offset: float) -> None:
    moves = [np.eye(4), motion(seed, 0.3, 0.005), motion(seed + 9, 0.3, 0.005)]
    points, normals, view = several([corner(seed + k) for k in range(3)], moves)
    points = points + offset
    poses = np.stack([motion(k, 50.0, 1.0) for k in range(3)])
    found = refine_poses(points, normals, view, poses, reach=2.0, overlap=0.1)
    assert found.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert found.datum.tolist() == [0] and len(found.left) == 0 and not found.open.any()
    np.testing.assert_array_equal(found.refined[0], poses[0])
    change = found.change()
    for v, m in enumerate(moves):
        original = carried(np.linalg.inv(m), points[view == v] - offset)
        placed = carried(change[v], points[view == v]) - offset
        np.testing.assert_allclose(placed, original, atol=1e-6 if offset == 0.0 else 1e-3)
    assert (found.after < 1e-3 * found.before + 1e-6).all() and found.rms_before > 0.05
    shift, angle = found.moves()
    assert shift[0] == angle[0] == 0.0 and (angle[1:] > 1e-4).all()


def test_one_plane_holds_three_directions_and_the_others_are_not_moved_along() -> None:
    rng = np.random.default_rng(0)
    clouds = []
    for _ in range(2):
        flat = rng.uniform(-20.0, 20.0, (4000, 3)) * (1.0, 1.0, 0.0)
        tilt = 0.01 * rng.standard_normal((4000, 3)) * (1.0, 1.0, 0.0)
        up = np.array([0.0, 0.0, 1.0])
        clouds.append((flat, (tilt + up) / np.sqrt(1.0 + (tilt**2).sum(1))[:, None]))
    lifted = np.eye(4)
    lifted[:3, 3] = (0.2, -0.1, 0.3)
    points, normals, view = several(clouds, [np.eye(4), lifted])
    found = refine_poses(points, normals, view, None, reach=2.0, overlap=0.1)
    assert found.open.tolist() == [0, 3]
    np.testing.assert_allclose(found.refined[1][:3, 3], (0.0, 0.0, -0.3), atol=2e-3)
    np.testing.assert_allclose(found.refined[1][:3, :3], np.eye(3), atol=1e-4)
    assert "not held in every direction: view 1" in str(found)


def test_views_without_overlap_are_left_and_named() -> None:
    far = motion(1, 0.1, 0.001)
    far[:3, 3] += (500.0, 0.0, 0.0)
    makers = [corner(k) for k in range(5)]
    moves = [np.eye(4), far, motion(2, 0.1, 0.001), far @ motion(3, 0.05, 0.001), np.eye(4)]
    moves[4][:3, 3] = (0.0, 900.0, 0.0)
    points, normals, view = several(makers, moves)
    found = refine_poses(points, normals, view, None, reach=2.0, overlap=0.1)
    assert found.pairs.tolist() == [[0, 2], [1, 3]]
    assert found.datum.tolist() == [0, 1] and found.left.tolist() == [4]
    assert "left as recorded (too little overlap): view 4" in str(found)
    for v in (0, 1, 4):
        np.testing.assert_array_equal(found.refined[v], np.eye(4))
    alone = refine_poses(points[view == 0], normals[view == 0], view[view == 0], None,
                         reach=2.0, overlap=0.1)  # fmt: skip
    assert len(alone.pairs) == 0 and math.isnan(alone.rms_before)
    assert "all poses left as recorded" in str(alone)


def test_opposite_sides_of_a_sheet_are_no_overlap() -> None:
    rng = np.random.default_rng(4)
    sheet = rng.uniform(-10.0, 10.0, (2000, 3)) * (1.0, 1.0, 0.0)
    up = np.tile([0.0, 0.0, 1.0], (2000, 1))
    points, normals, view = several([(sheet, up), (sheet, -up)], [np.eye(4), np.eye(4)])
    found = refine_poses(points, normals, view, None, reach=2.0, overlap=0.1)
    assert len(found.pairs) == 0 and found.left.tolist() == [0, 1]


def test_equal_views_stay_and_runs_are_equal_bit_for_bit() -> None:
    cloud = corner(3)
    points, normals, view = several([cloud, cloud], [np.eye(4), np.eye(4)])
    found = refine_poses(points, normals, view, None, reach=2.0, overlap=0.1)
    np.testing.assert_allclose(found.refined, np.tile(np.eye(4), (2, 1, 1)), atol=1e-9)
    moved = several([cloud, corner(4)], [np.eye(4), motion(5, 0.2, 0.004)])
    runs = [refine_poses(*moved, None, reach=2.0, overlap=0.1) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].refined, runs[1].refined)


def test_points_without_normals_and_near_edges_take_no_part() -> None:
    points, normals = corner(6, 800)
    normals[::7] = 0.0
    smooth = refinement._smooth_points(points, normals)
    assert 0 < len(smooth.points) < len(points)
    np.testing.assert_allclose(np.linalg.norm(smooth.normals, axis=1), 1.0, atol=1e-12)
    assert refinement._smooth_points(points, np.zeros_like(points)).tree is None
    found = refine_poses(
        points, np.zeros_like(points), np.zeros(len(points), np.int32), None, reach=1, overlap=0.1
    )
    assert found.left.tolist() == [0]


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(MissingPackageError, match=r"small_gicp: pip install 'octoseg\[icp\]'"):
        refine_poses(np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3, np.int32), None,
                     reach=1.0, overlap=0.1)  # fmt: skip


def test_rotations_of_the_whole_change_nothing_but_the_frame() -> None:
    points, normals, view = several([corner(1), corner(2)], [np.eye(4), motion(3, 0.2, 0.004)])
    turn = np.eye(4)
    turn[:3, :3] = rotation(8)
    here = refine_poses(points, normals, view, None, reach=2.0, overlap=0.1).refined[1]
    there = refine_poses(
        carried(turn, points), normals @ turn[:3, :3].T, view, None, reach=2.0, overlap=0.1
    ).refined[1]
    np.testing.assert_allclose(turn @ here @ turn.T, there, atol=1e-6)
