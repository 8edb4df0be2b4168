"""Edge-pair normals: the march of Fig. 5, the mean of Eqs 1-2, gaps, and the side of the probe."""

import math

import numpy as np
import pytest
from reference import stripes as plain
from reference.clouds import lattice_stripes, ragged_stripes, rotation
from reference.device_normals import edge_pair_normals

from octoseg_ti.stages.normals import stripe_axes


@pytest.mark.parametrize("rule", ["diagonal", "paper"])
@pytest.mark.parametrize("weight", ["unit", "area"])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("stripes", "length"), [(2, 3), (3, 10), (9, 30), (20, 60)])
def test_equals_the_reference(rule: str, weight: str, seed: int, stripes: int, length: int) -> None:
    points, start, _, view = ragged_stripes(seed, stripes, length, views=2)
    origin = np.array([[5.0, 10.0, 200.0], [5.0, 10.0, 230.0]])
    for gap in (1.2, 1e9):
        got = edge_pair_normals(
            points, start, view, gap=gap, rule=rule, weight=weight, origin=origin
        )
        expected = plain.edge_pair_normals(
            points, start, view, gap=gap, rule=rule, weight=weight, origin=origin
        )
        np.testing.assert_allclose(got, expected, atol=1e-10, err_msg=f"seed {seed}, gap {gap}")
    assert len(points) > 2


def test_without_a_probe_the_outside_is_away_from_the_middle() -> None:
    # Half a cylinder, seen from anywhere.
    x, a = 0.5 * np.arange(20)[:, None], 0.05 * np.arange(-25, 26)[None, :]
    points, start, _, view = lattice_stripes(x, 10 * np.sin(a), 10 * np.cos(a) + 0 * x)
    got = edge_pair_normals(points, start, view, gap=3.0)
    expected = plain.edge_pair_normals(
        points, start, view, gap=3.0, rule="diagonal", weight="unit", origin=None
    )
    np.testing.assert_allclose(got, expected, atol=1e-10)
    assert np.all(got[:, 2] > 0)


@pytest.mark.parametrize("rule", ["diagonal", "paper"])
@pytest.mark.parametrize("weight", ["unit", "area"])
@pytest.mark.parametrize("seed", range(3))
def test_a_plane_gives_its_normal(rule: str, weight: str, seed: int) -> None:
    points, start, _, view = ragged_stripes(seed, 12, 40)
    q = rotation(seed)
    points[:, 2] = 0.0
    turned = np.ascontiguousarray(points @ q.T)
    probe = q @ [3.0, 5.0, 300.0]
    got = edge_pair_normals(
        turned, start, view, gap=2.0, rule=rule, weight=weight, origin=probe[None]
    )
    there = got.any(axis=1)
    assert there.mean() > 0.95
    # Slim triangles of a rounded plane: 1e-15 of 10 mm over a width of 0.01 mm.
    np.testing.assert_allclose(got[there], np.broadcast_to(q[:, 2], got[there].shape), atol=1e-11)


@pytest.mark.parametrize("rule", ["diagonal", "paper"])
def test_rotating_the_part_rotates_the_normals(rule: str) -> None:
    points, start, _, view = ragged_stripes(4, 15, 40)
    origin = np.array([[4.0, 8.0, 300.0]])
    before = edge_pair_normals(points, start, view, gap=1.5, rule=rule, origin=origin)
    q = rotation(9)
    after = edge_pair_normals(
        np.ascontiguousarray(points @ q.T), start, view, gap=1.5, rule=rule, origin=origin @ q.T
    )
    np.testing.assert_allclose(after, before @ q.T, atol=1e-9)


def test_cylinder_normals_are_radial() -> None:
    # Lattice triangles of a cylinder are chords of step h: their normals are off by h / 2 at most,
    # and by symmetry the mean over the triangles of a point is off much less.
    step = 0.02
    x, a = 0.4 * np.arange(15)[:, None], step * np.arange(-50, 51)[None, :]
    points, start, _, view = lattice_stripes(x, 20 * np.sin(a), 20 * np.cos(a) + 0 * x)
    got = edge_pair_normals(points, start, view, gap=2.0, origin=np.array([[3.0, 0.0, 300.0]]))
    true = points * [0, 1, 1] / 20
    inside = np.abs(points[:, 1]) < 15
    assert np.max(np.linalg.norm(got - true, axis=1)[inside]) < step / 2


def test_six_triangles_of_a_lattice_point() -> None:
    """Fig. 6: a point inside a regular lattice belongs to six edge pairs; here one leans."""
    x, y = np.arange(3.0)[:, None], np.arange(3.0)[None, :]
    z = np.zeros((3, 3))
    z[2, 1] = 1.0
    points, start, _, view = lattice_stripes(x, y, z)
    got = edge_pair_normals(points, start, view, gap=9.0, origin=np.array([[1.0, 1.0, 99.0]]))
    triangles = [
        (two[a], one[b], (one, two)[line][place])
        for one, two in ((range(0, 3), range(3, 6)), (range(3, 6), range(6, 9)))
        for a, b, (line, place) in plain.strip_triangles(
            points[list(one)], points[list(two)], "diagonal", np.array([0.0, 1.0, 0.0])
        )
    ]
    assert len(triangles) == 8
    around = [t for t in triangles if 4 in t]
    total = sum(
        -n / np.linalg.norm(n)
        for n in (np.cross(points[q] - points[p], points[r] - points[p]) for p, q, r in around)
    )
    np.testing.assert_allclose(got[4], total / np.linalg.norm(total), atol=1e-14)


def test_a_shadow_gets_no_wall() -> None:
    # A block 5 mm above a plate; without the gap the wall between them would be triangulated.
    x, y = 0.5 * np.arange(10)[:, None], 0.5 * np.arange(30)[None, :]
    z = np.where(y < 7, 5.0, 0.0) + 0 * x
    points, start, _, view = lattice_stripes(x, y, z)
    origin = np.array([[2.0, 7.0, 300.0]])
    broken = edge_pair_normals(points, start, view, gap=1.5, origin=origin)
    np.testing.assert_allclose(broken, np.tile([0.0, 0, 1], (300, 1)), atol=1e-12)
    joined = edge_pair_normals(points, start, view, gap=99.0, origin=origin)
    assert np.count_nonzero(joined[:, 2] < 0.9) >= 18  # both sides of the step


def test_a_lost_stripe_breaks_the_strip() -> None:
    x = np.array([0.0, 0.5, 5.0, 5.5])[:, None]
    points, start, _, view = lattice_stripes(x, 0.5 * np.arange(8)[None, :], 0.2 * x + np.zeros(8))
    got = edge_pair_normals(points, start, view, gap=1.5, origin=np.array([[2.0, 2.0, 99.0]]))
    true = np.array([-0.2, 0.0, 1.0]) / math.hypot(0.2, 1.0)
    np.testing.assert_allclose(got, np.tile(true, (32, 1)), atol=1e-12)


def test_views_do_not_see_each_other() -> None:
    points, start, run, view = ragged_stripes(2, 8, 30, views=2)
    both = edge_pair_normals(points, start, view, gap=1e9, origin=np.full((2, 3), 500.0))
    n, half = int(np.flatnonzero(view)[0]), int(run[np.flatnonzero(view)[0]])
    alone = edge_pair_normals(
        points[:n], start[: half + 1], view[:n], gap=1e9, origin=np.full((1, 3), 500.0)
    )
    np.testing.assert_array_equal(both[:n], alone)


def test_each_view_is_turned_as_a_whole() -> None:
    points, start, _, view = ragged_stripes(2, 8, 30, views=2)
    points[:, 2] = 0.0
    below = np.array([[4.0, 4.0, 100.0], [4.0, 4.0, -100.0]])
    got = edge_pair_normals(points, start, view, gap=2.0, origin=below)
    seen = got.any(axis=1)
    assert np.all(got[seen & (view == 0), 2] > 0.99) and np.all(got[seen & (view == 1), 2] < -0.99)


def test_points_without_an_edge_pair_have_no_normal() -> None:
    points = np.array([[0.0, 0, 0], [50, 0, 0], [50, 1, 0], [51, 0, 0], [51, 1, 0]])
    start = np.array([0, 1, 3, 5], np.int32)
    got = edge_pair_normals(
        points, start, np.zeros(5, np.int32), gap=2.0, origin=np.array([[50.0, 0, 99]])
    )
    np.testing.assert_allclose(got, [[0, 0, 0]] + [[0, 0, 1]] * 4, atol=1e-14)


def test_collinear_stripes_have_no_normals() -> None:
    points = np.zeros((6, 3))
    points[:, 0] = np.arange(6)
    got = edge_pair_normals(points, np.array([0, 3, 6], np.int32), np.zeros(6, np.int32), gap=9.0)
    np.testing.assert_array_equal(got, 0.0)


def test_a_single_stripe_has_no_normals() -> None:
    points, start, _, view = ragged_stripes(0, 1, 30)
    got = edge_pair_normals(points, start, view, gap=9.0)
    np.testing.assert_array_equal(got, 0.0)


def test_stripe_axes() -> None:
    points, start, _, view = ragged_stripes(1, 10, 50, views=2)
    axes = stripe_axes(points, start, view, 3)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), [1, 1, 0], atol=1e-12)
    assert np.all(axes[:2, 1] > 0.8)


@pytest.mark.parametrize(("key", "value"), [("rule", "nearest"), ("weight", "angle")])
def test_unknown_options_are_refused(key: str, value: str) -> None:
    points, start, _, view = ragged_stripes(1, 3, 10)
    with pytest.raises(ValueError, match=f"{key} must be .* not '{value}'"):
        edge_pair_normals(points, start, view, gap=1.0, **{key: value})
