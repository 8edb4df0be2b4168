"""Edge cells by why they stopped, by level, by radius."""

import numpy as np
import pytest
from reference import patches as plain

from octoseg_ti.stages.edges import edges_by_level, edges_by_radius, edges_by_reason
from octoseg_ti.types import EdgeClass, StopReason

NO, SHARP, FILLET = (int(c) for c in (EdgeClass.NONE, EdgeClass.SHARP, EdgeClass.FILLET))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("n", [3, 2000])
def test_equal_the_reference(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    stop = rng.integers(0, len(StopReason), n).astype(np.int32)
    assert edges_by_reason(stop).tolist() == plain.edges_by_reason(stop.tolist()), f"seed {seed}"
    level = rng.choice([0, 1, 2, 4, 5, 9], n).astype(np.int32)  # level 3 does not occur
    for smallest in range(8):
        for fillets in range(smallest + 1):
            got = edges_by_level(level, smallest, fillets)
            expected = plain.edges_by_level(level.tolist(), smallest, fillets)
            assert got.tolist() == expected, f"seed {seed}, {smallest} levels, {fillets} fillets"
    size = 8.0 / 2.0**level
    for radius in (0.1, 1.0, 10.0):
        got = edges_by_radius(size, 0.05, radius)
        assert got.tolist() == plain.edges_by_radius(size.tolist(), 0.05, radius)


def test_the_six_smallest_of_eleven_with_two_fillets() -> None:
    """The phone of the paper: the 4 smallest sizes are sharp edges, the 5th and 6th fillets."""
    got = edges_by_level(np.arange(11), 6, 2)
    assert got.tolist() == [NO] * 5 + [FILLET] * 2 + [SHARP] * 4


def test_more_levels_than_there_are_take_all() -> None:
    assert edges_by_level(np.array([0, 1]), 5, 0).tolist() == [SHARP, SHARP]
    assert edges_by_level(np.empty(0, np.int32), 2, 1).tolist() == []


@pytest.mark.parametrize(("smallest", "fillets"), [(2, 3), (-1, 0), (3, -1)])
def test_impossible_counts_are_refused(smallest: int, fillets: int) -> None:
    with pytest.raises(ValueError, match=f"not {fillets}"):
        edges_by_level(np.array([0, 1, 2]), smallest, fillets)


@pytest.mark.parametrize("radius", [0.5, 3.0, 20.0])
def test_the_radius_of_a_size(radius: float) -> None:
    """s = sqrt(12) tolerance r: cells below that size are edges, that size itself is none."""
    s = np.sqrt(12.0) * 0.01 * radius
    got = edges_by_radius(np.array([0.99 * s, 1.01 * s]), 0.01, radius)
    assert got.tolist() == [SHARP, NO]
