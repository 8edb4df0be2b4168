"""Rays against triangles: the tree against every triangle one by one, and no gaps between them."""

from __future__ import annotations

import numpy as np
import pytest
from reference.shapes import ball, cube, rod
from reference.triangles import first_hits

from scanner_sim.bvh import ANY, build_tree, cast_triangles


def _soup(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(-8, 8, (count, 1, 3)) + rng.normal(size=(count, 3, 3))


def _meshes() -> dict[str, np.ndarray]:
    return {
        "one": _soup(1, 0), "five": _soup(5, 1), "soup": _soup(700, 2), "ball": ball(8.0),
        "cube": cube(10.0, (-5, -5, -5)), "rod": rod(), "flat": _soup(90, 3) * [1, 1, 0],
    }  # fmt: skip


def _rays(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= 40.0 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-6, 6, (count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("name", _meshes())
def test_first_hits_match_every_triangle_one_by_one(name: str) -> None:
    corners = _meshes()[name]
    tree = build_tree(corners, np.zeros(len(corners), np.int32))
    origins, directions = _rays(400, seed=4)
    far, which = cast_triangles(tree, origins, directions, np.full(400, np.inf))
    expected, triangle = first_hits(corners, origins, directions)
    np.testing.assert_allclose(far, expected, rtol=1e-12)
    assert (which >= 0).sum() > (0 if name == "one" else 3)
    if name != "flat":  # there, many triangles lie one on the other
        assert (which == triangle).mean() > 0.99  # at an edge either of the two may be named
    reach = 40.0 + np.random.default_rng(5).uniform(-8, 8, 400)
    for any_hit in (False, True):
        found = cast_triangles(tree, origins, directions, reach, any_hit=any_hit)[1] >= 0
        np.testing.assert_array_equal(found, expected < reach)


def test_boxes_hold_their_triangles_and_every_triangle_is_in_one_leaf() -> None:
    corners = _soup(333, 6)
    tree = build_tree(corners, np.arange(333))
    np.testing.assert_array_equal(np.sort(tree.number), np.arange(333))
    np.testing.assert_array_equal(tree.surface, tree.number)
    leaves = len(tree.starts) - 1
    assert 1 <= np.diff(tree.starts).min() and np.diff(tree.starts).max() <= 4
    for leaf in range(leaves):
        inner = tree.corners[tree.starts[leaf] : tree.starts[leaf + 1]].reshape(-1, 3)
        node = leaves + leaf
        while node:
            assert (inner >= tree.boxes[node, :3]).all() and (inner <= tree.boxes[node, 3:]).all()
            node //= 2


@pytest.mark.parametrize("name", ["ball", "cube", "rod"])
def test_no_ray_leaves_a_closed_mesh_between_its_triangles(name: str) -> None:
    corners = _meshes()[name]
    tree = build_tree(corners, np.zeros(len(corners), np.int32))
    share = np.linspace(0.0, 1.0, 7)[:, None, None]
    ends = np.concatenate([corners, np.roll(corners, -1, axis=1)]).reshape(2, -1, 3)
    aims = ((1 - share) * ends[0] + share * ends[1]).reshape(-1, 3)
    inside = corners.reshape(-1, 3).mean(axis=0) + np.array([0.123, -0.234, 0.345])
    directions = aims - inside
    length = np.linalg.norm(directions, axis=1)
    directions /= length[:, None]
    origins = np.tile(inside, (len(aims), 1))
    far = cast_triangles(tree, origins, directions, np.full(len(aims), np.inf))[0]
    np.testing.assert_allclose(far, length, atol=1e-9)


def test_rays_along_the_axes_and_the_sides() -> None:
    tree = build_tree(cube(10.0), np.arange(12) // 2)
    places = np.array([[0.0, 0.0], [5.0, 5.0], [10.0, 10.0], [0.0, 5.0], [10.001, 5.0], [5.0, 0.0]])
    origins = np.column_stack([places, np.full(6, 30.0)])
    down = np.tile([0.0, 0.0, -1.0], (6, 1))
    far = cast_triangles(tree, origins, down, np.full(6, np.inf))[0]
    np.testing.assert_allclose(far, [20, 20, 20, 20, np.inf, 20])


def test_a_ray_may_ask_for_one_surface() -> None:
    corners = cube(10.0)
    surface = np.arange(12) // 2
    tree = build_tree(corners, surface)
    origins, directions = _rays(300, seed=7)
    full = np.full(300, np.inf)
    for s in range(6):
        far, which = cast_triangles(tree, origins, directions, full, wanted=np.full(300, s))
        expected = first_hits(corners[surface == s], origins, directions)[0]
        np.testing.assert_allclose(far, expected, rtol=1e-12)
        assert (surface[which[which >= 0]] == s).all()
    anything = cast_triangles(tree, origins, directions, full, wanted=np.full(300, ANY))[0]
    np.testing.assert_allclose(anything, first_hits(corners, origins, directions)[0], rtol=1e-12)


def test_no_rays() -> None:
    tree = build_tree(cube(), np.zeros(12, np.int32))
    assert len(cast_triangles(tree, np.empty((0, 3)), np.empty((0, 3)), np.empty(0))[0]) == 0
