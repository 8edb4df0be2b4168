"""What only a real process shows: exit codes, closed pipes, Ctrl-C, profiles."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, tent) -> Path:
    from octoseg_ti import files

    path = tmp_path_factory.mktemp("recording") / "tent.mcap"
    files.write(path, tent[0], truth=tent[1])
    return path


def _run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "octoseg_ti", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_exit_codes_of_the_process(tmp_path: Path) -> None:
    assert _run("--version").returncode == 0
    assert _run("nonsense").returncode == 2
    done = _run("info", tmp_path / "none.mcap")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1


def test_the_quick_end_of_a_run_keeps_the_kernels(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OCTOSEG_CACHE", str(tmp_path / "kernels"))
    done = _run("segment", recording, "-o", tmp_path / "out.npz", "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert len(list((tmp_path / "kernels").rglob("*.tic"))) > 10
    assert (tmp_path / "out.npz").stat().st_size > 0


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
@pytest.mark.parametrize("reader", ["head -1", "true"])
def test_closed_pipe_is_quiet(recording: Path, reader: str) -> None:
    command = f"'{sys.executable}' -m octoseg_ti info '{recording}' --json | {reader}"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=60)
    assert done.stderr == ""
    assert done.returncode == 0


def test_closed_pipe_while_help_is_printed() -> None:
    command = f"'{sys.executable}' -m octoseg_ti segment --help | true"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=60)
    assert done.stderr == ""


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_interrupt_is_130_and_one_line(recording: Path, tmp_path: Path) -> None:
    # A shell that runs this in the background hides the signal from its children: restore it.
    code = (
        "import signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "print('ready', flush=True)\n"
        "from octoseg_ti.cli import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    target = tmp_path / "p.rrd"
    target.write_bytes(b"old")
    arguments = ["play", str(recording), "--rate", "0.05", "--save", str(target)]
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(3.0)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert err == "octoseg: interrupted\n"
    assert target.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["p.rrd"]


def test_profile_tables_and_trace(recording: Path, tmp_path: Path) -> None:
    trace = tmp_path / "trace.json"
    done = _run("profile", recording, "--repeat", 2, "--trace", trace, "--threads", 1)
    assert done.returncode == 0, done.stderr
    assert "least ms" in done.stdout and "first run ms" in done.stdout
    assert "launches/run" in done.stdout
    assert "cpu, 1 thread(s)" in done.stdout
    events = json.loads(trace.read_text())["traceEvents"]
    assert any(event.get("cat") == "stage" for event in events)
    done = _run("profile", recording, "--repeat", 1, "--json")
    figures = json.loads(done.stdout)
    assert figures["stages"][-1]["stage"] == "total"
    assert figures["machine"]["arch"] == "cpu"
    assert figures["kernels"]


def test_arch_that_is_not_there_is_one_line(recording: Path, tmp_path: Path) -> None:
    # Metal exists on Macs only, CUDA needs a driver: one of them is missing everywhere.
    arch = "cuda" if sys.platform == "darwin" else "metal"
    done = _run("segment", recording, "-o", tmp_path / "a.npz", "--arch", arch)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert f"{arch!r} is not available" in done.stderr
    assert not (tmp_path / "a.npz").exists()


def test_results_do_not_depend_on_the_number_of_threads(recording: Path, tmp_path: Path) -> None:
    import numpy as np

    for threads in (1, 2):
        target = tmp_path / f"t{threads}.npz"
        done = _run("segment", recording, "-o", target, "--threads", threads, "--quiet")
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    a, b = np.load(tmp_path / "t1.npz"), np.load(tmp_path / "t2.npz")
    for name in ("labels", "edge", "normals", "level"):
        np.testing.assert_array_equal(a[name], b[name])


def test_cache_of_kernels_can_be_moved(recording: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "OCTOSEG_CACHE": str(tmp_path / "kernels")}
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "octoseg_ti",
            "segment",
            recording,
            "-o",
            tmp_path / "a.npz",
            "--quiet",
        ],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert any((tmp_path / "kernels").rglob("*"))
