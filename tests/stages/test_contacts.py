"""Surfaces touch where leaves hold both or touch; how they meet there equals plain geometry."""

import numpy as np
import pytest
from reference import meeting
from reference.device_grid import surface_leaves

from octoseg_ti.stages.contacts import smooth_contacts
from octoseg_ti.stages.labelling import own_lists
from octoseg_ti.stages.leaves import Samples, sample_leaves
from octoseg_ti.stages.sets import Surfaces


def planes(seed: int, count: int) -> Surfaces:
    """Return planes about the middle of a grid."""
    rng = np.random.default_rng(seed)
    parameters = np.full((count, 8), np.nan)
    parameters[:, :3] = rng.normal(3.0, 1.0, (count, 3))
    normal = rng.normal(size=(count, 3))
    parameters[:, 3:6] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return Surfaces(kind=np.zeros(count, np.int32), parameters=parameters)


def meet(samples: Samples, leaf: int, a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Return angle and distance of two planes at the first sample of a leaf."""
    point = samples.point[np.flatnonzero(samples.leaf == leaf)[0]]
    cosine = float(a[3:6] @ b[3:6])
    off = [float((point - p[:3]) @ p[3:6]) for p in (a, b)]
    return float(np.arccos(abs(cosine))), abs(off[0] - np.sign(cosine) * off[1])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("count", [1, 3, 40])
def test_contacts_equal_the_reference(seed: int, count: int) -> None:
    grid, leaves = surface_leaves(seed, 900)
    rng = np.random.default_rng(seed)
    leaf = rng.integers(0, len(leaves), 2 * len(leaves))
    own = own_lists(leaves, leaf, rng.integers(-1, count, len(leaf)))
    samples, surfaces = sample_leaves(grid, leaves, 2), planes(seed, count)
    lists = [row[row >= 0].tolist() for row in own]
    touching = list(zip(leaves.a.tolist(), leaves.b.tolist(), strict=True))
    expected: dict[tuple[int, int], list[float]] = {}
    for (a, b), places in meeting.contacts(lists, touching).items():
        met = [meet(samples, c, surfaces.parameters[a], surfaces.parameters[b]) for c in places]
        turn, step = np.min(met, axis=0)
        if turn <= 0.7:
            expected[a, b] = [turn, step]
    found = smooth_contacts(leaves, own, samples, surfaces)
    assert [tuple(pair) for pair in found.pairs.tolist()] == sorted(expected)
    assert count < 40 or expected
    if expected:
        met = [expected[pair] for pair in sorted(expected)]
        np.testing.assert_allclose(np.stack([found.turn, found.step], axis=1), met, atol=1e-7)


def test_surfaces_that_meet_at_an_edge_are_no_smooth_contact() -> None:
    grid, leaves = surface_leaves(0, 900)
    own = own_lists(leaves, np.repeat(np.arange(len(leaves)), 3), np.tile([0, 1, 2], len(leaves)))
    parameters = np.full((3, 8), np.nan)
    parameters[:, :3] = 0.0
    for s, angle in enumerate((0.0, 0.3, 1.2)):
        parameters[s, 3:6] = 0.0, np.sin(angle), np.cos(angle)
    surfaces = Surfaces(kind=np.zeros(3, np.int32), parameters=parameters)
    found = smooth_contacts(leaves, own, sample_leaves(grid, leaves, 2), surfaces)
    np.testing.assert_array_equal(found.pairs, [[0, 1]])
    np.testing.assert_allclose(found.turn, 0.3, atol=1e-9)
