"""What every test may use: the arch, the shared data, small seeded clouds."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from octoseg_ti.types import Scans, Truth

ROOT = Path(__file__).resolve().parent.parent


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that choose where kernels run."""
    parser.addoption("--arch", default="cpu", help="arch of the kernels: cpu, cuda, vulkan, metal")
    parser.addoption(
        "--check-bounds", action="store_true", help="check every index in kernels (slow, CPU only)"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Start Taichi now when it is to run otherwise than by default; else the first kernel does."""
    arch, debug = config.getoption("--arch"), config.getoption("--check-bounds")
    if arch != "cpu" or debug:
        from octoseg_ti.device import runtime

        runtime.start(arch, debug=debug)


@pytest.fixture(scope="session")
def runtime() -> Any:
    """The started runtime."""
    from octoseg_ti.device import runtime

    runtime.ensure_started()
    return runtime


@pytest.fixture(scope="session")
def arch(request: pytest.FixtureRequest) -> str:
    """The arch under test."""
    return str(request.config.getoption("--arch"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of the shared data; tests that need it skip where it is absent."""
    named = os.environ.get("OCTOSEG_SHARED")
    folder = Path(named) if named else ROOT.parent / "shared"
    folder = folder / "data" if (folder / "data").is_dir() else folder
    if not (folder / "proper_test.npz").is_file():
        pytest.skip(f"no shared data in {folder}")
    return folder


@pytest.fixture(scope="session")
def tent() -> tuple[Scans, Truth]:
    """Two planes that meet in a ridge, noise-free, with truth."""
    from reference.tent import make_tent

    return make_tent()


@pytest.fixture(scope="session")
def noisy_tent() -> tuple[Scans, Truth]:
    """The same with 0.01 mm noise."""
    from reference.tent import make_tent

    return make_tent(noise=0.01)
