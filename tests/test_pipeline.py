"""What must hold for any input: the same labels, in any order of views, points and threads."""

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reference.clouds import rotation
from reference.tent import make_tent

from octoseg_ti import Params, Scans, evaluate, paper, segment
from octoseg_ti.device.profiling import Trace
from octoseg_ti.params import CleaningParams
from octoseg_ti.pipeline import STAGES
from octoseg_ti.types import NONE, Segmentation, StopReason, SurfaceKind

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def block():
    """The test block in 30,000 points of several views, with noise, and its truth."""
    from scanner_sim import StripeScanner, blocks, simulate

    return simulate(blocks.test_block(), StripeScanner(points=30_000, range_noise=0.01), seed=3)


@pytest.fixture(scope="module")
def answer(block) -> Segmentation:
    return segment(block[0])


def rows_of(scans: Scans, rows: np.ndarray, **changes) -> Scans:
    """Return some rows of scans, in a given order."""
    picked = {
        name: getattr(scans, name)[rows]
        for name in ("points", "normals", "stripe", "column", "view", "time_ns")
        if getattr(scans, name) is not None
    }
    return replace(scans, **{**picked, **changes})


def same_partition(one: np.ndarray, other: np.ndarray) -> bool:
    """Say whether two labellings are the same but for the names."""
    pairs = set(zip(one.tolist(), other.tolist(), strict=True))
    return len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


def test_the_answer_is_consistent(block, answer: Segmentation) -> None:
    scans, _ = block
    n, k = len(scans), answer.patch_count
    assert answer.labels.shape == answer.edge.shape == answer.outlier.shape == (n,)
    assert answer.labels.dtype == np.int32 and answer.labels.min() >= NONE
    assert answer.labels.max() == k - 1
    assert np.all(np.diff(answer.patch_sizes) <= 0) and answer.patch_sizes.min() > 0
    assert answer.parameters.shape == (k, 8) and answer.residual.shape == (k,)
    planes = answer.kind == SurfaceKind.PLANE
    assert np.all(np.isfinite(answer.residual[planes]))
    assert answer.covariance.shape == (k, 8, 8) and answer.deviation.shape == (k, 8)
    known = np.isfinite(answer.deviation)
    assert np.all(known[planes] == [True] * 6 + [False] * 2)
    assert not known[~np.isfinite(answer.parameters)].any()
    np.testing.assert_allclose(np.linalg.norm(answer.parameters[planes, 3:6], axis=1), 1.0)
    size = np.linalg.norm(answer.normals, axis=1)
    assert np.all((np.abs(size - 1) < 1e-6) | (size == 0))
    assert np.all(answer.labels[answer.outlier == 1] == NONE)
    assert np.all((answer.level >= 0) == (answer.outlier == 0))
    cells = answer.cells
    assert cells.count.sum() == np.count_nonzero(answer.outlier == 0)
    np.testing.assert_allclose(cells.size, cells.initial_size / 2.0**cells.level)
    rough = cells.stop != int(StopReason.HOMOGENEOUS)
    np.testing.assert_array_equal(cells.edge > 0, rough)
    assert np.all(cells.label[rough] == NONE)
    assert cells.label.max() == k - 1
    assert list(answer.seconds) == list(STAGES)
    assert answer.params.grid.tolerance is not None and answer.params.regions.min_points is not None


def test_normals_point_to_the_probe_and_points_are_in_the_world(block, answer) -> None:
    _, truth = block
    np.testing.assert_allclose(answer.points, truth.position, atol=0.2)
    has = answer.normals.any(axis=1)
    inside = has & (truth.edge_distance > 3.0)
    cosine = np.einsum("ni,ni->n", answer.normals, truth.normal)[inside]
    assert np.mean(cosine > 0.95) > 0.99
    assert np.mean(cosine > 0) == 1.0


def test_segmentation_of_the_block_is_right(block, answer: Segmentation) -> None:
    scores = evaluate(answer, block[1])
    assert scores.regions.ari > 0.9 and scores.regions.under == 0


def test_five_runs_give_the_same_bits(block, answer: Segmentation) -> None:
    for _ in range(4):
        again = segment(block[0])
        for name in (
            "labels", "normals", "edge", "level", "outlier", "parameters", "covariance", "residual",
        ):  # fmt: skip
            np.testing.assert_array_equal(getattr(again, name), getattr(answer, name), err_msg=name)
        np.testing.assert_array_equal(again.cells.sigma, answer.cells.sigma)
        assert again.measured == answer.measured and again.params == answer.params


def test_threads_change_no_bit(block, answer: Segmentation, tmp_path: Path) -> None:
    scans, _ = block
    np.savez(
        tmp_path / "block.npz", points=scans.points, stripe=scans.stripe, view=scans.view,
        T_world_view=scans.T_world_view, origin=scans.origin,
    )  # fmt: skip
    code = (
        "import sys, hashlib\nimport numpy as np\n"
        "from octoseg_ti.device import runtime\n"
        "runtime.start('cpu', threads=int(sys.argv[1]))\n"
        "from octoseg_ti import Scans, segment\n"
        "f = np.load(sys.argv[2])\n"
        "r = segment(Scans(**{k: f[k] for k in f.files}, frame='view'))\n"
        "whole = r.labels.tobytes() + r.normals.tobytes() + r.covariance.tobytes()\n"
        "print(hashlib.sha256(whole).hexdigest())\n"
        "u = segment(f['points'][f['view'] == 0])\n"
        "print(hashlib.sha256(u.labels.tobytes() + u.normals.tobytes()).hexdigest())\n"
    )
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    answers = {
        subprocess.run(
            [sys.executable, "-c", code, str(threads), str(tmp_path / "block.npz")],
            capture_output=True, text=True, env=env, timeout=300, check=True,
        ).stdout
        for threads in (1, 2)
    }  # fmt: skip
    assert len(answers) == 1
    whole = answer.labels.tobytes() + answer.normals.tobytes() + answer.covariance.tobytes()
    both = hashlib.sha256(whole).hexdigest()
    assert answers.pop().splitlines()[0] == both


@pytest.mark.parametrize("seed", range(3))
def test_permuting_views_permutes_the_labels(block, answer: Segmentation, seed: int) -> None:
    scans, _ = block
    views = len(scans.T_world_view)
    new = np.random.default_rng(seed).permutation(views)  # view v becomes new[v]
    view = new[scans.view].astype(np.int32)
    rows = np.argsort(view, kind="stable")
    old = np.argsort(new)
    moved = rows_of(
        scans, rows, view=view[rows], T_world_view=scans.T_world_view[old],
        origin=scans.origin[old],
    )  # fmt: skip
    again = segment(moved)
    assert again.measured == answer.measured
    for name in ("labels", "normals", "edge", "level", "outlier"):
        got, expected = getattr(again, name), getattr(answer, name)[rows]
        np.testing.assert_array_equal(got, expected, err_msg=f"{name}, seed {seed}")


def test_renumbered_stripes_change_nothing(block, answer: Segmentation) -> None:
    scans, _ = block
    stripe = (7 * scans.stripe + 5).astype(np.int32)
    places = np.full((stripe.max() + 1, 3), np.nan)
    places[5::7] = scans.stripe_origin[: scans.stripe.max() + 1]
    again = segment(replace(scans, stripe=stripe, stripe_origin=places))
    np.testing.assert_array_equal(again.labels, answer.labels)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["lattice", "scattered"])
def test_permuting_unorganised_points_permutes_the_labels(kind: str, seed: int) -> None:
    scans, _ = make_tent(noise=0.0 if kind == "lattice" else 0.01)
    before = segment(scans.points)
    assert before.patch_count >= 2
    rows = np.random.default_rng(seed).permutation(len(scans))
    after = segment(scans.points[rows])
    for name in ("labels", "normals", "edge", "level"):
        got, expected = getattr(after, name), getattr(before, name)[rows]
        np.testing.assert_array_equal(got, expected, err_msg=f"{name}, seed {seed}")


def test_permuting_points_with_normals_permutes_the_labels(block) -> None:
    _, truth = block
    before = segment(truth.position, normals=truth.normal)
    rows = np.random.default_rng(5).permutation(len(truth))
    after = segment(truth.position[rows], normals=truth.normal[rows])
    np.testing.assert_array_equal(after.labels, before.labels[rows])
    assert evaluate(before, truth).regions.correct >= 10


def test_a_duplicated_view_gives_the_same_patches(block, answer: Segmentation) -> None:
    scans, _ = block
    extra = np.flatnonzero(scans.view == 0)
    rows = np.concatenate((np.arange(len(scans)), extra))
    view, stripe = scans.view[rows].copy(), scans.stripe[rows].copy()
    view[len(scans) :] = len(scans.T_world_view)
    stripe[len(scans) :] += int(scans.stripe.max()) + 1
    doubled = rows_of(
        scans, rows, view=view, stripe=stripe, stripe_origin=None,
        T_world_view=np.concatenate((scans.T_world_view, scans.T_world_view[:1])),
        origin=np.concatenate((scans.origin, scans.origin[:1])),
    )  # fmt: skip
    again = segment(doubled)
    assert again.patch_count == answer.patch_count
    # The copy of a point has the fate of the point.
    np.testing.assert_array_equal(again.labels[len(scans) :], again.labels[extra])
    scores = evaluate(again.labels[: len(scans)], answer.labels)
    assert scores.regions.correct == answer.patch_count and scores.regions.ari > 0.97


@pytest.mark.parametrize("offset", [1e3, 1e6])
def test_far_from_the_origin_the_labels_are_the_same(
    block, answer: Segmentation, offset: float
) -> None:
    scans, _ = block
    shift = offset * np.array([1.0, -1.0, 0.5])
    T_world_view = scans.T_world_view.copy()
    T_world_view[:, :3, 3] += shift
    far = segment(
        replace(
            scans,
            T_world_view=T_world_view,
            origin=scans.origin + shift,
            stripe_origin=scans.stripe_origin + shift,
        )
    )
    assert same_partition(far.labels, answer.labels)
    np.testing.assert_allclose(far.points, answer.points + shift, rtol=0, atol=1e-15 * offset * 4)

    bare = answer.points[np.argsort(scans.view, kind="stable")]
    assert same_partition(segment(bare + shift).labels, segment(bare).labels)


def test_scaling_the_part_scales_the_answer(block, answer: Segmentation) -> None:
    """No length is built in: a part of twice the size has the same patches."""
    scans, _ = block
    T_world_view = scans.T_world_view.copy()
    T_world_view[:, :3, 3] *= 2.0
    twice = segment(
        replace(
            scans,
            points=2.0 * scans.points,
            origin=2.0 * scans.origin,
            stripe_origin=2.0 * scans.stripe_origin,
            T_world_view=T_world_view,
        )
    )
    np.testing.assert_array_equal(twice.labels, answer.labels)
    assert twice.measured.noise == pytest.approx(2 * answer.measured.noise, rel=1e-6)


def test_a_turned_part_has_the_same_patches() -> None:
    scans, truth = make_tent(noise=0.01)
    for seed in range(4):
        q = rotation(seed)
        turned = replace(scans, points=scans.points @ q.T, origin=scans.origin @ q.T)
        scores = evaluate(segment(turned), truth)
        assert scores.regions.correct == 2 and scores.regions.over == 0, f"seed {seed}"


def test_views_and_world_frame_agree(block, answer: Segmentation) -> None:
    """Registration before or after: the same points in the world give the same patches."""
    scans, _ = block
    pose = scans.T_world_view[scans.view]
    world = np.einsum("nij,nj->ni", pose[:, :3, :3], scans.points) + pose[:, :3, 3]
    again = segment(replace(scans, points=world, frame="world"))
    scores = evaluate(again, answer.labels)
    assert again.patch_count == answer.patch_count and scores.regions.ari > 0.995


# The preset of the paper.


def test_the_paper_preset_finds_both_planes(tent) -> None:
    scans, truth = tent
    result = segment(scans, paper(divisions=4, smallest_levels=3))
    scores = evaluate(result, truth)
    assert scores.regions.correct == 2 and result.patch_count == 2
    assert not np.any((result.labels >= 0) & (result.edge > 0))  # edge points are left out
    assert segment(scans, preset="paper").params.grid.divisions == 12


def test_passes_and_levels_are_monotone_in_the_tolerance(block) -> None:
    found = [
        segment(block[0], paper(divisions=8, tolerance=t)) for t in (1.0, 0.5, 0.1, 0.03, 0.01)
    ]
    passes, levels = [r.passes for r in found], [r.level_count for r in found]
    assert passes == sorted(passes) and levels == sorted(levels), (passes, levels)
    assert passes[0] == 1 and levels[0] == 1  # sigma never exceeds 1 (Eq. 4)
    assert passes[-1] > 5


def test_an_unknown_preset_is_refused(tent) -> None:
    with pytest.raises(ValueError, match="preset must be one of default, paper, not 'fast'"):
        segment(tent[0], preset="fast")


# What the user sees.


def test_the_answer_says_what_was_found(answer: Segmentation) -> None:
    text = str(answer)
    assert f"{len(answer)} points, {answer.patch_count} patches" in text
    assert f"patch 0: plane, {answer.patch_sizes[0]} points, rms" in text
    assert "milliseconds: cleaning" in text
    assert len(text.splitlines()) <= 16


def test_stages_are_timed_and_reported(tent) -> None:
    seen, trace = [], Trace()
    result = segment(tent[0], trace=trace, progress=lambda name, share: seen.append((name, share)))
    assert [name for name, _ in seen] == list(STAGES) == list(result.seconds)
    shares = [share for _, share in seen]
    assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] < 1.0


# Cleaning, on a scan with injected spikes.


@pytest.mark.parametrize("share", [0.002, 0.01])
def test_spikes_are_found_and_little_else(block, share: float) -> None:
    scans, _ = block
    clean = segment(scans)
    rng = np.random.default_rng(8)
    n = len(scans)
    hit = rng.random(n) < share
    # Along the line of sight, as mirror bounces come: 3 to 30 spacings, either way.
    spacing = max(clean.measured.spacing_along, clean.measured.spacing_across)
    points = scans.points.copy()
    far = rng.uniform(3, 30, n) * rng.choice([-1.0, 1.0], n) * spacing
    points[hit, 2] += far[hit]
    marked = segment(replace(scans, points=points)).outlier == 1
    # Near the end of a stripe, or beside a gap, there are no two neighbours on either side.
    recall = np.mean(marked[hit])
    before = clean.outlier == 1
    precision = np.mean(hit[marked & ~before])
    assert recall > 0.8, recall
    assert precision > 0.9, precision
    assert np.mean(before) < 0.01


def test_cleaning_can_be_switched_off(block) -> None:
    result = segment(block[0], Params(cleaning=CleaningParams(enabled=False)))
    assert not result.outlier.any()
