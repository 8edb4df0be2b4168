"""Simulated views with pose errors, segmented with refinement: the poses come back."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from octoseg_ti import Params, evaluate, segment
from octoseg_ti.evaluation import pose_errors
from octoseg_ti.params import RegistrationParams
from octoseg_ti.types import Scans, Segmentation, Truth
from scanner_sim import StripeScanner, View, blocks, simulate
from scanner_sim.scanner import around

pytest.importorskip("small_gicp")

REFINE = Params(registration=RegistrationParams(refine=True))
SCANNER = StripeScanner(pose_noise=0.05, pose_angle_noise=math.radians(0.05), range_noise=0.01)


@pytest.fixture(scope="module")
def views() -> tuple[View, ...]:
    return (View(), *around((math.radians(37.5), 3)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_relative_poses_come_back_within_a_hundredth(seed: int, views: tuple[View, ...]) -> None:
    assert len(views) == 4
    scanner = replace(SCANNER, views=views, points=45_000)
    scans, truth = simulate(blocks.test_block(), scanner, seed=seed)
    result = segment(scans, REFINE)
    assert result.registration is not None and truth.T_world_view is not None
    before = pose_errors(result.registration.recorded, truth.T_world_view)
    shift, angle = pose_errors(result.registration.refined, truth.T_world_view)
    assert before[0] > 0.05 and math.degrees(before[1]) > 0.05
    assert shift < 0.01 and math.degrees(angle) < 0.01
    assert result.registration.rms_after < 0.015 < result.registration.rms_before
    assert not result.registration.open.any() and len(result.registration.left) == 0
    assert "registration: 6 pairs of 4 views, rms " in str(result)
    assert evaluate(result, truth).regions.ari > 0.95


@pytest.fixture(scope="module")
def small() -> tuple[Scans, Truth]:
    part = blocks.test_block()
    views = (View(), View(tilt=0.65), View(tilt=0.65, azimuth=2.1))
    return simulate(part, replace(SCANNER, views=views, points=12_000), seed=4)


@pytest.fixture(scope="module")
def refined(small: tuple[Scans, Truth]) -> Segmentation:
    return segment(small[0], REFINE)


def test_what_was_not_asked_for_is_not_done(
    small: tuple[Scans, Truth], refined: Segmentation
) -> None:
    scans, _ = small
    plain = segment(scans)
    assert plain.registration is None and "registration" not in str(plain).split("milli")[0]
    assert refined.registration is not None
    np.testing.assert_array_equal(refined.registration.recorded, scans.T_world_view)
    assert refined.params.registration.reach == plain.params.registration.reach is not None
    # The points of the datum keep their places, and every point goes where its new pose says.
    assert scans.view is not None
    np.testing.assert_array_equal(refined.points[scans.view == 0], plain.points[scans.view == 0])
    pose = refined.registration.refined[scans.view]
    expected = np.einsum("nij,nj->ni", pose[:, :3, :3], scans.points) + pose[:, :3, 3]
    np.testing.assert_allclose(refined.points, expected, atol=1e-9)
    assert refined.outlier.any()  # so the line above was true for points left out as well
    turned = np.einsum(
        "nij,nj->ni", refined.registration.change()[scans.view][:, :3, :3], plain.normals
    )
    np.testing.assert_allclose(refined.normals, turned, atol=1e-6)


def test_points_in_the_world_are_aligned_alike(
    small: tuple[Scans, Truth], refined: Segmentation
) -> None:
    scans, _ = small
    assert scans.T_world_view is not None and scans.view is not None
    pose = scans.T_world_view[scans.view]
    world = np.einsum("nij,nj->ni", pose[:, :3, :3], scans.points) + pose[:, :3, 3]
    there = segment(replace(scans, points=world, frame="world"), REFINE).registration
    here = refined.registration
    assert here is not None and there is not None
    np.testing.assert_allclose(there.refined, here.refined, atol=1e-4)
    bare = segment(replace(scans, points=world, frame="world", T_world_view=None), REFINE)
    assert bare.registration is not None
    np.testing.assert_array_equal(bare.registration.recorded, np.tile(np.eye(4), (3, 1, 1)))
    np.testing.assert_allclose(bare.registration.change(), there.change(), atol=1e-9)


_RUN = """
import hashlib, math, sys
from octoseg_ti.device import runtime
runtime.start(threads=int(sys.argv[1]))
from octoseg_ti import Params, segment
from octoseg_ti.params import RegistrationParams
from scanner_sim import StripeScanner, View, blocks, simulate
scanner = StripeScanner(views=(View(), View(tilt=0.65)), points=9000, pose_noise=0.05)
result = segment(simulate(blocks.test_block(), scanner, seed=1)[0],
                 Params(registration=RegistrationParams(refine=True)))
arrays = [result.labels, result.points, result.registration.refined, result.registration.after]
print(hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest())
"""


def test_any_number_of_threads_gives_the_same_bits() -> None:
    answers = set()
    for threads in ("1", "2"):
        known = {name: threads for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        done = subprocess.run(
            [sys.executable, "-c", _RUN, threads], check=True, capture_output=True, text=True,
            env=os.environ | known,
        )  # fmt: skip
        answers.add(done.stdout.splitlines()[-1])
    assert len(answers) == 1


def test_result_files_keep_the_registration(
    small: tuple[Scans, Truth], refined: Segmentation, tmp_path
) -> None:
    from files.compare import assert_equal

    from octoseg_ti import files
    from octoseg_ti.files.recording_read import collect, read_segmentation

    scans, truth = small
    files.write(tmp_path / "a.npz", refined)
    files.write(tmp_path / "a.mcap", refined, scans=scans, truth=truth)
    from octoseg_ti.files import npz

    for back in (npz.read_segmentation(tmp_path / "a.npz"), read_segmentation(tmp_path / "a.mcap")):
        assert_equal(back.registration, refined.registration)
    contents = collect(tmp_path / "a.mcap", {"/tf"})
    stored = contents.metadata["octoseg.registration"]
    assert json.loads(stored["pairs"]) == [[0, 1], [0, 2], [1, 2]]
    assert json.loads(stored["left_as_recorded"]) == []
    assert len(json.loads(stored["rms_after_mm"])) == 3
    frames = contents.messages[-1].data
    assert b"view_2/refined" in frames and b"view_0/refined" in frames
    plain = files.read_truth(tmp_path / "a.mcap")
    assert plain is not None
    np.testing.assert_array_equal(plain.T_world_view, truth.T_world_view)


def test_the_report_says_it(small: tuple[Scans, Truth], refined: Segmentation) -> None:
    from octoseg_ti.view.report import sections

    found = [one for one in sections(refined) if one.title == "Registration"]
    assert len(found) == 1 and [row[0] for row in found[0].rows] == ["0 - 1", "0 - 2", "1 - 2"]
    assert not [one for one in sections(segment(small[0])) if one.title == "Registration"]
