"""Random blocks: their names, shapes known in closed form, and a sample of the whole check."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import verify_blocks
from reference.blocks import first_hits, solid

from octoseg_ti.errors import DataError
from octoseg_ti.types import EdgeClass, SurfaceKind
from scanner_sim import blocks
from scanner_sim.bases import Corner, drawn_body
from scanner_sim.draw import BLEND, FAMILIES, FILLET, Draw
from scanner_sim.edges import trace_edges
from scanner_sim.features import (
    FILLET_LIMIT,
    Rim,
    Shape,
    block_shape,
    dome_shape,
    drill_shape,
    pin_shape,
    round_shape,
)
from scanner_sim.menu import random_feature
from scanner_sim.part import Part
from scanner_sim.random_blocks import describe_block, parse_name, random_block

_PLANE, _CYLINDER, _CONE = SurfaceKind.PLANE, SurfaceKind.CYLINDER, SurfaceKind.CONE
_SPHERE, _TORUS = SurfaceKind.SPHERE, SurfaceKind.TORUS


def _volume(part: Part, low: np.ndarray, high: np.ndarray, count: int = 400_000) -> float:
    points = np.random.default_rng(0).uniform(low, high, (count, 3))
    return float(solid(part, points).mean() * np.prod(np.subtract(high, low)))


def _height(part: Part, x: float, y: float, start: float = 50.0) -> float:
    """Height of the top of a part at a place."""
    down = np.array([[0.0, 0.0, -1.0]])
    return start - float(first_hits(part, np.array([[x, y, start]]), down, np.array([200.0]))[0])


def test_the_same_name_is_the_same_block() -> None:
    first, again = (blocks.by_name("random:17:filleted") for _ in range(2))
    assert first.name == "random:17:filleted" and first.nominal_points == 90_000
    for one, two in zip(first.flat().surfaces, again.flat().surfaces, strict=True):
        np.testing.assert_array_equal(one, two)
    assert blocks.by_name("random:17").name == "random:17:mixed"
    seen = {blocks.random_block(s, f).flat().surfaces.data.tobytes()
            for s in range(2) for f in FAMILIES}  # fmt: skip
    assert len(seen) == 2 * len(FAMILIES)
    assert describe_block(17, "filleted") == describe_block(17, "filleted")
    assert parse_name("random:0:sharp") == (0, "sharp")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("random", "random:SEED"), ("random:", "whole number"), ("random:x", "whole number"),
        ("random:-1", "whole number"), ("random:1.5", "whole number"), ("random:²", "whole number"),
        ("random:3:round", "sharp, filleted, smooth, mixed"), ("random:1:sharp:2", "names no"),
        ("random:" + "9" * 5000, "whole number"), ("random:18446744073709551616", "below 2"),
        ("random17", "there is no part"),
    ],
)  # fmt: skip
def test_bad_names_are_refused(name: str, message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        blocks.by_name(name)
    assert "\n" not in str(caught.value)


def test_a_rounded_boss_has_the_profile_of_its_drawing() -> None:
    radius, height, end, foot = 8.0, 6.0, 1.5, 2.0
    shape = round_shape(radius, height, end=Rim(round=end), foot=Rim(round=foot))
    assert shape.kinds == (_PLANE, _CYLINDER) and shape.extent == (10.0, 10.0)
    for place, expected in (
        (0.0, height), (6.4, height),
        (6.5 + 1.5 * math.sin(0.7), height - 1.5 + 1.5 * math.cos(0.7)),
        (10.0 - 2.0 * math.sin(0.5), 2.0 - 2.0 * math.cos(0.5)),
    ):  # fmt: skip
        assert _height(shape.solid, place * 0.6, place * 0.8) == pytest.approx(expected, abs=1e-9)


def test_a_leaning_boss_is_rounded_without_an_edge() -> None:
    shape = round_shape(9.0, 7.0, lean=0.4, end=Rim(round=2.0), foot=Rim(round=1.5))
    edges = trace_edges(shape.solid.flat())
    above = np.minimum(edges.start[:, 2], edges.end[:, 2]) > 0.01
    assert set(edges.kind[above]) == {EdgeClass.FILLET}
    blend = round_shape(12.0, 9.0, end=Rim(round=4.0))
    assert blend.kinds == (_PLANE, _CYLINDER, _TORUS)
    edges = trace_edges(blend.solid.flat())
    above = np.minimum(edges.start[:, 2], edges.end[:, 2]) > 0.01
    assert set(edges.kind[above]) == {EdgeClass.SMOOTH}


@pytest.mark.parametrize(
    ("shape", "volume", "kinds"),
    [
        (round_shape(5, 4), 25 * math.pi * 4, (_PLANE, _CYLINDER)),
        (round_shape(5, 4, end=Rim(chamfer=1.5)),
         math.pi * (25 * 2.5 + 1.5 / 3 * (25 + 3.5 * 5 + 3.5**2)), (_PLANE, _CYLINDER, _CONE)),
        (drill_shape(3, 5, tip=True),
         math.pi * 9 * (5 + 1 / math.tan(math.radians(59))), (_CYLINDER, _CONE)),
        (pin_shape(4, 5), math.pi * (16 * 5 + 2 / 3 * 64), (_CYLINDER, _SPHERE)),
        (dome_shape(6, 3), math.pi * 3 * (3 * 36 + 9) / 6, (_SPHERE,)),
        (block_shape((8, 6), 5, corner=2.0), 4 * (48 - 4 + math.pi) * 5, (_PLANE,) * 5),
        (block_shape((8, 3.5), 5, corner=3.5), (9 * 7 + math.pi * 3.5**2) * 5,
         (_PLANE,) * 3 + (_CYLINDER,) * 2),
        (block_shape((8, 6), 5, end=Rim(chamfer=2.0)),
         # Simpson's rule is exact: 16 x 12 below, 12 x 8 on top, 14 x 10 between.
         192 * 3 + 2 / 6 * (192 + 4 * 140 + 96), (_PLANE,) * 9),
        (block_shape((8, 6), 5, corner=2.0, end=Rim(round=2.0)),
         # Steiner's formula for 12 x 8 and a ball of 2 mm.
         (96 + 2 * 40 + math.pi * 4) * 3 + 2 * 96 + 40 * math.pi + 2 / 3 * math.pi * 8,
         (_PLANE,) * 5),
    ],
)  # fmt: skip
def test_shapes_have_the_volume_of_their_drawing(
    shape: Shape, volume: float, kinds: tuple[SurfaceKind, ...]
) -> None:
    low, high = (-9.0, -9.0, 0.0), (9.0, 9.0, 10.0)
    assert _volume(shape.solid, np.array(low), np.array(high)) == pytest.approx(volume, rel=0.012)
    assert sorted(shape.kinds) == sorted(kinds)


def test_drawn_bodies() -> None:
    outline = [
        Corner(-20, 0), Corner(-20, 10, 2.0), Corner(0, 10, 4.0), Corner(0, 4), Corner(20, 4),
        Corner(20, 0),
    ]  # fmt: skip
    body = drawn_body(outline, 30.0)
    area = 20 * 10 + 20 * 4 - (1 - math.pi / 4) * (4 + 16)
    low, high = np.array([-21.0, -16.0, -1.0]), np.array([21.0, 16.0, 11.0])
    assert _volume(body.solid, low, high) == pytest.approx(30 * area, rel=0.01)
    # Ends, step and two levels, two sides; the arc of 4 mm. The one of 2 mm is a fillet.
    assert sorted(body.kinds) == [_PLANE] * 7 + [_CYLINDER]
    assert [deck.half for deck in body.decks] == [(7.0, 15.0), (10.0, 15.0)]
    assert [deck.rise for deck in body.decks] == [(0.0, 0.0), (6.0, 0.0)]
    assert _height(body.solid, -10.0, 3.0) == pytest.approx(10.0)
    assert _height(body.solid, -4.0 + 4.0 * math.sin(0.6), 3.0) == pytest.approx(
        6.0 + 4.0 * math.cos(0.6), abs=1e-9
    )


@pytest.mark.parametrize("family", FAMILIES)
def test_features_stay_within_their_extent_and_height(family: str) -> None:
    rng = np.random.default_rng(5)
    names = set()
    for _ in range(60):
        feature = random_feature(Draw(rng, family))
        names.add(feature.name)
        shape = feature.shape
        reach = np.array([*shape.extent, min(shape.height, 12.0)])
        points = rng.uniform([*-1.2 * reach[:2], 0.0], 1.2 * reach, (800, 3))
        inside = points[solid(shape.solid, points)]
        assert len(inside) > 20, feature.name
        assert (np.abs(inside) <= [*shape.extent, shape.height]).all(), feature.name
        flat = shape.solid.flat()
        rounds = flat.surfaces.data[flat.surfaces.kind == _TORUS, 7]
        fillet = flat.surfaces.fillet[flat.surfaces.kind == _TORUS]
        np.testing.assert_array_equal(fillet, rounds <= FILLET_LIMIT)
        assert (rounds >= FILLET[0]).all() and (rounds <= BLEND[1]).all()
        assert not (family in ("sharp", "smooth") and flat.surfaces.fillet.any())
    assert len(names) >= 8


def test_families_have_what_they_are_named_for() -> None:
    fillets = {f: 0 for f in FAMILIES}
    blends = {f: 0 for f in FAMILIES}
    for family in FAMILIES:
        for seed in range(4):
            flat = random_block(seed, family).flat()
            fillets[family] += int(flat.surfaces.fillet.sum())
            if seed < 2:
                blends[family] += int((trace_edges(flat).kind == EdgeClass.SMOOTH).any())
    assert fillets["sharp"] == fillets["smooth"] == 0
    assert fillets["filleted"] > fillets["mixed"] > 0
    assert blends["smooth"] == 2


def test_the_first_hits_of_the_reference_enter_the_part() -> None:
    part = random_block(3, "sharp")
    down = np.tile([0.0, 0.0, -1.0], (50, 1))
    rng = np.random.default_rng(0)
    half = 0.4 * np.ptp(part.box, axis=0)[:2]
    start = np.column_stack([rng.uniform(-half, half, (50, 2)), np.full(50, 80.0)])
    far = first_hits(part, start, down, np.full(50, 200.0))
    assert np.isinf(far).sum() < 15  # through a hole, to nothing
    hit = np.isfinite(far)
    down, place = down[hit], start[hit] + far[hit, None] * down[hit]
    assert (solid(part, place + 1e-6 * down) & ~solid(part, place - 1e-6 * down)).all()


@pytest.mark.parametrize(("seed", "family"), [(s, f) for f in FAMILIES for s in (0, 7)])
def test_a_sample_of_blocks(seed: int, family: str) -> None:
    block = verify_blocks.scan_block(seed, family, points=10_000)
    assert len(block.scans) == 10_000
    checks: dict[str, Callable[[verify_blocks.Block], list[str]]] = dict(verify_blocks.CHECKS)
    checks.pop("counts")  # at 3 mm pitch a patch of 2 mm has too few points to be one
    checks["rays"] = lambda b: verify_blocks.check_rays(b, 24)
    assert {name: check(block) for name, check in checks.items()} == {name: [] for name in checks}


@pytest.mark.parametrize(("seed", "family"), [(1, "filleted"), (1, "smooth")])
def test_kinds_and_counts_are_those_of_the_construction(seed: int, family: str) -> None:
    block = verify_blocks.scan_block(seed, family)
    assert len(block.scans) == 90_000
    assert verify_blocks.check_counts(block) == []
    assert verify_blocks.check_patches(block) == []
