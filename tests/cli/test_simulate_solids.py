"""`simulate` with files of solids: recordings with truth, or one clear line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from reference.shapes import cube, rod, write_ascii_stl, write_obj, write_ply, write_stl


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_a_mesh_becomes_a_recording_with_truth(octoseg, tmp_path: Path, suffix: str) -> None:
    from octoseg_ti import files

    source = tmp_path / f"rod.{suffix}"
    {"stl": write_stl, "obj": write_obj, "ply": write_ply}[suffix](source, rod(5.0, 12.0))
    output = tmp_path / "scan.mcap"
    outcome = octoseg("simulate", source, "-o", output, "--points", "3000", "--unit", "cm")
    assert outcome.code == 0 and outcome.err == ""
    assert "100 x 100 x 120 mm" in outcome.out and "2 plane, 1 cylinder" in outcome.out
    truth = files.read_truth(output)
    assert truth is not None and len(truth) == 3000 and truth.patch_count == 2
    assert truth.info["format"] == suffix and truth.info["unit"] == "cm"


def test_figures_as_json_and_angles_in_degrees(octoseg, tmp_path: Path) -> None:
    source = write_stl(tmp_path / "rod.stl", rod(5.0, 12.0, turns=24))
    arguments = ["simulate", source, "-o", tmp_path / "scan.npz", "--points", "2000", "--json"]
    smooth = json.loads(octoseg(*arguments).out)
    facets = json.loads(octoseg(*arguments, "--smooth-angle-deg", "10").out)
    assert smooth["patches"] == 2 and facets["patches"] > 10
    assert facets["truth"]["smooth_angle_deg"] == "10"


@pytest.mark.parametrize(
    ("name", "content", "wanted"),
    [
        ("empty.step", b"", "empty"),
        ("text.step", b"not at all", "not a STEP file"),
        ("text.stl", b"not at all", "STL"),
        ("far.obj", b"v 0 0 0\nf 1 2 3\n", "line 2"),
        ("text.ply", b"not at all", "PLY"),
    ],
)
def test_damaged_files_end_in_one_line(
    octoseg, tmp_path: Path, name: str, content: bytes, wanted: str
) -> None:
    if name.endswith(".step"):
        pytest.importorskip("OCP.STEPControl")
    source = tmp_path / name
    source.write_bytes(content)
    outcome = octoseg("simulate", source, "-o", tmp_path / "scan.mcap")
    assert outcome.code == 1 and outcome.out == ""
    assert name in outcome.complaint and wanted in outcome.complaint
    assert not (tmp_path / "scan.mcap").exists()


def test_a_missing_file_and_an_impossible_option(octoseg, tmp_path: Path) -> None:
    source = write_ascii_stl(tmp_path / "cube.stl", cube())
    outcome = octoseg("simulate", tmp_path / "cubes.stl", "-o", tmp_path / "scan.mcap")
    assert outcome.code == 1 and "did you mean 'cube.stl'" in outcome.complaint
    outcome = octoseg("simulate", source, "-o", tmp_path / "s.npz", "--smooth-angle-deg", "-3")
    assert outcome.code == 2 and "--smooth-angle-deg must be above 0, not -3;" in outcome.complaint
