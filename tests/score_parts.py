"""Scores the default segmentation on the paper's parts as a probe of some years ago sees them.

    PYTHONPATH=. python tests/score_parts.py --seeds 0:3

scans with the preset `surveyor-like` in four views with errors of their poses, loses 1 % of the
points, throws 0.5 % of the others along their line of sight, and prints a row for every part and
kind of views: true patches, Hoover's counts at T = 0.8, regions on what is no patch (fillets), the
adjusted Rand index, and of the spikes (thrown points and mirror images) the share that was found.
Views are planned, or stand around the part, from where it may show fewer faces. It is no test: it
has no bar.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np

from octoseg_ti import Scans, evaluate, segment
from octoseg_ti.types import NONE, Artefact, Truth
from scanner_sim import StripeScanner, View, blocks, plan_views, simulate
from scanner_sim.part import Part
from scanner_sim.scanner import around

_PARTS = ("two-planes", "test-block", "phone")
_SHARE, _NEAR, _FAR = 0.005, 0.15, 3.0  # points that are thrown, and how far [mm]


def main() -> None:
    """Simulate, segment and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", default="0:3", help="first and one past the last seed")
    parser.add_argument("--parts", default=",".join(_PARTS), help="names, separated by commas")
    parser.add_argument("--scanner", default="surveyor-like", help="preset of the scanner")
    parser.add_argument("--pose-noise", type=float, default=0.02, help="error of a pose [mm]")
    parser.add_argument("--pose-angle", type=float, default=0.02, help="... of its angles [deg]")
    options = parser.parse_args()
    first, last = map(int, options.seeds.split(":"))
    head = ("seed", "true", "correct", "over", "under", "missed", "noise", "other", "ARI", "spikes")
    print(f"{'part':12s}{'views':8s}" + "".join(f"{h:>8s}" for h in head))
    for name in options.parts.split(","):
        part = blocks.by_name(name)
        scanner = StripeScanner.preset(
            options.scanner,
            dropout=0.01,
            pose_noise=options.pose_noise,
            pose_angle_noise=math.radians(options.pose_angle),
        )
        for kind, views in _views(part, name, scanner).items():
            for seed in range(first, last):
                scans, truth = simulate(part, replace(scanner, views=views), seed=seed)
                scans, truth = with_spikes(scans, truth, seed)
                result = segment(scans)
                scores = evaluate(result, truth).regions
                assert truth.artefact is not None
                spike = truth.artefact == Artefact.SPIKE
                found = float(np.mean(result.outlier[spike] > 0)) if spike.any() else math.nan
                counts = (
                    seed, scores.patches, scores.correct, scores.over, scores.under,
                    scores.missed, scores.noise, scores.on_unknown,
                )  # fmt: skip
                print(
                    f"{name:12s}{kind:8s}" + "".join(f"{n:8d}" for n in counts)
                    + f"{scores.ari:8.4f}{found:8.3f}",
                    flush=True,
                )  # fmt: skip


def _views(part: Part, name: str, scanner: StripeScanner) -> dict[str, tuple[View, ...]]:
    """Return four views that are planned, and four that stand around the part."""
    if name == "two-planes":  # its faces look up
        turned = (math.radians(70.0 + 90.0 * k) for k in range(4))
        beside = tuple(View(tilt=math.radians(10.0), azimuth=azimuth) for azimuth in turned)
    else:
        beside = (View(azimuth=math.radians(70.0)), *around((math.radians(50.0), 3)))
    return {"planned": plan_views(part, scanner, overlap=0.3, count=4), "around": beside}


def with_spikes(scans: Scans, truth: Truth, seed: int) -> tuple[Scans, Truth]:
    """Throw some points along their lines of sight, to either side."""
    assert scans.stripe_origin is not None and scans.stripe is not None
    assert scans.T_world_view is not None and scans.view is not None
    assert truth.artefact is not None
    rng = np.random.default_rng(seed)
    hit = np.flatnonzero(rng.random(len(scans)) < _SHARE)
    pose = scans.T_world_view[scans.view[hit]]
    place = np.einsum("nij,nj->ni", pose[:, :3, :3], scans.points[hit]) + pose[:, :3, 3]
    sight = scans.stripe_origin[scans.stripe[hit]] - place
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    far = rng.uniform(_NEAR, _FAR, len(hit)) * rng.choice([-1.0, 1.0], len(hit))
    points, artefact, patch = scans.points.copy(), truth.artefact.copy(), truth.patch.copy()
    points[hit] += far[:, None] * np.einsum("nji,nj->ni", pose[:, :3, :3], sight)
    artefact[hit], patch[hit] = Artefact.SPIKE, NONE
    return replace(scans, points=points), replace(truth, artefact=artefact, patch=patch)


if __name__ == "__main__":
    main()
