"""Edges and fillets of simple parts of which all is known."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from reference.leaves import leaves_of
from reference.rounded import bend

from octoseg_ti import evaluate, segment
from octoseg_ti.borders.tracing import find_borders, give_back
from octoseg_ti.borders.zones import Search
from octoseg_ti.device import runtime
from octoseg_ti.evaluation import Scores
from octoseg_ti.params import EdgeParams, Params
from octoseg_ti.stages.extraction import Surfaces
from octoseg_ti.types import EdgeClass, Segmentation, SurfaceKind
from scanner_sim import StripeScanner, simulate
from scanner_sim.part import (
    Part,
    box,
    cylinder,
    difference,
    half_space,
    intersection,
    sphere,
    union,
)


def s_blend(radius: float, turn_deg: float, wide: float = 6.0) -> Part:
    """A plane, a cylinder, another one turned the other way, and a lower plane, without an edge."""
    turn = math.radians(turn_deg)
    half, fall = radius * math.sin(turn), radius * (1.0 - math.cos(turn))
    low = -2.0 * fall

    def column(first: float, last: float) -> Part:
        return box((-wide, first, -20), (wide, last, 5))

    convex = cylinder((0, 0, -radius), (1, 0, 0), radius)
    hollow = cylinder((0, 2.0 * half, low + radius), (1, 0, 0), radius)
    return union(
        intersection(column(-wide, 0.0), half_space((0, 0, 0), (0, 0, 1))),
        intersection(column(0.0, half), union(convex, half_space((0, 0, -radius), (0, 0, 1)))),
        difference(
            intersection(column(half, 2.0 * half), half_space((0, 0, low + radius), (0, 0, 1))),
            hollow,
        ),
        intersection(column(2.0 * half, 2.0 * half + wide), half_space((0, 0, low), (0, 0, 1))),
    )


def capped(radius: float) -> Part:
    """A cylinder that ends in a tangent sphere."""
    tube = cylinder((0, 0, 0), (0, 0, 1), radius)
    limits = box((-2.0 * radius, -2.0 * radius, -8), (2.0 * radius, 2.0 * radius, 0))
    return union(intersection(tube, limits), sphere((0, 0, 0), radius))


def scanned(part: Part, noise: float, params: Params | None = None) -> tuple[Segmentation, Scores]:
    scans, truth = simulate(part, StripeScanner(stripe_pitch=0.25, range_noise=noise), seed=3)
    result = segment(scans, params)
    return result, evaluate(result, truth)


@pytest.mark.parametrize(
    ("radius", "noise", "limit"),
    [
        (0.95, 0.0, 0.01),
        (2.4, 0.0, 0.01),
        (0.75, 0.01, 0.05),
        (3.0, 0.01, 0.05),
        (0.75, 0.025, 0.1),
        (1.5, 0.025, 0.1),
    ],
)
def test_a_fillet_between_planes(radius: float, noise: float, limit: float) -> None:
    result, scores = scanned(bend(radius, 90.0, fillet=True), noise)
    found = result.fillets
    assert found is not None and len(found) == 1
    assert abs(found.radius[0] / radius - 1.0) < limit
    assert 0.0 < found.deviation[0] < limit * radius and not found.concave[0]
    sides = result.kind[found.patches[0]]
    assert (sides == SurfaceKind.PLANE).all()
    assert found.points[0] == np.count_nonzero(found.point == 0)
    assert scores.edges["fillet"].recall >= 0.95 and scores.edges["fillet"].precision >= 0.95
    assert scores.fillets is not None and scores.fillets.within_10 == 1.0


def test_cells_have_the_label_of_their_points_where_a_strip_ends() -> None:
    result, _ = scanned(bend(3.0, 90.0, fillet=True), 0.01)
    assert result.fillets is not None and (result.fillets.strip >= 0).any()
    cells, checked = result.cells, 0
    for k in np.flatnonzero(cells.label >= 0):
        low, high = cells.corner[k], cells.corner[k] + cells.size[k]
        inside = ((result.points > low + 1e-6) & (result.points < high - 1e-6)).all(axis=1)
        assert (result.labels[inside] == cells.label[k]).all(), k
        checked += np.count_nonzero(inside)
    assert checked > 1000


@pytest.mark.parametrize("radius", [1.5, 3.0, 12.0])
def test_tangent_joints_are_patches(radius: float) -> None:
    turn = 90.0 if radius < 12.0 else 40.0
    result, scores = scanned(bend(radius, turn, fillet=False), 0.01)
    assert scores.regions.correct == scores.regions.patches
    assert result.fillets is not None
    if radius > 3.0:
        assert len(result.fillets) == 0 and np.any(result.edge == EdgeClass.SMOOTH)
    else:
        assert np.count_nonzero(result.fillets.strip >= 0) == 1


@pytest.mark.parametrize(("radius", "turn"), [(3.0, 45.0), (4.0, 40.0), (12.0, 25.0)])
def test_both_bends_of_an_s_are_patches(radius: float, turn: float) -> None:
    result, scores = scanned(s_blend(radius, turn), 0.01)
    assert scores.regions.correct == scores.regions.patches == 8
    bends = result.kind == SurfaceKind.CYLINDER
    assert np.count_nonzero(bends) == 2
    np.testing.assert_allclose(result.parameters[bends, 6], radius, rtol=0.05)
    assert radius <= 3.0 or np.any(result.edge == EdgeClass.SMOOTH)


@pytest.mark.parametrize("radius", [3.0, 6.0])
def test_a_tangent_cap_is_a_patch(radius: float) -> None:
    result, scores = scanned(capped(radius), 0.01)
    assert scores.regions.correct == scores.regions.patches == 2
    assert set(result.kind.tolist()) == {int(SurfaceKind.CYLINDER), int(SurfaceKind.SPHERE)}
    assert np.any(result.edge == EdgeClass.SMOOTH)


@pytest.mark.parametrize("turn", [3.0, 5.0, 10.0])
def test_shallow_ridges_are_two_patches(turn: float) -> None:
    result, scores = scanned(bend(0.0, turn, fillet=False, wide=14.0), 0.005)
    assert scores.regions.correct == scores.regions.patches
    assert result.fillets is not None and len(result.fillets) == 0
    assert scores.edges["sharp"].precision > 0.8 and scores.edges["sharp"].recall > 0.6


@pytest.mark.parametrize("noise", [0.005, 0.01, 0.025])
def test_the_result_says_which_edges_the_noise_hides(noise: float) -> None:
    def sides(turn_deg: float) -> tuple[int, Segmentation]:
        scanner = StripeScanner(stripe_pitch=0.25, range_noise=noise)
        scans, truth = simulate(bend(0.0, turn_deg, fillet=False, wide=11.0), scanner, seed=3)
        result = segment(scans)
        assert truth.normal is not None
        up = (truth.normal[:, 2] > 0.5) & (truth.patch >= 0) & (result.labels >= 0)
        main = [np.bincount(result.labels[up & (truth.patch == k)]).argmax()
                for k in np.unique(truth.patch[up])]  # fmt: skip
        return len(set(main)), result

    told, result = sides(30.0)
    assert told == 2 and result.edge_width == pytest.approx(11.0, rel=0.05)
    limit = math.degrees(result.shallowest_edge)
    assert 100.0 * noise < limit < 1000.0 * noise
    assert ("the noise hides shallower ones" in str(result)) == (limit > 3.0)
    assert sides(1.3 * limit)[0] == 2
    assert sides(0.2 * limit)[0] == 1


def test_fillets_can_be_left_out() -> None:
    params = Params(edges=EdgeParams(fillet_radius=0.0))
    result, _ = scanned(bend(1.5, 90.0, fillet=True), 0.01, params)
    assert result.fillets is not None and len(result.fillets) == 0
    assert not np.any(result.edge == EdgeClass.FILLET)


# A strip between two planes, point by point.

STEP, CORNER = 0.2, np.array([1.0, 7.0, 9.0])


class Strip(NamedTuple):
    """A fillet between two planes, 0 and 1; patch 2 is its strip."""

    search: Search
    along: np.ndarray
    """Way of every point over the edge, from the one line of contact [mm]."""
    arc: float
    """Way to the other one."""

    def rows(self, label: np.ndarray, patch: int = 2) -> np.ndarray:
        """Return the rows of points along the edge that are of a patch now, and were of the strip.

        Ways are in hundredths of the step, so that they are whole numbers.
        """
        mine = (label == patch) & (self.search.label == 2)
        return np.unique(np.rint(100.0 * self.along[mine] / STEP).astype(int))


def strip_between(
    radius: float, *, beyond: float, scatter: float, noise: float, first: float = 0.0
) -> Strip:
    """Return rows of points over an edge; those up to so far ``beyond`` the strip are of it."""
    arc = 0.5 * np.pi * radius
    x, along = (
        a.ravel() for a in np.meshgrid(np.arange(0, 10, STEP), np.arange(-5, arc + 5, STEP) + first)
    )
    on = np.clip(along, 0.0, arc)
    turn, rest = on / radius, along - on
    normals = np.column_stack([0.0 * turn, np.sin(turn), np.cos(turn)])
    points = np.column_stack([
        x, radius * np.sin(turn) + np.minimum(rest, 0.0),
        radius * (np.cos(turn) - 1.0) - np.maximum(rest, 0.0),
    ])  # fmt: skip
    points += CORNER + scatter * np.random.default_rng(0).normal(size=(len(x), 1)) * normals
    label = np.where(along < -beyond, 0, np.where(along > arc + beyond, 1, 2)).astype(np.int32)
    parameters = np.full((3, 8), np.nan)
    parameters[0, :6] = *CORNER, 0, 0, 1
    parameters[1, :6] = *(CORNER + np.array([0, radius, 0])), 0, 1, 0
    parameters[2, :7] = *(CORNER - np.array([0, 0, radius])), 1, 0, 0, radius
    kind = [SurfaceKind.PLANE, SurfaceKind.PLANE, SurfaceKind.CYLINDER]
    leaves, order = leaves_of(points, 0.45)
    runtime.ensure_started()
    search = Search(
        runtime.upload(points[order]), runtime.upload(normals[order]), leaves, label[order],
        np.arange(3, dtype=np.int32),
        Surfaces(kind=np.array(kind, np.int32), parameters=parameters),
        noise=noise, spacing=STEP, limit=3.0,
    )  # fmt: skip
    return Strip(search, along[order], arc)


@pytest.mark.parametrize(("radius", "beyond_mm"), [(1.0, 0.22), (2.0, 0.25), (1.0, 0.0)])
def test_beyond_the_lines_of_contact_points_of_a_strip_go_to_the_sides(
    radius: float, beyond_mm: float
) -> None:
    strip = strip_between(radius, beyond=beyond_mm, scatter=0.01, noise=0.013)
    before = strip.search.label.copy()
    found = find_borders(strip.search)
    np.testing.assert_array_equal(strip.search.label, before)
    assert found.strip.tolist() == [-1, -1, 0]
    np.testing.assert_allclose(found.radius, -radius, rtol=0.02)
    np.testing.assert_array_equal(found.label[before != 2], before[before != 2])
    beside = np.where(strip.along < strip.arc / 2.0, 0, 1)
    # Beyond the lines of contact all go; within them one in seven at most, the nearest to them.
    inside = (before == 2) & (strip.along > 0.02) & (strip.along < strip.arc - 0.02)
    beyond = (before == 2) & ((strip.along < -0.02) | (strip.along > strip.arc + 0.02))
    assert np.count_nonzero(inside) >= 200 and (beyond.any() or beyond_mm < 0.02)
    np.testing.assert_array_equal(found.label[beyond], beside[beyond])
    gone = (before == 2) & (found.label != 2)
    np.testing.assert_array_equal(found.label[gone], beside[gone])
    assert np.count_nonzero(gone & inside) <= 0.15 * np.count_nonzero(inside) + 1
    deep = np.minimum(strip.along, strip.arc - strip.along)
    assert not (gone & (deep > 0.25 * strip.arc)).any()


def test_of_a_narrow_strip_what_is_within_the_lines_stays() -> None:
    # All of it is within twice the noise of the planes.
    strip = strip_between(0.5, beyond=0.0, scatter=0.03, noise=0.08)
    found = find_borders(strip.search)
    assert found.strip.tolist() == [-1, -1, 0]
    assert strip.rows(strip.search.label).tolist() == [0, 100, 200, 300]
    # The first row is on the line of contact; the others stay whole.
    inner = (strip.search.label == 2) & (strip.along > 0.5 * STEP)
    assert (found.label[inner] == 2).all()


@pytest.mark.parametrize("rows", [2, 3, 4, 5, 7])
def test_a_strip_stays_where_rows_are_as_far_from_both_sides(rows: int) -> None:
    # Without noise whole rows of points are equally far from the sides.
    radius = 0.38 * rows / np.pi
    half = 0.25 * np.pi * radius
    first = (half - (0.5 * STEP if rows % 2 == 0 else 0.0)) % STEP
    strip = strip_between(radius, beyond=0.0, scatter=0.0, noise=0.5, first=float(first))
    assert len(strip.rows(strip.search.label)) == rows
    sides, of = np.array([[0, 1]], np.int32), np.array([-1, -1, 0], np.int32)
    before = strip.search.label == 2
    after = give_back(strip.search, of, sides, np.array([-radius])) == 2
    assert np.count_nonzero(after) >= 0.85 * np.count_nonzero(before)
    assert len(strip.rows(np.where(after, 2, -1))) >= 1


def test_what_is_no_strip_gives_nothing_back() -> None:
    strip = strip_between(1.0, beyond=0.15, scatter=0.01, noise=0.013)
    search, none = strip.search, np.zeros((0, 2), np.int32)
    np.testing.assert_array_equal(
        give_back(search, np.full(3, -1, np.int32), none, np.zeros(0)), search.label
    )
    search.analytic[2] = False
    sides, of = np.array([[0, 1]], np.int32), np.array([-1, -1, 0], np.int32)
    np.testing.assert_array_equal(give_back(search, of, sides, np.array([-1.0])), search.label)
