"""The covariance of a fit is that of plain formulas, and of the errors that fits make."""

import numpy as np
import pytest
from reference.clouds import rotation
from reference.covariances import (
    HAS,
    UNKNOWNS,
    covariance_of,
    gradient_of,
    squared_error,
    ways_of,
)
from reference.surfaces import CONE, CYLINDER, PLANE, SPHERE, TORUS, patch_of, placed

from octoseg_ti.device.surfaces import evaluate_surfaces
from octoseg_ti.fitting.covariance import covariances, distance_changes, frames_of
from octoseg_ti.fitting.covariance import ways_of as all_ways_of
from octoseg_ti.fitting.primitives import FREEDOM, fit_all

KINDS = range(5)
NOISE = 0.01


def measured(
    kind: int, seed: int, n: int = 200, arc: float = 1.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return noisy points and normals of a patch anywhere, and its true parameters."""
    rng = np.random.default_rng(1000 * seed + kind)
    points, normals, parameters = patch_of(kind, rng, n, arc)
    points = points + NOISE * rng.standard_normal((n, 1)) * normals
    return placed(points, normals, parameters, rotation(seed), rng.uniform(-100, 100, 3))


def alone(points: np.ndarray, kind: int, parameters: np.ndarray) -> np.ndarray:
    """Return the covariance of one surface."""
    return covariances(points, np.array([0, len(points)]), np.array([kind]), parameters[None])[0]


def assert_alike(found: np.ndarray, expected: np.ndarray, tolerance: float = 1e-5) -> None:
    """Assert that covariances are equal, in units of the deviations of points and of directions."""
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    size = np.sqrt(np.diag(expected))
    for part in (slice(0, 3), slice(3, 6)):
        size[part] = np.sqrt(np.sum(size[part] ** 2))
    scale = np.where(size > 0.0, size, 1.0)
    scale = np.outer(scale, scale)
    np.testing.assert_allclose(found / scale, expected / scale, atol=tolerance)


def changes_of(
    points: np.ndarray, kind: int, parameters: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how distances to a surface change, shape (N, 7), and its ways, shape (8, 7)."""
    code, rows = np.array([kind]), parameters[None]
    _, normal = evaluate_surfaces(points, np.zeros(len(points), np.int32), code, rows)
    frame = frames_of(rows[:, 3:6])
    found = distance_changes(points.T[:, None], normal.T[:, None], frame, code, rows)
    return found[:, 0].T, all_ways_of(frame, code)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_numerical_derivatives(kind: int) -> None:
    for seed in range(3):
        points, _, parameters = measured(kind, seed, 60, 2.5)
        found, ways = changes_of(points, kind, parameters)
        same = ways.T @ ways_of(kind, parameters)
        np.testing.assert_allclose(same.T @ same, np.eye(UNKNOWNS[kind]), atol=1e-12)
        np.testing.assert_allclose(found @ same, gradient_of(points, kind, parameters), atol=1e-6)


def test_behind_the_apex_only_its_place_counts() -> None:
    parameters = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.5, np.nan])
    points = np.array([[1.1, 2.2, -1.0], [1.0, 2.0, 1.0]])
    found, ways = changes_of(points, CONE, parameters)
    away = points - parameters[:3]
    expected = -away / np.linalg.norm(away, axis=1)[:, None]
    np.testing.assert_allclose(found[:, :3], expected @ ways[:3, :3], atol=1e-12)
    np.testing.assert_allclose(found[:, 3:6], 0.0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_equals_the_plain_formula(kind: int) -> None:
    cases = [measured(kind, seed, 40 + 30 * seed) for seed in range(5)]
    start = np.cumsum([0] + [len(c[0]) for c in cases])
    found = covariances(
        np.concatenate([c[0] for c in cases]), start, np.full(5, kind),
        np.stack([c[2] for c in cases]),
    )  # fmt: skip
    for g, (points, _, parameters) in enumerate(cases):
        assert_alike(found[g], covariance_of(points, kind, parameters))
        np.testing.assert_array_equal(found[g], found[g].T)
        assert_alike(found[g], alone(points, kind, parameters), 1e-9)


def test_kinds_together_are_as_each_alone() -> None:
    cases = [(k, *measured(k, s, 50 + 10 * k + s)) for s in range(3) for k in KINDS]
    start = np.cumsum([0] + [len(c[1]) for c in cases])
    found = covariances(
        np.concatenate([c[1] for c in cases]), start, np.array([c[0] for c in cases]),
        np.stack([c[3] for c in cases]),
    )  # fmt: skip
    for g, (kind, points, _, parameters) in enumerate(cases):
        assert_alike(found[g], alone(points, kind, parameters), 1e-9)


def test_a_plane_has_the_covariance_of_a_straight_line_fit() -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-5.0, 6.0), np.arange(-2.0, 3.0)))
    z = 0.1 * (-1.0) ** np.arange(len(x))
    found = alone(np.column_stack((x, y, z)), PLANE, np.array([0, 0, 0, 0, 0, 1.0, 0, 0]))
    square = 0.01 * len(x) / (len(x) - 3)
    expected = np.zeros((8, 8))
    expected[2, 2] = square / len(x)
    expected[3, 3], expected[4, 4] = square / np.sum(x**2), square / np.sum(y**2)
    expected[6:], expected[:, 6:] = np.nan, np.nan
    np.testing.assert_allclose(found, expected, atol=1e-15)
    # The offset n.p seen from an origin far off: its deviation is that of a height there.
    far = np.array([30.0, 0.0, 0.0])
    moved = alone(np.column_stack((x, y, z)) - far, PLANE, np.array([*-far, 0, 0, 1.0, 0, 0]))
    np.testing.assert_allclose(moved, expected, atol=1e-15)
    gradient = np.array([0.0, 0.0, 1.0, *-far])
    variance = gradient @ moved[:6, :6] @ gradient
    assert variance == pytest.approx(square * (1 / len(x) + 900.0 / np.sum(x**2)))


def test_the_centre_of_a_whole_sphere_is_three_times_as_open_as_its_radius() -> None:
    rng = np.random.default_rng(0)
    normal = rng.standard_normal((20_000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    far = 0.02 * rng.standard_normal((20_000, 1))
    found = alone((5.0 + far) * normal, SPHERE, np.array([0, 0, 0, 0, 0, 1.0, 5.0, np.nan]))
    assert np.sqrt(found[6, 6]) == pytest.approx(0.02 / np.sqrt(20_000), rel=0.03)
    np.testing.assert_allclose(np.diag(found)[:3], 3 * found[6, 6], rtol=0.05)


@pytest.mark.parametrize("radius", [50.0, 5e3, 5e5])
def test_shallow_pieces_keep_their_digits(radius: float) -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-5, 5, (2, 300))
    depth = (x**2 + y**2) / (radius + np.sqrt(radius**2 - x**2 - y**2))
    far = 0.01 * rng.standard_normal(300)
    normal = np.column_stack((x, y, radius - depth)) / radius
    points = np.column_stack((x, y, -depth)) + far[:, None] * normal
    found = alone(points, SPHERE, np.array([0, 0, -radius, 0, 0, 1.0, radius, np.nan]))
    # From the top, which stays while the radius grows: nothing cancels.
    near = np.column_stack((x / radius, y / radius, 1.0 - depth / radius, depth / radius))
    inverse = np.linalg.inv((near / np.linalg.norm(near, axis=0)).T @ near)
    inverse = inverse / np.linalg.norm(near, axis=0)[:, None]
    square = np.sum(far**2) / 296
    assert found[6, 6] == pytest.approx(square * inverse[3, 3], rel=1e-4)
    assert found[0, 0] == pytest.approx(square * inverse[0, 0], rel=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_a_shift_changes_nothing_and_a_turn_turns(kind: int) -> None:
    points, normals, parameters = measured(kind, 3)
    before = alone(points, kind, parameters)
    shifted = placed(points, normals, parameters, np.eye(3), np.array([400.0, -300.0, 50.0]))
    assert_alike(alone(shifted[0], kind, shifted[2]), before, 1e-6)
    q = rotation(8)
    turned = placed(points, normals, parameters, q, np.zeros(3))
    whole = np.eye(8)
    whole[:3, :3] = whole[3:6, 3:6] = q
    expected = whole @ np.nan_to_num(before) @ whole.T
    assert_alike(alone(turned[0], kind, turned[2]), np.where(np.isnan(before), np.nan, expected))
    if kind != CONE:
        opposite = parameters * np.where(np.isin(np.arange(8), [3, 4, 5]), -1.0, 1.0)
        side = np.diag([1.0, 1, 1, -1, -1, -1, 1, 1])
        expected = side @ np.nan_to_num(before) @ side
        expected = np.where(np.isnan(before), np.nan, expected)
        assert_alike(alone(points, kind, opposite), expected)


@pytest.mark.parametrize("kind", KINDS)
def test_errors_of_fits_are_as_large_as_they_say(kind: int) -> None:
    cases = [measured(kind, seed) for seed in range(150)]
    points, normals = (np.concatenate([c[k] for c in cases]) for k in (0, 1))
    start = np.arange(151) * 200
    fits = fit_all(points, normals, None, start)
    parameters = fits.parameters[:, kind]
    found = covariances(points, start, np.full(150, kind), parameters)
    error = np.array([
        squared_error(kind, parameters[g], cases[g][2], found[g]) for g in range(150)
    ])  # fmt: skip
    # The mean of 150 such squares is off by a tenth or less, nearly always.
    assert 0.8 < error.mean() / UNKNOWNS[kind] < 1.25
    assert UNKNOWNS[kind] == FREEDOM[kind]
    if kind != PLANE:
        off = (parameters[:, 6] - cases[0][2][6]) / np.sqrt(found[:, 6, 6])
        assert 0.8 < np.sqrt(np.mean(off**2)) < 1.25 and np.abs(off).max() < 4.5


@pytest.mark.parametrize("kind", KINDS)
def test_the_covariance_is_the_scatter_of_the_parameters(kind: int) -> None:
    rng = np.random.default_rng(kind)
    points, normals, _ = patch_of(kind, rng, 200)
    many = (points + NOISE * rng.standard_normal((200, 200, 1)) * normals).reshape(-1, 3)
    start = np.arange(201) * 200
    parameters = fit_all(many, np.tile(normals, (200, 1)), None, start).parameters[:, kind]
    found = covariances(many, start, np.full(200, kind), parameters)
    parameters[:, 3:6] *= np.sign(parameters[:, 5:6])
    columns = {PLANE: [3, 4], CYLINDER: [3, 4, 6], TORUS: [3, 4, 6, 7, 0, 1, 2]}.get(kind)
    columns = columns or ([0, 1, 2, 6] if kind == SPHERE else [3, 4, 6, 0, 1, 2])
    scatter = np.cov(parameters[:, columns].T)
    expected = found.mean(axis=0)[np.ix_(columns, columns)]
    np.testing.assert_allclose(np.diag(expected), np.diag(scatter), rtol=0.4)
    size = np.sqrt(np.diag(scatter))
    np.testing.assert_allclose(
        expected / np.outer(size, size), scatter / np.outer(size, size), atol=0.35
    )


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_too_little_says_so(kind: int) -> None:
    points, _, parameters = measured(kind, 0, UNKNOWNS[kind] + 1)
    assert np.isfinite(np.diag(alone(points, kind, parameters))[HAS[kind]]).all()
    assert np.isnan(alone(points[:-1], kind, parameters)).all()
    assert np.isnan(alone(points[:0], kind, parameters)).all()


@pytest.mark.parametrize("kind", KINDS)
def test_what_no_point_holds_is_open(kind: int) -> None:
    points, _, parameters = measured(kind, 0, 30)
    same = np.repeat(points[:1], 30, axis=0)
    deviation = np.sqrt(np.diag(alone(same, kind, parameters))[HAS[kind]])
    assert np.isfinite(deviation).all() and deviation.max() > 1e3


def test_no_surfaces() -> None:
    found = covariances(np.zeros((0, 3)), np.zeros(1), np.zeros(0, np.int32), np.zeros((0, 8)))
    assert found.shape == (0, 8, 8)
