"""Peaks of a line with a width: kernels, casts and plain Python, and cases with known answers."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from reference.profiles import on_detector, peak, sees
from reference.rays import first_hit

from scanner_sim import StripeScanner, View, blocks
from scanner_sim.line_kernel import peaks_of_solid
from scanner_sim.line_profile import Fan, Peaks, centroids, peaks
from scanner_sim.optics import merging, sub_rays
from scanner_sim.part import Part, box, cone, intersection, rod, sphere, torus, union
from scanner_sim.target import CsgTarget

Peak = Callable[[CsgTarget, StripeScanner, Fan], Peaks]
BOTH = pytest.mark.parametrize("find", [peaks, peaks_of_solid])


def _fan(part: Part, scanner: StripeScanner, view: View, x: np.ndarray, y: np.ndarray) -> Fan:
    rotation, high = view.rotation(), scanner.stand_off
    source = np.column_stack([x, 0 * x, np.full(len(x), high)])
    ray = np.column_stack([0 * y, y, np.full(len(y), -high)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return Fan(source @ rotation.T + part.box.mean(axis=0), ray @ rotation.T, rotation)


def _mixed_part() -> Part:
    room = box((-9, -9, -2), (9, 9, 8))
    return union(
        box((-8, -6, -2), (8, 6, 0)), rod((-4, 0, 0), (-4, 0, 4), 2.0), sphere((3, 3, 1), 2.0),
        torus((3, -3, 0.2), (0, 0, 1), 1.5, 0.7),
        intersection(room, cone((0, -4, 5), (0.1, 0.2, -1), math.radians(20))),
    )  # fmt: skip


@pytest.mark.parametrize(
    "scanner",
    [
        StripeScanner(),
        StripeScanner(line_width=0.3),
        StripeScanner(line_width=0.5, sub_rays=25, blur=0.5, saturation=0.4, specular=0.2),
        StripeScanner(line_width=0.2, sub_rays=3, depth_of_field=6.0),
    ],
)
def test_kernels_agree_with_casts(scanner: StripeScanner) -> None:
    for part, view in (
        (_mixed_part(), View(turn=0.3)),
        (_mixed_part(), View(tilt=0.8, azimuth=1.0)),
        (blocks.test_block(), View(tilt=0.5, azimuth=2.0)),
    ):
        half = np.abs(part.box).max()
        x = np.linspace(-half, half, 61)
        fan = _fan(part, scanner, view, x, np.linspace(-half, half, 43))
        plain, kernel = (find(CsgTarget(part), scanner, fan) for find in (peaks, peaks_of_solid))
        assert len(plain.ray) > 150
        np.testing.assert_array_equal(kernel.ray, plain.ray)
        np.testing.assert_array_equal(kernel.surface, plain.surface)
        for name in ("length", "position", "normal", "light", "excess"):
            found, expected = getattr(kernel, name), getattr(plain, name)
            np.testing.assert_allclose(found, expected, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("seed", range(4))
def test_centroids_against_plain_python(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scanner = StripeScanner(
        line_width=0.2, sub_rays=7, blur=1.0, saturation=None if seed % 2 else 0.5
    )
    shares = sub_rays(scanner)[1]
    place = np.cumsum(rng.choice([0.2, 0.5, 9.0], (200, 7)), axis=1)
    place = rng.permuted(place, axis=1)
    place[rng.random((200, 7)) < 0.3] = np.nan
    place = place[~np.isnan(place).all(axis=1)]
    bright = rng.uniform(0.1, 1.0, place.shape)
    found = np.column_stack(centroids(scanner, place, np.nan_to_num(bright), shares))
    full = scanner.saturation or math.inf
    expected = [
        peak(p.tolist(), b.tolist(), shares.tolist(), merging(scanner), full)
        for p, b in zip(place, bright, strict=True)
    ]
    np.testing.assert_allclose(found, expected, atol=1e-12, err_msg=f"seed {seed}")


@BOTH
def test_rows_against_one_ray_at_a_time(find: Peak) -> None:
    part = union(box((-5, -4, -2), (0, 4, 1.5)), box((0, -4, -2), (5, 4, 0)))
    scanner = StripeScanner(line_width=0.6, sub_rays=5, stand_off=60.0)
    x = np.array([-1.3, -0.21, -0.1, 0.05, 0.17, 0.8, 0.9, 1.0, 4.9])
    y = np.array([-2.0, 0.3, 3.1])
    fan = _fan(part, scanner, View(), x, y)
    found = find(CsgTarget(part), scanner, fan)
    offsets, shares = sub_rays(scanner)
    rows = {int(r): k for k, r in enumerate(found.ray)}
    checked = 0
    for i, source in enumerate(fan.source):
        camera = source + fan.rotation @ scanner.camera
        for j, ray in enumerate(fan.ray):
            place, bright = [], []
            fall = -float(ray @ fan.rotation[:, 2])
            for offset in offsets:
                origin = source + offset * fan.rotation[:, 0]
                far = first_hit(part, origin, ray, 500.0)
                hit = np.isfinite(far) and sees(part, origin + (far - 1e-6) * ray, camera)
                place.append(on_detector(scanner, offset, far * fall) if hit else math.nan)
                bright.append(fall if hit else 0.0)  # all that can be seen from above is level
            key = i * len(y) + j
            assert (key in rows) == (not all(map(math.isnan, place)))
            if key not in rows:
                continue
            centre, _, light, _ = peak(place, bright, list(shares), merging(scanner), math.inf)
            k = rows[key]
            depth = found.length[k] * fall
            assert on_detector(scanner, 0.0, depth) == pytest.approx(centre, abs=1e-6)
            assert found.light[k] == pytest.approx(light, rel=1e-6)
            checked += 1
    assert checked >= 15


@BOTH
def test_zero_width_is_one_ray_and_exact(find: Peak) -> None:
    part = _mixed_part()
    fan = _fan(part, StripeScanner(), View(), np.linspace(-8, 8, 40), np.linspace(-6, 6, 30))
    found = find(CsgTarget(part), StripeScanner(), fan)
    source, ray = fan.source[found.ray // 30], fan.ray[found.ray % 30]
    np.testing.assert_allclose(source + found.length[:, None] * ray, found.position, atol=1e-12)
    np.testing.assert_allclose(found.light, -np.einsum("ij,ij->i", found.normal, ray), atol=1e-12)


@BOTH
def test_planes_are_not_bent_by_the_width(find: Peak) -> None:
    plate = box((-5, -5, -1), (5, 5, 0))
    scanner = StripeScanner(line_width=0.4)
    for turn in ("x", "y"):
        part = plate.turned(turn, 0.6)
        fan = _fan(part, scanner, View(), np.linspace(-2, 2, 9), np.linspace(-2, 2, 9))
        found = find(CsgTarget(part), scanner, fan)
        middle = fan.source[found.ray // 9] + found.length[:, None] * fan.ray[found.ray % 9]
        off = np.abs(np.einsum("ij,ij->i", middle - found.position, found.normal))
        assert off.max() < 5e-5  # the camera sees the near side of the line a little larger


@BOTH
def test_small_steps_give_points_between_their_levels(find: Peak) -> None:
    # 0.1 mm apart in height is less than the blur of 3 pixels: one peak of both levels.
    part = union(box((-5, -4, -2), (0, 4, 0.1)), box((0, -4, -2), (5, 4, 0)))
    scanner = StripeScanner(line_width=0.2)
    view = View(turn=math.pi)  # the camera on the lower side
    fan = _fan(part, scanner, view, np.linspace(-0.3, 0.3, 41), np.array([0.0]))
    found = find(CsgTarget(part), scanner, fan)
    height = (fan.source[found.ray] + found.length[:, None] * fan.ray[0])[:, 2]
    x = fan.source[found.ray][:, 0]
    far = np.abs(x) > 0.1
    np.testing.assert_allclose(height[far], np.where(x[far] < 0, 0.1, 0.0), atol=1e-5)
    between = (height > 0.02) & (height < 0.08)
    assert between.sum() >= 3 and np.abs(x[between]).max() < 0.1
