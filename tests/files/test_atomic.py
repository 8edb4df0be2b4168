"""Outputs are whole or absent, and what was there before survives a failure."""

from __future__ import annotations

import os
import sys
import types

import numpy as np
import pytest

from octoseg_ti.errors import DataError
from octoseg_ti.files import write
from octoseg_ti.files.atomic import replacing

from .factory import make, make_result

SUFFIXES = (".mcap", ".npz", ".ply", ".pcd", ".xyz")


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, SystemExit])
def test_failure_keeps_the_old_file_and_leaves_no_part(tmp_path, error):
    path = tmp_path / "out"
    path.write_bytes(b"old")
    with pytest.raises(error), replacing(path) as output:
        output.write(b"new")
        raise error
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_success_replaces(tmp_path):
    path = tmp_path / "out"
    path.write_bytes(b"old")
    with replacing(path) as output:
        output.write(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_disk_errors_become_one_line(tmp_path):
    path = tmp_path / "out"
    with pytest.raises(DataError, match="No space left"), replacing(path):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_full_disk_leaves_nothing(tmp_path, suffix):
    path = tmp_path / f"out{suffix}"
    path.write_bytes(b"old")
    os.symlink("/dev/full", f"{path}.part")
    with pytest.raises(DataError, match="cannot write: No space left") as caught:
        write(path, make(40, 100)[0])
    assert str(path) in str(caught.value)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_unwritable_places(tmp_path, suffix):
    scans, _ = make(2, 4)
    with pytest.raises(DataError, match="cannot write"):
        write(tmp_path / "missing" / f"out{suffix}", scans)
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(DataError, match="not a regular file"):
        write(tmp_path / f"folder{suffix}", scans)
    (tmp_path / f"taken{suffix}").write_bytes(b"old")
    with pytest.raises(DataError, match="exists"):
        write(tmp_path / f"taken{suffix}", scans, overwrite=False)
    assert (tmp_path / f"taken{suffix}").read_bytes() == b"old"
    (tmp_path / f"file{suffix}").write_bytes(b"")
    with pytest.raises(DataError, match="cannot write"):
        write(tmp_path / f"file{suffix}" / f"out{suffix}", scans)


def test_symbolic_links_are_followed(tmp_path):
    (tmp_path / "real.npz").write_bytes(b"old")
    os.symlink(tmp_path / "real.npz", tmp_path / "link.npz")
    write(tmp_path / "link.npz", make(2, 4)[0])
    assert (tmp_path / "link.npz").is_symlink()
    assert (tmp_path / "real.npz").read_bytes()[:2] == b"PK"


def test_groups_that_do_not_belong_together_are_refused(tmp_path):
    scans, truth = make()
    other, _ = make(seed=5)
    assert len(other) != len(scans)
    for suffix in SUFFIXES:
        with pytest.raises(DataError, match="points, not"):
            write(tmp_path / f"x{suffix}", other, truth=truth)
        with pytest.raises(DataError, match="points, not"):
            write(tmp_path / f"x{suffix}", make_result(scans, truth), scans=other)
    assert list(tmp_path.iterdir()) == []


def test_rrd_goes_to_the_viewer_module(tmp_path, monkeypatch):
    calls = []

    def save_rrd(path, *, scans=None, segmentation=None, truth=None):
        calls.append((scans, segmentation, truth))
        path.write_bytes(b"rrd")
        if truth is not None:
            raise RuntimeError("failed")

    module = types.ModuleType("octoseg_ti.view.rerun_log")
    module.save_rrd = save_rrd
    monkeypatch.setitem(sys.modules, "octoseg_ti.view.rerun_log", module)
    scans, truth = make(2, 4)
    write(tmp_path / "x.rrd", scans)
    assert (tmp_path / "x.rrd").read_bytes() == b"rrd"
    with pytest.raises(RuntimeError):
        write(tmp_path / "y.rrd", scans, truth=truth)
    assert [p.name for p in tmp_path.iterdir()] == ["x.rrd"]
    np.testing.assert_array_equal(calls[0][0].points, scans.points)
    assert calls[0][1] is None and calls[1][2] is truth
