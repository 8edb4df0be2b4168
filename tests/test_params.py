"""Parameters go to plain values and back, and unknown ones are named."""

import json

import pytest

from octoseg_ti.params import PRESETS, GridParams, Params, paper


@pytest.mark.parametrize("preset", PRESETS)
def test_round_trip_through_json(preset: str) -> None:
    params = PRESETS[preset]()
    assert Params.from_dict(json.loads(json.dumps(params.to_dict()))) == params


def test_missing_sections_and_keys_keep_their_defaults() -> None:
    assert Params.from_dict({}) == Params()
    assert Params.from_dict({"grid": {"tolerance": 0.2}}) == Params(grid=GridParams(tolerance=0.2))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"grids": {}},
            "unknown parameter section 'grids'; known: cleaning, normals, registration, grid",
        ),
        ({"grid": {"tolerence": 1}}, "unknown parameter grid.tolerence; known: .*tolerance"),
    ],
)
def test_unknown_names_are_refused(values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Params.from_dict(values)


def test_the_paper_is_literal() -> None:
    params = paper(divisions=9, tolerance=0.5, smallest_levels=6, fillet_levels=2)
    assert (params.grid.divisions, params.grid.tolerance, params.grid.min_cell) == (9, 0.5, 0.0)
    assert params.grid.min_points == 2  # until a cell holds one point
    assert params.normals.rule == "paper" and params.normals.weight == "unit"
    assert (params.edges.rule, params.edges.smallest_levels, params.edges.fillet_levels) == (
        "levels", 6, 2,
    )  # fmt: skip
    assert not params.regions.assign_edges and not params.cleaning.enabled
