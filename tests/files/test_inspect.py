"""What `describe` tells, and which faults `check` finds."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from octoseg_ti.errors import DataError
from octoseg_ti.files import write
from octoseg_ti.files.inspect import check, describe
from octoseg_ti.types import Scans

from .factory import make, make_result
from .test_damage import cloud, record


@pytest.mark.parametrize("suffix", [".mcap", ".npz"])
def test_whole_files_have_no_fault(tmp_path, suffix):
    scans, truth = make(views=2)
    result = make_result(scans, truth)
    path = tmp_path / f"w{suffix}"
    write(path, result, scans=scans, truth=truth)
    assert check(path) == []
    facts = describe(path)
    json.dumps(facts)
    assert facts["points"] == len(scans)
    assert facts["stripes"] == len(np.unique(scans.stripe))
    assert facts["views"] == 2
    assert facts["truth_patches"] == truth.patch_count
    assert facts["patches"] == result.patch_count
    write(path, result)
    assert check(path) == []
    assert describe(path)["patches"] == result.patch_count


def test_recording_is_described(tmp_path):
    scans, truth = make()
    path = tmp_path / "s.mcap"
    write(path, scans, truth=truth, run={"part": "factory"})
    facts = describe(path)
    topics = {topic["topic"]: topic for topic in facts["topics"]}
    assert set(topics) == {"/scan/lines", "/tf", "/truth/lines"}
    assert topics["/scan/lines"]["messages"] == 12
    assert facts["frames"] == ["scanner", "view_0", "world"]
    assert facts["duration_s"] == pytest.approx(0.11)
    assert facts["metadata"]["octoseg.run"]["part"] == "factory"
    assert set(facts["attachments"]) == {"scan.npz", "ground_truth.npz"}


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".xyz"])
def test_tables_are_described_and_checked(tmp_path, suffix):
    scans, _ = make()
    points = scans.points.copy()
    points[:3] = np.nan
    path = tmp_path / f"t{suffix}"
    write(path, dataclasses.replace(scans, points=points))
    assert describe(path)["finite"] == len(scans) - 3
    assert check(path) == [f"3 of {len(scans)} positions are not finite"]


def test_faults_are_found(tmp_path):
    scans, truth = make()
    path = tmp_path / "f.npz"
    write(path, dataclasses.replace(scans, normals=2.0 * truth.normal))
    assert check(path) == [f"{len(scans)} normals have no unit length"]
    write(path, dataclasses.replace(scans, time_ns=scans.time_ns[::-1].copy()))
    assert check(path) == ["the times of the points go back"]
    gap = dataclasses.replace(truth, patch=np.where(truth.patch == 1, 9, truth.patch))
    write(path, scans, truth=gap)
    assert "truth labels have no point" in check(path)[0]
    path.write_bytes(path.read_bytes()[:-10])
    assert len(check(path)) == 1 and "NPZ" in check(path)[0]


def test_faults_of_results_are_found(tmp_path):
    scans, truth = make()
    result = make_result(scans, truth)
    path = tmp_path / "f.npz"
    write(path, result)
    assert check(path) == []
    assert 0 < describe(path)["covariances"] < result.patch_count
    bad = np.zeros((4, 8, 8))
    bad[0, 0, 0] = -1.0
    bad[1, 0, 1] = 1.0
    bad[2, [0, 1], [1, 0]] = 2.0
    bad[2, [0, 1], [0, 1]] = 1.0
    bad[3, 2, 2] = np.inf
    covariance = np.concatenate([bad, result.covariance[4:]])
    write(path, dataclasses.replace(result, covariance=covariance))
    assert check(path) == ["4 covariances of the result are none of any parameters"]


def test_faults_of_messages_are_found(tmp_path):
    from octoseg_ti.files import messages

    path = tmp_path / "f.mcap"
    points = np.ones((2, 3))
    clouds = [cloud(points), cloud(points)]
    record(
        path,
        [
            ("/b", None, "json", [b"{}"]),
            ("/scan/lines", messages.PointCloud, "protobuf", clouds),
            ("/log", messages.Log, "protobuf", [b"\xff\xff"]),
        ],
    )
    found = check(path)
    assert any("unknown schema (none) in json" in line for line in found)
    assert any("no transform comes before" in line for line in found)
    assert any("1 messages of /log cannot be decoded" in line for line in found)
    assert any("stripes of /scan/lines are out of order" in line for line in found)
    assert any("older than the one before" in line for line in found)


def test_unknown_and_missing_files(tmp_path):
    with pytest.raises(DataError, match="known"):
        (tmp_path / "x.step").write_text("x")
        describe(tmp_path / "x.step")
    assert check(tmp_path / "nothing.mcap") == ["no such file; check the name"]


def test_damaged_recording_is_one_problem(tmp_path):
    path = tmp_path / "d.mcap"
    write(path, Scans(points=np.ones((5, 3))))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    assert len(check(path)) == 1
