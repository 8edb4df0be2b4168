"""Strips: patches on a ball between two others, one edge after the other."""

import numpy as np
from reference.leaves import leaves_of

from octoseg_ti.borders.zones import Search, leaves_between, strips_between
from octoseg_ti.device import runtime
from octoseg_ti.stages.extraction import Surfaces
from octoseg_ti.types import SurfaceKind

WIDE, RADIUS, STEP = 6.0, 1.0, 0.2


def lid() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A square top (0) over four walls (1..4); the rounded edges around it are one patch (5)."""
    points, normals, label = [], [], []
    line = np.arange(-WIDE, WIDE, STEP)
    for a in line:
        for b in line:
            points.append((a, b, 0.0))
            normals.append((0.0, 0.0, 1.0))
            label.append(0)
    outward = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    for wall, (cx, cy) in enumerate(outward):
        for a in line:
            for s in np.arange(STEP, 4.0, STEP):
                turn = min(s / RADIUS, np.pi / 2)
                out, down = np.sin(turn), RADIUS * (1.0 - np.cos(turn))
                down += s - turn * RADIUS
                away = WIDE + RADIUS * out
                points.append((cx * away - cy * a, cy * away + cx * a, -down))
                normals.append((cx * out, cy * out, np.cos(turn)))
                label.append(5 if s < RADIUS * np.pi / 2 else 1 + wall)
    return np.array(points), np.array(normals), np.array(label, np.int32)


def searched() -> Search:
    points, normals, label = lid()
    points += (10.0, 10.0, 6.0)
    leaves, order = leaves_of(points, 1.0)
    points, normals, label = points[order], normals[order], label[order]
    parameters = np.zeros((6, 8))
    parameters[0, :6] = (10, 10, 6, 0, 0, 1)
    for wall, (cx, cy) in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)]):
        away = WIDE + RADIUS
        parameters[1 + wall, :6] = (10 + cx * away, 10 + cy * away, 0, cx, cy, 0)
    parameters[5, :6] = (10, 10, 5, 0, 0, 1)
    runtime.ensure_started()
    return Search(
        runtime.upload(points),
        runtime.upload(normals),
        leaves,
        label,
        np.arange(6, dtype=np.int32),
        Surfaces(kind=np.full(6, int(SurfaceKind.PLANE), np.int8), parameters=parameters),
        noise=0.01,
        spacing=STEP,
        limit=3.0,
    )


def test_one_patch_is_the_strip_of_four_edges() -> None:
    search = searched()
    touching = [(0, 5), (1, 5), (2, 5), (3, 5), (4, 5), (0, 1), (1, 2)]
    found = strips_between(search, np.array(touching))
    np.testing.assert_array_equal(found[found[:, 0] == 5], [[5, 0, w] for w in (1, 2, 3, 4)])
    assert not np.any(found[:, 0] == 0)


def test_of_a_strip_only_the_leaves_near_an_edge_belong_to_it() -> None:
    search = searched()
    triple = np.array([[5, 0, 1], [5, 0, 3]])
    owner, leaf = leaves_between(search, triple)
    middle = 0.5 * (search.leaves.box[leaf, :3] + search.leaves.box[leaf, 3:]) - (10.0, 10.0, 6.0)
    holds = (search.own == 5).any(axis=1)
    for k, sign in enumerate((1.0, -1.0)):
        mine = leaf[owner == k]
        assert np.all(holds[mine]) and len(np.unique(mine)) == len(mine)
        here = holds & (sign * (search.leaves.box[:, 0] - 10.0) > WIDE - 1.0)
        assert set(np.flatnonzero(here & (sign * (search.leaves.box[:, 3] - 10.0) > WIDE))) <= set(
            mine
        )
    assert np.all(middle[owner == 0, 0] > middle[owner == 1, 0].min())
