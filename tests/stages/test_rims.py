"""Borders in scan order and what is beyond them: as by hand, and the same as the plain answer."""

import numpy as np
import pytest
from reference import rims as plain

from octoseg_ti.stages.rims import (
    BEFORE,
    BEHIND,
    DOWN,
    ENDED,
    HIDDEN,
    NEXT,
    PASSED,
    UP,
    Lines,
    look_beyond,
    open_sides,
)

GAP, OFF = 2.5, 0.2
FIELD = np.array([[0.5, 30.5], [0.5, 30.5]])
Z = np.array([0.0, 0.0, 1.0])


def lines_of(height: np.ndarray, *, views: int = 1, known: bool = True) -> Lines:
    """A scan from far above: a row a stripe, a column a ray; NaN = no point."""
    stripe, lane = np.nonzero(~np.isnan(height))
    points = np.column_stack([stripe, lane, height[stripe, lane]]).astype(float)
    there, run = np.unique(stripe, return_inverse=True)
    start = np.searchsorted(run, np.arange(len(there) + 1)).astype(np.int32)
    source = np.column_stack([there, np.full(len(there), 15), np.full(len(there), 1e4)])
    return Lines(
        points, start, run.astype(np.int32), (there * views // len(height)).astype(np.int32),
        lane.astype(float), source.astype(float) if known else None,
        np.arange(len(points)), np.arange(len(points)),
    )  # fmt: skip


def beyond(lines: Lines, at: tuple[int, int], outward: tuple[float, float]) -> tuple[int, int]:
    """Open sides of a point, and what is beyond."""
    i = int(np.flatnonzero((lines.points[:, 0] == at[0]) & (lines.points[:, 1] == at[1]))[0])
    side = open_sides(lines, np.ones(len(lines.points), bool), GAP)[[i]]
    to = np.array([[*outward, 0.0]])
    found = look_beyond(lines, FIELD, np.array([i]), side, Z[None], to, gap=GAP, off=OFF)
    return int(side[0]), int(found[0])


def plate(shape: tuple[int, int] = (20, 32)) -> np.ndarray:
    height = np.full(shape, np.nan)
    height[4:16, 4:28] = 0.0
    return height


def test_a_plate_in_free_space_ends() -> None:
    lines = lines_of(plate())
    assert beyond(lines, (9, 27), (0, 1)) == (NEXT, ENDED)
    assert beyond(lines, (9, 4), (0, -1)) == (BEFORE, ENDED)
    assert beyond(lines, (15, 9), (1, 0)) == (UP, PASSED)
    assert beyond(lines, (4, 9), (-1, 0)) == (DOWN, PASSED)
    assert beyond(lines, (9, 9), (1, 0)) == (0, 0)
    assert beyond(lines, (15, 9), (0, 1)) == (UP, 0)  # the free sector is elsewhere


def test_at_the_end_of_the_field_of_view_nothing_is_known() -> None:
    height = np.zeros((20, 32))
    height[:, 31] = np.nan
    assert beyond(lines_of(height), (9, 0), (0, -1)) == (BEFORE, HIDDEN)
    assert beyond(lines_of(height), (9, 30), (0, 1)) == (NEXT, ENDED)


def test_the_upper_side_of_a_step_is_an_edge_and_its_shadow_is_none() -> None:
    height = np.zeros((20, 32))
    height[:9] = 5.0  # the camera sees nothing of three stripes behind it
    height[9:12] = np.nan
    assert beyond(lines_of(height), (8, 9), (1, 0)) == (UP, BEHIND)
    assert beyond(lines_of(height), (12, 9), (-1, 0)) == (DOWN, HIDDEN)
    assert beyond(lines_of(height, known=False), (8, 9), (1, 0)) == (UP, HIDDEN)
    turned = lines_of(height.T[:20])
    assert beyond(turned, (9, 8), (0, 1))[0] == NEXT
    height[15] = 7.0  # what stands in front of the plane may have thrown the shadow
    assert beyond(lines_of(height), (8, 9), (1, 0)) == (UP, HIDDEN)


def test_holes_in_a_plate_are_no_edges() -> None:
    height = np.zeros((20, 32))
    height[8:12, 10:16] = np.nan
    lines = lines_of(height)
    assert beyond(lines, (7, 12), (1, 0)) == (UP, HIDDEN)
    assert beyond(lines, (9, 9), (0, 1)) == (NEXT, HIDDEN)


def test_views_know_nothing_of_each_other() -> None:
    height = np.zeros((20, 32))
    assert beyond(lines_of(height, views=2), (9, 9), (1, 0)) == (UP, PASSED)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("known", [True, False])
def test_equal_the_reference(seed: int, known: bool) -> None:
    rng = np.random.default_rng(seed)
    height = np.repeat(np.repeat(rng.choice([0.0, 1.0, 4.0], (4, 5)), 6, axis=0), 6, axis=1)
    height += rng.normal(0, 0.05, height.shape)
    height[rng.random(height.shape) < 0.15] = np.nan
    height[np.repeat(np.repeat(rng.random((8, 10)) < 0.2, 3, axis=0), 3, axis=1)] = np.nan
    lines = lines_of(height, views=2, known=known)
    n = len(lines.points)
    asked = rng.random(n) < 0.9
    side = open_sides(lines, asked, GAP)
    expected = [plain.open_sides(lines, i, GAP) if asked[i] else 0 for i in range(n)]
    np.testing.assert_array_equal(side, expected)
    point = np.flatnonzero(side)
    outward = rng.normal(size=(len(point), 3)) * (1, 1, 0)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    normal = Z + rng.normal(0, 0.02, (len(point), 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    found = look_beyond(lines, FIELD, point, side[point], normal, outward, gap=GAP, off=OFF)
    answers = [
        plain.look_beyond(lines, FIELD, i, side[i], m, o, GAP, OFF)
        for i, m, o in zip(point, normal, outward, strict=True)
    ]
    np.testing.assert_array_equal(found, answers)
    assert len(set(found.tolist())) > 3


def test_nothing_asked_nothing_found() -> None:
    lines, none = lines_of(plate()), np.zeros(0, np.int64)
    assert not open_sides(lines, np.zeros(len(lines.points), bool), GAP).any()
    rows = np.zeros((0, 3))
    assert len(look_beyond(lines, FIELD, none, none, rows, rows, gap=GAP, off=OFF)) == 0
