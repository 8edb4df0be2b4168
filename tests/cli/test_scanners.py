"""Whole scanners on the command line: `simulate --scanner`, `acceptance`, scores of cleaning."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest


def test_a_scanner_by_name_and_its_options_over_it() -> None:
    from octoseg_ti.cli.acceptance import AcceptanceOptions
    from octoseg_ti.cli.parse import parse
    from octoseg_ti.cli.simulate import ScannerName, SimulateOptions
    from scanner_sim.presets import SCANNERS, scanner

    base = ["phone", "-o", "a.mcap"]
    for name, probe in SCANNERS.items():
        for given in (["--scanner", name], [f"--scanner={name}"]):
            assert parse("simulate", SimulateOptions, [*base, *given]).scanner == probe
    assert set(ScannerName.__args__) == set(SCANNERS)
    over = ["--scanner", "modern", "--speckle", "0", "--lobe-deg", "5"]
    changed = parse("simulate", SimulateOptions, [*base, *over])
    assert changed.scanner == scanner("modern", speckle=0.0, lobe=np.radians(5.0))
    tested = parse("acceptance", AcceptanceOptions, ["--scanner", "harsh", "--line-width", "0"])
    assert tested.scanner == scanner("harsh", line_width=0.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--scanner", "surveyer"], ["surveyer", "surveyor-like"]),
        (["--scanner"], ["--scanner"]),
        (["--scanner", "harsh", "--sub-rays", "4"], ["--sub-rays must be an odd number", "not 4"]),
        (["--specle", "1"], ["did you mean '--speckle'"]),
    ],
)
def test_wrong_scanners_are_named(octoseg, tmp_path: Path, arguments, words) -> None:
    outcome = octoseg("simulate", "two-planes", "-o", tmp_path / "a.npz", *arguments)
    assert outcome.code in (1, 2) and outcome.err.count("\n") == 1
    assert all(word in outcome.err for word in words), outcome.err
    assert not (tmp_path / "a.npz").exists()


@pytest.mark.parametrize("suffix", [".mcap", ".npz"])
def test_artefacts_are_recorded_and_scored(octoseg, tmp_path: Path, suffix: str) -> None:
    from octoseg_ti import files

    path = tmp_path / f"scan{suffix}"
    arguments = ["--scanner", "surveyor-like", "--points", "8000", "--json"]
    outcome = octoseg("simulate", "two-planes", "-o", path, *arguments)
    assert outcome.code == 0, outcome.err
    counts = json.loads(outcome.out)["artefacts"]
    assert sum(counts.values()) == 8000 and counts["mixed"] > 5
    truth = files.read_truth(path)
    assert truth is not None and truth.artefact is not None and truth.artefact.dtype == np.uint8
    assert np.count_nonzero(truth.artefact == 1) == counts["mixed"]
    outcome = octoseg("evaluate", path, "--json", "--quiet")
    scores = json.loads(outcome.out)["artefacts"]
    assert scores["true"] == 8000 - counts["clean"]
    assert scores["classes"]["mixed"]["true"] == counts["mixed"]
    shown = octoseg("evaluate", path, "--quiet").out
    assert "cleaning" in shown and f"mixed, {counts['mixed']} points" in shown


def test_acceptance_prints_figures_beside_what_is_stated(octoseg, tmp_path: Path) -> None:
    from PIL import Image

    outcome = octoseg("acceptance", "--scanner", "modern", "-o", tmp_path / "new")
    assert outcome.code == 0, outcome.err
    for word in ("probing form", "size error", "flatness", "height error", "stated", "70 deg"):
        assert word in outcome.out
    assert "NO" not in outcome.out
    report = (tmp_path / "new" / "acceptance.md").read_text("utf-8")
    assert "| height error, 5 mm step |" in report and "](phantom-points.png)" in report
    figures = json.loads((tmp_path / "new" / "acceptance.json").read_text("utf-8"))
    assert figures["scanner"] == "modern" and figures["parameters"]["line_width"] == 0.08
    assert figures["probing_form"]["within"] and len(figures["noise"]) == 8
    picture = np.asarray(Image.open(tmp_path / "new" / "phantom-points.png"))
    assert picture.shape == (640, 960, 3)
    # The colours of clean and of mixed points, and the strip of the line's width.
    for color, least in (((70, 110, 170), 500), ((225, 90, 30), 30), ((255, 238, 205), 500)):
        assert (picture == color).all(axis=2).sum() > least


def test_acceptance_says_when_a_figure_is_out_of_range(octoseg) -> None:
    outcome = octoseg("acceptance", "--scanner", "ideal", "--range-noise", "0.01", "--json")
    figures = json.loads(outcome.out)
    assert not figures["flatness"]["within"] and figures["flatness"]["stated"] == [0.0, 0.0001]
    assert figures["flatness"]["mm"] > 0.01
