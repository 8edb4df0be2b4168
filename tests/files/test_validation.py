"""Arrays that do not fit are refused at the door; those that do get their types."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octoseg_ti.errors import DataError
from octoseg_ti.files.validation import make_scans, make_truth, runs

GOOD = {"points": np.zeros((4, 3)), "stripe": np.array([0, 0, 1, 1])}
TURNED = np.diag([1.0, 1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"points": np.zeros((0, 3))}, "no points"),
        ({"points": np.zeros((4, 2))}, r"\(4, 2\), not \(N, 3\)"),
        ({"points": np.zeros(12)}, r"\(12,\), not \(N, 3\)"),
        ({"points": np.array([["a"] * 3] * 4)}, "not numbers"),
        ({"points": np.zeros((4, 3), complex)}, "not numbers"),
        ({"normals": np.zeros((3, 3))}, r"\(3, 3\), not \(4, 3\)"),
        ({"stripe": np.zeros(3, int)}, r"\(3,\), not \(4,\)"),
        ({"stripe": np.array([0, 1, 0, 1])}, "one after the other"),
        ({"stripe": np.array([3, 3, 1, 1])}, "go down"),
        ({"stripe": np.array([-1, -1, 0, 0])}, "negative"),
        ({"stripe": np.array([0.0, 0.5, 1.0, 1.0])}, "whole"),
        ({"stripe": np.array([0.0, np.nan, 1.0, 1.0])}, "whole"),
        ({"stripe": np.array([0, 0, 2**31, 2**31])}, "does not fit"),
        ({"view": np.array([0, 0, -1, -1])}, "negative"),
        ({"column": np.zeros((4, 1), int)}, "column has shape"),
        ({"T_world_view": np.zeros((1, 4, 4))}, "not a rotation"),
        ({"T_world_view": TURNED}, "not a rotation"),
        ({"T_world_view": np.zeros((3, 3))}, r"\(V, 4, 4\)"),
        ({"T_world_view": np.eye(4)[None], "view": np.array([0, 0, 1, 1])}, "1 poses for 2"),
        ({"origin": np.zeros((1, 3)), "view": np.array([0, 0, 1, 1])}, "1 rows for 2"),
        ({"stripe_origin": np.zeros((1, 3))}, "fewer than the stripes"),
        ({"frame": "robot"}, "'robot'"),
        ({"frame": "view"}, "without T_world_view"),
    ],
)
def test_what_does_not_fit_is_refused(change, reason):
    with pytest.raises(DataError, match=reason) as caught:
        make_scans("in.npz", GOOD | change)
    assert str(caught.value).startswith("in.npz: ") and caught.value.hint


def test_types_are_those_of_the_contract():
    scans = make_scans(None, GOOD | {"view": [0.0] * 4, "time_ns": range(4), "column": [1] * 4})
    assert scans.points.dtype == np.float64
    assert scans.stripe.dtype == scans.column.dtype == scans.view.dtype == np.int32
    assert scans.time_ns.dtype == np.int64


def test_stripes_that_start_again_in_every_view_become_unique():
    values = {
        "points": np.zeros((6, 3)),
        "stripe": np.array([0, 2, 0, 1, 3, 0]),
        "view": np.array([0, 0, 1, 1, 1, 2]),
    }
    assert make_scans(None, values).stripe.tolist() == [0, 2, 3, 4, 6, 7]
    with pytest.raises(DataError, match="ambiguous"):
        make_scans(None, values | {"stripe_origin": np.zeros((4, 3))})


def test_views_may_alternate():
    values = {
        "points": np.zeros((4, 3)),
        "stripe": np.array([0, 1, 2, 3]),
        "view": np.array([0, 1, 0, 1]),
    }
    assert make_scans(None, values).stripe.tolist() == [0, 1, 2, 3]


def test_values_that_are_not_finite_pass():
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(make_scans(None, GOOD | {"points": points}).points, points)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 5)), min_size=1, max_size=30))
def test_accepted_stripes_are_unique_and_whole(pairs):
    view = np.array([p[0] for p in pairs])
    stripe = np.array([p[1] for p in pairs])
    try:
        scans = make_scans(
            None, {"points": np.zeros((len(pairs), 3)), "stripe": stripe, "view": view}
        )
    except DataError:
        first = runs(stripe, view)[:-1]
        met = [(view[k], stripe[k]) for k in first]
        falls = any(a[0] == b[0] and b[1] < a[1] for i, a in enumerate(met) for b in met[i + 1 :])
        assert len(set(met)) < len(met) or falls
        return
    first = runs(scans.stripe, scans.view)[:-1]
    assert len(np.unique(scans.stripe)) == len(first)
    same = [tuple(np.unique(stripe[scans.stripe == k])) for k in np.unique(scans.stripe)]
    assert all(len(numbers) == 1 for numbers in same)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"patch": np.array([0, -2])}, "below -1"),
        ({"patch": np.array([0, 1, 2])}, r"\(3,\), not \(2,\)"),
        ({"patch": np.array([0, 1]), "normal": np.zeros((2, 2))}, "normal"),
        ({"patch": np.array([0, 1]), "edge_distance": np.zeros(3)}, "edge_distance"),
    ],
)
def test_truth_that_does_not_fit_is_refused(values, reason):
    with pytest.raises(DataError, match=reason):
        make_truth("t.npz", values, 2)
