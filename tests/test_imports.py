"""Importing the packages stays cheap: nothing heavy or optional comes with them."""

import json
import subprocess
import sys

import pytest

HEAVY = [
    "PIL", "foxglove_schemas_protobuf", "google.protobuf", "laspy", "mcap", "mcap_protobuf",
    "plyfile", "pye57", "pyarrow", "rerun", "rich", "scipy", "small_gicp",
    "taichi", "tyro",
]  # fmt: skip


def _loaded(code: str) -> list[str]:
    """Return which heavy modules a fresh interpreter holds after running the code."""
    report = f"import json, sys; print(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(
    "code",
    [
        "import octoseg_ti",
        "import scanner_sim",
        "from octoseg_ti import Params, Scans, Segmentation, Truth, SurfaceKind, EdgeClass",
        "import octoseg_ti.cli",
        "from octoseg_ti.cli import main\nmain(['--help'])",
        "from octoseg_ti.cli import main\nmain(['--version'])",
    ],
)
def test_import_loads_nothing_heavy(code: str) -> None:
    assert _loaded(code) == []


def test_the_check_sees_a_heavy_import() -> None:
    assert _loaded("import tyro") == ["tyro"]


def test_public_names_resolve() -> None:
    import octoseg_ti

    for name in octoseg_ti.__all__:
        assert getattr(octoseg_ti, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = octoseg_ti.nonsense
