"""Bad input is exit code 1 and one line that names the file; no output is half-written."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, tent) -> Path:
    """A whole recording with truth."""
    from octoseg_ti import files

    path = tmp_path_factory.mktemp("recording") / "tent.mcap"
    files.write(path, tent[0], truth=tent[1])
    return path


def _npz(path: Path, **arrays: object) -> Path:
    np.savez(path, **arrays)  # type: ignore[arg-type]
    return path


def _grid(side: int = 40) -> np.ndarray:
    x, y = (a.ravel() for a in np.mgrid[0:side, 0:side])
    return np.column_stack((0.5 * x, 0.5 * y, np.zeros(x.size)))


def _refused(octoseg, source: Path, folder: Path, *wanted: str) -> None:
    """Check that segmenting the file fails with one good line and leaves nothing behind."""
    before = sorted(folder.iterdir())
    outcome = octoseg("segment", source, "-o", folder / "out.mcap", "-o", folder / "out.ply")
    assert outcome.code == 1, outcome.out + outcome.err
    assert outcome.out == ""
    assert source.name in outcome.complaint
    for part in wanted:
        assert part in outcome.complaint
    assert sorted(folder.iterdir()) == before


def test_missing_file(octoseg, tmp_path: Path) -> None:
    (tmp_path / "scan.npz").touch()
    _refused(octoseg, tmp_path / "scna.npz", tmp_path, "no such file", "did you mean 'scan.npz'")


def test_folder(octoseg, tmp_path: Path) -> None:
    (tmp_path / "scan.npz").mkdir()
    _refused(octoseg, tmp_path / "scan.npz", tmp_path, "folder")


@pytest.mark.parametrize("verb", ["info", "check", "evaluate", "profile", "play"])
def test_missing_file_for_every_reading_verb(octoseg, tmp_path: Path, verb: str) -> None:
    outcome = octoseg(verb, tmp_path / "none.mcap")
    assert outcome.code == 1
    assert "none.mcap: no such file" in outcome.complaint


@pytest.mark.parametrize("suffix", [".mcap", ".npz", ".ply", ".pcd", ".xyz", ".las", ".e57"])
@pytest.mark.parametrize("content", [b"", b"this is not what its name says\n" * 9, os.urandom(999)])
def test_not_what_its_suffix_says(octoseg, tmp_path: Path, suffix: str, content: bytes) -> None:
    source = tmp_path / f"scan{suffix}"
    source.write_bytes(content)
    _refused(octoseg, source, tmp_path)


def test_unknown_input_suffix(octoseg, tmp_path: Path) -> None:
    source = tmp_path / "scan.docx"
    source.write_bytes(b"x")
    _refused(octoseg, source, tmp_path, ".docx", ".mcap")


@pytest.mark.parametrize("keep", [0.02, 0.3, 0.7, 0.98, 0.9999])
def test_truncated_recording(octoseg, tmp_path: Path, recording: Path, keep: float) -> None:
    whole = recording.read_bytes()
    source = tmp_path / "cut.mcap"
    source.write_bytes(whole[: int(len(whole) * keep)])
    _refused(octoseg, source, tmp_path)
    outcome = octoseg("check", source)
    assert outcome.code == 1
    assert "cut.mcap" in outcome.complaint
    assert octoseg("info", source).code in (0, 1)


def test_flipped_bits(octoseg, tmp_path: Path, recording: Path) -> None:
    damaged = bytearray(recording.read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    source = tmp_path / "flipped.mcap"
    source.write_bytes(bytes(damaged))
    _refused(octoseg, source, tmp_path)


def test_empty_cloud(octoseg, tmp_path: Path) -> None:
    source = _npz(tmp_path / "empty.npz", points=np.zeros((0, 3)))
    _refused(octoseg, source, tmp_path, "no points")


@pytest.mark.parametrize(
    "arrays",
    [
        {"points": np.zeros((5, 2))},
        {"points": np.zeros(15)},
        {"points": np.full((5, 3), "a")},
        {"points": _grid(), "stripe": np.zeros(3, np.int32)},
        {"points": _grid(), "normals": np.zeros((7, 3))},
        {"points": _grid(), "view": np.zeros(7, np.int32)},
        {"points": _grid(), "T_world_view": np.eye(3)},
        {"wrong": _grid()},
    ],
)
def test_wrong_shapes(octoseg, tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    _refused(octoseg, _npz(tmp_path / "scan.npz", **arrays), tmp_path)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1, 3)),
        np.zeros((50, 3)),
        np.linspace(0, 1, 300).reshape(-1, 1) * [1.0, 2.0, 3.0],
        np.full((20, 3), np.nan),
    ],
    ids=["one", "equal", "collinear", "nan"],
)
def test_degenerate_clouds_give_an_answer_or_a_clear_error(
    octoseg, tmp_path: Path, points: np.ndarray
) -> None:
    source = _npz(tmp_path / "scan.npz", points=points)
    outcome = octoseg("segment", source, "-o", tmp_path / "out.npz")
    assert outcome.code in (0, 1)
    if outcome.code == 1:
        assert "scan.npz" in outcome.complaint or outcome.complaint
        assert not (tmp_path / "out.npz").exists()
    else:
        assert outcome.err == ""
        labels = np.load(tmp_path / "out.npz")["labels"]
        assert labels.shape == (len(points),)
        assert (labels == -1).all()


def test_nan_rows_keep_their_place_and_get_no_label(octoseg, tmp_path: Path) -> None:
    points = _grid()
    points[[0, 17, 400]] = np.nan, np.inf, -np.inf
    source = _npz(tmp_path / "scan.npz", points=points)
    outcome = octoseg("segment", source, "-o", tmp_path / "out.npz")
    assert outcome.code == 0, outcome.err
    labels = np.load(tmp_path / "out.npz")["labels"]
    assert labels.shape == (len(points),)
    assert (labels[[0, 17, 400]] == -1).all()
    assert (labels >= 0).mean() > 0.5


def test_missing_output_folder(octoseg, tmp_path: Path, recording: Path) -> None:
    outcome = octoseg("segment", recording, "-o", tmp_path / "none" / "out.mcap")
    assert outcome.code == 1
    assert "folder does not exist" in outcome.complaint


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_folder(octoseg, tmp_path: Path, recording: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o500)
    outcome = octoseg("segment", recording, "-o", folder / "out.mcap")
    assert outcome.code == 1
    assert "not writable" in outcome.complaint
    outcome = octoseg("demo", "-o", folder)
    assert outcome.code == 1


def test_output_is_a_folder(octoseg, tmp_path: Path, recording: Path) -> None:
    (tmp_path / "out.mcap").mkdir()
    outcome = octoseg("segment", recording, "-o", tmp_path / "out.mcap")
    assert outcome.code == 1
    assert "is a folder" in outcome.complaint


def test_folder_of_the_demo_is_a_file(octoseg, tmp_path: Path) -> None:
    (tmp_path / "demo").touch()
    outcome = octoseg("demo", "-o", tmp_path / "demo")
    assert outcome.code == 1
    assert "is a file" in outcome.complaint


@pytest.mark.parametrize(
    ("error", "wanted"),
    [
        (OSError(28, "No space left on device", "out.mcap"), "out.mcap: No space left on device"),
        (MemoryError(), "not enough memory"),
        (KeyboardInterrupt(), "interrupted"),
    ],
)
def test_failing_write_leaves_the_old_file(
    octoseg, tmp_path: Path, recording: Path, monkeypatch, error: BaseException, wanted: str
) -> None:
    from octoseg_ti import files

    old = tmp_path / "out.mcap"
    old.write_bytes(b"old")

    def fail(*_args: object, **_options: object) -> None:
        raise error

    monkeypatch.setattr(files, "write", fail)
    outcome = octoseg("segment", recording, "-o", old)
    assert outcome.code == (130 if isinstance(error, KeyboardInterrupt) else 1)
    assert wanted in outcome.complaint
    assert old.read_bytes() == b"old"


def test_missing_package_names_its_install_command(
    octoseg, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "laspy", None)
    source = tmp_path / "scan.las"
    source.write_bytes(b"LASF")
    outcome = octoseg("segment", source, "-o", tmp_path / "out.npz")
    assert outcome.code == 1
    assert "octoseg[las]" in outcome.complaint


def test_a_bug_is_called_a_bug(
    octoseg, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from octoseg_ti import files

    def broken(*_args: object, **_options: object) -> None:
        raise KeyError("no such thing")

    monkeypatch.setattr(files, "read_with_truth", broken)
    outcome = octoseg("segment", recording, "-o", tmp_path / "out.npz")
    assert outcome.code == 1
    assert "this is a bug" in outcome.err
    assert "Traceback" not in outcome.err
    monkeypatch.setenv("OCTOSEG_TRACEBACK", "1")
    assert "Traceback" in octoseg("segment", recording, "-o", tmp_path / "out.npz").err


def test_truth_of_another_scan_is_refused(octoseg, tmp_path: Path, recording: Path) -> None:
    source = _npz(tmp_path / "other.npz", points=_grid())
    outcome = octoseg("evaluate", source, "--truth", recording, "--quiet")
    assert outcome.code == 1
    assert "same scan" in outcome.complaint


def test_evaluate_without_truth(octoseg, tmp_path: Path) -> None:
    source = _npz(tmp_path / "plain.npz", points=_grid())
    outcome = octoseg("evaluate", source)
    assert outcome.code == 1
    assert "no truth" in outcome.complaint
    assert "--truth" in outcome.complaint


def test_play_without_stripes(octoseg, tmp_path: Path) -> None:
    source = _npz(tmp_path / "plain.npz", points=_grid())
    outcome = octoseg("play", source, "--headless")
    assert outcome.code == 1
    assert "no stripes" in outcome.complaint
