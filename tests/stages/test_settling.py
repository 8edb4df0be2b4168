"""Where two surfaces would do, what lies around a point settles which one it is on."""

from typing import NamedTuple

import numpy as np
import pytest
from reference.leaves import leaves_of
from reference.settling import settle_one
from reference.surfaces import CYLINDER, PLANE, SPHERE, TORUS, distance_of

from octoseg_ti.device import runtime
from octoseg_ti.stages.labelling import surface_table
from octoseg_ti.stages.leaves import Leaves
from octoseg_ti.stages.settling import DOUBT, settle

FARTHEST = 2.5
NOISE = 0.02
NAN = np.nan


class Scene(NamedTuple):
    """Points in the order of their leaves, and what each chose by itself."""

    point: np.ndarray
    leaves: Leaves
    label: np.ndarray
    second: np.ndarray
    off: np.ndarray
    kind: np.ndarray
    parameters: np.ndarray

    def settled(self, reach: float) -> np.ndarray:
        runtime.ensure_started()
        return settle(
            runtime.upload(self.point), self.leaves, runtime.upload(self.label),
            runtime.upload(self.second), runtime.upload(self.off),
            surface_table(self.kind, self.parameters), reach=reach, farthest=FARTHEST,
        )  # fmt: skip


def random_scene(seed: int, n: int = 500) -> Scene:
    """Return points in a flat box, and surfaces through it that touch and that cross."""
    rng = np.random.default_rng(seed)
    point = rng.uniform(0.0, (4.0, 4.0, 2.0), (n, 3))
    leaves, order = leaves_of(point, 1.0)
    kind = np.array([PLANE, PLANE, CYLINDER, SPHERE, CYLINDER, TORUS], np.int32)
    parameters = np.array([
        (0, 0, 1, 0, 0, 1, NAN, NAN),
        (2, 2, 1, 0, np.sin(0.15), np.cos(0.15), NAN, NAN),
        (2, 0, -7, 0, 1, 0, 8, NAN),
        (2, 2, -8, 0, 0, 1, 9, NAN),
        (2, 2, 0, 0, 0, 1, 1.5, NAN),
        (2, 2, 0, 0, 0, 1, 2, 1),
    ])  # fmt: skip
    label = rng.integers(-1, 6, n).astype(np.int32)
    second = ((label + rng.integers(1, 6, n)) % 6).astype(np.int32)
    second[(label < 0) | (rng.random(n) < 0.1)] = -1
    off = rng.uniform(0.0, (1.3 * FARTHEST, 5.0, 1.7 * DOUBT), (n, 3)).astype(np.float32)
    return Scene(point[order], leaves, label, second, off, kind, parameters)


def two_surfaces(
    point: np.ndarray, kind: np.ndarray, parameters: np.ndarray, cell: float
) -> tuple[Scene, np.ndarray]:
    """Return points that took the nearer one of two surfaces, and where these rows came from."""
    leaves, order = leaves_of(point, cell)
    point = point[order]
    far = [np.abs(distance_of(point, kind[s], parameters[s])) / NOISE for s in range(2)]
    label = (far[1] < far[0]).astype(np.int32)
    near, off = np.minimum(*far), np.maximum(*far)
    zero = np.zeros(len(point))
    table = np.column_stack([off, zero, off**2 - near**2]).astype(np.float32)
    return Scene(point, leaves, label, 1 - label, table, kind, parameters), order


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("reach", [0.4, 0.9])
def test_what_is_settled_equals_the_reference(seed: int, reach: float) -> None:
    scene = random_scene(seed)
    leaves, label = scene.leaves, scene.settled(reach)
    first, last = leaves.first, leaves.first + leaves.count
    moved = {"": 0, "cross": 0, "touch": 0}
    asked = moved.copy()
    for c in range(len(leaves)):
        cells = [c, *leaves.neighbor[leaves.start[c] : leaves.start[c + 1]]]
        around = np.concatenate([np.arange(first[d], last[d]) for d in cells])
        for i in range(first[c], last[c]):
            expected = settle_one(
                i, scene.point, around, scene.label, scene.second, scene.off, scene.kind,
                scene.parameters, reach, FARTHEST,
            )  # fmt: skip
            assert label[i] == expected.label or expected.margin < 1e-6, f"seed {seed}, point {i}"
            asked[expected.how] += 1
            moved[expected.how] += int(expected.label != scene.label[i])
    assert moved[""] == 0
    assert 0 < moved["cross"] < asked["cross"] and 0 < moved["touch"] < asked["touch"]


def test_what_is_beyond_doubt_stays() -> None:
    scene = random_scene(5)
    label = scene.settled(0.9)
    for sure in (scene.label < 0, scene.second < 0, scene.off[:, 0] > np.float32(FARTHEST)):
        assert sure.sum() > 20
        np.testing.assert_array_equal(label[sure], scene.label[sure])
    flat = (scene.kind == PLANE)[np.stack([scene.label, scene.second])].all(axis=0)
    assert np.any((scene.off[:, 2] >= DOUBT) & flat & (label != scene.label))


def test_without_surfaces_nothing_is_settled() -> None:
    scene = random_scene(0)
    none = scene._replace(kind=scene.kind[:0], parameters=scene.parameters[:0])
    np.testing.assert_array_equal(none.settled(0.9), scene.label)


def ridge(turn: float, hollow: bool, cell: float, seed: int) -> tuple[Scene, np.ndarray]:
    """Return points of two planes with errors along the bisector, and which are on the second."""
    rng = np.random.default_rng(seed)
    half = np.radians(turn) / 2.0 * (-1.0 if hollow else 1.0)
    x, y = rng.uniform(0.0, 8.0, 6000), rng.uniform(-3.0, 3.0, 6000)
    y[np.abs(y) < 1e-6] = 1.0
    z = -np.tan(half) * np.abs(y) + rng.uniform(-2.0, 2.0, 6000) * NOISE
    parameters = np.full((2, 8), NAN)
    parameters[:, :6] = [(0, 0, 0, 0, lean * np.sin(half), np.cos(half)) for lean in (-1, 1)]
    point = np.column_stack([x, y, z])
    scene, order = two_surfaces(point, np.zeros(2, np.int32), parameters, cell)
    return scene, y[order] > 0.0


@pytest.mark.parametrize("turn", [60.0, 10.0, 5.0])
@pytest.mark.parametrize("hollow", [False, True])
def test_points_beside_an_edge_go_to_their_side(turn: float, hollow: bool) -> None:
    # Such errors change the distances from both planes alike. They mix the labels as far as this
    # from the edge, and points farther off tell on which side of each other the planes are.
    mixed = 2.0 * NOISE / np.tan(np.radians(turn) / 2.0)
    scene, second = ridge(turn, hollow, max(0.4, 3.0 * mixed), 7)
    before = np.count_nonzero(scene.label != second)
    assert before > (20 if turn == 60.0 else 150)
    np.testing.assert_array_equal(scene.settled(max(0.8, 4.0 * mixed)), second)


@pytest.mark.parametrize("turn", [10.0, 5.0])
def test_where_noise_mixes_labels_farther_than_points_are_asked_fewer_are_wrong(
    turn: float,
) -> None:
    scene, second = ridge(turn, False, 0.4, 7)
    before, after = (np.count_nonzero(name != second) for name in (scene.label, scene.settled(0.8)))
    assert after < 0.75 * before


def test_where_a_plane_touches_a_cylinder_neither_gets_more() -> None:
    parameters = np.array([(0, 0, 0, 0, 0, 1, NAN, NAN), (0, 0, -10, 1, 0, 0, 10, NAN)])
    counts = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        x, y = rng.uniform(0.0, 8.0, 4000), rng.uniform(-3.0, 3.0, 4000)
        z = np.where(y < 0.0, 0.0, np.sqrt(100.0 - y**2) - 10.0) + rng.normal(0.0, NOISE, 4000)
        kind = np.array([PLANE, CYLINDER], np.int32)
        scene, order = two_surfaces(np.column_stack([x, y, z]), kind, parameters, 0.4)
        curved, label = y[order] > 0.0, scene.settled(0.8)
        wrong = label != curved
        counts.append((np.sum(scene.label != curved), np.sum(wrong), np.sum(wrong & curved)))
    before, after, lost = np.sum(counts, axis=0)
    assert after < 0.25 * before
    # Where the labels change sides the line wanders, one way in one place, the other in another.
    assert 0.35 < lost / after < 0.65
    assert np.all(np.array(counts)[:, 1] < 0.5 * np.array(counts)[:, 0])
