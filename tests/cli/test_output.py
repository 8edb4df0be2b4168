"""Tables, trees and JSON are what people and programs can read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from octoseg_ti.cli.output import out_json, plain, size_of, table, tree


def test_table_aligns() -> None:
    text = table(["name", "x"], [["a", 1.5], ["longer", None], ["n", float("nan")]])
    assert text.splitlines() == [
        "name      x",
        "------  ---",
        "a       1.5",
        "longer    -",
        "n         -",
    ]


def test_tree_nests() -> None:
    text = tree({"a": 1, "b": {"c": "x"}, "d": [{"k": 1, "l": 2}], "e": [1, 2]})
    assert text.splitlines() == [
        "a: 1",
        "b:",
        "  c: x",
        "d:",
        "  k  l",
        "  -  -",
        "  1  2",
        "e: 1, 2",
    ]


def test_json_of_numpy_and_infinities(capsys) -> None:
    out_json({"a": np.int32(3), "b": np.array([1.0, np.nan]), "c": Path("x"), 4: float("inf")})
    assert json.loads(capsys.readouterr().out) == {"a": 3, "b": [1.0, None], "c": "x", "4": None}


@given(
    st.recursive(
        # No subnormal numbers: where Taichi runs, the processor takes them for zero.
        st.none() | st.booleans() | st.integers() | st.floats(allow_subnormal=False) | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
)
def test_plain_is_always_strict_json(values: object) -> None:
    assert json.loads(json.dumps(plain(values), allow_nan=False)) == plain(values)


def test_sizes(tmp_path: Path) -> None:
    path = tmp_path / "a"
    for size, text in ((0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (2_500_000, "2.5 MB")):
        path.write_bytes(b"x" * size)
        assert size_of(path) == text


def test_lines() -> None:
    import pytest

    from octoseg_ti.cli import UsageError
    from octoseg_ti.cli.play import parse_lines

    assert parse_lines(None) is None
    assert parse_lines("3:9") == (3, 9)
    assert parse_lines(":9") == (0, 9)
    assert parse_lines("3:") == (3, None)
    for text in ("", "5", "9:3", "-1:4", "a:b", "1:2:3"):
        with pytest.raises(UsageError, match="--lines"):
            parse_lines(text)
