"""Every pair of leaves whose closed boxes touch is found, once, from the later of the two."""

import numpy as np
import pytest
from reference.clouds import random_cloud, random_surface
from reference.device_grid import leaves_of
from reference.graph import touching_pairs

from octoseg_ti.device import runtime
from octoseg_ti.stages.adjacency import find_touching
from octoseg_ti.stages.grid import build_grid


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n", [3, 60, 1500])
@pytest.mark.parametrize("kind", ["surface", "cloud", "paper"])
def test_equals_the_reference(kind: str, seed: int, n: int) -> None:
    points, normals = random_cloud(seed, n) if kind == "cloud" else random_surface(seed, n)
    options = {
        "surface": {"tolerance": 0.05, "min_cell": 0.7, "min_points": 3},
        "cloud": {"tolerance": 0.6, "divisions": 2, "min_cell": 0.2},
        "paper": {"tolerance": 0.01, "divisions": 3},  # neighbours of very different size
    }[kind]
    grid = build_grid(points, normals, **options)
    touching = find_touching(grid)
    count = runtime.download(touching.count)
    neighbor = runtime.download(touching.neighbor)
    found = [(int(b), c) for c in range(grid.count) for b in neighbor[c, : count[c]]]
    assert len(found) == len(set(found))
    expected = {
        (min(a.node, b.node), max(a.node, b.node))
        for a, b in touching_pairs(leaves_of(grid), grid.depth)
    }
    assert set(found) == expected, f"seed {seed}, n {n}"


def test_a_single_cell_touches_none() -> None:
    points, normals = random_cloud(0, 50)
    grid = build_grid(points, normals, tolerance=2.0, min_cell=20.0)
    assert grid.count == 1
    np.testing.assert_array_equal(runtime.download(find_touching(grid).count), 0)
