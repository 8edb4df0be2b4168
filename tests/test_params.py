"""Parameters go to plain values and back, and unknown ones are named."""

import json
import math

import numpy as np
import pytest

from octoseg_ti.params import PRESETS, GridParams, NormalParams, Params, SurfaceParams, paper


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


@pytest.mark.parametrize(
    ("section", "values", "message"),
    [
        (SurfaceParams, {"noise": -0.1}, "SurfaceParams: noise must be at least 0, not -0.1"),
        (SurfaceParams, {"tilt": 0.0}, "tilt must be above 0, not 0.0"),
        (SurfaceParams, {"min_points": "many"}, "min_points must be at least 0, not 'many'"),
        (GridParams, {"tolerance": 1.5}, r"tolerance must be 0\.\.1, not 1.5"),
        (GridParams, {"divisions": 0}, "divisions must be at least 1, not 0"),
        (NormalParams, {"gap": math.nan}, "NormalParams: gap must be at least 0, not nan"),
        (NormalParams, {"neighbors": 2}, "neighbors must be at least 3, not 2"),
    ],
)
def test_numbers_outside_their_ranges_are_refused(
    section: type, values: dict, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        section(**values)


def test_numbers_of_every_kind_and_the_ends_of_ranges_are_taken() -> None:
    assert GridParams(tolerance=np.float32(1.0), divisions=np.int64(1)).divisions == 1
    assert GridParams(tolerance=0, min_cell=math.inf).tolerance == 0
    assert NormalParams(gap=None, neighbors=3).neighbors == 3
