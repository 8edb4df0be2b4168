"""Links of points against loops over all pairs, and components against SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from scanner_sim.links import components, in_doubt, link_mesh


def _labels(pairs: np.ndarray, count: int) -> np.ndarray:
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (count, count))
    labels: np.ndarray = connected_components(graph, directed=False)[1]
    return labels


@pytest.mark.parametrize(("count", "links"), [(1, 0), (5, 0), (400, 150), (30_000, 40_000)])
def test_components_are_numbered_by_their_first_members(count: int, links: int) -> None:
    pairs = np.random.default_rng(count).integers(0, count, (links, 2))
    found = components(pairs, count)
    np.testing.assert_array_equal(found, _labels(pairs, count))
    new = np.flatnonzero(np.diff(np.maximum.accumulate(found), prepend=-1))
    np.testing.assert_array_equal(found[new], np.arange(found.max() + 1))


@pytest.mark.parametrize("seed", range(3))
def test_mesh_links_against_all_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stripes, columns = 14, 25
    kept = rng.random((stripes, columns)) < 0.8
    kept[4] = False  # a lost stripe
    stripe, column = (place.astype(np.int32) for place in np.nonzero(kept))
    position = np.column_stack([stripe, 0.8 * column, rng.normal(0.0, 0.5, len(stripe))])
    surface = (column > 12).astype(np.int32) + 2 * (stripe > 9)
    clear = rng.uniform(0.0, 1.5, len(stripe))
    reach = 1.9
    sure, doubtful = [], set()
    for i in range(len(stripe)):
        for j in range(i + 1, len(stripe)):
            step = (int(stripe[j] - stripe[i]), int(column[j] - column[i]))
            length = np.linalg.norm(position[i] - position[j])
            if step not in ((0, 1), (0, 2), (1, -1), (1, 0), (1, 1), (2, 0)) or length > reach:
                continue
            if surface[i] != surface[j]:
                continue
            if in_doubt(clear[i] + clear[j], length):
                doubtful.add((i, j))
            else:
                sure.append((i, j))
    assert len(sure) > 50 and len(doubtful) > 50
    piece, pairs = link_mesh(position, surface, stripe, column, clear, reach)
    np.testing.assert_array_equal(piece, _labels(np.array(sure), len(stripe)))
    assert {tuple(pair) for pair in pairs.tolist()} == doubtful and len(pairs) == len(doubtful)
