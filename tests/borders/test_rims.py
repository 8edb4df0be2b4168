"""Edges of which one face was scanned: found where the probe saw past them, and only there."""

import dataclasses

import numpy as np
import pytest

from octoseg_ti import evaluate, segment
from octoseg_ti.evaluation import Scores
from octoseg_ti.types import EdgeClass, Scans, Segmentation, Truth
from scanner_sim import StripeScanner, simulate
from scanner_sim.part import Part, box, cylinder, intersection, union
from scanner_sim.scanner import View

PLATE = box((-13, -9, -8), (13, 9, 0))
FROM_ABOVE = (View(),)


def scanned(part: Part, **options: object) -> tuple[Scans, Truth, Segmentation, Scores]:
    scanner = StripeScanner(stripe_pitch=0.25, range_noise=0.01, **options)  # type: ignore[arg-type]
    scans, truth = simulate(part, scanner, seed=1)
    result = segment(scans)
    return scans, truth, result, evaluate(result, truth)


def test_the_bottom_rim_of_a_block_is_an_edge() -> None:
    _, truth, result, scores = scanned(PLATE)
    assert scores.edges["sharp"].precision > 0.93 and scores.edges["sharp"].recall > 0.97
    assert truth.position is not None
    low = truth.position[:, 2] < -7.6
    assert np.mean(result.edge[low] == EdgeClass.SHARP) > 0.97


def test_what_a_side_view_sees_of_a_post_ends_at_no_edge() -> None:
    # The post turns out of the sight of the probe, and throws a shadow on the plate.
    post = intersection(cylinder((0, 0, 0), (0, 0, 1), 4.0), box((-5, -5, -1), (5, 5, 8)))
    _, truth, result, scores = scanned(union(PLATE, post), views=(View(tilt=0.9),))
    assert scores.edges["sharp"].precision > 0.98
    assert truth.edge_distance is not None
    assert not np.any(result.edge[truth.edge_distance > 1.2] == EdgeClass.SHARP)


@pytest.mark.parametrize("field_of_view", [None, 12.0])
def test_shadows_and_the_end_of_the_field_of_view_are_no_edges(field_of_view: float | None) -> None:
    part = union(PLATE, box((-4, -3, -1), (4, 3, 6)))
    scans, truth, _, scores = scanned(part, views=FROM_ABOVE, field_of_view=field_of_view)
    assert scores.edges["sharp"].precision > 0.99 and scores.edges["sharp"].recall > 0.15
    # Without columns, and without a place of the probe, less can be said, and nothing wrong.
    bare = dataclasses.replace(scans, column=None, origin=None, stripe_origin=None)
    assert evaluate(segment(bare), truth).edges["sharp"].precision > 0.95


@pytest.mark.parametrize("turn", [0.0, np.pi])
def test_the_upper_edge_of_a_step_is_found_whatever_the_camera_sees_below(turn: float) -> None:
    step = union(PLATE, box((0, -9, -8), (13, 9, 6)))
    _, truth, result, scores = scanned(step, views=(View(azimuth=turn),))
    assert truth.position is not None and truth.edge_distance is not None
    x, y, z = truth.position.T
    middle = np.abs(y) < 8.0
    upper = (z > 5.5) & (x < 0.35) & middle
    assert upper.any() and np.mean(result.edge[upper] == EdgeClass.SHARP) > 0.95
    shadow = (z < 0.5) & (x < -1.0) & (x > -12.0) & middle
    assert not np.any(result.edge[shadow] == EdgeClass.SHARP)
    assert scores.edges["sharp"].precision > 0.99


def test_points_without_stripes_have_no_rims() -> None:
    scans, _, result, _ = scanned(PLATE, views=FROM_ABOVE)
    loose = segment(result.points)
    assert len(loose) == len(scans) and not np.any(loose.edge == EdgeClass.SHARP)
