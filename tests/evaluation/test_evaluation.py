"""Scores: known answers for every instance, invariants, agreement with an independent version."""

import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octoseg_ti import DataError, Truth, evaluate
from octoseg_ti.evaluation import adjusted_rand, best_match, overlap_table, wrong_points

from .cases import blocks, edge_case, five


def peer_metrics():
    """Return the independent metrics that lie beside the repository, or skip."""
    shared = os.environ.get("OCTOSEG_SHARED")
    if shared:
        places = [Path(shared), Path(shared).parent]
    else:
        places = [Path(__file__).resolve().parents[2].parent / "shared"]
    for place in places:
        if (place / "peers" / "metrics.py").is_file():
            sys.path.insert(0, str(place / "peers"))
            try:
                import metrics
            finally:
                sys.path.pop(0)
            return metrics
    pytest.skip("no shared peers folder")


def test_correct():
    truth = blocks(50, 30, 20)
    assert five(np.array([7, 3, 11])[truth], truth) == (3, 0, 0, 0, 0)


def test_over_segmentation():
    labels = np.concatenate([blocks(50, 50), np.full(100, 9)])
    assert five(labels, blocks(100, 100)) == (1, 1, 0, 0, 0)


def test_under_segmentation():
    labels = np.concatenate([np.zeros(100, int), np.ones(40, int)])
    assert five(labels, blocks(50, 50, 40)) == (1, 0, 1, 0, 0)


def test_missed_and_noise():
    labels = np.full(200, -1)
    labels[:30] = 0  # lies in patch 0, but covers too little of it
    assert five(labels, blocks(100, 100)) == (0, 0, 0, 2, 1)


def test_fragments_that_cover_too_little_are_noise():
    labels = np.full(100, -1)
    labels[:35], labels[35:70] = 0, 1  # 70 % in two pieces
    assert five(labels, np.zeros(100, int)) == (0, 0, 0, 1, 2)
    assert five(labels, np.zeros(100, int), overlap=0.7) == (0, 1, 0, 0, 0)


def test_the_threshold_itself_counts():
    labels = blocks(100, 100)
    labels[:20] = -1
    assert five(labels, blocks(100, 100))[0] == 2
    labels[20] = -1
    assert five(labels, blocks(100, 100))[0] == 1


def test_an_ambiguous_region_keeps_the_instance_of_higher_overlap():
    # Region 0 alone would be correct with (0.85 + 1) / 2; together with region 1 the patch is
    # covered fully.
    assert five(blocks(85, 15), np.zeros(100, int)) == (0, 1, 0, 0, 0)
    # Here region 1 also covers 24 foreign points of 106: it no longer lies in patch 0 by 80 %.
    truth = np.concatenate([np.zeros(200, int), np.ones(400, int)])
    labels = np.concatenate(
        [np.zeros(180, int), np.ones(20, int), np.ones(6, int), np.full(394, 2)]
    )
    assert five(labels, truth) == (2, 0, 0, 0, 1)


def test_unknown_truth_takes_no_part():
    truth = np.concatenate([blocks(50, 50), np.full(30, -1)])
    labels = np.concatenate([blocks(50, 50), np.repeat([0, 5], [10, 20])])
    scores = evaluate(labels, truth)
    assert scores.perfect
    assert scores.regions.points == 100
    assert scores.regions.regions == 2
    assert scores.regions.on_unknown == 1
    assert scores.regions.mean_iou == 1.0


def test_a_region_mostly_on_unknown_truth_is_no_noise():
    truth = np.concatenate([blocks(50, 50), np.full(30, -1)])
    labels = np.concatenate([blocks(50, 45), np.full(5, 7), np.full(30, 7)])
    scores = evaluate(labels, truth)
    assert (scores.regions.correct, scores.regions.noise, scores.regions.on_unknown) == (2, 0, 1)
    sliver = np.concatenate([blocks(50, 50), np.full(30, 7)])
    sliver[95:100] = 7
    regions = evaluate(sliver, truth).regions
    assert (regions.correct, regions.over) == (2, 0)
    mostly_known = np.concatenate([blocks(50, 45), np.full(5, 7), np.full(4, 7), np.full(26, -1)])
    assert evaluate(mostly_known, truth).regions.over == 1


def test_exactly_half_on_unknown_is_not_mostly():
    truth = np.array([0, 0, -1, -1])
    assert evaluate(np.zeros(4, int), truth).regions.on_unknown == 0
    assert evaluate(np.array([-1, 0, 0, 0]), truth).regions.on_unknown == 1


def test_no_region_at_all():
    scores = evaluate(np.full(20, -1), blocks(10, 10))
    assert five(np.full(20, -1), blocks(10, 10)) == (0, 0, 0, 2, 0)
    assert scores.regions.mean_iou == 0.0
    assert scores.regions.labelled == 0.0
    assert math.isnan(scores.regions.ari_labelled)
    assert scores.to_dict()["regions"]["ari_labelled"] is None


@pytest.mark.parametrize("truth", [np.full(3, -1), np.zeros(0, np.int32)])
def test_nothing_known(truth):
    scores = evaluate(np.zeros(len(truth), np.int32), truth)
    assert (scores.regions.patches, scores.regions.points) == (0, 0)
    assert not scores.perfect
    assert math.isnan(scores.regions.mean_iou)
    assert "correct" in str(scores)
    json.dumps(scores.to_dict(), allow_nan=False)


def test_mean_iou_is_the_best_matching_not_the_greedy_one():
    truth = blocks(10, 10)
    labels = np.array([0] * 6 + [1] * 4 + [0] * 5 + [2] * 5)
    iou = {(k, v): np.sum((truth == k) & (labels == v)) / np.sum((truth == k) | (labels == v))
           for k in (0, 1) for v in (0, 1, 2)}  # fmt: skip
    best = max((iou[0, a] + iou[1, b]) / 2 for a in range(3) for b in range(3) if a != b)
    assert evaluate(labels, truth).regions.mean_iou == pytest.approx(best)


def test_matching_of_many_regions_is_exact():
    rng = np.random.default_rng(3)
    truth = blocks(400, 300, 200)
    labels = rng.integers(0, 300, truth.size)
    labels[:200], labels[400:520] = 900, 901
    table = overlap_table(truth, labels)
    dense = np.zeros((3, len(table.region)))
    dense[table.row, table.column] = table.count
    iou = dense / (table.patch_size[:, None] + table.region_size - dense)
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-iou)
    assert best_match(table)[1].sum() == pytest.approx(iou[rows, columns].sum(), rel=1e-12)


labelings = st.integers(2, 40).flatmap(
    lambda n: st.tuples(
        st.lists(st.integers(-1, 4), min_size=n, max_size=n),
        st.lists(st.integers(-1, 5), min_size=n, max_size=n),
    )
)


@given(labelings)
def test_ari_is_that_of_counted_pairs(pair):
    truth, labels = (np.array(x) for x in pair)
    known = truth >= 0
    t, p = truth[known], labels[known]
    upper = np.triu_indices(len(t), 1)
    same_t = (t[:, None] == t)[upper]
    same_p = (p[:, None] == p)[upper]
    ours = adjusted_rand(overlap_table(truth, labels))
    if not len(same_t):
        assert math.isnan(ours)
        return
    expected = same_t.sum() * same_p.sum() / len(same_t)
    highest = (same_t.sum() + same_p.sum()) / 2
    if highest == expected:
        assert ours == 1.0
    else:
        brute = (np.sum(same_t & same_p) - expected) / (highest - expected)
        assert ours == pytest.approx(brute, abs=1e-12)


@given(labelings, st.permutations(range(6)))
def test_names_of_labels_do_not_matter(pair, names):
    truth, labels = (np.array(x) for x in pair)
    renamed = np.append(np.array(names) * 1000 + 7, -1)[labels]
    a, b = evaluate(labels, truth).to_dict(), evaluate(renamed, truth).to_dict()
    for key, value in a["regions"].items():
        other = b["regions"][key]
        assert other == (value if value is None else pytest.approx(value, abs=1e-12)), key


@given(st.lists(st.integers(-1, 6), min_size=1, max_size=60))
def test_the_truth_itself_is_perfect(values):
    truth = np.array(values)
    scores = evaluate(truth, truth)
    patches = len(set(values) - {-1})
    assert scores.regions.correct == scores.regions.patches == patches
    assert scores.perfect == (patches > 0)
    assert not wrong_points(truth, truth).any()


@given(labelings)
def test_counts_account_for_every_patch_at_most_once(pair):
    truth, labels = (np.array(x) for x in pair)
    for _, c in evaluate(labels, truth).sweep():
        assert c.correct + c.over + c.missed <= len(set(truth[truth >= 0]))
        assert min(c.correct, c.over, c.under, c.missed, c.noise) >= 0


def test_sweep_is_monotone_in_what_is_correct():
    rng = np.random.default_rng(0)
    truth = blocks(100, 100, 100, 100)
    labels = np.where(rng.random(400) < 0.3, rng.integers(0, 4, 400), truth)
    sweep = evaluate(labels, truth).sweep()
    assert [round(t, 2) for t, _ in sweep] == [round(0.51 + 0.01 * k, 2) for k in range(45)]
    correct = [c.correct for _, c in sweep]
    assert correct == sorted(correct, reverse=True)
    assert correct[0] == 4 and correct[-1] == 0
    with pytest.raises(ValueError):
        evaluate(labels, truth).sweep(np.array([0.5]))


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_agreement_with_the_peer_metrics(seed):
    peers = peer_metrics()
    rng = np.random.default_rng(seed)
    n, k = int(rng.integers(50, 400)), int(rng.integers(1, 9))
    truth = np.sort(rng.integers(-1, k, n))
    # Noisy copies with merges, splits and holes, so that every instance occurs.
    labels = rng.integers(-1, k, k + 1)[truth] + (k + 1) * (rng.random(n) < rng.random() * 0.4)
    labels[rng.random(n) < 0.1] = -1
    r = evaluate(labels, truth, overlap=0.8).regions
    theirs = peers.hoover(truth, labels, 0.8)
    ours = dict(correct=r.correct, over=r.over, under=r.under, missed=r.missed, noise=r.noise)
    # They judge regions that lie mostly on unknown truth by the rest; we count these apart.
    if r.on_unknown == 0:
        assert ours == {name: theirs[name] for name in ours}
    for value, other in (
        (r.mean_iou, peers.seg_miou(truth, labels)),
        (r.ari, peers.adjusted_rand(truth, labels)),
        (r.ari_labelled, peers.adjusted_rand(truth, labels, labelled_only=True)),
        (100 * r.labelled, peers.labelled_percent(truth, labels)),
    ):
        assert value == pytest.approx(other, nan_ok=True, abs=1e-9)


def test_wrong_points():
    truth = np.array([0, 0, 0, 1, 1, 1, -1, -1])
    labels = np.array([5, 5, 2, 2, 2, -1, -1, 5])
    assert wrong_points(labels, truth).tolist() == [0, 0, 1, 0, 0, 2, 0, 3]


def test_interior_by_the_result_when_the_truth_has_no_edges():
    result, truth = edge_case()
    scores = evaluate(result, truth.patch)
    assert scores.regions_interior.points == np.sum((result.edge == 0) & (truth.patch >= 0))
    assert "does not know its edges" in scores.interior_rule
    assert scores.edges == {}
    assert "not scored" in str(scores)


def test_scores_as_json_and_text():
    result, truth = edge_case()
    scores = evaluate(result, truth)
    values = json.loads(json.dumps(scores.to_dict(), allow_nan=False))
    assert values["regions"]["patches"] == 2
    assert set(values["edges"]) == {"all", "sharp", "fillet"}
    text = str(scores)
    for word in ("correct", "over-segmented", "adjusted Rand index", "sharp", "interior"):
        assert word in text
    assert max(map(len, text.splitlines())) <= 100


@pytest.mark.parametrize(
    ("result", "truth", "options", "word"),
    [
        ([0, 1], [0], {}, "true patches: 1 entries for 2"),
        ([0], Truth(patch=np.zeros(1, int), edge_distance=np.zeros(2)), {}, "edge distances"),
        (SimpleNamespace(labels=[0], edge=[0, 1]), [0], {}, "edge: 2 entries"),
        ([0.5], [0], {}, "whole numbers"),
        ([[0]], [0], {}, "whole numbers"),
        ([0], [0], {"overlap": 0.5}, "overlap"),
        ([0], [0], {"overlap": float("nan")}, "overlap"),
        ([0], [0], {"edge_distance": -1.0}, "edge distance"),
    ],
)
def test_bad_input(result, truth, options, word):
    with pytest.raises(DataError, match=word) as caught:
        evaluate(result, truth, **options)
    assert "\n" not in str(caught.value)


def test_narrow_and_unsigned_labels():
    truth = np.array([0] * 200 + [1] * 100, np.uint8)
    assert evaluate(truth.astype(np.int8), truth).perfect


def test_a_million_points_are_no_work():
    rng = np.random.default_rng(1)
    n = 1_000_000
    truth = Truth(
        patch=rng.integers(-1, 40, n).astype(np.int32),
        normal=np.tile([0.0, 0.0, 1.0], (n, 1)),
        edge_distance=rng.random(n, np.float32),
        edge_class=rng.integers(0, 3, n).astype(np.uint8),
    )
    result = SimpleNamespace(
        labels=truth.patch, normals=truth.normal.astype(np.float32), edge=truth.edge_class
    )
    evaluate(result.labels[:10], truth.patch[:10])  # imports
    times = []
    for _ in range(3):
        start = time.perf_counter()
        assert evaluate(result, truth, edge_distance=0.2).perfect
        times.append(time.perf_counter() - start)
    assert min(times) < 1.0  # 0.35 s on two free cores


def test_evaluation_needs_no_taichi():
    code = "import sys, octoseg_ti; octoseg_ti.evaluate([0], [0]); print('taichi' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
