"""Every file of both packages keeps the conventions, and the checker would notice if not."""

import shutil
import subprocess
from pathlib import Path

import pytest
from conventions import findings

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted(
    path.relative_to(ROOT).as_posix()
    for package in ("octoseg_ti", "scanner_sim")
    for path in (ROOT / package).rglob("*.py")
)

GOOD = '''
"""Adds one."""

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F64Array, ti


@ti.func
def _one() -> ti.f64:
    """Return one."""
    return 1.0


@ti.kernel
def _add(
    n: ti.i32,
    # In:
    x_in: F64Array,
    # Out:
    y_out: F64Array,
):
    """Write x + 1."""
    for i in range(n):
        y_out[i] = x_in[i] + _one()


def add(x):
    """Return x + 1."""
    runtime.ensure_started()
    y = runtime.empty(len(x), float)
    _add(len(x), x, y)
    return y
'''

# What is changed in the good sample -> what the checker has to say.
BREACHES = {
    "future": (('"""Adds one."""', '"""A."""\nfrom __future__ import annotations'), "__future__"),
    "taichi": (
        ("from octoseg_ti.device.runtime import F64Array, ti", "import taichi as ti"),
        "tak",
    ),
    "init": (("runtime.ensure_started()", "runtime.ensure_started(); ti.init()"), "ti.init"),
    "field": (("runtime.ensure_started()", "runtime.ensure_started(); ti.field(int)"), "ti.field"),
    "public": (("def _add(", "def add_one("), "starts with _"),
    "docstring": (('    """Write x + 1."""\n', ""), "no docstring"),
    "func docstring": (('    """Return one."""\n', ""), "no docstring"),
    "module docstring": (('"""Adds one."""\n', ""), "no module docstring"),
    "annotation": (("n: ti.i32", "n"), "no annotation"),
    "call as type": (("x_in: F64Array", "x_in: ti.types.ndarray(ti.f64, ndim=1)"), "alias"),
    "suffix": (("x_in", "x"), "ends in _in"),
    "scalar suffix": (("n: ti.i32", "n_in: ti.i32"), "for arrays"),
    "no In": (("    # In:\n", ""), "no group # In:"),
    "no Out": (("    # Out:\n", ""), "no group # Out:"),
    "order": (("    y_out: F64Array,\n", "    y_out: F64Array,\n    k: ti.i32,\n"), "after # Out:"),
    "default": (("    y_out: F64Array,\n", "    y_out: F64Array = None,\n"), "defaults"),
    "augmented sum": (("y_out[i] = x_in[i] + _one()", "y_out[0] += x_in[i]"), "atomic sum"),
    "atomic": (("y_out[i] = x_in[i] + _one()", "ti.atomic_add(y_out[0], x_in[i])"), "atomic sum"),
    "not started": (("    runtime.ensure_started()\n", ""), "ensure_started"),
    "print": (("    return y\n", "    print(y)\n    return y\n"), "print()"),
    "star": (("from octoseg_ti.device import runtime", "from os import *"), "star import"),
    "optional": (("from octoseg_ti.device import runtime", "import laspy"), "laspy"),
    "many parameters": (
        ("    n: ti.i32,\n", "".join(f"    n{k}: ti.i32,\n" for k in range(11))),
        "13 parameters",
    ),
    "long kernel": (
        (
            "        y_out[i] = x_in[i]",
            "        y_out[i] = 0.0\n" * 55 + "        y_out[i] = x_in[i]",
        ),
        "at most 60",
    ),
}


@pytest.mark.parametrize("path", SOURCES)
def test_source_keeps_the_conventions(path: str) -> None:
    assert findings((ROOT / path).read_text(encoding="utf-8"), path) == []


def test_sources_are_found() -> None:
    assert "octoseg_ti/device/runtime.py" in SOURCES
    assert "scanner_sim/__init__.py" in SOURCES


def test_good_sample_has_no_findings() -> None:
    assert findings(GOOD, "octoseg_ti/stages/good.py") == []


@pytest.mark.parametrize("name", BREACHES)
def test_breach_is_found(name: str) -> None:
    (old, new), message = BREACHES[name]
    assert old in GOOD
    found = findings(GOOD.replace(old, new), "octoseg_ti/stages/bad.py")
    assert any(message in line for line in found), found


def test_nested_kernel_is_found() -> None:
    nested = "\n".join(f"    {line}" if line else "" for line in GOOD.splitlines()[13:25])
    source = GOOD + "\n\ndef make():\n" + '    """Make."""\n' + nested
    assert any("module level" in line for line in findings(source, "octoseg_ti/stages/bad.py"))


def test_long_file_and_empty_name_are_found() -> None:
    source = '"""Doc."""\n' + "x = 1\n" * 460
    found = findings(source, "octoseg_ti/stages/utils.py")
    assert any("450 lines" in line for line in found)
    assert any("concern" in line for line in found)


def test_the_command_line_may_print() -> None:
    assert findings('"""Doc."""\nprint(1)\n', "octoseg_ti/cli/output.py") == []


def test_the_front_page_holds_only_what_belongs_there() -> None:
    """The packages, tests and recordings, and what describes them: nothing is left lying about."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a checkout")
    listed = ["git", "-c", f"safe.directory={ROOT}", "ls-files"]
    done = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True)
    top = {name.split("/")[0] for name in done.stdout.splitlines()}
    assert top <= {
        ".ci", ".gitignore", "LICENSE", "README.md", "pyproject.toml",
        "octoseg_ti", "scanner_sim", "tests", "recordings",
    }  # fmt: skip
