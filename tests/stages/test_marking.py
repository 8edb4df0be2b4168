"""Points with a mark near others: the same as by looking at all points."""

import numpy as np
import pytest
from reference import rolling
from reference.leaves import leaves_of

from octoseg_ti.device import runtime
from octoseg_ti.stages.marking import marked_near


@pytest.mark.parametrize("seed", range(4))
def test_equal_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 6, (700, 3)) * (1, 1, 0.3)
    leaves, order = leaves_of(points, 1.0)
    points = points[order]
    mark = rng.choice([-1, 0, 65, 1, 7], 700, p=[0.3, 0.3, 0.1, 0.29, 0.01]).astype(np.int32)
    asked = rng.integers(0, 700, 200)
    leaf = np.searchsorted(leaves.first, asked, side="right") - 1
    wanted = rng.choice([0, 1, 7], 200)
    reach = rng.uniform(0.1, 0.99, 200)
    runtime.ensure_started()
    device = runtime.upload(points)
    found = marked_near(device, mark, leaves, asked, leaf, wanted, reach)
    expected = [
        np.isfinite(rolling.nearest(points, mark, i, w, r))
        for i, w, r in zip(asked, wanted, reach, strict=True)
    ]
    np.testing.assert_array_equal(found, expected)
    assert 0 < np.count_nonzero(found) < 200


def test_nothing_asked_nothing_found() -> None:
    leaves, _ = leaves_of(np.zeros((3, 3)), 1.0)
    none = np.zeros(0, np.int64)
    runtime.ensure_started()
    points = runtime.upload(np.zeros((3, 3)))
    assert len(marked_near(points, np.zeros(3), leaves, none, none, none, none)) == 0
    one = np.zeros(1, np.int64)
    assert not marked_near(points, np.full(3, 2), leaves, one, one, one + 5, np.ones(1))[0]
