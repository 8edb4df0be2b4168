"""Traced edges against lines and circles known in closed form."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from octoseg_ti.types import EdgeClass
from scanner_sim.edges import trace_edges
from scanner_sim.nearest import Edges, nearest_edge
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


def _line(start: tuple[float, ...], end: tuple[float, ...]) -> np.ndarray:
    share = np.linspace(0, 1, 4001)[:, None]
    return (1 - share) * np.array(start) + share * np.array(end)


def _circle(center: tuple[float, ...], radius: float, axis: int = 2) -> np.ndarray:
    angle = np.linspace(0, 2 * math.pi, 4001)
    ring = np.zeros((len(angle), 3))
    ring[:, (axis + 1) % 3] = radius * np.cos(angle)
    ring[:, (axis + 2) % 3] = radius * np.sin(angle)
    return np.array(center) + ring


def _box_lines(low: tuple[float, ...], high: tuple[float, ...]) -> list[np.ndarray]:
    lines = []
    for k in range(3):
        for i, j in product((0, 1), repeat=2):
            start, end = np.zeros(3), np.zeros(3)
            start[k], end[k] = low[k], high[k]
            for other, side in (((k + 1) % 3, i), ((k + 2) % 3, j)):
                start[other] = end[other] = (low, high)[side][other]
            lines.append(_line(tuple(start), tuple(end)))
    return lines


def _assert_same(edges: Edges, expected: list[np.ndarray], kind: EdgeClass) -> None:
    """Every expected place lies on a traced edge, and every traced place on an expected one."""
    from scipy.spatial import cKDTree

    places = np.concatenate(expected)
    chosen = edges.kind == kind
    part = Edges(edges.start[chosen], edges.end[chosen], edges.kind[chosen])
    far, _ = nearest_edge(part, places)
    assert far.max() < 0.01, f"{kind.name}: an edge is missing near {places[far.argmax()]}"
    ends = np.concatenate([part.start, part.end, 0.5 * (part.start + part.end)])
    back = cKDTree(places).query(ends)[0]
    assert back.max() < 0.01, f"{kind.name}: no edge is expected near {ends[back.argmax()]}"


def test_a_machined_block() -> None:
    low, high = (-10.0, -8.0, 0.0), (10.0, 8.0, 6.0)
    dish = math.sqrt(5.0**2 - 3.0**2)
    part = union(
        difference(
            box(low, high),
            rod((5, 0, 3), (5, 0, 9), 3.0),
            sphere((-5, 0, 6 + dish), 5.0),
        ),
        intersection(
            cone((0, 5, 12), (0, 0, -1), math.atan(0.25)), box((-4, 1, 4), (4, 9, 10))
        ),
    )  # fmt: skip
    expected = [
        *_box_lines(low, high),
        _circle((5, 0, 6), 3.0), _circle((5, 0, 3), 3.0), _circle((-5, 0, 6), 3.0),
        _circle((0, 5, 6), 1.5), _circle((0, 5, 10), 0.5),
    ]  # fmt: skip
    edges = trace_edges(part.flat())
    assert set(edges.kind) == {EdgeClass.SHARP}
    _assert_same(edges, expected, EdgeClass.SHARP)


def test_oblique_parts_have_oblique_edges() -> None:
    low, high = (-4.03, -3.07, 0.0), (5.01, 4.02, 3.05)
    part = box(low, high).turned("x", 0.4).turned("z", 1.1).shifted(3, -2, 7)
    lines = np.concatenate(_box_lines(low, high))
    for axis, angle in ((0, 0.4), (2, 1.1)):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        c, s = math.cos(angle), math.sin(angle)
        first, second = c * lines[:, i] - s * lines[:, j], s * lines[:, i] + c * lines[:, j]
        lines[:, i], lines[:, j] = first, second
    lines += np.array([3, -2, 7])
    _assert_same(trace_edges(part.flat()), [lines], EdgeClass.SHARP)


def _rounded_block() -> Part:
    """A block with a rounded edge, along y at x = 5, z = 4, and a key with a rounded rim."""
    cut = intersection(
        half_space((4, 0, 0), (-1, 0, 0)), half_space((0, 0, 3), (0, 0, -1)),
        outside(cylinder((4, 0, 3), (0, 1, 0), 1.0, fillet=True)),
    )  # fmt: skip
    key = union(
        rod((-1, 0, 3), (-1, 0, 4.5), 1.5), torus((-1, 0, 4), (0, 0, 1), 1.5, 0.5, fillet=True)
    )
    return union(difference(box((-5, -4, 0), (5, 4, 4)), cut), key)


def test_fillets_have_smooth_borders() -> None:
    edges = trace_edges(_rounded_block().flat())
    fillet = [
        _line((5, -4, 3), (5, 4, 3)),
        _line((4, -4, 4), (4, 4, 4)),
        _circle((-1, 0, 4.5), 1.5),
    ]
    _assert_same(edges, fillet, EdgeClass.FILLET)
    ends = [p[(p[:, 0] >= 4) & (p[:, 2] >= 3)]
            for p in (_circle((4, y, 3), 1.0, axis=1) for y in (-4, 4))]  # fmt: skip
    sharp = [
        _circle((-1, 0, 4), 2.0), *ends,
        _line((5, -4, 0), (5, -4, 3)), _line((5, 4, 0), (5, 4, 3)),
        _line((4, -4, 4), (-5, -4, 4)), _line((4, 4, 4), (-5, 4, 4)),
        *(p for p in _box_lines((-5, -4, 0), (5, 4, 4)) if not np.allclose(p[:, 0], 5) and
          not (np.allclose(p[:, 2], 4) and np.allclose(np.abs(p[:, 1]), 4))),
        _line((5, -4, 0), (5, 4, 0)),
    ]  # fmt: skip
    _assert_same(edges, sharp, EdgeClass.SHARP)


def test_a_smooth_joint_of_two_patches() -> None:
    part = union(
        intersection(cylinder((0, 0, 0), (0, 0, 1), 2.0), box((-3, -3, 0), (3, 3, 5))),
        intersection(sphere((0, 0, 5), 2.0), box((-3, -3, 5), (3, 3, 8))),
    )
    edges = trace_edges(part.flat())
    _assert_same(edges, [_circle((0, 0, 5), 2.0)], EdgeClass.SMOOTH)
    _assert_same(edges, [_circle((0, 0, 0), 2.0)], EdgeClass.SHARP)


def test_a_ball_has_no_edges() -> None:
    edges = trace_edges(sphere((0, 0, 0), 3.0).flat())
    assert len(edges.kind) == 0
    far, kind = nearest_edge(edges, np.zeros((2, 3)))
    assert np.isinf(far).all() and (kind == EdgeClass.NONE).all()


def test_nearest_edge_equals_brute_force() -> None:
    edges = trace_edges(_rounded_block().flat())
    points = np.random.default_rng(0).uniform((-6, -5, -1), (6, 5, 6), (300, 3))
    span = edges.end - edges.start
    offset = points[:, None] - edges.start
    share = np.clip(np.sum(offset * span, axis=2) / np.sum(span * span, axis=1), 0, 1)
    brute = np.linalg.norm(offset - share[..., None] * span, axis=2).min(axis=1)
    np.testing.assert_allclose(nearest_edge(edges, points)[0], brute, atol=1e-12)
