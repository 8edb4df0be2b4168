"""Taichi starts once, late, on the arch that was asked for, and not at all otherwise."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from octoseg_ti.device import runtime

ROOT = Path(__file__).resolve().parents[2]


def run(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=env, timeout=120
    )


def test_importing_starts_nothing() -> None:
    done = run(
        "from octoseg_ti.device import runtime; import octoseg_ti.pipeline\n"
        "assert runtime.running() is None\n"
        "options = runtime.ensure_started()\n"
        "assert runtime.running() is options and options.arch == 'cpu', options\n"
        "assert options is runtime.ensure_started() and runtime.on_cpu()\n"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""  # no banner


def test_a_process_has_one_runtime() -> None:
    done = run(
        "from octoseg_ti.device import runtime\n"
        "first = runtime.start('cpu', threads=1)\n"
        "assert runtime.start('cpu', threads=1) == first\n"
        "try:\n    runtime.start('cpu', threads=2)\n"
        "except RuntimeError as error:\n    print(error)\n"
    )
    assert done.returncode == 0, done.stderr
    assert "already runs" in done.stdout and "threads=1" in done.stdout


def test_an_arch_that_is_not_there_is_an_error_not_the_cpu() -> None:
    done = run(
        "from octoseg_ti.device import runtime\n"
        "try:\n    runtime.start('metal')\n"
        "except RuntimeError as error:\n    print(error)\n"
        "assert runtime.running() is None\n"
    )
    if sys.platform == "darwin":
        pytest.skip("Metal is there")
    assert done.returncode == 0, done.stderr
    assert "arch 'metal' is not available on this machine: use --arch cpu" in done.stdout


def test_the_environment_does_not_overrule_the_arch() -> None:
    done = run(
        "import os\nfrom octoseg_ti.device import runtime\n"
        "runtime.start('cpu')\n"
        "arch = str(runtime.ti.lang.impl.current_cfg().arch)\n"
        "print(arch, os.environ['TI_ARCH'])\n",
        TI_ARCH="opengl",
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[0] in ("Arch.x64", "Arch.arm64")
    assert done.stdout.split()[1] == "opengl"  # left as it was


def test_the_cache_can_be_moved(tmp_path: Path) -> None:
    done = run(
        "from octoseg_ti.device import runtime\n"
        "import numpy as np\nfrom octoseg_ti.stages.registration import to_world\n"
        "to_world(np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3, np.int32), np.eye(4)[None])\n"
        "print(runtime.cache_folder())\n",
        OCTOSEG_CACHE=str(tmp_path / "kernels"),
    )
    assert done.returncode == 0, done.stderr
    folder = Path(done.stdout.strip())
    assert folder.parent == tmp_path / "kernels" and folder.name.startswith("taichi-1.7")
    assert any(folder.rglob("*.tic"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(("opengl",), "arch must be one of cpu, cuda, vulkan, metal"), (("cpu", 0), "at least 1")],
)
def test_wrong_options_are_refused(arguments: tuple, message: str) -> None:
    arch, *threads = arguments
    with pytest.raises(ValueError, match=message):
        runtime.start(arch, threads=threads[0] if threads else None)


def test_fast_math_is_off_and_reals_are_double() -> None:
    runtime.ensure_started()
    config = runtime.ti.lang.impl.current_cfg()
    assert not config.fast_math
    assert config.default_fp == runtime.ti.f64


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32, np.int64])
def test_arrays_come_and_go(dtype: type) -> None:
    runtime.ensure_started()
    rng = np.random.default_rng(1)
    host = (1000 * rng.standard_normal((50, 3))).astype(dtype)
    np.testing.assert_array_equal(runtime.download(runtime.upload(host)), host)
    strided = host[::2]
    np.testing.assert_array_equal(runtime.download(runtime.upload(strided)), strided)
    zeros = runtime.download(runtime.zeros((4, 2), dtype))
    assert zeros.dtype == dtype and not zeros.any()
    assert runtime.download(runtime.empty(5, dtype)).shape == (5,)
    larger = runtime.download(runtime.grown(runtime.upload(host), 80))
    assert larger.shape == (80, 3) and larger.dtype == dtype
    np.testing.assert_array_equal(larger[:50], host)


def test_workers_do_not_depend_on_the_threads() -> None:
    counts = {
        run(
            "from octoseg_ti.device import runtime\n"
            f"runtime.start('cpu', threads={threads})\nprint(runtime.workers())\n"
        ).stdout
        for threads in (1, 3)
    }
    assert len(counts) == 1 and counts != {""}


@pytest.mark.parametrize(("items", "stride"), [(0, 16384), (1, 16384), (32, 512), (20_000, 1)])
def test_few_items_are_shared_between_threads_too(items: int, stride: int) -> None:
    runtime.ensure_started()
    if runtime.on_cpu():
        assert runtime.stride_of(items) == stride
    assert runtime.stride_of(items) >= 1
