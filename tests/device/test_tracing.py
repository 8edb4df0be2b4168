"""The cheaper translation reads the same sources, and Taichi asks nobody."""

import importlib
import inspect
import pkgutil
import subprocess
import sys

import pytest

import octoseg_ti.device
import octoseg_ti.stages
import scanner_sim
from octoseg_ti.device import tracing


def functions() -> list:
    """Return every function that stands at the top of a module with kernels."""
    found = []
    for package in (octoseg_ti.device, octoseg_ti.stages, scanner_sim):
        for info in pkgutil.iter_modules(package.__path__):
            module = importlib.import_module(f"{package.__name__}.{info.name}")
            found += [
                function
                for function in vars(module).values()
                if inspect.isfunction(function) and function.__module__ == module.__name__
            ]
    return [inspect.unwrap(function) for function in found]


def test_sources_are_those_of_inspect():
    fast = tracing._source_lines(inspect.getsourcelines)
    assert len(functions()) > 100
    for function in functions():
        expected, first = inspect.getsourcelines(function)
        while not expected[-1].strip():
            expected.pop()
        assert fast(function) == (expected, first), function


def outer():
    def inner():
        return 1

    return inner


def test_what_is_not_plain_is_left_to_the_thorough_way():
    asked = []

    def thorough(function):
        asked.append(function)
        return inspect.getsourcelines(function)

    fast = tracing._source_lines(thorough)
    inner = outer()
    scope: dict = {}
    exec("def nowhere():\n    return 2\n", scope)
    assert fast(inner) == inspect.getsourcelines(inner)
    with pytest.raises(OSError, match="could not get source"):
        fast(scope["nowhere"])
    assert asked == [inner, scope["nowhere"]]


def test_frames_are_described_alike():
    frame = inspect.currentframe()
    assert frame is not None
    fast, thorough = tracing._frame_info(frame), inspect.getframeinfo(frame)
    assert (fast.filename, fast.function) == (thorough.filename, thorough.function)
    assert fast.code_context is not None and "tracing._frame_info(frame)" in fast.code_context[0]
    assert "tracing._frame_info(frame)" in thorough.code_context[0]


def test_taichi_asks_no_server():
    code = (
        "import sys, inspect; before = inspect.getframeinfo\n"
        "from octoseg_ti.device import runtime; runtime.start()\n"
        "assert inspect.getframeinfo is before\n"
        "print('urllib.request' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_kernels_run_again_after_a_new_start():
    code = (
        "import numpy as np\n"
        "from octoseg_ti import segment\n"
        "from octoseg_ti.device import runtime\n"
        "from scanner_sim import simulate, StripeScanner, blocks\n"
        "runtime.start(threads=1)\n"
        "scans, _ = simulate(blocks.two_planes(), StripeScanner(points=2000), seed=1)\n"
        "labels = [segment(scans).labels]\n"
        "for profile in (True, False):\n"
        "    runtime.restart(profile=profile)\n"
        "    labels.append(segment(scans).labels)\n"
        "assert all(np.array_equal(one, labels[0]) for one in labels)\n"
        "print(runtime.running())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "threads=1" in done.stdout and "profile=False" in done.stdout
