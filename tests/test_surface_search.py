"""Of small surfaces those stay whose points are nearer to them than to what lies around."""

import numpy as np
import pytest
from reference.device_grid import touching_leaves

from octoseg_ti import SurfaceKind
from octoseg_ti.stages.extraction import Tolerance
from octoseg_ti.stages.grid import build_grid
from octoseg_ti.stages.labelling import Rule, own_lists
from octoseg_ti.stages.sets import Surfaces
from octoseg_ti.surface_search import _Search

NOISE, STEP, SLOPE = 0.05, 0.2, 0.45


def strip(rows: int, *, real: bool) -> _Search:
    """Return a plane and a steep strip across it, which is there or which only its normals show."""
    x, y = (a.ravel() for a in np.mgrid[0.0:12.0:STEP, 0.0:12.0:STEP])
    points = np.column_stack([x, y, np.random.default_rng(0).normal(0.0, 0.6 * NOISE, len(x))])
    within = (x > 5.1) & (x < 5.1 + rows * STEP)
    middle = points[within].mean(axis=0)
    if real:
        points[within, 2] += SLOPE * (x[within] - middle[0])
    steep = np.array([-np.sin(SLOPE), 0.0, np.cos(SLOPE)])
    normals = np.where(within[:, None], steep, [0.0, 0.0, 1.0])
    grid = build_grid(points, normals, tolerance=0.05, min_cell=0.7, min_points=3)
    leaves = touching_leaves(grid)
    search = _Search(grid, leaves, Tolerance(NOISE, 0.4, 20), Rule(NOISE, 0.05))
    nothing = np.full(2, np.nan)
    search.surfaces = Surfaces(
        kind=np.full(2, int(SurfaceKind.PLANE), np.int32),
        parameters=np.array([
            np.r_[-grid.corner, 0.0, 0.0, 1.0, nothing], np.r_[middle - grid.corner, steep, nothing]
        ]),
    )  # fmt: skip
    cell = np.tile(np.arange(len(leaves)), 2)
    search.own = own_lists(leaves, cell, np.repeat([0, 1], len(leaves)))
    search.early = 2
    search.choose()
    return search


@pytest.mark.parametrize(("rows", "real"), [(1, False), (2, False), (6, True), (9, True)])
def test_what_only_normals_hold_is_no_surface(rows: int, real: bool) -> None:
    search = strip(rows, real=real)
    before = np.bincount(search.label[search.label >= 0], minlength=2)
    assert before[1] >= 20
    assert not search.give_up()
    search.give_up_slivers()
    after = np.bincount(search.label[search.label >= 0], minlength=2)
    assert (after[1] > 0) == real


@pytest.mark.parametrize(
    ("share", "raised", "anew"), [(1.0, 1.0, False), (0.5, 1.0, True), (0.0, 0.05, False)]
)
def test_a_surface_is_fitted_anew_where_its_samples_are_others(
    share: float, raised: float, anew: bool
) -> None:
    search = strip(9, real=True)
    search.refit()
    before = search.surfaces.parameters
    search.choose()
    label = search.label[search.samples.index]
    search.surfaces.parameters[0, 2] += raised * NOISE
    search.choose()
    rng = np.random.default_rng(0)
    search.fitted = np.where(rng.random(len(label)) < share, label, -1).astype(np.int32)
    moved = search.surfaces.parameters.copy()
    search.refit()
    np.testing.assert_array_equal(search.surfaces.parameters[1], before[1])
    if not anew:
        np.testing.assert_array_equal(search.surfaces.parameters[0], moved[0])
        return
    plane = search.surfaces.parameters[0]
    assert abs((plane[:3] - moved[0, :3]) @ plane[3:6]) > 0.5 * raised * NOISE
