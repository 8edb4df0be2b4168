"""The plane that walls stand on, found from the last points of their rims."""

from typing import NamedTuple

import numpy as np
import pytest

from octoseg_ti.borders.base import find_base

DOWN = np.array([0.0, 0.0, -1.0])


class Rims(NamedTuple):
    point: np.ndarray
    normal: np.ndarray
    outward: np.ndarray
    label: np.ndarray


def walls(lift: tuple[float, ...], rough: float, seed: int = 0, many: int = 60) -> Rims:
    """The rims of the four walls of a box on the plane z = 0, some way above that plane each."""
    rng = np.random.default_rng(seed)
    parts = []
    for k, up in enumerate(lift):
        along = rng.uniform(-10, 10, many)
        z = up + rough * rng.random(many) ** 2 + rng.normal(0, 0.005, many)
        turn = np.pi / 2 * k
        normal = np.array([np.cos(turn), np.sin(turn), 0.0])
        side = np.array([-np.sin(turn), np.cos(turn), 0.0])
        point = 10 * normal + np.outer(along, side) + np.outer(z, -DOWN)
        outward = DOWN + rng.normal(0, 0.05, (many, 1)) * side
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        parts.append((point, np.tile(normal, (many, 1)), outward, np.full(many, 5 + k)))
    return Rims(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def boxes(points: np.ndarray) -> np.ndarray:
    """A box for each point."""
    return np.concatenate([points, points], axis=1)


def turned(rims: Rims, seed: int) -> tuple[Rims, np.ndarray]:
    rotation = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return Rims(*(a @ rotation.T for a in rims[:3]), rims.label), rotation


@pytest.mark.parametrize("seed", range(4))
def test_walls_with_ragged_rims_show_the_plane(seed: int) -> None:
    rims, rotation = turned(walls((0.0, 0.9, 0.0, 0.7), 0.8, seed), seed)
    cloud = np.random.default_rng(seed).uniform((-10, -10, 0), (10, 10, 9), (500, 3))
    cloud = cloud @ rotation.T
    base = find_base(*rims, boxes(cloud), 1.0)
    assert base is not None
    np.testing.assert_allclose(base.above(cloud), (cloud @ rotation)[:, 2], atol=0.12)
    np.testing.assert_array_equal(base.walls, [5, 6, 7, 8])


def test_the_plane_is_neither_within_the_walls_nor_beyond_them() -> None:
    # Stripes end at any distance up to a spacing from the plane.
    heights = []
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        rims = walls((0.0,) * 4, 0.0, seed, many=400)
        rims.point[:, 2] += rng.random(len(rims.point))
        base = find_base(*rims, boxes(rims.point), 1.0)
        assert base is not None
        heights.append(base.above(np.zeros((1, 3)))[0])
    assert abs(np.mean(heights)) < 0.02


def test_where_all_rims_are_even_the_plane_is_above_the_next_stripe() -> None:
    # One wall ends 0.1 above its plane, another 0.8: the plane is 0 to 0.2 below the first.
    rims = walls((0.1, 0.8, 0.3, 0.8), 0.0)
    base = find_base(*rims, boxes(rims.point), 1.0)
    assert base is not None
    np.testing.assert_allclose(base.above(rims.point), rims.point[:, 2], atol=0.12)


def test_no_plane_without_walls_that_agree() -> None:
    two = walls((0.0, 0.3), 0.5)
    assert find_base(*two, boxes(two.point), 1.0) is None
    rims = walls((0.0, 4.0, 8.0, 2.0), 0.5)
    assert find_base(*rims, boxes(rims.point), 1.0) is None
    # The part goes on below.
    rims = walls((0.0, 0.3, 0.0, 0.3), 0.5)
    below = np.concatenate([rims.point, [[0.0, 0.0, -3.0]]])
    assert find_base(*rims, boxes(below), 1.0) is None
    few = Rims(*(column[::10] for column in rims))
    assert find_base(*few, boxes(rims.point), 1.0) is None
    none = Rims(*(column[:0] for column in rims))
    assert find_base(*none, boxes(rims.point), 1.0) is None


def test_faces_in_the_plane_do_not_stand_on_it() -> None:
    rims = walls((0.0, 0.3, 0.0, 0.3), 0.5)
    flat = Rims(rims.point, np.tile(-DOWN, (len(rims.point), 1)), rims.outward, rims.label)
    assert find_base(*flat, boxes(rims.point), 1.0) is None
