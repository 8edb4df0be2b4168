"""Mirror images that look like faces are given up; faces that one view alone sees are not."""

import math
from dataclasses import replace

import numpy as np
import pytest

from octoseg_ti import DataError, Params, evaluate, segment
from octoseg_ti.params import CleaningParams
from octoseg_ti.types import Scans
from scanner_sim import StripeScanner, View, blocks, plan_views, simulate
from scanner_sim.scanner import around


def scene(depth: float, hole: bool) -> tuple[Scans, np.ndarray]:
    """Return a plate with a small plate below it, seen from above, and which points are of that.

    Args:
        depth: How far below it lies [mm].
        hole: The plate has a hole where the small one is.
    """
    x, y = np.meshgrid(np.arange(0.0, 30.0, 0.25), np.arange(0.0, 30.0, 0.25))
    below = (abs(x - 15.0) < 4.0) & (abs(y - 15.0) < 4.0)
    plate = np.stack([x, y, np.zeros(x.shape)], axis=-1)
    rows, views = [], []
    if hole:
        rows = [np.where(below[..., None], plate - [0.0, 0.0, depth], plate)[i] for i in range(120)]
        views = [0] * 120
    else:
        rows = [plate[i] for i in range(120)]
        rows += [plate[i][below[i]] - [0.0, 0.0, depth] for i in range(120) if below[i].any()]
        views = [0] * 120 + [1] * (len(rows) - 120)
    count = [len(row) for row in rows]
    points = np.concatenate(rows) + np.random.default_rng(0).normal(0, 0.003, (sum(count), 3))
    probe = np.array([[row[:, 0].mean(), row[0, 1], 100.0] for row in rows])
    scans = Scans(
        points=points, stripe=np.repeat(np.arange(len(rows)), count), view=np.repeat(views, count),
        stripe_origin=probe,
    )  # fmt: skip
    return scans, points[:, 2] < -0.5 * depth


def test_what_lies_behind_a_face_is_given_up() -> None:
    scans, image = scene(6.0, hole=False)
    result = segment(scans)
    assert result.outlier[image].mean() > 0.95
    assert not result.outlier[~image].any()
    assert result.patch_count == 1 and np.all(result.labels[image & (result.outlier > 0)] == -1)
    assert not result.edge[result.outlier > 0].any()


def test_what_is_seen_through_a_hole_stays() -> None:
    scans, floor = scene(6.0, hole=True)
    result = segment(scans)
    assert not result.outlier[floor].any()
    assert (result.labels[floor] >= 0).mean() > 0.9 and result.patch_count == 2


def test_a_face_that_its_view_just_sees_stays() -> None:
    """Lines of sight to its rims pass close by the edges of what hides the rest of it."""
    slot = blocks.box((-3.7, -11.0, 8.0), (3.7, 11.0, 13.0))
    part = blocks.difference(blocks.box((-15.0, -10.0, 0.0), (15.0, 10.0, 12.0)), slot)
    views = (View(), *(View(tilt=math.radians(61.0), azimuth=turn) for turn in (0.0, math.pi)))
    scanner = StripeScanner(stripe_pitch=0.25, range_noise=0.0, views=views)
    scans, truth = simulate(part, scanner, seed=0)
    result = segment(scans)
    assert result.outlier.mean() < 0.001
    regions = evaluate(result, truth).regions
    assert regions.correct == regions.patches == regions.regions == 7


@pytest.mark.parametrize("why", ["unknown place", "never asked", "one place for a view"])
def test_without_a_place_of_the_probe_nothing_is_given_up(why: str) -> None:
    scans, image = scene(6.0, hole=False)
    params = Params()
    if why == "unknown place":
        scans = replace(scans, stripe_origin=np.full_like(scans.stripe_origin, np.nan))
    elif why == "one place for a view":
        scans = replace(scans, stripe_origin=None, origin=np.full((2, 3), 100.0))
    else:
        params = Params(cleaning=CleaningParams(enabled=False))
    result = segment(scans, params)
    assert not result.outlier[image].any() and result.patch_count == 2


def test_places_of_another_number_are_an_error() -> None:
    scans, _ = scene(6.0, hole=False)
    assert scans.stripe_origin is not None
    for places in (scans.stripe_origin[:-1], scans.stripe_origin[:, :2]):
        with pytest.raises(DataError, match="stripe_origin"):
            segment(replace(scans, stripe_origin=places))


@pytest.mark.parametrize("planned", [False, True])
def test_the_block_of_the_paper_as_an_old_probe_sees_it(planned: bool) -> None:
    """Four views that do not quite meet, lost points, mirror images."""
    part = blocks.test_block()
    scanner = StripeScanner.preset(
        "surveyor-like", pose_noise=0.02, pose_angle_noise=math.radians(0.02), dropout=0.01
    )
    views = (View(azimuth=math.radians(70.0)), *around((math.radians(50.0), 3)))
    if planned:
        views = plan_views(part, scanner, overlap=0.3, count=4)
    scans, truth = simulate(part, replace(scanner, views=views), seed=0)
    scores = evaluate(segment(scans), truth)
    regions = scores.regions
    assert regions.correct == regions.patches == regions.regions
    assert scores.artefacts is not None
    if planned:  # the others see hardly any images
        assert scores.artefacts.classes["spike"][1] > 0.8
