"""Corners: the ball that touches three sides is found, and what it and its tubes explain."""

from types import SimpleNamespace

import numpy as np
import pytest
from reference.leaves import leaves_of
from reference.rounded import rounded_block

from octoseg_ti import evaluate, segment
from octoseg_ti.borders.corners import (
    Corners,
    fillets_that_meet,
    find_corners,
    mark_corners,
    parts_of,
)
from octoseg_ti.borders.fillets import Fit
from octoseg_ti.borders.zones import Search, Zones
from octoseg_ti.device import runtime
from octoseg_ti.types import NONE, EdgeClass, SurfaceKind
from scanner_sim import StripeScanner, simulate

RADIUS, NOISE, STEP = 1.5, 0.01, 0.12
AWAY = np.array([7.0, 8.0, 9.0])
CONE = 3  # the label of the ball and of the ends of two tubes


class Searched(SimpleNamespace):
    """What the functions here need of a `Search`."""

    leaf_of = Search.leaf_of
    place = Search.place


def fit_of(radius: np.ndarray, deviation: float = 0.01) -> Fit:
    none = np.zeros(len(radius))
    return Fit(
        radius=radius, deviation=none + deviation, hollow=np.sign(radius), turn=none,
        points=none, good=none > 0, large=none > 0,
    )  # fmt: skip


def zones_of(pairs: list[tuple[int, int]]) -> Zones:
    none = np.zeros(0, np.int64)
    return Zones(np.array(pairs).reshape(-1, 2), none, none, none > 0, none, 99, none)


def rounded_corner(hollow: float, seed: int, *, sharp: bool = False) -> Searched:
    """Three planes x, y, z = 0 around the octant of negative coordinates, its edges rounded.

    Tubes 0, 1, 2 run along the pairs (1, 2), (0, 2), (0, 1) of the planes. The ball and the next
    millimetre of the tubes 0 and 1 have a label of their own, the tubes the label of a side.
    """
    rng = np.random.default_rng(seed)
    parts, r = [], 0.0 if sharp else RADIUS
    grid = np.arange(STEP / 2, 6.0, STEP)
    for axis in range(3):
        far = grid[grid > r]
        u, v = (a.ravel() for a in np.meshgrid(far, far))
        flat = np.zeros((len(u), 3))
        flat[:, (axis + 1) % 3], flat[:, (axis + 2) % 3] = -u, -v
        parts.append((flat, np.tile(np.eye(3)[axis], (len(u), 1)), np.full(len(u), axis), NONE))
        if sharp:
            continue
        angle = np.arange(STEP / 2, np.pi / 2 * r, STEP) / r
        t, angle = (a.ravel() for a in np.meshgrid(far, angle))
        normal = np.zeros((len(t), 3))
        normal[:, (axis + 1) % 3], normal[:, (axis + 2) % 3] = np.cos(angle), np.sin(angle)
        place = r * normal - r
        place[:, axis] = -t
        label = np.where((t < r + 1.0) & (axis < 2), CONE, (axis + 1) % 3)
        parts.append((place, normal, label, axis))
    if not sharp:
        normal = np.abs(rng.normal(size=(250, 3)))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        parts.append((r * normal - r, normal, np.full(250, CONE), NONE))
    point = np.concatenate([p[0] + rng.normal(0, NOISE, (len(p[0]), 1)) * p[1] for p in parts])
    normal = hollow * -np.concatenate([p[1] for p in parts])
    label = np.concatenate([p[2] for p in parts]).astype(np.int32)
    claim = np.concatenate([np.full(len(p[0]), p[3]) for p in parts])
    claim[label == CONE] = NONE
    leaves, order = leaves_of(point + AWAY, 0.5)
    point, normal, label, claim = (a[order] for a in (point + AWAY, normal, label, claim))
    table = np.zeros((4, 10))
    for axis in range(3):
        table[axis, :3], table[axis, 3:6] = AWAY, np.eye(3)[axis]
    table[:3, 9] = -hollow
    table[3] = (0, 0, 0, 0, 0, 1, 1.0, 0, int(SurfaceKind.CONE), 1)
    runtime.ensure_started()
    off = np.where(label == CONE, 1.2 * NOISE, NOISE)
    return Searched(
        table=table, count=4, label=label, claim=claim, points=point, normals=normal, off=off,
        members=[np.flatnonzero(label == k) for k in range(4)], noise=NOISE, spacing=STEP,
        size=np.bincount(label, minlength=4), leaves=leaves,
        device=(runtime.upload(point), runtime.upload(normal)),
    )  # fmt: skip


PAIRS = [(1, 2), (0, 2), (0, 1), (0, 3), (1, 3), (2, 3)]


def test_fillets_meet_that_share_a_side_and_a_radius() -> None:
    pairs = np.array([[0, 1], [1, 2], [0, 3], [4, 5], [0, 2], [1, 4]])
    fit = fit_of(np.array([-1.0, -1.1, 1.0, -1.0, -1.0, -1.6]))
    chosen = np.array([True, True, True, True, False, True])
    np.testing.assert_array_equal(fillets_that_meet(pairs, fit, chosen), [[0, 1]])
    loose = fit_of(np.asarray(fit.radius), 0.2)
    np.testing.assert_array_equal(
        fillets_that_meet(pairs, loose, chosen), [[0, 1], [0, 5], [1, 5], [3, 5]]
    )
    np.testing.assert_array_equal(fillets_that_meet(pairs, fit, chosen & False), np.zeros((0, 2)))


@pytest.mark.parametrize("hollow", [-1.0, 1.0])
@pytest.mark.parametrize("fillets", [[0, 1, 2], [1, 2], [0, 2]])
def test_the_ball_of_a_corner_is_found(hollow: float, fillets: list[int]) -> None:
    search = rounded_corner(hollow, 0)
    zones, fit = zones_of(PAIRS), fit_of(np.full(6, hollow * RADIUS))
    corners = find_corners(search, zones, fit, np.isin(np.arange(6), fillets))  # type: ignore[arg-type]
    np.testing.assert_array_equal(corners.sides, [[0, 1, 2]])
    np.testing.assert_allclose(corners.centre, [AWAY - RADIUS], atol=1e-6)
    np.testing.assert_allclose(corners.radius, [hollow * RADIUS])
    np.testing.assert_allclose(corners.toward[0], np.eye(3), atol=1e-6)
    # Its points: what is between the contacts, and nothing else.
    inside = (search.points - AWAY > -RADIUS).all(axis=1)
    np.testing.assert_array_equal(np.sort(corners.point), np.flatnonzero(inside))
    edge = np.zeros(len(search.label), np.uint8)
    mark_corners(search, corners, edge)  # type: ignore[arg-type]
    touch = AWAY - RADIUS + RADIUS * np.eye(3)
    assert np.all(edge[inside] == int(EdgeClass.FILLET))
    flat = (search.label < 3) & (search.claim < 0)
    gap = np.linalg.norm(search.points[flat] - touch[search.label[flat]], axis=1)
    np.testing.assert_array_equal(edge[flat] > 0, gap <= 2.0 * STEP)


def test_a_sharp_corner_has_no_ball() -> None:
    search = rounded_corner(-1.0, 0, sharp=True)
    # Points at the edges, taken for tubes.
    edge = (search.points - AWAY > -0.3).sum(axis=1) >= 2
    search.claim[np.flatnonzero(edge)] = np.arange(np.count_nonzero(edge)) % 3
    fit = fit_of(np.full(6, -RADIUS))
    corners = find_corners(search, zones_of(PAIRS), fit, np.arange(6) < 3)  # type: ignore[arg-type]
    assert len(corners.sides) == 0 and len(corners.point) == 0


def test_a_patch_of_ball_and_tubes_is_a_part_and_a_surface_of_its_own_is_none() -> None:
    search = rounded_corner(-1.0, 1)
    zones, fit = zones_of(PAIRS), fit_of(np.full(6, -RADIUS))
    chosen = np.arange(6) < 3
    corners = find_corners(search, zones, fit, chosen)  # type: ignore[arg-type]
    none = np.full((4, 2), NONE)
    parts = parts_of(search, zones, corners, none)  # type: ignore[arg-type]
    np.testing.assert_array_equal(parts.patch, [False, False, False, True])
    np.testing.assert_array_equal(parts.strip, [[CONE, 0, 2], [CONE, 1, 2]])
    np.testing.assert_array_equal(parts.smooth, [False, False, False, True, True, True])
    # The same, with half of a plane.
    mine = np.flatnonzero((search.label == 0) & (search.claim < 0))
    search.label[mine[::2]] = CONE
    search.members = [np.flatnonzero(search.label == k) for k in range(4)]
    parts = parts_of(search, zones, corners, none)  # type: ignore[arg-type]
    assert not parts.patch.any() and len(parts.strip) == 0 and not parts.smooth.any()


def test_without_corners_there_are_no_parts() -> None:
    search = rounded_corner(-1.0, 2)
    zones = zones_of(PAIRS)
    corners = find_corners(search, zones, fit_of(np.full(6, -1.0)), np.zeros(6, bool))  # type: ignore[arg-type]
    assert isinstance(corners, Corners) and len(corners.sides) == 0
    parts = parts_of(search, zones, corners, np.full((4, 2), NONE))  # type: ignore[arg-type]
    assert not parts.patch.any() and len(parts.strip) == 0


@pytest.mark.parametrize(("radius", "seeds"), [(2.5, (3,)), (1.3, (1, 2, 3))])
def test_balls_that_pass_as_cones_are_corners(radius: float, seeds: tuple[int, ...]) -> None:
    scanner = StripeScanner(stripe_pitch=0.25, range_noise=0.025)
    rows: list[tuple[float, ...]] = []
    for seed in seeds:
        scans, truth = simulate(rounded_block(8.0, 6.0, 6.0, radius), scanner, seed=seed)
        result = segment(scans)
        edges = evaluate(result, truth).edges
        rows.append(
            tuple(x for k in ("sharp", "fillet") for x in (edges[k].precision, edges[k].recall))
        )
        assert result.fillets is not None and len(result.fillets) == 8
        np.testing.assert_allclose(np.abs(result.fillets.radius), radius, rtol=0.05)
    # Of the few points of small corners chance takes some: of one scan more, of another fewer.
    assert np.all(np.mean(rows, axis=0) > [0.93, 0.95, 0.98, 0.89])
