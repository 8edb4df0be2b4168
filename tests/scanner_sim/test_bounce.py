"""Mirrored light: where the second spot is, and what the camera makes of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference.profiles import on_detector

from octoseg_ti.types import Artefact
from scanner_sim import StripeScanner, View
from scanner_sim.bounce import add_bounces
from scanner_sim.line_kernel import peaks_of_solid
from scanner_sim.line_profile import Fan, Peaks
from scanner_sim.part import Part, box, half_space, intersection, union
from scanner_sim.target import CsgTarget

TILT = math.radians(70.0)


def _ramp() -> Part:
    """A floor at z = 0, and a face of 70 degrees that rises from it at x = 0."""
    face = half_space((0, 0, 0), (-math.sin(TILT), 0.0, math.cos(TILT)))
    return union(box((-20, -5, -2), (4, 5, 0)), intersection(face, box((-1, -5, -2), (4, 5, 8))))


def _measure(
    height: float, offset: float = 0.0, **values: float
) -> tuple[StripeScanner, Fan, Peaks, Peaks, np.ndarray]:
    """Aim at the face at a height above the floor."""
    values = {"specular": 0.3, "lobe": math.radians(2.0), **values}
    scanner = StripeScanner(**values)  # type: ignore[arg-type]
    rotation = View().rotation()
    x, y = height / math.tan(TILT), np.linspace(-3.0, 3.0, 7)
    source = np.array([[x, offset, scanner.stand_off]])
    ray = np.column_stack([0 * y, y, np.full(7, -scanner.stand_off)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    fan = Fan(source, ray @ rotation.T, rotation)
    direct = peaks_of_solid(CsgTarget(_ramp()), scanner, fan)
    return (
        scanner,
        fan,
        direct,
        *add_bounces(CsgTarget(_ramp()), scanner, fan, y, direct),
    )  # type: ignore[return-value]


def test_a_mirrored_spot_alone_is_triangulated_in_the_laser_plane() -> None:
    height = 3.0
    scanner, _, direct, found, mark = _measure(height, incidence_limit=math.radians(50.0))
    assert len(direct.ray) == 0  # the face is beyond the limit
    assert (mark == Artefact.SPIKE).all() and len(found.ray) == 7
    # In the middle row: down to the face, and on by twice 20 degrees from it to the floor.
    aside = height * math.tan(math.radians(40.0))
    middle = int(np.flatnonzero(found.ray == 3)[0])
    z = scanner.stand_off - found.length[middle]
    seen = -scanner.stand_off * aside / (scanner.camera[0] - aside)
    assert z == pytest.approx(seen, abs=1e-5)  # the mirrored ray starts a little above the face
    share = 0.3 + 0.7 * (1.0 - math.cos(TILT)) ** 5
    light = share * 0.7 * math.cos(math.radians(40.0))
    assert found.light[middle] == pytest.approx(light, rel=1e-6)
    # The truth is where the laser meets the face.
    np.testing.assert_allclose(found.position[:, 2], height, atol=0.2)
    off = found.position[:, 0] * math.sin(TILT) - found.position[:, 2] * math.cos(TILT)
    np.testing.assert_allclose(off, 0.0, atol=1e-9)


def test_the_brighter_of_two_spots_wins() -> None:
    wide = math.radians(80.0)
    _, _, direct, found, mark = _measure(3.0, incidence_limit=wide, specular=0.6)
    np.testing.assert_array_equal(found.ray, direct.ray)
    assert direct.light[3] == pytest.approx(0.4 * math.cos(TILT), rel=1e-3)
    assert mark[3] == Artefact.SPIKE and found.light[3] > direct.light[3]
    _, _, direct, found, mark = _measure(3.0, incidence_limit=wide)
    assert mark[3] == Artefact.CLEAN and found.length[3] == direct.length[3]
    _, _, plain, kept, none = _measure(3.0, incidence_limit=math.radians(80.0), threshold=0.9)
    assert (none == Artefact.CLEAN).all()  # the second spot is too faint to be seen
    np.testing.assert_array_equal(kept.length, plain.length)


def test_a_mirrored_spot_beside_the_line_pulls_the_peak() -> None:
    scanner, _, direct, found, mark = _measure(0.05, incidence_limit=math.radians(80.0))
    assert mark[3] == Artefact.MULTI_BOUNCE
    line = on_detector(scanner, 0.0, direct.length[3])
    second = on_detector(scanner, 0.05 * math.tan(math.radians(40.0)), scanner.stand_off)
    share = 0.3 + 0.7 * (1.0 - math.cos(TILT)) ** 5
    bright, light = direct.light[3], share * 0.7 * math.cos(math.radians(40.0))
    expected = (line * bright + second * light) / (bright + light)
    assert on_detector(scanner, 0.0, found.length[3]) == pytest.approx(expected, abs=1e-4)
    assert found.light[3] == pytest.approx(bright + light)


def test_rows_count_from_the_laser_not_from_the_middle_of_the_part() -> None:
    *_, found, mark = _measure(3.0, incidence_limit=math.radians(50.0))
    *_, aside, other = _measure(3.0, offset=1.0, incidence_limit=math.radians(50.0))
    np.testing.assert_array_equal(aside.ray, found.ray)
    np.testing.assert_allclose(aside.length, found.length, atol=1e-9)
    shifted = np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(aside.position - shifted, found.position, atol=1e-9)
    np.testing.assert_array_equal(other, mark)


def test_a_flat_part_has_no_second_spots() -> None:
    scanner = StripeScanner(specular=0.5)
    rotation = View().rotation()
    y = np.linspace(-2, 2, 5)
    ray = np.column_stack([0 * y, y, np.full(5, -scanner.stand_off)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    fan = Fan(np.array([[0.0, 0.0, scanner.stand_off]]), ray @ rotation.T, rotation)
    plate = CsgTarget(box((-5, -5, -1), (5, 5, 0)))
    direct = peaks_of_solid(plate, scanner, fan)
    found, mark = add_bounces(plate, scanner, fan, y, direct)
    assert (mark == 0).all()
    np.testing.assert_array_equal(found.length, direct.length)
