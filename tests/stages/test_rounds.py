"""Shallow rounds between planes are found by what all of their points say together."""

import math

import numpy as np
import pytest
from reference.device_grid import samples_of

from octoseg_ti import SurfaceKind
from octoseg_ti.stages.rounds import hidden_rounds, refitted_rounds
from octoseg_ti.stages.sets import Surfaces

NOISE, HALF, LENGTH = 0.06, 0.13, 20.0  # deviation [mm], half the angle [rad], length [mm]


def edge(
    radius: float, *, hollow: bool, seed: int, noise: float = 0.04
) -> tuple[np.ndarray, np.ndarray, Surfaces, np.ndarray]:
    """Return points around a turned edge, their planes, these as surfaces, and the true places.

    The places are those across the edge: a round reaches from -w to w, w = radius sin HALF.
    """
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-10.0, 10.0, 6000), rng.uniform(0.0, LENGTH, 6000)
    wide = radius * math.sin(HALF)
    plane, ball = np.abs(x) * math.tan(HALF), np.full(len(x), radius / math.cos(HALF))
    ball -= np.sqrt(np.maximum(radius**2 - x**2, 0.0))
    z = np.where(np.abs(x) < wide, ball, plane) * (1.0 if hollow else -1.0)
    flat = np.column_stack([x, y, z + rng.normal(0.0, noise, len(x))])
    sign = -1.0 if hollow else 1.0
    normal = np.array([[-s * sign * math.sin(HALF), 0.0, math.cos(HALF)] for s in (1.0, -1.0)])
    at = np.array([[s * 5.0, 3.0, -5.0 * sign * math.tan(HALF)] for s in (-1.0, 1.0)])
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    parameters = np.full((3, 8), np.nan)
    parameters[:2, :3], parameters[:2, 3:6] = at @ turn.T, normal @ turn.T
    parameters[1, 3:6] *= -1.0  # normals have no side
    parameters[2] = parameters[0]  # in contact with nothing
    kind = np.full(3, int(SurfaceKind.PLANE), np.int32)
    label = np.where(x < 0.0, 0, 1).astype(np.int32)
    return flat @ turn.T, label, Surfaces(kind=kind, parameters=parameters), x


PAIRS = np.array([[0, 1]])


@pytest.mark.parametrize("hollow", [False, True])
@pytest.mark.parametrize("radius", [9.0, 14.0, 25.0])
def test_the_round_between_two_planes_is_found(radius: float, hollow: bool) -> None:
    point, label, surfaces, x = edge(radius, hollow=hollow, seed=int(radius))
    samples = samples_of(point, np.zeros_like(point))
    new, sides, on = hidden_rounds(samples, label, surfaces, PAIRS, noise=NOISE, limit=3.0)
    assert new.kind.tolist() == [SurfaceKind.CYLINDER] and sides.tolist() == [[0, 1]]
    assert new.parameters[0, 6] == pytest.approx(radius, rel=0.1)
    wide = new.parameters[0, 6] * math.sin(HALF)
    np.testing.assert_array_equal(on >= 0, np.abs(x) <= wide)
    # It touches both planes.
    for place, normal in surfaces.parameters[:2].reshape(2, 8)[:, :6].reshape(2, 2, 3):
        off = abs((new.parameters[0, :3] - place) @ normal)
        assert off == pytest.approx(new.parameters[0, 6], rel=1e-9)
        assert abs(new.parameters[0, 3:6] @ normal) < 1e-12


@pytest.mark.parametrize("seed", range(4))
def test_a_sharp_edge_and_a_fillet_are_no_rounds(seed: int) -> None:
    for radius in (0.0, 2.0):
        point, label, surfaces, _ = edge(radius, hollow=seed % 2 == 0, seed=seed)
        samples = samples_of(point, np.zeros_like(point))
        new, sides, on = hidden_rounds(samples, label, surfaces, PAIRS, noise=NOISE, limit=3.0)
        assert len(new) == len(sides) == 0 and np.all(on == -1)


def test_only_planes_that_meet_at_small_angles_are_asked() -> None:
    point, label, surfaces, _ = edge(14.0, hollow=False, seed=0)
    samples = samples_of(point, np.zeros_like(point))
    for pairs in (np.zeros((0, 2), np.int64), np.array([[0, 2]]), np.array([[1, 2]])):
        assert len(hidden_rounds(samples, label, surfaces, pairs, noise=NOISE, limit=3.0)[0]) == 0
    surfaces.kind[1] = int(SurfaceKind.CONE)
    assert len(hidden_rounds(samples, label, surfaces, PAIRS, noise=NOISE, limit=3.0)[0]) == 0


def test_rounds_below_the_limit_are_edges() -> None:
    point, label, surfaces, _ = edge(9.0, hollow=False, seed=1)
    samples = samples_of(point, np.zeros_like(point))
    assert len(hidden_rounds(samples, label, surfaces, PAIRS, noise=NOISE, limit=14.0)[0]) == 0


def test_planes_without_points_at_their_edge_have_no_round() -> None:
    point, label, surfaces, x = edge(14.0, hollow=False, seed=3)
    far = np.abs(x) > 8.0
    samples = samples_of(point[far], np.zeros_like(point[far]))
    with np.errstate(all="raise"):
        new, _, on = hidden_rounds(samples, label[far], surfaces, PAIRS, noise=NOISE, limit=3.0)
    assert len(new) == 0 and np.all(on == -1)


def test_rounds_follow_their_planes() -> None:
    point, label, surfaces, x = edge(12.0, hollow=False, seed=2)
    samples = samples_of(point, np.zeros_like(point))
    parameters = surfaces.parameters.copy()
    parameters[2] = 0.0
    label[np.abs(x) < 1.0] = 2
    found = refitted_rounds(samples, label, parameters, PAIRS, noise=NOISE, limit=3.0)
    np.testing.assert_array_equal(found[:2], parameters[:2])
    assert found[2, 6] == pytest.approx(12.0, rel=0.1)
    # Nothing shows one: it stays.
    sharp, label, _, x = edge(0.0, hollow=False, seed=2)
    label[np.abs(x) < 1.0] = 2
    found = refitted_rounds(
        samples_of(sharp, np.zeros_like(sharp)), label, parameters, PAIRS, noise=NOISE, limit=3.0
    )
    np.testing.assert_array_equal(found, parameters)
