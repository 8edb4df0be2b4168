"""Solids: boxes around them, movement, and what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.rays import solid

from octoseg_ti.errors import DataError
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
from scanner_sim.quadric import canonical

_NUMBER = st.floats(-5, 5)
_RADIUS = st.floats(0.5, 4)
_POINT = st.tuples(_NUMBER, _NUMBER, _NUMBER)


def _primitives() -> st.SearchStrategy[Part]:
    return st.one_of(
        st.builds(sphere, _POINT, _RADIUS),
        st.builds(lambda c, r, t: torus(c, (0, 1, 0), r + 0.1, r * t), _POINT, _RADIUS,
                  st.floats(0.1, 0.9)),
        st.builds(lambda p, q: box(np.minimum(p, q), np.maximum(p, q)), _POINT, _POINT),
        st.builds(lambda p, h, r: rod(p, np.add(p, (0, 0, h)), r), _POINT, _RADIUS, _RADIUS),
    )  # fmt: skip


def _parts() -> st.SearchStrategy[Part]:
    return st.recursive(
        _primitives(),
        lambda inner: st.one_of(
            st.builds(union, inner, inner), st.builds(intersection, inner, inner),
            st.builds(difference, inner, inner),
        ),
        max_leaves=6,
    )  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(_parts(), st.floats(-3, 3), _POINT)
def test_boxes_hold_all_of_the_part_and_movement_moves_it(
    part: Part, angle: float, shift: tuple[float, float, float]
) -> None:
    points = np.random.default_rng(0).uniform(-12, 12, (4000, 3))
    inside = points[solid(part, points)]
    assert (inside >= part.box[0] - 1e-9).all() and (inside <= part.box[1] + 1e-9).all()
    moved = part.turned("y", angle).shifted(*shift)
    c, s = math.cos(angle), math.sin(angle)
    turned = inside @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) + np.array(shift)
    assert (turned >= moved.box[0] - 1e-9).all() and (turned <= moved.box[1] + 1e-9).all()
    assert solid(moved, turned).mean() > 0.99 if len(turned) else True


def test_operators_are_the_functions() -> None:
    a, b = sphere((0, 0, 0), 2.0), sphere((1, 0, 0), 2.0)
    points = np.random.default_rng(1).uniform(-4, 4, (2000, 3))
    in_a, in_b = solid(a, points), solid(b, points)
    np.testing.assert_array_equal(solid(a | b, points), in_a | in_b)
    np.testing.assert_array_equal(solid(a & b, points), in_a & in_b)
    np.testing.assert_array_equal(solid(a - b, points), in_a & ~in_b)


def test_equal_surfaces_have_one_normal_form() -> None:
    up, down = half_space((5, 1, 2), (0, 0, 1)), half_space((-3, 0, 2), (0, 0, -2))
    assert up.surface is not None and down.surface is not None
    (first, flip_up), (second, flip_down) = canonical(up.surface), canonical(down.surface)
    assert first.key() == second.key()
    assert flip_up != flip_down
    tubes = [cylinder((1, 2, 3), (0, 0, 1), 2.0), cylinder((1, 2, -9), (0, 0, -1), 2.0)]
    assert len({canonical(t.surface)[0].key() for t in tubes if t.surface}) == 1


@pytest.mark.parametrize(
    "build",
    [
        lambda: sphere((0, 0, 0), 0.0),
        lambda: cylinder((0, 0, 0), (0, 0, 0), 1.0),
        lambda: cone((0, 0, 0), (0, 0, 1), 2.0),
        lambda: torus((0, 0, 0), (0, 0, 1), 1.0, 1.0),
        lambda: sphere((0, math.nan, 0), 1.0),
        lambda: union(),
        lambda: outside(box((0, 0, 0), (1, 1, 1))),
        lambda: half_space((0, 0, 0), (0, 0, 1)).flat(),
    ],
)
def test_what_is_no_solid_is_refused(build: object) -> None:
    with pytest.raises(DataError):
        build()  # type: ignore[operator]


def test_too_deep_a_tree_is_refused() -> None:
    part = sphere((0, 0, 0), 1.0)
    for _ in range(40):
        part = union(sphere((0, 0, 0), 1.0), part)
    with pytest.raises(DataError, match="deep"):
        part.flat()
