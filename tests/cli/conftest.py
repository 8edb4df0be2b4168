"""How tests call the command line: in this process, or as a real one."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest


@dataclass(frozen=True)
class Outcome:
    """What a call of the command line left behind."""

    code: int
    out: str
    err: str

    @property
    def complaint(self) -> str:
        """The one line on stderr; fails when there is another number of lines."""
        lines = self.err.splitlines()
        assert len(lines) == 1, f"wanted one line on stderr, got {len(lines)}:\n{self.err}"
        assert lines[0].startswith("octoseg: ")
        assert "Traceback" not in self.err
        assert "this is a bug" not in self.err, lines[0]
        return lines[0]


@pytest.fixture
def octoseg(capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Call the command line in this process."""
    from octoseg_ti.cli import main

    def call(*arguments: Any) -> Outcome:
        capsys.readouterr()
        code = main([str(a) for a in arguments])
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return call


def run_process(*arguments: Any, cwd: Path | None = None) -> Outcome:
    """Call the command line as a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "octoseg_ti", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=120,
    )
    return Outcome(done.returncode, done.stdout, done.stderr)
