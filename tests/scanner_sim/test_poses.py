"""Recorded poses differ from the true ones, and nothing else does."""

from __future__ import annotations

import math

import numpy as np
import pytest
from files.compare import assert_equal

from octoseg_ti import files
from octoseg_ti.errors import DataError
from octoseg_ti.types import Scans, Truth
from scanner_sim import Part, StripeScanner, View, box, simulate
from scanner_sim.poses import pose_errors

VIEWS = (View(), View(tilt=0.5), View(tilt=0.5, azimuth=2.0))


def _scan(**values: float) -> tuple[Scans, Truth]:
    part: Part = box((-8, -6, 0), (8, 6, 5))
    return simulate(part, StripeScanner(stripe_pitch=0.6, views=VIEWS, **values), seed=3)  # type: ignore[arg-type]


def test_errors_have_the_size_that_was_asked_for() -> None:
    motions = pose_errors(4000, 0.05, 0.001, seed=1)
    np.testing.assert_array_equal(motions[0], np.eye(4))
    turned = motions[1:, :3, :3]
    np.testing.assert_allclose(
        turned @ turned.transpose(0, 2, 1), np.tile(np.eye(3), (3999, 1, 1)), atol=1e-14
    )
    assert motions[1:, :3, 3].std(axis=0) == pytest.approx([0.05] * 3, rel=0.05)
    vectors = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=1)
    assert vectors.std(axis=0) == pytest.approx([0.001] * 3, rel=0.05)
    assert np.abs(vectors.mean(axis=0)).max() < 1e-4
    np.testing.assert_array_equal(motions[:7], pose_errors(7, 0.05, 0.001, seed=1))
    assert not np.array_equal(motions, pose_errors(4000, 0.05, 0.001, seed=2))


def test_only_the_recorded_poses_change() -> None:
    (plain, truth), (wrong, same) = _scan(), _scan(pose_noise=0.2, pose_angle_noise=0.01)
    moved = ("T_world_view", "origin", "stripe_origin")
    assert_equal(plain, wrong, but=moved)
    assert_equal(truth, same)
    np.testing.assert_array_equal(plain.T_world_view, truth.T_world_view)
    assert wrong.T_world_view is not None and truth.T_world_view is not None
    np.testing.assert_array_equal(wrong.T_world_view[0], truth.T_world_view[0])
    error = np.linalg.inv(truth.T_world_view) @ wrong.T_world_view
    assert 0.01 < np.abs(error[1:, :3, 3]).max() < 1.0
    # The scanner believes its probe where its pose puts it.
    assert plain.stripe_origin is not None and wrong.stripe_origin is not None
    assert plain.stripe is not None and plain.view is not None
    for v in range(3):
        first, last = plain.stripe[plain.view == v].min(), plain.stripe[plain.view == v].max()
        for scans, there in ((plain, truth.T_world_view[v]), (wrong, wrong.T_world_view[v])):
            back = np.linalg.inv(there)
            assert scans.stripe_origin is not None
            local = scans.stripe_origin[first : last + 1] @ back[:3, :3].T + back[:3, 3]
            np.testing.assert_allclose(local[:, 2], 300.0, atol=1e-9)
            np.testing.assert_allclose(local[:, 1], 0.0, atol=1e-9)


@pytest.mark.parametrize("suffix", [".npz", ".mcap"])
def test_true_poses_come_back_from_files(suffix: str, tmp_path) -> None:
    scans, truth = _scan(pose_noise=0.05, pose_angle_noise=math.radians(0.05))
    path = tmp_path / f"scan{suffix}"
    files.write(path, scans, truth=truth)
    back, known = files.read(path), files.read_truth(path)
    assert known is not None
    np.testing.assert_array_equal(known.T_world_view, truth.T_world_view)
    np.testing.assert_array_equal(back.T_world_view, scans.T_world_view)


@pytest.mark.parametrize("values", [{"pose_noise": -1.0}, {"pose_angle_noise": math.nan}])
def test_impossible_errors_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(DataError, match=f"StripeScanner: {next(iter(values))}"):
        StripeScanner(**values)  # type: ignore[arg-type]
