"""Every verb does its work: on a small scan, with the outputs read back."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, tent) -> Path:
    """A recording with truth and no result."""
    from octoseg_ti import files

    path = tmp_path_factory.mktemp("recording") / "tent.mcap"
    files.write(path, tent[0], truth=tent[1])
    return path


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory, recording: Path) -> Path:
    """A recording with scan, truth and result."""
    from octoseg_ti.cli import main

    path = tmp_path_factory.mktemp("result") / "result.mcap"
    assert main(["segment", str(recording), "-o", str(path), "--quiet"]) == 0
    return path


def test_segment_writes_every_output(octoseg, recording: Path, tmp_path: Path, tent) -> None:
    names = ("a.mcap", "a.npz", "a.ply", "a.pcd", "a.xyz", "a.rrd")
    outputs = [a for name in names for a in ("-o", tmp_path / name)]
    outcome = octoseg("segment", recording, *outputs)
    assert outcome.code == 0, outcome.err
    assert outcome.err == ""
    assert "Segmentation:" in outcome.out
    for name in names:
        assert f"wrote {tmp_path / name} (" in outcome.out
        assert (tmp_path / name).stat().st_size > 1000
    from octoseg_ti import files

    assert len(np.load(tmp_path / "a.npz")["labels"]) == len(tent[0])
    truth = files.read_truth(tmp_path / "a.mcap")
    assert truth is not None
    np.testing.assert_array_equal(truth.patch, tent[1].patch)
    kept = files.read(tmp_path / "a.mcap")
    np.testing.assert_array_equal(kept.stripe, tent[0].stripe)


def test_segment_json_is_json(octoseg, recording: Path, tmp_path: Path) -> None:
    outcome = octoseg("segment", recording, "-o", tmp_path / "a.npz", "--json", "--quiet")
    figures = json.loads(outcome.out)
    assert figures["patches"] == len(figures["patch_table"]) == 2
    for patch in figures["patch_table"]:
        for name in ("parameters", "deviations"):
            assert [value is not None for value in patch[name]] == 6 * [True] + 2 * [False]
    assert figures["params"]["grid"]["tolerance"] > 0, "chosen values are reported"
    assert figures["seconds"]
    assert figures["outputs"] == [str(tmp_path / "a.npz")]


def test_quiet_is_quiet(octoseg, recording: Path, tmp_path: Path) -> None:
    outcome = octoseg("segment", recording, "-o", tmp_path / "a.npz", "--quiet")
    assert (outcome.code, outcome.out, outcome.err) == (0, "", "")


def test_parameters_reach_the_result(octoseg, recording: Path, tmp_path: Path) -> None:
    arguments = ["--preset", "paper", "--params.grid.divisions", "5"]
    outcome = octoseg("segment", recording, "-o", tmp_path / "a.npz", "--json", *arguments)
    assert outcome.code == 0, outcome.err
    params = json.loads(outcome.out)["params"]
    assert params["grid"]["divisions"] == 5
    assert params["normals"]["rule"] == "paper"


def test_segment_onto_its_own_input_keeps_everything(
    octoseg, recording: Path, tmp_path: Path, tent
) -> None:
    from octoseg_ti import files

    own = tmp_path / "own.mcap"
    own.write_bytes(recording.read_bytes())
    assert octoseg("segment", own, "-o", own).code == 0
    assert len(files.read_segmentation(own)) == len(tent[0])
    assert files.read_truth(own) is not None


def test_simulate_is_the_same_for_the_same_seed(octoseg, tmp_path: Path) -> None:
    for name in ("a.npz", "b.npz"):
        outcome = octoseg("simulate", "two-planes", "-o", tmp_path / name, "--seed", "5")
        assert outcome.code == 0, outcome.err
    assert "two-planes: 20000 points" in outcome.out
    a, b = np.load(tmp_path / "a.npz"), np.load(tmp_path / "b.npz")
    assert set(a.files) == set(b.files)
    for name in a.files:
        np.testing.assert_array_equal(a[name], b[name])


def test_simulate_takes_options_of_the_scanner(octoseg, tmp_path: Path) -> None:
    arguments = ["--points", "3000", "--range-noise", "0", "--json"]
    outcome = octoseg("simulate", "two-planes", "-o", tmp_path / "a.mcap", *arguments)
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["points"] == 3000


def test_evaluate_a_result(octoseg, result: Path) -> None:
    outcome = octoseg("evaluate", result)
    assert outcome.code == 0
    assert outcome.err == ""
    assert "recorded result" in outcome.out
    scores = json.loads(octoseg("evaluate", result, "--json").out)
    assert scores["regions"]["correct"] == scores["regions"]["patches"] == 2


def test_evaluate_a_scan_segments_it_and_says_so(octoseg, recording: Path) -> None:
    outcome = octoseg("evaluate", recording)
    assert outcome.code == 0
    assert "segmenting it now" in outcome.err
    assert "segmented now" in outcome.out


def test_evaluate_many_files_is_a_table(octoseg, recording: Path, result: Path) -> None:
    outcome = octoseg("evaluate", recording, result, "--quiet")
    assert outcome.code == 0
    lines = outcome.out.splitlines()
    assert lines[0].split()[:4] == ["file", "true", "found", "correct"]
    assert [line.split()[0] for line in lines[2:]] == [str(recording), str(result)]
    figures = json.loads(octoseg("evaluate", recording, result, "--quiet", "--json").out)
    assert set(figures) == {str(recording), str(result)}


def test_evaluate_goes_on_after_a_bad_file(octoseg, result: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"nothing")
    outcome = octoseg("evaluate", bad, result)
    assert outcome.code == 1
    assert str(result) in outcome.out
    assert "bad.mcap" in outcome.err
    assert "1 of 2 files" in outcome.err


def test_info_and_check(octoseg, result: Path) -> None:
    outcome = octoseg("info", result)
    assert outcome.code == 0
    assert "/scan/lines" in outcome.out
    assert json.loads(octoseg("info", result, "--json").out)
    outcome = octoseg("check", result)
    assert (outcome.code, outcome.out) == (0, f"{result}: ok\n")
    assert octoseg("check", result, "--quiet").out == ""
    assert json.loads(octoseg("check", result, "--json").out) == {str(result): []}


def test_convert_keeps_the_result(octoseg, result: Path, tmp_path: Path) -> None:
    from octoseg_ti import files

    outcome = octoseg("convert", result, tmp_path / "r.npz")
    assert outcome.code == 0, outcome.err
    before, after = files.read_segmentation(result), files.read_segmentation(tmp_path / "r.npz")
    np.testing.assert_array_equal(before.labels, after.labels)
    np.testing.assert_array_equal(before.edge, after.edge)
    outcome = octoseg("convert", result, tmp_path / "r.xyz")
    assert outcome.code == 0
    assert ".mcap and .npz hold all" in outcome.err


def test_play_to_a_file(octoseg, recording: Path, tmp_path: Path) -> None:
    arguments = ["--save", tmp_path / "p.rrd", "--lines", "3:13", "--every", "2", "--json"]
    outcome = octoseg("play", recording, *arguments)
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["stripes"] == 5
    assert (tmp_path / "p.rrd").stat().st_size > 1000


def test_play_segments_what_was_played(octoseg, recording: Path) -> None:
    arguments = ["--headless", "--segment", "--segment-every", "20", "--json"]
    outcome = octoseg("play", recording, *arguments)
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["segmentations"] == 2


def test_play_without_a_display_says_what_to_do(octoseg, recording: Path, monkeypatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    outcome = octoseg("play", recording)
    assert outcome.code == 1
    assert "--save" in outcome.complaint


def test_play_headless_keeps_the_pace(octoseg, recording: Path) -> None:
    # 40 stripes, 20 ms apart, at 4 times the speed: 0.2 s.
    outcome = octoseg("play", recording, "--headless", "--rate", "4", "--json")
    figures = json.loads(outcome.out)
    assert figures["stripes"] == 40
    assert 0.15 < figures["seconds"] < 2.0


@pytest.mark.slow
def test_demo_writes_what_it_lists(octoseg, tmp_path: Path) -> None:
    outcome = octoseg("demo", "-o", tmp_path / "demo", "--part", "two-planes")
    assert outcome.code == 0, outcome.err
    names = {p.name for p in (tmp_path / "demo").iterdir()}
    wanted = {"scan.mcap", "result.mcap", "result.npz", "result.ply", "result.rrd"}
    assert names == wanted | {"report.html", "report.md"}
    for name in names:
        assert name in outcome.out
    assert "rerun " in outcome.out
    assert "correct" in outcome.out


def test_open_without_a_display_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from octoseg_ti.cli import Failure
    from octoseg_ti.cli.demo import open_in_rerun

    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(Failure, match="no display"):
        open_in_rerun(tmp_path / "a.rrd")
    assert "DISPLAY" not in os.environ
