"""Options that many verbs share, and what they do."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from octoseg_ti.cli import Failure, UsageError, suggest
from octoseg_ti.errors import DataError

OUTPUT_SUFFIXES = (".mcap", ".npz", ".ply", ".pcd", ".xyz", ".rrd")


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """Where the work runs."""

    arch: Literal["cpu", "cuda", "vulkan", "metal"] = "cpu"
    """Backend of the kernels. One that this machine lacks is an error, never replaced."""
    threads: int | None = None
    """Threads of the cpu backend; default: every core."""

    def start(self, *, profile: bool = False) -> None:
        """Start Taichi as asked; with every option at its default the first kernel does.

        Raises:
            UsageError: The number of threads is below 1.
            Failure: The arch is not available here.
        """
        if self.threads is not None and self.threads < 1:
            raise UsageError(f"--threads must be at least 1, not {self.threads}")
        if self.arch == "cpu" and self.threads is None and not profile:
            return
        from octoseg_ti.device import runtime

        try:
            runtime.start(self.arch, threads=self.threads, profile=profile)
        except RuntimeError as error:
            raise Failure(str(error)) from error


def check_inputs(paths: Iterable[Path]) -> None:
    """Refuse inputs that are not there before any work starts.

    Raises:
        DataError: A path is missing, or a folder.
    """
    for path in paths:
        if path.is_dir():
            raise DataError("is a folder, not a file", path=path)
        if not path.exists():
            beside = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
            raise DataError(f"no such file{suggest(path.name, beside)}", path=path)


def check_outputs(paths: Iterable[Path], suffixes: tuple[str, ...] = OUTPUT_SUFFIXES) -> None:
    """Refuse outputs that cannot be written before any work starts.

    Raises:
        UsageError: A suffix that names no format.
        DataError: A folder that is missing or not writable.
    """
    for path in paths:
        if path.suffix.lower() not in suffixes:
            known = ", ".join(suffixes)
            raise UsageError(f"{path}: unknown suffix {path.suffix!r}; outputs are {known}")
        if path.is_dir():
            raise DataError("is a folder, not a file", path=path)
        if not path.parent.is_dir():
            raise DataError("its folder does not exist", path=path, hint="create it first")
        if not os.access(path.parent, os.W_OK):
            raise DataError("its folder is not writable", path=path, hint="choose another folder")


def make_folder(folder: Path) -> None:
    """Create the folder of the outputs.

    Raises:
        DataError: It cannot be created or written.
    """
    if folder.exists() and not folder.is_dir():
        raise DataError("is a file, not a folder", path=folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cannot be created ({error.strerror})", path=folder) from error
    if not os.access(folder, os.W_OK):
        raise DataError("is not writable", path=folder, hint="choose another folder")


def need_display(instead: str) -> None:
    """Refuse to start a viewer where none can be seen.

    Args:
        instead: What the user can do.

    Raises:
        Failure: There is no display.
    """
    linux = sys.platform.startswith("linux")
    if linux and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise Failure(f"no display for the Rerun viewer; {instead}")
