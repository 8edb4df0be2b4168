"""Scores the segmentation of the Fit4CAD clouds by the measures of that benchmark.

    OCTOSEG_SHARED=... PYTHONPATH=. python tests/fit4cad.py

prints a row for every cloud, then the means of both halves: the even clouds are for development,
the odd ones only for reports. The clouds (Romanengo, Raffo, Qie, Anwer, Falcidieno 2022: Fit4CAD)
are CAD parts, sampled without noise or order, with the primitives they are made of. Without the
folder of data there is nothing to score, and the command says so.

A primitive is one surface, in however many pieces, and holds all points that lie on it: points of a
crease belong to several primitives. What was found is the points of a surface, each in one only, so
that creases alone keep the overlap of small primitives below one. Primitives and surfaces are
paired one to one, so that the overlaps add up to the most.

dice      twice the points in common over the sum of the points, mean over the primitives; a
          primitive without a partner counts 0
correct   primitives that share 80 % of either's points with their partner
kinds     of the correct ones, those of the right kind
shared    dice and correct again, when a point of a crease may be with any of its primitives
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octoseg_ti import Segmentation, SurfaceKind, segment

OVERLAP = 0.8
"""Share of either's points that a primitive and its partner must have in common."""


class Primitives(NamedTuple):
    """The primitives of a cloud; points may belong to several."""

    start: np.ndarray
    """First entry of every primitive in ``index``, and the number of entries, shape (K + 1,)."""
    index: np.ndarray
    """Points of the primitives, one primitive after the other."""
    kind: np.ndarray
    """`SurfaceKind` of every primitive, shape (K,)."""


class Score(NamedTuple):
    """How well the primitives of a cloud were found, for each of the K primitives."""

    dice: np.ndarray
    """Dice coefficient with its partner, 0 = no partner."""
    correct: np.ndarray
    """Shares enough points with its partner, bool."""
    partner: np.ndarray
    """The surface that is its partner, -1 = none."""


def score(truth: Primitives, label: np.ndarray, *, shared: bool = False) -> Score:
    """Compare primitives with labels.

    Args:
        truth: The primitives.
        label: Surface of every point, -1 = none, shape (N,).
        shared: A point of several primitives need not be with more than one of them.
    """
    from scipy.optimize import linear_sum_assignment

    count = len(truth.kind)
    owner = np.repeat(np.arange(count), np.diff(truth.start))
    mine = label[truth.index]
    surfaces = int(label.max(initial=-1)) + 1
    size = np.bincount(label[label >= 0], minlength=surfaces)
    there = mine >= 0
    common = np.zeros((count, surfaces))
    np.add.at(common, (owner[there], mine[there]), 1)
    members = np.repeat(np.diff(truth.start)[:, None], surfaces, axis=1)
    if shared:
        several = np.bincount(truth.index, minlength=len(label))[truth.index] > 1
        creased = np.zeros((count, surfaces))
        np.add.at(creased, (owner[there & several], mine[there & several]), 1)
        # Those of its points of creases that are with another surface do not count.
        members = members - (creased.sum(axis=1, keepdims=True) - creased)
    dice = 2.0 * common / (members + size)
    row, column = linear_sum_assignment(-dice)
    paired = common[row, column] > 0
    row, column = row[paired], column[paired]
    result = Score(np.zeros(count), np.zeros(count, bool), np.full(count, -1))
    result.dice[row], result.partner[row] = dice[row, column], column
    both = common[row, column]
    result.correct[row] = (both >= OVERLAP * members[row, column]) & (both >= OVERLAP * size[column])
    return result


def surface_labels(result: Segmentation) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of every point, -1 = none, and the kind of every surface."""
    label = np.where(result.labels >= 0, np.append(result.surface, -1)[result.labels], -1)
    kind = np.full(int(result.surface.max(initial=-1)) + 1, -1)
    kind[result.surface] = result.kind
    return label, kind


def read_cloud(path: Path) -> tuple[np.ndarray, Primitives]:
    """Return the points of a cloud [mm] and its primitives."""
    with np.load(path) as file:
        kind = np.array([int(SurfaceKind[name.upper()]) for name in file["kinds"].tolist()])
        start = file["member_start"]
        start = start if len(start) > len(kind) else np.append(start, len(file["member_index"]))
        return file["points"].astype(np.float64), Primitives(start, file["member_index"], kind)


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
    head += f"{'kinds':>6s} {'shared':>7s} {'correct':>8s} {'s':>6s}"
    print(f"{'cloud':8s}{head}")
    for path in paths:
        half = ("even", "odd")[int(path.stem[2:]) % 2]
        if options.half not in (half, "both") or (options.clouds and path.stem not in options.clouds):
            continue
        points, truth = read_cloud(path)
        began = time.perf_counter()
        result = segment(points)
        seconds = time.perf_counter() - began
        label, kind = surface_labels(result)
        strict, eased = score(truth, label), score(truth, label, shared=True)
        right = strict.correct & (np.append(kind, -1)[strict.partner] == truth.kind)
        row = np.array(
            [len(points), len(truth.kind), len(kind), strict.dice.mean(), strict.correct.sum(),
             right.sum(), eased.dice.mean(), eased.correct.sum(), seconds]
        )  # fmt: skip
        rows[half].append(row)
        print(f"{path.stem:8s}{_text(row)}", flush=True)
        if options.missed:
            for k in np.flatnonzero(~strict.correct):
                _explain(truth, label, kind, strict, int(k))
    for half, of in rows.items():
        if of:
            table = np.array(of)
            total = table.sum(axis=0)
            total[[3, 6]] /= len(table)
            print(f"{half:8s}{_text(total)}   correct {total[4] / total[1]:.1%}, "
                  f"shared {total[7] / total[1]:.1%}")  # fmt: skip


def _text(row: np.ndarray) -> str:
    return (
        f"{row[0]:7.0f} {row[1]:10.0f} {row[2]:6.0f} {row[3]:6.3f} {row[4]:8.0f} {row[5]:6.0f} "
        f"{row[6]:7.3f} {row[7]:8.0f} {row[8]:6.2f}"
    )


def _explain(
    truth: Primitives, label: np.ndarray, kind: np.ndarray, found: Score, k: int
) -> None:
    """Print what became of a primitive."""
    members = truth.index[truth.start[k] : truth.start[k + 1]]
    several = np.bincount(truth.index, minlength=len(label))[members] > 1
    names, count = np.unique(label[members], return_counts=True)
    parts = []
    for at in np.argsort(-count)[:5]:
        s = names[at]
        what = SurfaceKind(int(kind[s])).name.lower() if s >= 0 else "none"
        whole = np.count_nonzero(label == s)
        parts.append(f"{count[at]} of {whole} on {what} {s}{'*' if s == found.partner[k] else ''}")
    print(
        f"    {SurfaceKind(int(truth.kind[k])).name.lower()} {k}: {len(members)} points, "
        f"{several.sum()} of creases, dice {found.dice[k]:.3f}: {', '.join(parts)}"
    )


if __name__ == "__main__":
    main()
