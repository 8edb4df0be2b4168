"""Pieces of surfaces become patches, and what surfaces leave of a region a free form."""

from types import SimpleNamespace

import numpy as np
import pytest
from reference import meeting
from reference.device_grid import surface_leaves
from reference.leaves import leaves_of

from octoseg_ti import Scans, SurfaceKind, segment
from octoseg_ti.device import runtime
from octoseg_ti.stages.labelling import label_lists
from octoseg_ti.stages.leaves import Leaves
from octoseg_ti.stages.sets import Surfaces
from octoseg_ti.surface_search import EXPLAINED, FREE, Surfaced
from octoseg_ti.surfacing import _with_free_forms, connected_pieces, number_pieces

LEAST = 20


def surfaced(leaves: Leaves, label: np.ndarray, off: np.ndarray, count: int) -> Surfaced:
    return Surfaced(
        surfaces=Surfaces(kind=np.zeros(count, np.int32), parameters=np.zeros((count, 8))),
        covariance=np.zeros((count, 8, 8)),
        label=label.astype(np.int32),
        own=label_lists(leaves, label.astype(np.int32)),
        off=off.astype(np.float32),
    )


def band(ends: list[float], names: list[int]) -> tuple[Leaves, np.ndarray, np.ndarray]:
    """Return a strip of points, cut across into surfaces: its leaves, labels and places along."""
    x, y = (a.ravel() for a in np.mgrid[0.125:20.0:0.25, 0.125:4.0:0.25])
    leaves, order = leaves_of(np.column_stack([x, y, 0.0 * x]), 1.0)
    x = x[order]
    return leaves, np.array(names)[np.searchsorted(ends, x)], x


def numbered(
    leaves: Leaves, found: Surfaced, least: float, fewest: float
) -> tuple[np.ndarray, np.ndarray]:
    points = runtime.upload(np.zeros((len(found.label), 3)))  # none too far from another
    piece, entries = connected_pieces(points, leaves, found, None)
    return number_pieces(found, entries, piece, least, fewest)


def plain_numbers(
    leaves: Leaves, found: Surfaced, least: float, fewest: float
) -> tuple[list[int], list[int]]:
    """Return the patch of every point, and the surface of every patch."""
    own = [row[row >= 0].tolist() for row in found.own]
    pairs = list(zip(leaves.a.tolist(), leaves.b.tolist(), strict=True))
    piece = meeting.pieces(own, pairs)
    members: dict[int, list[int]] = {}
    for c in range(len(leaves)):
        for i in range(leaves.first[c], leaves.first[c] + leaves.count[c]):
            if found.label[i] >= 0:
                name = piece[c][own[c].index(found.label[i])]
                members.setdefault(name, []).append(i)
    surface = {p: int(found.label[mine[0]]) for p, mine in members.items()}
    largest: dict[int, int] = {}
    for p, mine in members.items():
        largest[surface[p]] = max(largest.get(surface[p], 0), len(mine))
    patches = []
    for p, mine in members.items():
        main = len(mine) == largest[surface[p]]
        within = np.mean(np.minimum(found.off[mine], 4.0) ** 2) <= EXPLAINED
        if len(mine) >= (fewest if main else least) and (main or not within):
            patches.append(p)
    patches.sort(key=lambda p: (-len(members[p]), p))
    label = [-1] * len(found.label)
    for number, p in enumerate(patches):
        for i in members[p]:
            label[i] = number
    return label, [surface[p] for p in patches]


@pytest.mark.parametrize("seed", range(4))
def test_numbers_of_pieces_equal_the_reference(seed: int) -> None:
    _, leaves = surface_leaves(seed, 900)
    rng = np.random.default_rng(seed)
    count = 6
    # Most leaves have one surface, so that there are pieces of many sizes.
    leaf = np.repeat(np.arange(len(leaves)), leaves.count)
    label = np.where(rng.random(900) < 0.05, -1, rng.integers(0, count, len(leaves))[leaf])
    label = np.where(rng.random(900) < 0.03, rng.integers(-1, count, 900), label)
    calm = rng.random(len(leaves)) < 0.5
    found = surfaced(leaves, label, rng.uniform(0, np.where(calm[leaf], 2.2, 6.0)), count)
    numbers, surface = numbered(leaves, found, 5, 3)
    expected, names = plain_numbers(leaves, found, 5, 3)
    np.testing.assert_array_equal(numbers, expected, err_msg=f"seed {seed}")
    assert surface.tolist() == names
    strict, _ = numbered(leaves, surfaced(leaves, label, 0 * label + 9.0, count), 5, 3)
    assert np.any((strict >= 0) & (numbers < 0))


@pytest.mark.parametrize(("off", "patch"), [(5.0, True), (1.5, True), (1.4, False), (0.0, False)])
def test_a_second_piece_that_another_surface_explains_is_no_patch(off: float, patch: bool) -> None:
    leaves, label, x = band([8.0, 14.0, 15.0, 20.0], [0, 1, 0, 2])
    small = (x > 14.0) & (x < 15.0)
    found = surfaced(leaves, label, np.where(small, off, 9.0), 3)
    numbers, surface = numbered(leaves, found, 20, 10)
    assert surface.tolist() == ([0, 1, 2, 0] if patch else [0, 1, 2])
    np.testing.assert_array_equal(numbers, np.where(small, 3 if patch else -1, label))


def test_the_largest_piece_of_a_surface_stays_and_may_be_small() -> None:
    leaves, label, x = band([8.0, 14.0, 15.0, 20.0], [0, 1, 2, 1])
    small = (x > 14.0) & (x < 15.0)
    found = surfaced(leaves, label, np.where(small, 0.0, 9.0), 3)
    for least, fewest, kept in ((20, 10, True), (100, 64, True), (100, 65, False)):
        numbers, surface = numbered(leaves, found, least, fewest)
        # The second piece of surface 1 has 320 points, the first has 384.
        assert surface.tolist() == ([0, 1, 1, 2] if kept else [0, 1, 1])
        assert (numbers[small] == (3 if kept else -1)).all()
    _, surface = numbered(leaves, found, 321, 10)
    assert surface.tolist() == [0, 1, 2]


def freed(
    label: list[tuple[int, int]], surface: list[int], region: list[tuple[int, int]], count: int
) -> tuple[list[tuple[int, int]], list[int], int]:
    """Call `_with_free_forms` with runs (label, length), and return such runs."""
    mine, theirs = (np.repeat(*np.array(runs).T).astype(np.int32) for runs in (label, region))
    found = SimpleNamespace(label=theirs, count=count)
    after, kept, free = _with_free_forms(mine, np.array(surface), found, LEAST)  # type: ignore[arg-type]
    ends = np.flatnonzero(np.append(np.diff(after), 1))
    runs = list(zip(after[ends].tolist(), np.diff(ends, prepend=-1).tolist(), strict=True))
    return runs, kept.tolist(), free


def test_a_small_surface_within_a_free_form_is_a_part_of_it() -> None:
    few, many = int(FREE * LEAST) - 1, int(FREE * LEAST)
    region = [(0, 2000), (1, 500)]
    # Patch 0 explains region 1, patch 1 a piece of region 0.
    label = [(-1, 1000), (1, few), (-1, 1000 - few), (0, 500)]
    assert freed(label, [7, 4], region, 2) == ([(1, 2000), (0, 500)], [7], 1)
    label = [(-1, 1000), (1, many), (-1, 1000 - many), (0, 500)]
    runs = [(2, 1000), (1, many), (2, 1000 - many), (0, 500)]
    assert freed(label, [7, 4], region, 2) == (runs, [7, 4], 1)


def test_a_small_surface_mostly_beside_a_free_form_stays() -> None:
    for inside, stays in ((40, True), (50, False), (60, False)):
        label = [(-1, 1000 - inside), (0, 100), (-1, 400 + inside)]
        region = [(0, 1000), (-1, 500)]
        runs = [(1, 1000 - inside), (0, 100), (-1, 400 + inside)]
        gone = [(0, 1000), (-1, 500)]
        assert freed(label, [3], region, 1) == ((runs, [3], 1) if stays else (gone, [], 1))


def test_a_region_that_surfaces_explain_is_no_free_form() -> None:
    label = [(0, 60), (1, 45), (-1, 95)]
    assert freed(label, [3, 5], [(0, 200)], 1) == (label, [3, 5], 0)
    # Nor is one of which too little is left; the points of no region stay without a patch.
    label, region = [(0, 60), (-1, LEAST - 1), (-1, 50)], [(0, 60), (1, LEAST - 1), (-1, 50)]
    assert freed(label, [3], region, 2) == ([(0, 60), (-1, LEAST + 49)], [3], 0)
    label, region = [(0, 60), (-1, LEAST), (-1, 50)], [(0, 60), (1, LEAST), (-1, 50)]
    assert freed(label, [3], region, 2) == ([(0, 60), (1, LEAST), (-1, 50)], [3], 1)


# Through the whole pipeline.


def stripes(height: np.ndarray, step: float, seed: int, noise: float) -> Scans:
    """Return a height map z(y, x) as scans, a stripe for every row; NaN is no point."""
    rows, columns = np.indices(height.shape)
    there = np.isfinite(height)
    rng = np.random.default_rng(seed)
    z = height + rng.normal(0.0, noise, height.shape)
    points = np.stack([step * columns[there], step * rows[there], z[there]], axis=1)
    return Scans(points=points, stripe=rows[there].astype(np.int32))


def test_pieces_of_a_surface_are_patches_where_a_gap_parts_them() -> None:
    """A shadow of ten spacings across a plane: boxes touch over it, points do not."""
    height = np.zeros((100, 120))
    height[:, 55:65] = np.nan
    result = segment(stripes(height, 0.3, 0, 0.01))
    assert result.patch_count == 2
    assert len(np.unique(result.surface)) == 1
    left, right = result.points[:, 0] < 0.3 * 55, result.points[:, 0] >= 0.3 * 65
    assert len(np.unique(result.labels[left])) == 1 and len(np.unique(result.labels[right])) == 1


def test_the_ragged_rim_of_a_shadow_is_no_surface() -> None:
    """Beside a round shadow a few points fall off the face, here more and there less."""
    rng = np.random.default_rng(1)
    y, x = np.indices((120, 160))
    far = np.hypot(x - 80, y - 60)
    height = 0.02 * x
    height[far < 25] = np.nan
    drop = np.convolve(rng.normal(size=128), np.ones(9) / 3.0, "valid")[:, None]
    height -= 0.072 * np.clip(29 - far, 0, None) * (1.0 + 0.5 * drop) * (x < 80)
    result = segment(stripes(height, 0.5, 1, 0.05))
    assert result.kind.tolist() == [SurfaceKind.PLANE]


def test_a_shallow_round_that_noise_hides_is_a_patch() -> None:
    """No point of it is beyond doubt on either plane; all of them together are."""
    half, radius, step = 0.13, 14.0, 0.25
    x = step * (np.indices((200, 120))[1] - 60)
    wide = radius * np.sin(half)
    ball = radius / np.cos(half) - np.sqrt(np.maximum(radius**2 - x**2, 0.0))
    bent = np.where(abs(x) < wide, ball, abs(x) * np.tan(half))
    result = segment(stripes(-bent, step, 0, 0.05))
    kinds = [SurfaceKind.PLANE, SurfaceKind.PLANE, SurfaceKind.CYLINDER]
    assert result.kind.tolist() == kinds
    there = abs(x.ravel()) < wide
    assert np.mean(result.labels[there] == 2) > 0.9
    assert np.mean(there[result.labels == 2]) > 0.9
    assert abs(result.parameters[2, 6] / radius - 1.0) < 0.1
    sharp = segment(stripes(-abs(x) * np.tan(half), step, 0, 0.05))
    assert sharp.kind.tolist() == [SurfaceKind.PLANE] * 2


@pytest.mark.parametrize(("apart", "count"), [(0.6, 1), (1.2, 1), (1.8, 2)])
def test_stripes_that_graze_a_face_are_one_piece(apart: float, count: int) -> None:
    """Two faces of one plane, so far apart that a triangle of 0.5 mm would not span it."""
    x, y = (a.ravel() for a in np.mgrid[0.05:8.0:0.1, 0.05:3.0:0.1])
    points = np.column_stack([x, y, 0.0 * x])[np.abs(x - 4.0) > apart / 2.0]
    leaves, order = leaves_of(points, 2.0)
    found = surfaced(leaves, np.zeros(len(points)), np.full(len(points), 9.0), 1)
    piece, _ = connected_pieces(runtime.upload(points[order]), leaves, found, 0.5)
    assert len(np.unique(piece[found.own >= 0])) == count
