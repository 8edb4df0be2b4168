"""Scores the segmentation of the Fit4CAD clouds by the measures of that benchmark.

    OCTOSEG_SHARED=... PYTHONPATH=. python tests/fit4cad.py

prints a row for every cloud, then the means of both halves: the even clouds are for development,
the odd ones only for reports. The clouds (Romanengo, Raffo, Qie, Anwer, Falcidieno 2022: Fit4CAD)
are CAD parts, sampled without noise or order, with the primitives they are made of. Without the
folder of data there is nothing to score, and the command says so.

A primitive is one surface, in however many pieces, and holds all points that lie on it: points of a
crease belong to several primitives. So do those of what was found (`patch_members`). Members
and surfaces are paired one to one, so that the overlaps add up to the most.

dice      twice the points in common over the sum of the points, mean over the primitives; a
          primitive without a partner counts 0
correct   primitives that share 80 % of either's points with their partner
kinds     of the correct ones, those of the right kind
single    dice and correct again, of the labels: every point is of one patch only, so that creases
          alone keep small primitives from being correct
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octoseg_ti import Segmentation, SurfaceKind, segment
from octoseg_ti.evaluation.members import Members, patch_members

OVERLAP = 0.8
"""Share of either's points that a primitive and its partner must have in common."""


class Score(NamedTuple):
    """How well the primitives of a cloud were found, for each of the K primitives."""

    dice: np.ndarray
    """Dice coefficient with its partner, 0 = no partner."""
    correct: np.ndarray
    """Shares enough points with its partner, bool."""
    partner: np.ndarray
    """The patch that is its partner, -1 = none."""


def score(truth: Members, found: Members) -> Score:
    """Compare primitives with patches; a point may be of several of either."""
    from scipy.optimize import linear_sum_assignment
    from scipy.sparse import csr_array

    count = len(truth.kind)
    wide = int(max(truth.index.max(initial=0), found.index.max(initial=0))) + 1
    tables = [
        csr_array((np.ones(len(m.index)), m.index, m.start), shape=(len(m.kind), wide))
        for m in (truth, found)
    ]
    common = (tables[0] @ tables[1].T).toarray()
    members, size = np.diff(truth.start)[:, None], np.diff(found.start)[None, :]
    dice = 2.0 * common / np.maximum(members + size, 1)
    row, column = linear_sum_assignment(-dice)
    paired = common[row, column] > 0
    row, column = row[paired], column[paired]
    result = Score(np.zeros(count), np.zeros(count, bool), np.full(count, -1))
    result.dice[row], result.partner[row] = dice[row, column], column
    both = common[row, column]
    result.correct[row] = (both >= OVERLAP * members[row, 0]) & (both >= OVERLAP * size[0, column])
    return result


def labelled(result: Segmentation) -> Members:
    """Return the points of every patch by their labels: each point is of one patch only."""
    order = np.argsort(result.labels, kind="stable")
    start = np.searchsorted(result.labels[order], np.arange(result.patch_count + 1))
    return Members(start - start[0], order[start[0] :], result.kind)


def read_cloud(path: Path) -> tuple[np.ndarray, Members]:
    """Return the points of a cloud [mm] and its primitives."""
    with np.load(path) as file:
        kind = np.array([int(SurfaceKind[name.upper()]) for name in file["kinds"].tolist()])
        start = file["member_start"]
        start = start if len(start) > len(kind) else np.append(start, len(file["member_index"]))
        return file["points"].astype(np.float64), Members(start, file["member_index"], kind)


def main() -> None:
    """Segment and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--half", choices=("even", "odd", "both"), default="both")
    parser.add_argument("--missed", action="store_true", help="list the primitives not found")
    parser.add_argument("clouds", nargs="*", help="names, such as PC2; default: all")
    options = parser.parse_args()
    folder = Path(os.environ.get("OCTOSEG_SHARED", "")) / "fit4cad_train"
    if not os.environ.get("OCTOSEG_SHARED") or not folder.is_dir():
        print("no clouds: OCTOSEG_SHARED names no folder that holds fit4cad_train")
        return
    paths = sorted(folder.glob("PC*.npz"), key=lambda p: int(p.stem[2:]))
    rows: dict[str, list[np.ndarray]] = {"even": [], "odd": []}
    head = f"{'points':>7s} {'primitives':>10s} {'found':>6s} {'dice':>6s} {'correct':>8s} "
    head += f"{'kinds':>6s} {'single':>7s} {'correct':>8s} {'s':>6s}"
    print(f"{'cloud':8s}{head}")
    for path in paths:
        half = ("even", "odd")[int(path.stem[2:]) % 2]
        if options.half not in (half, "both") or (
            options.clouds and path.stem not in options.clouds
        ):
            continue
        points, truth = read_cloud(path)
        began = time.perf_counter()
        result = segment(points)
        seconds = time.perf_counter() - began
        found, single = patch_members(result), score(truth, labelled(result))
        all_of = score(truth, found)
        right = all_of.correct & (np.append(found.kind, -1)[all_of.partner] == truth.kind)
        row = np.array(
            [len(points), len(truth.kind), len(found.kind), all_of.dice.mean(),
             all_of.correct.sum(), right.sum(), single.dice.mean(), single.correct.sum(), seconds]
        )  # fmt: skip
        rows[half].append(row)
        print(f"{path.stem:8s}{_text(row)}", flush=True)
        if options.missed:
            for k in np.flatnonzero(~all_of.correct):
                _explain(truth, labelled(result), all_of, int(k), len(points))
    for half, of in rows.items():
        if of:
            table = np.array(of)
            total = table.sum(axis=0)
            total[[3, 6]] /= len(table)
            print(f"{half:8s}{_text(total)}   correct {total[4] / total[1]:.1%}, "
                  f"single {total[7] / total[1]:.1%}")  # fmt: skip


def _text(row: np.ndarray) -> str:
    return (
        f"{row[0]:7.0f} {row[1]:10.0f} {row[2]:6.0f} {row[3]:6.3f} {row[4]:8.0f} {row[5]:6.0f} "
        f"{row[6]:7.3f} {row[7]:8.0f} {row[8]:6.2f}"
    )


def _explain(truth: Members, found: Members, scores: Score, k: int, count: int) -> None:
    """Print what became of a primitive."""
    label = np.full(count, len(found.kind))
    label[found.index] = np.repeat(np.arange(len(found.kind)), np.diff(found.start))
    members = truth.index[truth.start[k] : truth.start[k + 1]]
    several = np.bincount(truth.index, minlength=count)[members] > 1
    names, shared = np.unique(label[members], return_counts=True)
    parts = []
    for at in np.argsort(-shared)[:5]:
        s = names[at]
        what = "nothing"
        if s < len(found.kind):
            star = "*" if s == scores.partner[k] else ""
            what = f"{SurfaceKind(int(found.kind[s])).name.lower()} {s}{star}"
        parts.append(f"{shared[at]} of {np.count_nonzero(label == s)} on {what}")
    print(
        f"    {SurfaceKind(int(truth.kind[k])).name.lower()} {k}: {len(members)} points, "
        f"{several.sum()} of creases, dice {scores.dice[k]:.3f}: {', '.join(parts)}"
    )


if __name__ == "__main__":
    main()
