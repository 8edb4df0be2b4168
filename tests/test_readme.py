"""The README keeps to the program: its verbs, its parts, its Python program."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from octoseg_ti.cli import VERBS

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_two_commands_come_first() -> None:
    lines = README.splitlines()
    assert lines[2:4] == [
        "    pip install . && octoseg demo",
        "    pip install '.[test]' && pytest",
    ]


def test_every_verb_is_named_and_no_other() -> None:
    named = set(re.findall(r"`octoseg ([a-z]+)", README))
    assert named == set(VERBS)


def test_parts_are_those_of_the_simulator() -> None:
    from scanner_sim import blocks

    for part in blocks.PARTS:
        assert f"`{part}`" in README


def test_program_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = re.search(r"```python\n(from octoseg_ti.*?)```", README, re.DOTALL)
    assert program is not None
    monkeypatch.chdir(tmp_path)
    exec(compile(program[1], "README.md", "exec"), {})
    assert (tmp_path / "result.ply").stat().st_size > 10_000


def test_ci_checks_the_outputs_of_the_demo() -> None:
    from octoseg_ti.cli.demo import OUTPUTS

    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for name in (*OUTPUTS, "report.html", "report.md"):
        assert name in script
