"""Input that no one wants: a right answer or one clear line, never a crash."""

from dataclasses import replace

import numpy as np
import pytest
from reference.tent import make_tent

from octoseg_ti import DataError, Params, Scans, Segmentation, paper, segment
from octoseg_ti.params import PRESETS, GridParams, SurfaceParams


def check(result: Segmentation, n: int) -> None:
    """Whatever the answer is, it has a row for every row of the input."""
    assert len(result.labels) == len(result.normals) == len(result.outlier) == n
    assert result.labels.max(initial=-1) == result.patch_count - 1
    assert np.all(result.labels[result.outlier == 1] == -1)
    assert str(result)


def cloud(kind: str) -> np.ndarray:
    rng = np.random.default_rng(3)
    return {
        "empty": np.zeros((0, 3)),
        "one": np.ones((1, 3)),
        "two": np.eye(3)[:2],
        "three": np.eye(3),
        "four": np.concatenate((np.eye(3), np.zeros((1, 3)))),
        "equal": np.full((100, 3), 7.5),
        "two places": np.repeat([[0.0, 0, 0], [1, 2, 3]], 50, axis=0),
        "collinear": np.outer(np.linspace(0, 5, 100), [1.0, 2.0, 3.0]),
        "collinear twice": np.repeat(np.outer(np.arange(50.0), [1.0, 0, 0]), 2, axis=0),
        "plane": np.column_stack((rng.uniform(0, 9, (300, 2)), np.zeros(300))),
        "plane twice": np.repeat(
            np.column_stack((rng.uniform(0, 9, (300, 2)), np.zeros(300))), 2, axis=0
        ),
        "all nan": np.full((50, 3), np.nan),
        "all inf": np.full((50, 3), np.inf),
        "two finite": np.concatenate((np.eye(3)[:2], np.full((50, 3), np.nan))),
        "far pair": np.concatenate((rng.uniform(0, 1, (200, 3)), [[1e9, 0, 0]])),
        "huge": rng.uniform(-1e150, 1e150, (100, 3)),
        "tiny": 1e-12 * rng.uniform(0, 1, (200, 3)),
        "needle": np.column_stack((np.linspace(0, 1e6, 500), 1e-6 * rng.random((500, 2)))),
        "blob": rng.standard_normal((400, 3)),
    }[kind]


ERRORS = {
    "empty": "there are no points",
    "one": "1 of 1 points can be used",
    "two": "2 of 2 points can be used",
    "equal": "all points coincide",
    "all nan": "0 of 50 points can be used",
    "all inf": "0 of 50 points can be used",
    "two finite": "2 of 52 points can be used",
}
FINE = ["three", "four", "plane", "collinear", "collinear twice", "plane twice", "blob", "tiny"]


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("kind", ERRORS)
def test_what_cannot_be_segmented_is_refused_in_one_line(kind: str, preset: str) -> None:
    with pytest.raises(DataError, match=ERRORS[kind]) as caught:
        segment(cloud(kind), preset=preset)
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("kind", FINE)
def test_meagre_clouds_get_an_answer(kind: str, preset: str) -> None:
    points = cloud(kind)
    check(segment(points, preset=preset), len(points))


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_two_places_have_no_spacing() -> None:
    points = cloud("two places")
    with pytest.raises(DataError, match=r"no spacing .*coincide.*grid.min_cell"):
        segment(points)
    given = Params(grid=GridParams(min_cell=0.5))
    check(segment(points, given), 100)
    check(segment(points, preset="paper"), 100)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_positions_said_to_be_exact_are_taken_at_the_step_of_single_precision() -> None:
    points = np.random.default_rng(5).uniform(0.0, 10.0, (2000, 3)) * [1.0, 1.0, 0.0]
    result = segment(points, Params(surfaces=SurfaceParams(noise=0.0)))
    check(result, len(points))
    assert 0.0 < result.params.surfaces.noise < 1e-5


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("kind", ["far pair", "huge", "needle"])
def test_extreme_extents_get_an_answer_or_a_clear_line(kind: str) -> None:
    points = cloud(kind)
    for preset in PRESETS:
        try:
            check(segment(points, preset=preset), len(points))
        except DataError as error:
            assert "cell" in str(error) and "\n" not in str(error)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("kind", ["three", "four", "equal", "collinear", "plane", "blob"])
@pytest.mark.parametrize("split", ["one stripe", "two stripes", "a stripe each", "two views"])
def test_meagre_stripes_get_an_answer_or_a_clear_line(kind: str, split: str) -> None:
    points = cloud(kind)
    n = len(points)
    stripe = {
        "one stripe": np.zeros(n, int),
        "two stripes": (np.arange(n) >= n // 2).astype(int),
        "a stripe each": np.arange(n),
        "two views": (np.arange(n) >= n // 2).astype(int),
    }[split]
    view = stripe if split == "two views" else np.zeros(n, int)
    for preset in PRESETS:
        try:
            check(segment(points, stripe=stripe, view=view, preset=preset), n)
        except DataError as error:
            assert "\n" not in str(error)


def test_one_stripe_is_refused_with_advice(tent) -> None:
    first = tent[0].stripe == 0
    with pytest.raises(DataError, match=r"one stripe.*unorganised"):
        segment(tent[0].points[first], stripe=np.zeros(int(first.sum()), int))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("organised", [True, False])
def test_rows_without_a_position_keep_their_place(value: float, organised: bool) -> None:
    scans, _ = make_tent(noise=0.01)
    n = len(scans)
    rows = np.random.default_rng(1).random(n) < 0.02
    points = scans.points.copy()
    points[rows, np.random.default_rng(2).integers(0, 3, n)[rows]] = value
    keep = ~rows
    if organised:
        result = segment(replace(scans, points=points))
        alone = segment(
            replace(
                scans, points=points[keep], stripe=scans.stripe[keep], column=scans.column[keep],
                view=scans.view[keep], time_ns=scans.time_ns[keep],
            )
        )  # fmt: skip
    else:
        result, alone = segment(points), segment(points[keep])
    assert np.all(result.labels[rows] == -1) and np.all(result.outlier[rows] == 1)
    assert np.all(result.level[rows] == -1) and not result.normals[rows].any()
    np.testing.assert_array_equal(result.labels[keep], alone.labels)
    np.testing.assert_array_equal(result.outlier[keep], alone.outlier)
    assert result.patch_count == 2


def test_a_plane_is_one_patch() -> None:
    points = cloud("plane")
    result = segment(points)
    assert result.patch_count == 1 and np.mean(result.labels == 0) > 0.95


def test_given_normals_of_length_zero_are_none() -> None:
    points = cloud("plane")
    normals = np.tile([0.0, 0.0, 1.0], (300, 1))
    normals[::10] = 0.0
    check(segment(points, normals=normals), 300)
    check(segment(points, normals=np.zeros((300, 3))), 300)


def test_two_opposite_sheets_are_two_patches() -> None:
    """W8: a thin wall. Its sides share cells, and normals of opposite sense must not join."""
    x, y = (a.ravel() for a in np.mgrid[0:60, 0:60] * 0.5)
    sheet = np.column_stack((x, y, np.zeros_like(x)))
    points = np.concatenate((sheet, sheet + np.array([0, 0, 3.0])))
    normals = np.repeat([[0.0, 0, -1], [0.0, 0, 1]], len(sheet), axis=0)
    result = segment(points, normals=normals)
    assert result.patch_count == 2
    assert set(result.labels[: len(sheet)]) == {0} and set(result.labels[len(sheet) :]) == {1}


def test_the_input_is_not_changed(tent) -> None:
    scans = tent[0]
    arrays = {
        name: getattr(scans, name).copy()
        for name in ("points", "stripe", "view", "column", "origin", "T_world_view")
    }
    frozen = {}
    for name, array in arrays.items():
        array.setflags(write=False)
        frozen[name] = array
    segment(Scans(**frozen))
    segment(Scans(**frozen), paper(divisions=4))
    segment(frozen["points"])
    for name, array in frozen.items():
        np.testing.assert_array_equal(array, getattr(scans, name), err_msg=name)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"data": np.zeros((9, 4))}, r"points must have the shape \(N, 3\), not \(9, 4\)"),
        ({"data": np.eye(3), "normals": np.eye(3)[:2]}, "normals must have the shape"),
        ({"data": np.eye(3), "stripe": np.zeros(3)}, "stripe must be integers"),
        ({"data": np.eye(3), "view": [0, 1]}, "view must be integers"),
    ],
)
def test_wrong_arrays_are_named(arguments: dict, message: str) -> None:
    with pytest.raises(DataError, match=message):
        segment(**arguments)
