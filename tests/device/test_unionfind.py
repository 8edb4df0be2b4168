"""The root of a set is its smallest member, in whatever order the sets were joined."""

import numpy as np
import pytest
from reference.graph import components

from octoseg_ti.device import runtime, unionfind
from octoseg_ti.device.runtime import I32Array, I32Rows, ti
from octoseg_ti.device.unionfind import unite


@ti.kernel
def _join(
    # In:
    edge_in: I32Rows,
    # Out:
    parent_inout: I32Array,
):
    """Unite the ends of every edge."""
    for e in range(edge_in.shape[0]):
        unite(parent_inout, edge_in[e, 0], edge_in[e, 1])


def roots(n: int, edges: np.ndarray) -> list[int]:
    runtime.ensure_started()
    parent = runtime.upload(np.arange(n, dtype=np.int32))
    _join(runtime.upload(edges.astype(np.int32).reshape(-1, 2)), parent)
    return unionfind.roots(parent)[:n].tolist()


def walked(n: int, edges: np.ndarray) -> list[int]:
    root = components(list(range(n)), [(int(a), int(b)) for a, b in edges])
    return [root[i] for i in range(n)]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("n", [1, 2, 30, 3000])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 2.0])
def test_random_graphs(seed: int, n: int, share: float) -> None:
    edges = np.random.default_rng(seed).integers(0, n, (int(share * n), 2))
    assert roots(n, edges) == walked(n, edges), f"seed {seed}"
    a, b = edges.astype(np.int32).T
    assert unionfind.components(n, a, b).tolist() == walked(n, edges), f"seed {seed}"


@pytest.mark.parametrize("order", ["up", "down", "random"])
def test_long_chain(order: str) -> None:
    n = 20_000
    edges = np.column_stack((np.arange(n - 1), np.arange(1, n)))
    if order == "down":
        edges = edges[::-1, ::-1].copy()
    if order == "random":
        edges = edges[np.random.default_rng(0).permutation(n - 1)]
    assert roots(n, edges) == [0] * n


def test_star_and_order() -> None:
    n = 5000
    edges = np.column_stack((np.full(n - 2, n - 1), np.arange(1, n - 1)))
    assert roots(n, edges) == [0] + [1] * (n - 1)
    shuffled = edges[np.random.default_rng(1).permutation(len(edges))][:, ::-1].copy()
    assert roots(n, shuffled) == [0] + [1] * (n - 1)


def test_without_edges_every_member_is_alone() -> None:
    none = np.zeros(0, np.int32)
    assert unionfind.components(4, none, none).tolist() == [0, 1, 2, 3]
    assert unionfind.components(0, none, none).tolist() == []
