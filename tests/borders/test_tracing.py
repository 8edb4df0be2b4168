"""Edges and fillets of simple parts of which all is known."""

import math

import numpy as np
import pytest
from reference.rounded import bend

from octoseg_ti import evaluate, segment
from octoseg_ti.evaluation import Scores
from octoseg_ti.params import EdgeParams, Params
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
