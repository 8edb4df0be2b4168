"""Scores the default segmentation on random blocks of every family, at several noise levels.

    PYTHONPATH=. python tests/score_blocks.py --seeds 1000:1005 --noise 0,0.01,0.025,0.05
    PYTHONPATH=. python tests/score_blocks.py --seeds 1000:1050 --by-turns

prints a row for every noise and family: blocks, true patches, the share found (Hoover's correct at
T = 0.8), over- and under-segmented patches and regions of noise as a share of the true ones, the
mean and the least adjusted Rand index, the share of patches of more than 500 points whose kind is
right, and the F1 of the points at sharp edges and on fillets. By turns, every block is scanned at
one of the noises instead of all: more parts in the same time. It is no test: it has no bar.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict

import numpy as np

from octoseg_ti import Segmentation, evaluate, segment
from octoseg_ti.types import Truth
from scanner_sim import StripeScanner, simulate
from scanner_sim.random_blocks import FAMILIES, random_block

_LARGE = 500


def kinds(result: Segmentation, truth: Truth) -> tuple[int, int]:
    """Return how many large patches were found, and how many of these have the right kind."""
    assert truth.kind is not None
    known = (truth.patch >= 0) & (result.labels >= 0)
    region = np.bincount(result.labels[known], minlength=result.patch_count)
    found = right = 0
    for patch in range(truth.patch_count):
        points = truth.patch == patch
        size = int(points.sum())
        labels = result.labels[points]
        shared = np.bincount(labels[labels >= 0], minlength=1)
        best = int(shared.argmax())
        if size <= _LARGE or shared[best] < 0.8 * size or shared[best] < 0.8 * region[best]:
            continue
        found += 1
        right += int(result.kind[best]) == int(truth.kind[points][0])
    return found, right


def main() -> None:
    """Simulate, segment and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", default="1000:1005", help="first and one past the last seed")
    parser.add_argument("--families", default="all", help="names, separated by commas")
    parser.add_argument("--noise", default="0,0.01,0.025,0.05", help="range noise [mm]")
    parser.add_argument("--pitch", type=float, default=0.25, help="distance of the stripes [mm]")
    parser.add_argument("--by-turns", action="store_true", help="every block at one noise only")
    options = parser.parse_args()
    first, last = map(int, options.seeds.split(":"))
    families = FAMILIES if options.families == "all" else options.families.split(",")
    head = ("noise", "family", "blocks", "true", "correct", "wrong", "ARI", "least", "kinds",
            "sharp", "fillet", "s")  # fmt: skip
    print("".join(f"{h:>9s}" for h in head))
    levels = [float(noise) for noise in options.noise.split(",")]
    for turn, noise in enumerate(levels):
        rows: dict[str, list[tuple[float, ...]]] = defaultdict(list)
        for place, family in enumerate(families):
            for seed in range(first, last):
                if options.by_turns and (place + seed) % len(levels) != turn:
                    continue
                part = random_block(seed, family)
                scanner = StripeScanner(stripe_pitch=options.pitch, range_noise=noise)
                scans, truth = simulate(part, scanner, seed=seed)
                began = time.perf_counter()
                result = segment(scans)
                seconds = time.perf_counter() - began
                scores = evaluate(result, truth)
                r = scores.regions
                found, right = kinds(result, truth)
                f1 = [scores.edges[k].f1 if k in scores.edges else np.nan
                      for k in ("sharp", "fillet")]  # fmt: skip
                row = (r.patches, r.correct, r.over + r.under + r.noise, r.ari, found, right,
                       *f1, seconds)  # fmt: skip
                rows[family].append(row)
                rows["all"].append(row)
                if r.correct < r.patches:
                    print(f"  random:{seed}:{family} at {noise:g} mm: {r.correct} of {r.patches}")
            if rows[family]:
                _show(noise, family, rows[family])
        if rows["all"]:
            _show(noise, "all", rows["all"])


def _show(noise: float, family: str, rows: list[tuple[float, ...]]) -> None:
    a = np.array(rows)
    true = a[:, 0].sum()
    edges = [np.nanmean(c) if np.isfinite(c).any() else np.nan for c in (a[:, 6], a[:, 7])]
    print(
        f"{noise:9g}{family:>9s}{len(a):9d}{int(true):9d}{a[:, 1].sum() / true:9.1%}"
        f"{a[:, 2].sum() / true:9.1%}{a[:, 3].mean():9.3f}{a[:, 3].min():9.3f}"
        f"{a[:, 5].sum() / max(a[:, 4].sum(), 1):9.1%}{edges[0]:9.3f}{edges[1]:9.3f}"
        f"{np.median(a[:, 8]):9.2f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
