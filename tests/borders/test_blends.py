"""Blends: small tubes and balls that join others smoothly; bosses, large rounds are none."""

from types import SimpleNamespace

import numpy as np
import pytest
from reference.leaves import leaves_of
from reference.rounded import rounded_block

from octoseg_ti import evaluate, segment
from octoseg_ti.borders.blends import find_blends, mark_blends
from octoseg_ti.borders.zones import Search, Zones
from octoseg_ti.device import runtime
from octoseg_ti.types import EdgeClass, SurfaceKind
from scanner_sim import StripeScanner, simulate

PLANE, CYLINDER, SPHERE, TORUS = (
    int(getattr(SurfaceKind, name)) for name in ("PLANE", "CYLINDER", "SPHERE", "TORUS")
)


class Searched(SimpleNamespace):
    """What the functions here need of a `Search`."""

    ball_radii = Search.ball_radii
    leaf_of = Search.leaf_of


def surface(kind: int, first: float = 0.0, second: float = 0.0) -> np.ndarray:
    return np.array([0, 0, 0, 0, 0, 1, first, second, kind, 1.0])


def searched(table: list[np.ndarray], normals: list[np.ndarray]) -> Searched:
    return Searched(
        table=np.array(table),
        analytic=np.ones(len(table), bool),
        count=len(table),
        label=np.repeat(np.arange(len(table)), [len(n) for n in normals]),
        normals=np.concatenate(normals),
        size=np.array([len(n) for n in normals]),
        limit=3.0,
        noise=0.01,
    )


def zones_of(pairs: list[tuple[int, int]], contact: list[int]) -> Zones:
    none = np.zeros(0, np.int64)
    return Zones(np.array(pairs), none, none, none > 0, none, 99, np.array(contact))


def arc(degrees: float) -> np.ndarray:
    angle = np.radians(np.linspace(0.0, degrees, 60, endpoint=False))
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(60)])


def test_the_ball_of_a_surface() -> None:
    table = [surface(PLANE), surface(CYLINDER, 2.0), surface(SPHERE, 1.5), surface(TORUS, 9.0, 0.7)]
    search = searched(table, [arc(90)] * 4)
    np.testing.assert_array_equal(search.ball_radii(), [np.inf, 2.0, 1.5, 0.7])
    search.analytic[1] = False
    assert np.isinf(search.ball_radii()[1])


@pytest.mark.parametrize(
    ("ball", "degrees", "turn", "contact", "blend"),
    [
        (surface(TORUS, 4.0, 1.2), 90.0, (0.0, 0.02, 1.0), (9, 5, 4), True),
        (surface(SPHERE, 1.2), 90.0, (0.0, 0.02, 0.0), (3, 3, 3), True),
        (surface(TORUS, 4.0, 3.6), 90.0, (0.0, 0.02, 1.0), (9, 5, 4), False),  # large
        (surface(CYLINDER, 1.2), 360.0, (0.0, 0.02, 1.0), (9, 5, 4), False),  # a boss
        (surface(CYLINDER, 1.2), 90.0, (0.0, 1.2, 1.0), (9, 5, 4), False),  # joins one
        (surface(CYLINDER, 1.2), 90.0, (0.0, 0.02, 1.0), (3, 2, 9), False),  # mostly sharp
        (surface(CYLINDER, 1.2), 90.0, (0.0, 0.02, 1.0), (9, 0, 4), False),  # touches one
    ],
)
def test_what_is_a_blend(
    ball: np.ndarray, degrees: float, turn: tuple[float, ...], contact: tuple[int, ...], blend: bool
) -> None:
    flat = np.tile([0.0, 0.0, 1.0], (30, 1))
    search = searched([surface(PLANE)] * 3 + [ball], [flat] * 3 + [arc(degrees)])
    zones = zones_of([(0, 3), (1, 3), (2, 3), (0, 1)], [*contact, 50])
    found = find_blends(search, zones, np.array([*turn, 1.5]))  # type: ignore[arg-type]
    np.testing.assert_array_equal(found, [False, False, False, blend])


def test_points_beside_a_blend_are_marked_and_stray_ones_are_not() -> None:
    # A plane z = 0 that goes over into a quarter of a tube; some points of the plane far from it
    # were given to the tube.
    radius, step = 1.0, 0.1
    y = np.arange(0.05, 3.0, step)
    x, angle = np.arange(-4.0, 0.0, step), np.arange(step, np.pi / 2, step)
    flat = np.array([(a, b, 0.0) for a in x for b in y])
    tube = np.array([(np.sin(t), b, np.cos(t) - 1.0) for t in angle for b in y])
    points = np.concatenate([flat, tube]) + np.array([5.0, 0.0, 3.0])
    label = np.repeat([0, 1], [len(flat), len(tube)]).astype(np.int32)
    stray = (label == 0) & (points[:, 0] < 2.0) & (np.arange(len(label)) % 7 == 0)
    label[stray] = 1
    leaves, order = leaves_of(points, 0.5)
    points, label, stray = points[order], label[order], stray[order]
    runtime.ensure_started()
    table = np.array([surface(PLANE), surface(CYLINDER, radius)])
    table[0, :6] = (0, 0, 3, 0, 0, 1)
    table[1, :6] = (5, 0, 2, 0, 1, 0)
    cells = np.arange(len(leaves))
    search = Searched(
        table=table,
        analytic=np.ones(2, bool),
        count=2,
        label=label,
        held=np.zeros(len(label), bool),
        points=points,
        members=[np.flatnonzero(label == k) for k in (0, 1)],
        noise=0.002,
        spacing=step,
        leaves=leaves,
        device=(runtime.upload(points),),
    )
    zones = Zones(np.array([[0, 1]]), 0 * cells, cells, cells >= 0, cells[:0], 3, np.array([9]))
    edge = np.zeros(len(points), np.uint8)
    mark_blends(search, zones, np.array([False, True]), np.ones(1, bool), edge)  # type: ignore[arg-type]
    found = edge == int(EdgeClass.FILLET)
    assert not np.any(found & stray) and np.any(stray)
    off = 5.0 - points[:, 0]  # behind the line of contact
    assert np.all(found[off < 1e-9])
    assert np.all(found[(off > 0) & (off < 0.1)])
    assert not np.any(found[off > 0.4])


def test_the_edges_and_corners_of_a_rounded_block_are_fillets() -> None:
    scanner = StripeScanner(stripe_pitch=0.25, range_noise=0.025)
    scans, truth = simulate(rounded_block(8.0, 6.0, 6.0, 1.2), scanner, seed=3)
    scores = evaluate(segment(scans), truth)
    assert scores.regions.correct == scores.regions.patches
    assert scores.edges["fillet"].recall > 0.91 and scores.edges["fillet"].precision > 0.97
    assert scores.edges["sharp"].precision > 0.91 and scores.edges["sharp"].recall > 0.97
