"""Points at edges: of faces that meet, as far as both were scanned."""

import numpy as np
import pytest
from reference.leaves import leaves_of

from octoseg_ti.borders.fillets import Fit
from octoseg_ti.borders.marks import mark_points
from octoseg_ti.borders.zones import Search, find_zones
from octoseg_ti.device import runtime
from octoseg_ti.stages.extraction import Surfaces
from octoseg_ti.types import NONE, EdgeClass, SurfaceKind

STEP, LONG, WIDE = 0.2, 8.0, 3.0


def roof(cut: float) -> tuple[Search, np.ndarray, np.ndarray]:
    """A floor z = 0, a wall x = 0 up to y = cut; and places of points along and across the edge."""
    y, x = np.arange(0.1, LONG, STEP), np.arange(0.1, WIDE, STEP)
    floor = np.array([(a, b, 0.0) for a in x for b in y])
    wall = np.array([(0.0, b, a) for a in x for b in y if b < cut])
    points = np.concatenate([floor, wall]) + 1.0
    normals = np.repeat([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], [len(floor), len(wall)], axis=0)
    label = np.repeat([0, 1], [len(floor), len(wall)]).astype(np.int32)
    leaves, order = leaves_of(points, 0.5)
    points, normals, label = points[order], normals[order], label[order]
    parameters = np.zeros((2, 8))
    parameters[:, :3] = 1.0
    parameters[0, 5] = parameters[1, 3] = 1.0
    runtime.ensure_started()
    search = Search(
        runtime.upload(points), runtime.upload(normals), leaves, label,
        np.arange(2, dtype=np.int32),
        Surfaces(kind=np.full(2, int(SurfaceKind.PLANE), np.int8), parameters=parameters),
        noise=0.005, spacing=STEP, limit=3.0,
    )  # fmt: skip
    return search, points[:, 1] - 1.0, points[:, [0, 2]].max(axis=1) - 1.0


@pytest.mark.parametrize("form", [EdgeClass.SHARP, EdgeClass.SMOOTH])
def test_points_are_at_an_edge_where_the_other_face_is_near(form: EdgeClass) -> None:
    search, _, across = roof(LONG)
    zones, one = find_zones(search), np.ones(1)
    fit = Fit(one, one, one, 1.5 * one, 99 * one, one < 0.0, one < 0.0)
    joined = np.array([form == EdgeClass.SMOOTH])
    none = np.full(2, NONE, np.int32)
    edge = mark_points(search, zones, fit, one < 0.0, none, joined)
    assert np.all(edge[across < 1.4 * STEP] == int(form))
    assert np.all(edge[across > 2.1 * STEP] == int(EdgeClass.NONE))


def test_where_the_other_face_ends_there_is_no_edge() -> None:
    search, along, across = roof(0.5 * LONG)
    zones, one = find_zones(search), np.ones(1)
    fit = Fit(one, one, one, 1.5 * one, 99 * one, one < 0.0, one < 0.0)
    none = np.full(2, NONE, np.int32)
    edge = mark_points(search, zones, fit, one < 0.0, none, one < 0.0)
    near = across < 1.9 * STEP
    assert np.all(edge[near & (along < 0.5 * LONG)] == int(EdgeClass.SHARP))
    assert np.all(edge[along > 0.5 * LONG + 4.0 * STEP] == int(EdgeClass.NONE))


def test_too_few_points_make_no_line() -> None:
    search, _, _ = roof(LONG)
    zones, one = find_zones(search), np.ones(1)
    fit = Fit(one, one, one, 1.5 * one, 4 * one, one < 0.0, one < 0.0)
    none = np.full(2, NONE, np.int32)
    edge = mark_points(search, zones, fit, one < 0.0, none, one < 0.0)
    assert set(np.unique(edge)) == {int(EdgeClass.NONE), int(EdgeClass.SMOOTH)}
