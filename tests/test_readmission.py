"""Points that cleaning left out come back where the surface of a patch goes through them."""

import numpy as np
import pytest
from reference import readmission
from reference.surfaces import CYLINDER, PLANE, SPHERE

from octoseg_ti import Params, Scans, segment
from octoseg_ti.pipeline import clean
from octoseg_ti.readmission import readmit

NOISE, GAP = 0.02, 0.8
ON = 2.5 * NOISE
NAN = np.nan


def level(height: float) -> tuple[float, ...]:
    return 0.0, 0.0, height, 0.0, 0.0, 1.0, NAN, NAN


def square(height: float = 0.0) -> np.ndarray:
    """Return points 0.25 mm apart, from 0 to 5 mm."""
    x, y = (a.ravel() for a in np.mgrid[0:21, 0:21])
    return np.column_stack([0.25 * x, 0.25 * y, np.full(len(x), height)])


def come_back(outside: list[tuple[float, ...]], surface: int = 0) -> list[int]:
    """Return which points come back to a square."""
    point = square()
    found = readmit(
        np.array(outside, float).reshape(-1, 3), point, np.zeros(len(point), np.int32),
        np.array([surface]), np.array([PLANE]), np.array([level(0.0)]), noise=NOISE, gap=GAP,
    )  # fmt: skip
    assert found.dtype == np.int32 and len(found) == len(outside)
    return found.tolist()


def test_a_point_on_the_surface_and_near_the_patch_comes_back() -> None:
    assert come_back([(2, 2, 0.0), (5.7, 2, 0.9 * ON), (2, -0.5, -0.9 * ON)]) == [0, 0, 0]


def test_what_is_off_the_surface_or_too_far_stays_out() -> None:
    assert come_back([(2, 2, 1.1 * ON), (2, 2, -3.0), (5.9, 2, 0.0), (50, 50, 0.0)]) == [-1] * 4


def test_each_point_of_a_chain_holds_the_next() -> None:
    chain = [(5.7 + 0.75 * k, 2.0, 0.0) for k in range(6)]
    assert come_back(chain[::-1]) == [0] * 6
    # One that is off the surface holds nothing.
    broken = [(x, y, ON * 1.1 if k == 3 else z) for k, (x, y, z) in enumerate(chain)]
    assert come_back(broken) == [0, 0, 0, -1, -1, -1]
    assert come_back([*chain[:3], *chain[4:]]) == [0, 0, 0, -1, -1]


def test_of_two_patches_the_nearer_one_takes_a_point() -> None:
    point = np.concatenate([square(0.0), square(0.04) + np.array([4.0, 0.0, 0.0])])
    label = np.repeat([0, 1], len(point) // 2).astype(np.int32)
    outside = np.array([(4.5, 2.1, 0.01), (4.5, 2.1, 0.03), (0.1, 2.1, 0.03), (9.4, 2.1, 0.01)])
    for first in (0, 1):
        found = readmit(
            outside, point, label ^ first, np.array([first, 1 - first]),
            np.array([PLANE, PLANE]), np.array([level(0.0), level(0.04)]), noise=NOISE, gap=GAP,
        )  # fmt: skip
        # The last two have but one patch near them.
        assert (found ^ first).tolist() == [0, 1, 0, 1]


def test_a_patch_that_is_farther_from_all_points_takes_none() -> None:
    point = np.concatenate([square(0.0), square(0.04) + np.array([4.0, 0.0, 0.0])])
    label = np.repeat([0, 1], len(point) // 2).astype(np.int32)
    found = readmit(
        np.array([(4.5, 2.1, 0.01)]), point, label, np.array([0, 1]), np.array([PLANE, PLANE]),
        np.array([level(0.0), level(0.04)]), noise=NOISE, gap=GAP,
    )  # fmt: skip
    assert found.tolist() == [0]


def test_what_has_no_place_or_no_surface_stays_out() -> None:
    assert come_back([(NAN, NAN, NAN), (2, 2, 0.0), (2, NAN, 0)]) == [-1, 0, -1]
    assert come_back([(2, 2, 0.0)], surface=-1) == [-1]
    assert come_back([(NAN, NAN, NAN)]) == [-1]
    assert come_back([]) == []


@pytest.mark.parametrize("seed", range(4))
def test_what_comes_back_equals_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    kind = np.array([PLANE, CYLINDER, SPHERE, PLANE])
    parameters = np.array([
        level(0.0), (0, 0, -6, 1, 0, 0, 6, NAN), (3, 0, -5, 0, 0, 1, 5.05, NAN), level(0.05),
    ])  # fmt: skip
    surface = np.array([1, -1, 0, 2, 0, 3])
    point = rng.uniform((-3, -3, -0.3), (6, 3, 0.1), (300, 3))
    label = rng.integers(-1, 6, 300).astype(np.int32)
    outside = rng.uniform((-6, -4, -0.3), (9, 4, 0.1), (600, 3))
    outside[rng.random(600) < 0.05] = NAN
    found = readmit(outside, point, label, surface, kind, parameters, noise=NOISE, gap=0.5)
    there = np.isfinite(outside).all(axis=1)
    expected = readmission.readmit(
        outside[there], point, label, surface, kind, parameters, 2.5 * NOISE, 0.5
    )
    np.testing.assert_array_equal(found[there], expected, err_msg=f"seed {seed}")
    assert (found[~there] == -1).all()
    assert set(found.tolist()) == {-1, 0, 2, 3, 4, 5}
    many = np.tile(surface, 400)  # more than are compared at a time
    twice = readmit(outside, point, label, many, kind, parameters, noise=NOISE, gap=0.5)
    np.testing.assert_array_equal(twice, found)


def grazing(ratio: float, seed: int) -> tuple[Scans, np.ndarray]:
    """Return a face whose points are ever farther apart, in stripes, and two rows beside it."""
    rng = np.random.default_rng(seed)
    step = [0.25] * 40
    while step[-1] * ratio < 1.5:
        step.append(step[-1] * ratio)
    y = np.cumsum(step) + rng.uniform(-0.05, 0.05, (40, len(step)))
    x = np.broadcast_to(0.25 * np.arange(40.0)[:, None], y.shape)
    points = np.stack([x, y, rng.normal(0.0, 0.01, y.shape)], axis=-1).reshape(-1, 3)
    points = np.concatenate([points, [(9.75, y.max() + 1.0, 2.0), (9.75, y.max() + 6.0, 0.0)]])
    stripe = np.append(np.repeat(np.arange(40), len(step)), [39, 39])
    return Scans(points=points, stripe=stripe.astype(np.int32)), np.arange(2) + y.size


@pytest.mark.parametrize("ratio", [1.2, 1.3])
def test_a_face_seen_at_a_grazing_angle_is_kept_to_its_end(ratio: float) -> None:
    scans, stray = grazing(ratio, 0)
    arranged, _, _ = clean(scans, Params())
    left_out = np.ones(len(scans), bool)
    left_out[arranged.row] = False
    assert left_out.sum() > 20 and left_out[stray].all()
    result = segment(scans)
    face = np.ones(len(scans), bool)
    face[stray] = False
    assert result.patch_count == 1
    assert not result.outlier[face].any() and (result.labels[face] == 0).all()
    assert result.outlier[stray].all() and (result.labels[stray] == -1).all()
    np.testing.assert_array_equal(result.points, scans.points)


def test_patches_with_what_came_back_are_still_numbered_by_size() -> None:
    sparse, _ = grazing(1.2, 1)
    points, stripe = sparse.points[:-2], sparse.stripe[:-2]
    # A second face, larger than what cleaning leaves of the first, smaller than the whole.
    x, y = (0.25 * a.ravel() for a in np.mgrid[0:40, 0:48])
    z = np.random.default_rng(2).normal(5.0, 0.01, len(x))
    both = np.concatenate([points, np.column_stack([x, 60.0 + y, z])])
    stripe = np.append(stripe, np.rint(4.0 * x).astype(np.int32))
    order = np.argsort(stripe, kind="stable")
    first = order < len(points)
    scans = Scans(points=both[order], stripe=stripe[order])
    arranged, _, _ = clean(scans, Params())
    assert np.count_nonzero(first[arranged.row]) < len(x) < len(points)
    result = segment(scans)
    assert not result.outlier.any()
    # Of the sparse points that cleaning kept some are in no cell beside one of their patch.
    kept = result.labels >= 0
    assert np.mean(kept[first]) > 0.99 and kept[~first].all()
    np.testing.assert_array_equal(result.labels[kept], np.where(first, 0, 1)[kept])
    assert result.patch_sizes[0] > result.patch_sizes[1] == len(x)
