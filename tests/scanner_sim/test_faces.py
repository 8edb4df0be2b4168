"""Charts and faces: kernels against plain NumPy, on a part with every kind of surface."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference import faces as plain

from scanner_sim.charts import make_chart
from scanner_sim.edges import trace_edges
from scanner_sim.faces import goes_on, passing, side_near
from scanner_sim.features import Rim, dome_shape, drill_shape, round_shape, upside_down
from scanner_sim.nearest import Edges, nearest_edge
from scanner_sim.part import Part, box, difference, union
from scanner_sim.raycast import classify


def _part() -> Part:
    body = box((-20, -12, 0), (20, 12, 10)).turned("y", 0.1)
    boss = round_shape(4.0, 5.0, lean=0.3, end=Rim(round=1.0), foot=Rim(round=2.0))
    drill = drill_shape(3.0, 3.0, foot=Rim(chamfer=1.5), tip=True)
    return difference(
        union(body, boss.solid.shifted(-12.0, 2.0, 10.0), dome_shape(4, 2).solid.shifted(z=10.0)),
        upside_down(drill).shifted(12.0, 1.0, 10.0),
    )


PART = _part()
FLAT = PART.flat()


def _places(seed: int, count: int = 600) -> tuple[np.ndarray, np.ndarray]:
    """Surfaces, and parameters on them around the part."""
    rng = np.random.default_rng(seed)
    index = rng.integers(0, len(FLAT.surfaces.kind), count).astype(np.int32)
    return index, rng.uniform((-math.pi, -15), (math.pi, 15), (count, 2))


def test_positions_of_parameters() -> None:
    chart = make_chart(FLAT)
    index, angles = _places(0)
    scaled = angles * chart.scale[index]
    expected = plain.chart_points(FLAT, index, angles)
    np.testing.assert_allclose(chart.points(index, scaled), expected, atol=1e-9)


def test_sides_of_places_and_where_they_change() -> None:
    chart = make_chart(FLAT)
    index, angles = _places(1, 4000)
    scaled = angles * chart.scale[index]
    points = chart.points(index, scaled)
    side = chart.sides(index, scaled)
    np.testing.assert_array_equal(side, classify(FLAT, points, index))
    expected = plain.sides(PART, FLAT, index, points)
    assert (side == expected).mean() > 0.999  # not so within a nanometre of another surface
    assert {-1, 0, 1} == set(side)
    # Neighbours on one surface with different answers: somewhere between them it changes.
    order = np.argsort(index, kind="stable")
    one, other = order[:-1], order[1:]
    change = (index[one] == index[other]) & (side[one] != side[other])
    one, other = one[change], other[change]
    ends = chart.ends(index[one], scaled[one], scaled[other])
    way = scaled[other] - scaled[one]
    share = np.einsum("ij,ij->i", ends - scaled[one], way) / np.einsum("ij,ij->i", way, way)
    np.testing.assert_allclose(ends, scaled[one] + share[:, None] * way, atol=1e-9)
    assert ((share > 0) & (share < 1)).all()
    step = 2.0**-17 * way
    before, after = (chart.sides(index[one], ends + sign * step) for sign in (-1, 1))
    assert len(one) > 50 and (before != after).mean() > 0.99


def _face_points(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on the faces of the part."""
    chart = make_chart(FLAT)
    index, angles = _places(seed, count)
    scaled = angles * chart.scale[index]
    on = chart.sides(index, scaled) != 0
    return index[on], chart.points(index[on], scaled[on])


def test_where_a_face_goes_on() -> None:
    surface, first = _face_points(2, 6000)
    second = first + np.random.default_rng(3).normal(0.0, 2.0, first.shape)
    second = plain.onto(FLAT, surface, second)
    found = goes_on(FLAT, surface, first, second)
    expected = plain.goes_on(PART, FLAT, surface, first, second)
    assert (found == expected).mean() > 0.998
    assert 0.05 < found.mean() < 0.98


def test_what_passes_by_an_edge_and_on_which_side_its_faces_lie() -> None:
    edges = trace_edges(FLAT)
    rng = np.random.default_rng(4)
    some = rng.choice(len(edges.kind), 400, replace=False)
    start, end = edges.start[some], edges.end[some]
    surface = rng.integers(0, len(FLAT.surfaces.kind), len(some)).astype(np.int32)
    piece, other = passing(FLAT, surface, (start, end), 1e-5, 4e-3)
    expected = plain.passing(FLAT, surface, start, end, 1e-5, 4e-3)
    assert list(zip(piece.tolist(), other.tolist(), strict=True)) == expected
    assert len(expected) > 400  # two faces meet at an edge, one of them may be the one asked from
    run = (end - start)[piece]
    run /= np.linalg.norm(run, axis=1, keepdims=True)
    middle = 0.5 * (start + end)[piece]
    side = side_near(FLAT, other, middle, run, 0.02)
    expected_side = plain.side_near(PART, FLAT, other, middle, run, 0.02)
    assert (side == expected_side).mean() > 0.998
    assert 0.8 < (side != 0).mean() < 1.0  # some pass by inside of the part


def test_no_questions_have_no_answers() -> None:
    none, nowhere = np.empty(0, np.int32), np.empty((0, 3))
    assert len(goes_on(FLAT, none, nowhere, nowhere)) == 0
    assert len(side_near(FLAT, none, nowhere, nowhere, 0.1)) == 0
    assert [len(a) for a in passing(FLAT, none, (nowhere, nowhere), 1e-5, 1e-3)] == [0, 0]
    assert make_chart(FLAT).points(none, np.empty((0, 2))).shape == (0, 3)


@pytest.mark.parametrize("count", [1, 2, 300])
def test_nearest_edge_of_random_pieces(count: int) -> None:
    rng = np.random.default_rng(count)
    start = rng.uniform(-30, 30, (count, 3))
    end = start + rng.normal(0.0, 0.5, (count, 3))
    edges = Edges(start, end, rng.integers(1, 4, count).astype(np.uint8))
    points = rng.uniform(-40, 40, (500, 3))
    offset, span = points[:, None] - start, end - start
    share = np.clip(np.sum(offset * span, axis=2) / np.sum(span * span, axis=1), 0, 1)
    far = np.linalg.norm(offset - share[..., None] * span, axis=2)
    found, kind = nearest_edge(edges, points)
    np.testing.assert_allclose(found, far.min(axis=1), atol=1e-12)
    np.testing.assert_array_equal(kind, edges.kind[far.argmin(axis=1)])
