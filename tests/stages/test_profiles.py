"""Balls between two surfaces: the same as plain NumPy, and what is known of tori and cylinders."""

import math

import numpy as np
import pytest
from reference import rolling

from octoseg_ti.device import runtime
from octoseg_ti.stages.profiles import (
    BALL,
    FIRST,
    NOWHERE,
    SECOND,
    place,
    points_beside,
    sums,
)
from octoseg_ti.types import EdgeClass, SurfaceKind

PLANE, CYLINDER, SPHERE = (
    int(k) for k in (SurfaceKind.PLANE, SurfaceKind.CYLINDER, SurfaceKind.SPHERE)
)


def surface(kind: int, point, axis, a=math.nan, side=1.0) -> np.ndarray:  # type: ignore[no-untyped-def]
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return np.array([*point, *axis, a, math.nan, kind, side])


def placed(surfaces, points, radius, normals=None):  # type: ignore[no-untyped-def]
    n = len(points)
    normals = np.tile([0.0, 0.0, 1.0], (n, 1)) if normals is None else normals
    runtime.ensure_started()
    return place(
        runtime.upload(np.asarray(points, float)), runtime.upload(normals), np.array(surfaces),
        np.array([[0, 1]]), np.array([radius]), np.arange(n), np.zeros(n, np.int32),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(6))
def test_equal_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    floor = surface(PLANE, (0, 0, 0), (0.1 * rng.standard_normal(), 0, 1))
    other = (
        surface(PLANE, (1, 2, 0), (1, 0.3, 0.2)),
        surface(CYLINDER, (0, 0, 0), (0.1, 0, 1), 6.0, side=-1.0 if seed % 2 else 1.0),
        surface(SPHERE, (0, 0, -3), (0, 0, 1), 7.0),
    )[seed % 3]
    radius = (-1.0 if seed < 3 else 1.0) * rng.uniform(0.5, 1.5)
    points = rng.uniform(-2, 2, (300, 3)) + (6.0, 0.0, 0.0) * np.array([seed % 3 > 0])
    got = placed([floor, other], points, radius)
    tested = 0
    for i, p in enumerate(points):
        if got.region[i] == NOWHERE:
            continue
        off, along, region, turn = rolling.profile(floor, other, p, radius)
        assert got.region[i] == region, f"seed {seed}, point {i}"
        np.testing.assert_allclose(got.off[i], off, atol=1e-4)
        np.testing.assert_allclose(got.turn[i], turn, atol=1e-3)
        np.testing.assert_allclose(0.0 if region == BALL else got.along[i], along, atol=1e-3)
        tested += 1
    assert tested > 200


@pytest.mark.parametrize("hollow", [-1.0, 1.0])
def test_a_rounded_right_angle(hollow: float) -> None:
    """Planes z = 0 and x = 0: the ball of radius 2 touches them at x = 2 and at z = 2, inside."""
    faces = [surface(PLANE, (0, 0, 0), (0, 0, 1)), surface(PLANE, (0, 0, 0), (1, 0, 0))]
    c = 2.0 * hollow
    middle = c * (1.0 - math.sqrt(0.5))
    points = np.array([[middle, 5, middle], [c * 1.5, 1, 0.1], [0.0, 0, c * 2]])
    at = placed(faces, points, c)
    assert at.region.tolist() == [BALL, FIRST, SECOND]
    np.testing.assert_allclose(at.off, [0.0, 0.1, 0.0], atol=1e-9)
    np.testing.assert_allclose(at.along, [0.0, 1.0, 2.0], atol=1e-9)
    np.testing.assert_allclose(at.turn, math.pi / 2)


def test_a_ball_between_plane_and_cylinder_leaves_a_torus() -> None:
    rng = np.random.default_rng(1)
    faces = [surface(PLANE, (0, 0, 0), (0, 0, 1)), surface(CYLINDER, (0, 0, 0), (0, 0, 1), 5.0)]
    angle, tube = rng.uniform(0, 2 * math.pi, 200), rng.uniform(math.pi, 1.5 * math.pi, 200)
    rho, z = 6.5 + 1.4 * np.cos(tube), 1.5 + 1.4 * np.sin(tube)  # 0.1 off the torus 6.5, 1.5
    points = np.column_stack([rho * np.cos(angle), rho * np.sin(angle), z])
    at = placed(faces, points, 1.5)
    assert (at.region == BALL).all()
    np.testing.assert_allclose(at.off, 0.1, atol=1e-6)


def test_parallel_planes_have_no_edge() -> None:
    faces = [surface(PLANE, (0, 0, 0), (0, 0, 1)), surface(PLANE, (0, 0, 1), (0, 0, 1))]
    at = placed(faces, np.zeros((3, 3)), 1.0)
    assert (at.region == NOWHERE).all() and np.isinf(at.along).all()


def test_sums_are_those_of_the_places_and_change_with_the_radius() -> None:
    rng = np.random.default_rng(2)
    faces = np.array([surface(PLANE, (0, 0, 0), (0, 0, 1)), surface(PLANE, (0, 0, 0), (1, 0, 0.3))])
    points = rng.uniform(-0.5, 2, (400, 3))
    runtime.ensure_started()
    device = runtime.upload(points)
    task, entry, cap = np.array([[0, 1, 0, 400]] * 3), np.arange(400), 0.6
    shape = np.array([[1.5 - 1e-5, 1.0], [1.5, 1.0], [1.5 + 1e-5, 1.0]])
    got = sums(device, faces, task, shape[:, None], entry, cap)[:, 0]
    # Shapes of one task give the same sums as tasks of one shape.
    together = sums(device, faces, task[:1], shape[None], entry, cap)[0]
    np.testing.assert_array_equal(together, got)
    at = placed(faces, points, 1.5)
    near = np.minimum(np.abs(at.off), cap)
    np.testing.assert_allclose(got[1, 0], np.sum(near**2), rtol=1e-9)
    assert got[1, 3] == np.count_nonzero((at.region == BALL) & (np.abs(at.off) < cap))
    # Half the slope of the cost, but for points that pass the cap meanwhile.
    np.testing.assert_allclose((got[2, 0] - got[0, 0]) / 4e-5, got[1, 1], rtol=0.02)
    assert got[1, 2] > 0.0


def test_what_costs_more_than_the_limit_need_not_be_added_up() -> None:
    rng = np.random.default_rng(3)
    faces = np.array([surface(PLANE, (0, 0, 0), (0, 0, 1)), surface(PLANE, (0, 0, 0), (1, 0, 0.3))])
    runtime.ensure_started()
    device = runtime.upload(rng.uniform(-0.5, 2, (400, 3)))
    task, entry = np.array([[0, 1, 0, 150], [0, 1, 150, 400]]), np.arange(400)
    shape = np.stack([rng.uniform(0.2, 2.0, (2, 9)), np.ones((2, 9))], axis=2)
    whole = sums(device, faces, task, shape, entry, 0.6)[..., 0]
    limit = np.median(whole, axis=1)
    got = sums(device, faces, task, shape, entry, 0.6, limit)[..., 0]
    cheap = whole <= limit[:, None]
    np.testing.assert_array_equal(got[cheap], whole[cheap])
    assert np.all((got > limit[:, None])[~cheap]) and np.all(got <= whole)
    assert np.any(got < whole)


@pytest.mark.parametrize("seed", range(3))
def test_points_beside_edges_equal_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    faces = np.array([
        surface(PLANE, (0, 0, 0), (0, 0, 1)), surface(PLANE, (0, 0, 0), (1, 0, 0.3)),
        surface(CYLINDER, (0, 0, 0), (0, 1, 0), 1.0),
    ])  # fmt: skip
    points = rng.uniform(-1, 1.5, (300, 3)) * (1, 1, 0.4)
    label = rng.integers(-1, 4, 300).astype(np.int32)
    forms, radius = ("sharp", "smooth", "fillet"), np.array([1e-12, 0.0, 0.5])
    code = [int(EdgeClass[form.upper()]) for form in forms]
    edges = np.array([[0, 1, code[0], 0, 0], [1, 2, code[1], 0, 1], [0, 1, code[2], 1, 2]])
    edge, first = np.array([0, 0, 1, 2, 2]), np.array([0, 100, 50, 0, 200])
    count = np.array([70, 200, 60, 90, 100])
    runtime.ensure_started()
    limits = {"reach": 0.5, "on_ball": 0.1, "on_side": 0.2}
    point, which, along = points_beside(
        runtime.upload(points), label, faces, edges, np.array([0, 3]), radius, edge, first, count,
        **limits,
    )  # fmt: skip
    got = {(k, i): far for k, i, far in zip(which, point, along, strict=True)}
    expected = {}
    for k, (m, begin, many) in enumerate(zip(edge, first, count, strict=True)):
        for i in range(begin, begin + many):
            far = rolling.beside(
                faces, (edges[m, 0], edges[m, 1], forms[m]), {3}, label[i], points[i], radius[m],
                **limits,
            )  # fmt: skip
            if np.isfinite(far):
                expected[k, i] = far
    assert list(got) == list(expected) and {k for k, _ in got} == {0, 1, 2, 3, 4}
    np.testing.assert_allclose(list(got.values()), list(expected.values()), atol=1e-5)


def test_beside_no_edge_is_nothing() -> None:
    none = np.zeros(0, np.int64)
    runtime.ensure_started()
    found = points_beside(
        runtime.upload(np.zeros((3, 3))), np.zeros(3, np.int32), np.zeros((1, 10)),
        np.zeros((0, 5), np.int64), none, np.zeros(0), none, none, none,
        reach=1.0, on_ball=1.0, on_side=1.0,
    )  # fmt: skip
    assert all(len(part) == 0 for part in found)
