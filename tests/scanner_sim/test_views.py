"""The indexed head, planned passes, and passes that are shifted to the side."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from octoseg_ti.errors import DataError
from scanner_sim import (
    Part,
    ProbeHead,
    StripeScanner,
    View,
    blocks,
    box,
    half_space,
    parse_views,
    plan_views,
    simulate,
    sphere,
)
from scanner_sim.views import covered_share

STEP = math.radians(7.5)


def test_the_head_snaps_to_the_nearest_index() -> None:
    head = ProbeHead()
    rng = np.random.default_rng(0)
    for tilt, azimuth in zip(rng.uniform(0, 1.4, 50), rng.uniform(-7, 14, 50), strict=True):
        view = head.snap(View(tilt=tilt, azimuth=azimuth, offset=3.0))
        assert view.offset == 3.0
        for angle in (view.tilt, view.azimuth):
            assert angle / STEP == pytest.approx(round(angle / STEP), abs=1e-9)
        assert abs(view.tilt - tilt) <= STEP / 2 + 1e-9
        turned = (view.azimuth - azimuth + math.pi) % (2.0 * math.pi) - math.pi
        assert abs(turned) <= STEP / 2 + 1e-9
        assert 0.0 <= view.azimuth < 2.0 * math.pi
    assert head.snap(View(tilt=1.56)).tilt == pytest.approx(math.radians(82.5))
    other = head.snap(View(tilt=-0.4, azimuth=0.1))
    np.testing.assert_allclose(
        other.rotation()[:, 2], head.snap(View(tilt=0.4, azimuth=0.1 + math.pi)).rotation()[:, 2]
    )
    assert len(head.orientations()) == 1 + 11 * 48
    assert ProbeHead(step=math.radians(15.0)).orientations() == head.orientations(2)[: 1 + 5 * 24]


@pytest.mark.parametrize("values", [{"step": 0.1}, {"step": 0.0}, {"max_tilt": 1.6}])
def test_impossible_heads_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(DataError, match=f"ProbeHead: {next(iter(values))}"):
        ProbeHead(**values)


@pytest.mark.parametrize(
    ("text", "views"),
    [
        ("0,0", (View(),)),
        ("30,90; -15.5,0,12", (View(tilt=math.radians(30), azimuth=math.radians(90)),
                               View(tilt=math.radians(-15.5), offset=12.0))),
    ],
)  # fmt: skip
def test_views_are_read_in_degrees(text: str, views: tuple[View, ...]) -> None:
    assert parse_views(text) == views


@pytest.mark.parametrize("text", ["", "1", "1,2,3,4", "a,b", "nan,0", "90,0", "1,2;"])
def test_wrong_views_are_refused(text: str) -> None:
    with pytest.raises(DataError, match="view"):
        parse_views(text)


@pytest.mark.parametrize("name", ["test-block", "phone"])
def test_planned_views_cover_a_part(name: str) -> None:
    part, scanner = blocks.by_name(name), StripeScanner()
    views = plan_views(part, scanner)
    head = ProbeHead()
    assert all(head.snap(view) == replace(view, azimuth=head.snap(view).azimuth) for view in views)
    assert 1 < len(views) <= 8
    assert covered_share(part, scanner, views) >= 0.99
    few = plan_views(part, scanner, count=2)
    assert few == views[:2]  # the same in every run


def test_a_cube_needs_its_five_sides_and_a_plane_one() -> None:
    cube = box((-10, -10, 0), (10, 10, 20))
    views = plan_views(cube, coverage=1.0)
    scans, truth = simulate(cube, StripeScanner(stripe_pitch=0.5, views=views))
    assert truth.patch_count == 5 and len(views) <= 5 and len(scans) > 1000
    assert len(plan_views(box((-10, -10, 0), (10, 10, 1e-3)), count=1)) == 1


def test_wide_parts_get_passes_side_by_side_that_overlap() -> None:
    plate = box((-50, -30, 0), (50, 30, 2))
    scanner = StripeScanner(
        field_of_view=25.0, stripe_pitch=1.0, point_pitch=0.8, dropout=0.0, lost_ends=0.0,
        range_noise=0.0,
    )  # fmt: skip
    views = plan_views(plate, scanner, overlap=0.3, count=1)
    assert len({(view.tilt, view.azimuth) for view in views}) == 1 and len(views) > 3
    offsets = np.diff([view.offset for view in views])
    assert (offsets > 0.0).all() and (offsets <= 0.7 * 25.0 + 1e-6).all()
    scans, truth = simulate(plate, replace(scanner, views=views))
    assert scans.view is not None and scans.T_world_view is not None and truth.position is not None
    spans = []
    for v, view in enumerate(views):
        mine = scans.points[scans.view == v]
        assert np.abs(mine[:, 1] - view.offset).max() <= 12.5 * 1.2
        spans.append((mine[:, 1].min(), mine[:, 1].max()))
        np.testing.assert_array_equal(scans.T_world_view[v, :3, 3], plate.box.mean(axis=0))
    for (_, end), (start, _) in itertools.pairwise(spans):
        assert end - start > 0.2 * 25.0  # neighbours see the same strip
    # Together they see what one wide pass sees.
    wide, _ = simulate(
        plate, replace(scanner, field_of_view=None, views=(replace(views[0], offset=0.0),))
    )
    assert spans[0][0] == pytest.approx(wide.points[:, 1].min(), abs=1.5)
    assert spans[-1][1] == pytest.approx(wide.points[:, 1].max(), abs=1.5)


def test_every_point_of_several_passes_keeps_view_stripe_column_and_time() -> None:
    ball = sphere((0, 0, 0), 10.0)
    views = (View(offset=-4.0), View(offset=4.0), View(tilt=0.5, azimuth=1.0))
    scanner = StripeScanner(field_of_view=12.0, stripe_pitch=0.6, views=views)
    scans, truth = simulate(ball, scanner, seed=2)
    assert scans.view is not None and scans.stripe is not None and scans.column is not None
    assert (
        scans.time_ns is not None and scans.stripe_origin is not None and scans.origin is not None
    )
    assert np.unique(scans.view).tolist() == [0, 1, 2]
    assert (np.diff(scans.view) >= 0).all() and (np.diff(scans.stripe) >= 0).all()
    assert (np.diff(scans.time_ns) > 0).all()
    assert (np.diff(scans.column)[np.diff(scans.stripe) == 0] > 0).all()
    assert all(len(np.unique(scans.view[scans.stripe == s])) == 1 for s in np.unique(scans.stripe))
    # The probe of a shifted pass really stands to the side, and the laser line stays in its plane.
    np.testing.assert_allclose(scans.origin[:2, 1], [-4.0 * -1, 4.0 * -1], atol=1e-9)
    assert truth.T_world_view is not None and truth.T_world_view.shape == (3, 4, 4)


def test_what_cannot_be_planned_is_said() -> None:
    part: Part = box((-5, -5, 0), (5, 5, 4))
    for values in ({"overlap": 0.95}, {"overlap": -0.1}, {"coverage": 0.0}, {"count": 0}):
        with pytest.raises(DataError):
            plan_views(part, **values)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="infinite"):
        plan_views(half_space((0, 0, 0), (0, 0, 1)))
    with pytest.raises(DataError, match="sees nothing"):
        plan_views(part, StripeScanner(depth_of_field=1e-9))
    with pytest.raises(DataError, match="too narrow for a part"):
        plan_views(part, StripeScanner(field_of_view=1e-9))
