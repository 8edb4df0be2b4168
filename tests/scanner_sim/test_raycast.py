"""Rays against plain NumPy: polynomial roots and membership by the tree."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference.rays import first_hit, leaves, solid

from octoseg_ti.types import SurfaceKind
from scanner_sim.part import (
    Part,
    box,
    cone,
    cylinder,
    difference,
    half_space,
    intersection,
    outside,
    rod,
    sphere,
    torus,
    union,
)  # fmt: skip
from scanner_sim.quadric import distance, gradient
from scanner_sim.raycast import cast, classify


def _room() -> Part:
    return box((-6, -6, -6), (6, 6, 6))


def _solids() -> dict[str, Part]:
    tilted = (1.0, 2.0, 3.0)
    nested = difference(
        union(box((-5, -4, -3), (5, 4, 0)), rod((0, 0, -1), (0, 0, 4), 2.0)),
        union(sphere((4, 3, 0), 2.0), intersection(cylinder((0, 0, 0), (1, 0, 0), 1.0), _room())),
        torus((-3, 0, 0), (0, 0, 1), 1.0, 0.4),
    )
    return {
        "plane": intersection(_room(), half_space((0, 0, 1), tilted)),
        "sphere": sphere((1, 0, 0), 3.0),
        "cylinder": intersection(_room(), cylinder((0, 1, 0), tilted, 2.0)),
        "cone": intersection(_room(), cone((0, 0, 4), (0.2, 0.1, -1), math.radians(25))),
        "torus": torus((0.5, 0, 0), tilted, 3.0, 1.0),
        "thin torus": torus((0, 0, 0), (0, 0, 1), 4.0, 0.05),
        "hollow": difference(_room(), sphere((0, 0, 6), 4.0), rod((0, -9, 0), (0, 9, 0), 2.0)),
        "outside": intersection(_room(), outside(cylinder((0, 0, 0), (0, 0, 1), 3.0))),
        "boxes that share sides": union(
            box((-3, -3, -3), (0, 3, 2)), box((0, -3, -3), (3, 3, 2)), box((-1, -3, 2), (1, 3, 4))
        ),
        "nested": nested,
        "nested, moved": nested.turned("x", 0.7).shifted(0.5, -0.3, 0.2).turned("z", 2.0),
    }


def _rays(count: int, seed: int, radius: float = 40.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= radius / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-5, 5, (count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("name", _solids())
def test_first_hits_match_polynomial_roots(name: str) -> None:
    part = _solids()[name]
    origins, directions = _rays(400, seed=1)
    hits = cast(part.flat(), origins, directions, np.full(400, math.inf))
    expected = [first_hit(part, o, d, 200.0) for o, d in zip(origins, directions, strict=True)]
    found = np.isfinite(expected)
    assert found.sum() > 5
    np.testing.assert_array_equal(np.isfinite(hits.distance), found)
    np.testing.assert_allclose(hits.distance[found], np.array(expected)[found], atol=2e-7)


@pytest.mark.parametrize("name", _solids())
def test_hits_lie_on_their_surface_and_sides_point_outward(name: str) -> None:
    part = _solids()[name]
    flat = part.flat()
    origins, directions = _rays(3000, seed=2)
    hits = cast(flat, origins, directions, np.full(3000, math.inf))
    hit = hits.surface >= 0
    surface, side = hits.surface[hit], hits.side[hit]
    points = origins[hit] + hits.distance[hit, None] * directions[hit]
    assert np.abs(distance(flat.surfaces, surface, points)).max() < 1e-9
    normals = gradient(flat.surfaces, surface, points) * side[:, None]
    assert (np.einsum("ij,ij->i", normals, directions[hit]) < 1e-9).all()
    # Edges aside, it is empty in front of the hit and solid behind it.
    clear = solid(part, points - 1e-6 * normals) & ~solid(part, points + 1e-6 * normals)
    assert clear.mean() > 0.995
    np.testing.assert_array_equal(classify(flat, points, surface), side)


def test_rays_that_start_inside_find_the_way_out() -> None:
    part = difference(_room(), sphere((0, 0, 0), 2.0))
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = 3.0 * directions
    out = cast(part.flat(), origins, directions, np.full(200, math.inf))
    expected = [first_hit(part, o, d, 100.0) for o, d in zip(origins, directions, strict=True)]
    np.testing.assert_allclose(out.distance, expected, atol=1e-9)


def test_reach_and_shadow() -> None:
    part = _solids()["nested"]
    origins, directions = _rays(600, seed=3)
    full = cast(part.flat(), origins, directions, np.full(600, math.inf))
    rng = np.random.default_rng(0)
    reach = 40.0 + rng.uniform(-6, 6, 600)
    expected = full.distance < reach
    assert 0 < expected.sum() < 600
    hits = cast(part.flat(), origins, directions, reach)
    np.testing.assert_array_equal(hits.surface >= 0, expected)
    brute = [first_hit(part, o, d, r) for o, d, r in zip(origins, directions, reach, strict=True)]
    np.testing.assert_array_equal(np.isfinite(brute), expected)


@pytest.mark.parametrize("name", sorted(_solids()))
def test_from_outside_the_ways_into_the_solid_are_enough(name: str) -> None:
    flat = _solids()[name].flat()
    origins, directions = _rays(600, seed=4)
    endless = np.full(600, math.inf)
    full = cast(flat, origins, directions, endless)
    into = cast(flat, origins, directions, endless, from_outside=True)
    for one, other in zip(full, into, strict=True):
        np.testing.assert_array_equal(one, other)
    assert (full.surface >= 0).sum() > 10
    reach = np.where(np.isfinite(full.distance), full.distance, 40.0) - 1e-3
    hidden = cast(flat, origins, directions, reach, from_outside=True)
    assert (hidden.surface < 0).all()
    reach += 2e-3
    hidden = cast(flat, origins, directions, reach, from_outside=True)
    np.testing.assert_array_equal(hidden.surface >= 0, full.surface >= 0)


def test_rays_along_the_axes_meet_boxes() -> None:
    part = _solids()["boxes that share sides"]
    grid = np.linspace(-2.9, 2.9, 30)
    x, y = (v.ravel() for v in np.meshgrid(grid, grid))
    origins = np.column_stack([x, y, np.full(x.size, 50.0)])
    down = np.tile([0.0, 0.0, -1.0], (x.size, 1))
    hits = cast(part.flat(), origins, down, np.full(x.size, math.inf))
    np.testing.assert_allclose(hits.distance, np.where(np.abs(x) < 1, 46.0, 48.0), atol=1e-12)


def test_a_shared_side_is_one_face_without_a_seam() -> None:
    flat = _solids()["boxes that share sides"].flat()
    assert len(flat.surfaces.kind) == 10
    inner = np.array([[0.0, 1.0, -1.0]])
    wall = [s for s, (k, row) in enumerate(zip(flat.surfaces.kind, flat.surfaces.data, strict=True))
            if k == SurfaceKind.PLANE and abs(row[3]) == 1.0 and row[0] == 0.0]  # fmt: skip
    assert len(wall) == 1
    assert classify(flat, inner, np.array(wall, np.int32))[0] == 0


def test_no_rays() -> None:
    hits = cast(_room().flat(), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    assert len(hits.surface) == 0
    assert len(classify(_room().flat(), np.empty((0, 3)), np.empty(0, np.int32))) == 0


def test_gradients_agree_with_finite_differences() -> None:
    rng = np.random.default_rng(4)
    step = 1e-6
    for name, part in _solids().items():
        flat = part.flat()
        points = rng.uniform(-5, 5, (200, 3))
        index = rng.integers(len(flat.surfaces.kind), size=200).astype(np.int32)
        slopes = np.stack(
            [(distance(flat.surfaces, index, points + step * e)
              - distance(flat.surfaces, index, points - step * e)) / (2 * step) for e in np.eye(3)],
            axis=1,
        )  # fmt: skip
        assert np.abs(slopes - gradient(flat.surfaces, index, points)).max() < 1e-6, name


def test_trees_keep_their_leaves() -> None:
    assert len(leaves(_solids()["nested"])) == 6 + 3 + 1 + 7 + 1
