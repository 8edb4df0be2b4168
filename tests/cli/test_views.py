"""Verbs with views, pose errors and refinement."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from octoseg_ti import files


@pytest.mark.parametrize(
    ("views", "count"), [("0,0;45,90;45,210", 3), ("2", 2), ("0,0,-5;0,0,5", 2)]
)
def test_views_are_chosen(octoseg, tmp_path: Path, views: str, count: int) -> None:
    out = tmp_path / "scan.mcap"
    done = octoseg(
        "simulate", "two-planes", "-o", out, "--views", views, "--stripe-pitch", 1, "--json"
    )
    assert done.code == 0, done.err
    figures = json.loads(done.out)
    assert figures["views"] == count and figures["patches"] >= 2
    scans, truth = files.read(out), files.read_truth(out)
    assert len(scans) == figures["points"] and truth is not None and len(truth) == len(scans)
    assert octoseg("check", out).code == 0


def test_no_truth_on_request(octoseg, tmp_path: Path) -> None:
    for name in ("scan.mcap", "scan.npz"):
        done = octoseg("simulate", "two-planes", "-o", tmp_path / name, "--stripe-pitch", 1,
                       "--no-truth")  # fmt: skip
        assert done.code == 0 and "no truth recorded" in done.out
        assert files.read_truth(tmp_path / name) is None


@pytest.mark.parametrize("views", ["0", "4,x", "95,0", "some"])
def test_wrong_views_are_one_line(octoseg, tmp_path: Path, views: str) -> None:
    done = octoseg("simulate", "two-planes", "-o", tmp_path / "a.mcap", "--views", views)
    assert done.code == 2 and "--views" in done.complaint
    assert list(tmp_path.iterdir()) == []


def test_refinement_is_reported(octoseg, tmp_path: Path) -> None:
    pytest.importorskip("small_gicp")
    scan = tmp_path / "scan.mcap"
    done = octoseg(
        "simulate", "test-block", "-o", scan, "--views", "0,0;37.5,0;37.5,120", "--stripe-pitch",
        0.7, "--pose-noise", 0.05, "--pose-angle-noise-deg", 0.05, "--quiet",
    )  # fmt: skip
    assert done.code == 0, done.err
    done = octoseg("segment", scan, "-o", tmp_path / "a.npz", "--refine", "--json")
    figures = json.loads(done.out)
    assert figures["registration"]["rms_after_mm"] < figures["registration"]["rms_before_mm"]
    assert figures["pose_errors"]["refined_mm"] < figures["pose_errors"]["recorded_mm"]
    assert len(figures["registration"]["views"][1]["refined"]) == 4


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_interrupt_while_a_scan_is_written_leaves_nothing(tmp_path: Path) -> None:
    code = (
        "import signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from octoseg_ti.cli import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    out = tmp_path / "scan.mcap"
    work = subprocess.Popen(
        [sys.executable, "-c", code, "simulate", "phone", "-o", str(out), "--stripe-pitch", "0.1"],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    part = tmp_path / "scan.mcap.part"
    for _ in range(600):  # until a view or two are in the file
        if part.exists() and part.stat().st_size > 200_000:
            break
        assert work.poll() is None
        time.sleep(0.1)
    work.send_signal(signal.SIGINT)
    _, err = work.communicate(timeout=60)
    assert work.returncode == 130 and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
