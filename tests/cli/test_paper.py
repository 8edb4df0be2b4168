"""Verb `paper`: the examples come out as published, and the tables say which figure is whose."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest

from octoseg_ti.cli import paper as verb


def _row(example: verb.Example) -> dict:
    counts = {"correct": example.patches, "over": 0, "under": 0, "missed": 0, "noise": 0}
    return {
        "part": example.part,
        "title": example.title,
        "points": {"paper": example.points, "here": example.points},
        "patches": {"paper": example.patches, "here": example.patches},
        "grid_seconds": {"paper": example.grid_seconds, "here": 0.012},
        "segmentation_seconds": {"paper": example.segmentation_seconds, "here": 0.034},
        "levels": {"paper": example.levels, "here": 7},
        "passes": 8,
        "hoover": counts,
        "on_fillets": 3,
        "edge_points": 1234,
        "points_by_size": [{"size_mm": 0.5, "cells": 1, "points": 1}],
        "user_values": {"divisions": example.params.grid.divisions},
    }


def test_published_user_values_are_taken() -> None:
    by_part = {example.part: example.params for example in verb.EXAMPLES}
    assert all(params.grid.tolerance == 0.01 for params in by_part.values())
    phone = by_part["phone"]
    assert phone.grid.divisions == 12
    assert (phone.edges.smallest_levels, phone.edges.fillet_levels) == (6, 2)
    for params in by_part.values():
        assert params.normals.rule == "paper" and params.edges.rule == "levels"
        assert not params.cleaning.enabled and not params.regions.assign_edges
        assert params.grid.min_cell == 0.0


def test_examples_share_what_needs_no_choice_per_part() -> None:
    shared = {
        (e.params.regions.homogeneity, e.params.regions.min_points, e.params.grid.tolerance)
        for e in verb.EXAMPLES
    }
    assert shared == {(math.radians(3.5), 500, 0.01)}


def test_tables_hold_both_figures_and_every_reason() -> None:
    sweep = [
        {"tolerance": t, "iterations_paper": n, "iterations_here": 70 + n, "levels_here": 80 + n}
        for t, n in verb.TOLERANCES.items()
    ]
    text = verb.comparison([_row(example) for example in verb.EXAMPLES], sweep)
    lines = text.splitlines()
    assert max(map(len, lines)) <= 120
    block = next(line for line in lines if line.startswith("Test block (Fig. 11)"))
    assert block.split()[4:] == ["92000", "92000", "11", "11", "32", "0.012", "40", "0.034"]
    for row in sweep:
        values = [row["iterations_paper"], row["iterations_here"], row["levels_here"]]
        assert [f"{row['tolerance']:g}", *map(str, values)] in [line.split() for line in lines]
    flowing = " ".join(text.split())
    for reason in (*verb.COMMON_REASONS, *(r for e in verb.EXAMPLES for r in e.reasons)):
        assert reason in flowing
    assert verb.COUNTING in flowing and "published" in flowing


def test_another_count_is_a_failure(
    octoseg, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = dataclasses.replace(verb.EXAMPLES[0], patches=3)
    monkeypatch.setattr(verb, "EXAMPLES", (wrong,))
    outcome = octoseg("paper", "-o", tmp_path / "redone")
    assert outcome.code == 1
    assert "two-planes" in outcome.complaint
    assert (tmp_path / "redone" / "two-planes.mcap").exists(), "there is something to look at"


@pytest.mark.slow
def test_examples_come_out_as_published(octoseg, tmp_path: Path) -> None:
    from octoseg_ti import files

    folder = tmp_path / "redone"
    outcome = octoseg("paper", "-o", folder, "--json")
    assert outcome.code == 0, outcome.err
    figures = json.loads(outcome.out)
    assert [row["patches"]["here"] for row in figures["examples"]] == [2, 11, 32]
    for row in figures["examples"]:
        assert row["points"]["here"] == row["points"]["paper"]
        assert row["hoover"]["correct"] == row["patches"]["paper"]
        assert sum(row["hoover"].values()) == row["hoover"]["correct"]
        assert sum(size["points"] for size in row["points_by_size"]) == row["points"]["here"]
        assert len(row["points_by_size"]) == row["levels"]["here"]
        truth = files.read_truth(folder / f"{row['part']}.mcap")
        assert truth is not None and truth.patch_count == row["patches"]["paper"]
        assert (folder / row["part"] / "report.html").stat().st_size > 10_000
    counted = [row["iterations_here"] for row in figures["test_block_tolerances"]]
    assert counted[0] == 1, "no deviation of unit normals is above 1"
    assert counted == sorted(set(counted)), "the finer the tolerance the more iterations"
    assert "Table 1" in (folder / "table1.md").read_text(encoding="utf-8")
