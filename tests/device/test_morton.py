"""A Morton key holds the bits of the coordinates in turn, and gives the coordinates back."""

import numpy as np
import pytest

from octoseg_ti.device import runtime
from octoseg_ti.device.morton import AXIS_BITS, compacted, morton_keys
from octoseg_ti.device.runtime import I32Rows, I64Array, ti


@ti.kernel
def _take_apart(
    # In:
    key_in: I64Array,
    # Out:
    place_out: I32Rows,
):
    """Write the coordinates of every key."""
    for i in key_in:
        for k in ti.static(range(3)):
            place_out[i, k] = compacted(key_in[i], k)


def bit_by_bit(place: tuple[int, int, int]) -> int:
    key = 0
    for bit in reversed(range(AXIS_BITS)):
        for value in place:
            key = 2 * key + ((value >> bit) & 1)
    return key


def keys(points: np.ndarray, corner: np.ndarray, scale: float, last: np.ndarray) -> np.ndarray:
    runtime.ensure_started()
    return runtime.download(morton_keys(runtime.upload(points), corner, scale, last))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("bits", [1, 7, 16, 17, 20, 21])
def test_keys_bit_by_bit(seed: int, bits: int) -> None:
    rng = np.random.default_rng(seed)
    place = rng.integers(0, 2**bits, (500, 3))
    place[:2] = [[0] * 3, [2**bits - 1] * 3]
    corner = rng.uniform(-100, 100, 3)
    # In the middle of the boxes, so that rounding cannot move a point to the next one.
    points = corner + (place + 0.5) * 0.25
    got = keys(points, corner, 4.0, np.full(3, 2**bits - 1))
    assert got.tolist() == [bit_by_bit((x, y, z)) for x, y, z in place.tolist()], f"seed {seed}"


@pytest.mark.parametrize("seed", range(3))
def test_keys_give_the_coordinates_back(seed: int) -> None:
    runtime.ensure_started()
    place = np.random.default_rng(seed).integers(0, 2**AXIS_BITS, (1000, 3)).astype(np.int32)
    key = np.array([bit_by_bit((x, y, z)) for x, y, z in place.tolist()], np.int64)
    back = runtime.empty((1000, 3), np.int32)
    _take_apart(runtime.upload(key), back)
    np.testing.assert_array_equal(runtime.download(back), place, err_msg=f"seed {seed}")


def test_keys_sort_as_an_octree_walk() -> None:
    rng = np.random.default_rng(5)
    place = rng.integers(0, 8, (300, 3))
    got = keys(place + 0.5, np.zeros(3), 1.0, np.full(3, 7))
    walk = sorted(
        range(300),
        key=lambda i: [tuple((place[i] >> level) & 1) for level in (2, 1, 0)],
    )
    assert sorted(got.tolist()) == got[walk].tolist()


def test_points_outside_go_to_the_nearest_box() -> None:
    points = np.array([[-3.0, 0.5, 0.5], [99.0, 0.5, 0.5], [1.0, 2.0, 3.0]])
    got = keys(points, np.zeros(3), 1.0, np.array([1, 1, 1]))
    assert got.tolist() == [bit_by_bit(p) for p in ((0, 0, 0), (1, 0, 0), (1, 1, 1))]


def test_too_many_bits_are_refused() -> None:
    with pytest.raises(ValueError, match="holds 21 bits an axis, not 2097152"):
        keys(np.zeros((1, 3)), np.zeros(3), 1.0, np.array([0, 2**21, 0]))
