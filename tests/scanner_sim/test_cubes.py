"""Programs of cubes against the tree of the part."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference.blocks import solid
from reference.rays import first_hit

from scanner_sim import blocks
from scanner_sim.cubes import Cubes
from scanner_sim.part import (
    FlatPart,
    Op,
    Part,
    box,
    cone,
    cylinder,
    difference,
    intersection,
    outside,
    rod,
    sphere,
    torus,
    union,
)  # fmt: skip
from scanner_sim.quadric import distance
from scanner_sim.random_blocks import random_block
from scanner_sim.raycast import cast, classify


def _every_kind() -> Part:
    plate = union(box((-7, -5, -3), (7, 5, 0)), rod((0, 0, -1), (0, 0, 4), 1.9))
    spike = intersection(cone((-4, 0, 4), (0.3, 0, -1), 0.4), box((-7, -5, -1), (0, 5, 9)))
    return difference(
        union(plate, spike),
        union(sphere((4, 3, 0), 2.0), cylinder((0, 0, -2), (1, 0.2, 0), 0.5)),
        torus((4, -3, 0.2), (0, 0.1, 1), 1.0, 0.4),
        difference(box((-6, -4, -1), (-4, 4, 1)), outside(sphere((-5, 0, 0), 1.5))),
    )  # fmt: skip


PARTS = {
    "box": lambda: box((0, 0, 0), (10, 4, 1)),
    "every kind": _every_kind,
    "every kind, moved": lambda: _every_kind().turned("x", 0.7).shifted(90, -300, 0.2),
    "test block": blocks.test_block,
    "filleted": lambda: random_block(9, "filleted"),
}


def _cube_of(cubes: Cubes, points: np.ndarray) -> np.ndarray:
    place = np.floor((points - cubes.grid[0]) / cubes.grid[1]).astype(int)
    return np.ravel_multi_index(tuple(place.T), tuple(cubes.grid[2].astype(int)))


def _answer(flat: FlatPart, start: int, stop: int, point: np.ndarray) -> bool:
    """What some instructions say about a point."""
    stack: list[bool] = []
    for op, arg, flag in flat.cubes.code[start:stop]:
        if op == Op.LEAF:
            inside = distance(flat.surfaces, np.array([arg]), point[None])[0] <= 0.0
            stack.append(bool(inside) != bool(flag))
        else:
            two = (stack.pop(), stack.pop())
            stack.append(any(two) if op == Op.UNION else all(two))
    (answer,) = stack
    return answer


@pytest.mark.parametrize("name", PARTS)
def test_what_is_left_says_what_the_tree_says(name: str) -> None:
    part = PARTS[name]()
    flat = part.flat()
    first = flat.cubes.first
    rng = np.random.default_rng(1)
    points = rng.uniform(*part.box, (20_000, 3))
    expected = solid(part, points)
    cube = _cube_of(flat.cubes, points)
    length = first[cube + 1] - first[cube]
    assert (length == 0).mean() > 0.4
    for k in rng.permutation(np.flatnonzero(length))[:2000]:
        assert _answer(flat, first[cube[k]], first[cube[k] + 1], points[k]) == expected[k]
    # Where nothing is left, the cube is all solid or all empty.
    some, other = np.zeros((2, len(first) - 1), bool)
    some[cube[expected]] = other[cube[~expected]] = True
    assert not (some & other)[np.diff(first) == 0].any()


def test_a_cube_knows_only_what_passes_through_it() -> None:
    flat = box((0, 0, 0), (8, 8, 8)).flat()
    length = np.diff(flat.cubes.first)
    at = _cube_of(
        flat.cubes, np.array([[4.0, 4, 4], [4, 4, 7.999], [7.999, 4, 7.999], [7.999] * 3])
    )
    assert length[at].tolist() == [0, 1, 3, 5]  # none, a face, an edge, a corner


def test_rays_along_the_sides_of_cubes() -> None:
    part = _every_kind()
    flat = part.flat()
    low, size, count = flat.cubes.grid
    rng = np.random.default_rng(2)
    origins, directions = [], []
    for k in range(3):
        ends = low[None] + size * rng.integers(0, count + 1, (100, 3))
        away = np.zeros((100, 3))
        away[:, k] = rng.choice([-1.0, 1.0], 100)
        origins.append(ends - 30.0 * away)
        directions.append(away)
    # ... and from corner to corner.
    ends = low[None] + size * rng.integers(0, count + 1, (2, 100, 3))
    across = ends[1] - ends[0]
    across = across[(across != 0.0).any(axis=1)]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    origins.append(ends[0, : len(across)] - 30.0 * across)
    directions.append(across)
    origin, direction = np.concatenate(origins), np.concatenate(directions)
    reach = np.full(len(origin), 100.0)
    expected = np.array(
        [first_hit(part, o, d, 100.0) for o, d in zip(origin, direction, strict=True)]
    )
    assert np.isfinite(expected).sum() > 50
    found = cast(flat, origin, direction, reach).distance
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6)


def test_a_ray_that_misses_all_cubes_and_a_place_outside_of_them() -> None:
    flat = sphere((0, 0, 0), 2.0).flat()
    origins = np.array([[0.0, 0, 9], [3, 0, 9], [0, 0, 9], [0, 0, 1e12]])
    down = np.tile([0.0, 0, -1], (4, 1))
    down[2] *= -1.0
    reach = np.array([math.inf, math.inf, math.inf, 9.0])
    np.testing.assert_array_equal(cast(flat, origins, down, reach).surface, [0, -1, -1, -1])
    places = np.array([[0.0, 0, 2], [0, 0, 2.1], [1e100, 0, 0]])
    np.testing.assert_array_equal(classify(flat, places, np.zeros(3, np.int32)), [1, 0, 0])
