"""The scores of clouds whose points may belong to several primitives, and a cloud or two."""

from pathlib import Path

import fit4cad
import numpy as np
import pytest

from octoseg_ti import SurfaceKind, segment
from octoseg_ti.evaluation.members import Members, patch_members


def members(*rows: list[int]) -> Members:
    start = np.cumsum([0] + [len(r) for r in rows])
    return Members(start, np.concatenate(rows).astype(int), np.zeros(len(rows), int))


def test_a_point_of_a_crease_counts_for_both() -> None:
    truth = members([0, 1, 2, 3, 4], [4, 5, 6, 7])
    found = fit4cad.score(truth, members([4, 5, 6, 7], [0, 1, 2, 3, 4]))
    assert np.array_equal(found.dice, [1.0, 1.0])
    assert np.array_equal(found.partner, [1, 0])
    assert found.correct.all()
    single = fit4cad.score(truth, members([5, 6, 7], [0, 1, 2, 3, 4]))
    assert single.dice == pytest.approx([1.0, 6.0 / 7.0])
    assert np.array_equal(single.correct, [True, False])


def test_a_surface_is_the_partner_of_one_primitive() -> None:
    found = fit4cad.score(members([0, 1, 2], [3, 4]), members([0, 1, 2, 3, 4]))
    assert found.dice == pytest.approx([6.0 / 8.0, 0.0])
    assert np.array_equal(found.partner, [0, -1])
    assert not found.correct.any()


@pytest.mark.parametrize("name", ["PC16", "PC40"])
def test_all_primitives_of_a_cloud_are_found(shared: Path, name: str) -> None:
    points, truth = fit4cad.read_cloud(shared / "fit4cad_train" / f"{name}.npz")
    found = patch_members(segment(points))
    scores = fit4cad.score(truth, found)
    assert scores.correct.all()
    assert scores.dice.mean() > 0.98
    assert np.array_equal(found.kind[scores.partner], truth.kind)
    assert SurfaceKind.CYLINDER in truth.kind
