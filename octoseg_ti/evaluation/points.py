"""Scores of single points: the error of normals, and which points were called edge points."""

from __future__ import annotations

from typing import Any

import numpy as np

from octoseg_ti.evaluation.scores import (
    ArtefactScores,
    EdgeScores,
    FilletScores,
    NormalScores,
)
from octoseg_ti.types import Artefact, EdgeClass, Fillets, Truth

_SAMPLE = 20_000


def has_normal(normals: np.ndarray) -> np.ndarray:
    """Say of every row of shape (N, 3) whether it is a finite vector other than zero."""
    with np.errstate(over="ignore", invalid="ignore"):
        squared = np.einsum("ij,ij->i", normals, normals)
    return np.isfinite(squared) & (squared > 0)


def normal_angles(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the angle between unoriented normals [rad], 0 to pi/2, shape (N,).

    A zero or non-finite estimate counts as a right angle. Where the true normal is not known, the
    angle is NaN.

    Args:
        estimated: Estimated normals of any length, shape (N, 3).
        true: True normals of any length, shape (N, 3).
    """
    # One column at a time: strided rows of three would cost several times as much.
    ax, ay, az = np.asarray(estimated, np.float64).T
    bx, by, bz = np.asarray(true, np.float64).T
    with np.errstate(invalid="ignore", over="ignore"):
        cross = np.sqrt(
            (ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2
        )
        # atan2 stays exact at small angles, where arccos does not.
        angle = np.arctan2(cross, np.abs(ax * bx + ay * by + az * bz))
    angle[~has_normal(estimated)] = np.pi / 2
    angle[~has_normal(true)] = np.nan
    return angle


def score_normals(angles: np.ndarray, missing: np.ndarray) -> NormalScores | None:
    """Sum up the angles of `normal_angles`; None where no true normal is known.

    Args:
        angles: Angle of every point [rad], NaN = true normal not known, shape (N,).
        missing: Whether the estimate of a point is missing, shape (N,), bool.
    """
    known = ~np.isnan(angles)
    if not known.any():
        return None
    values = angles[known]
    median, p95 = np.percentile(values, [50, 95])
    return NormalScores(
        points=len(values),
        mean=float(values.mean()),
        median=float(median),
        p95=float(p95),
        missing=float(missing[known].mean()),
    )


def score_edges(edge: np.ndarray, truth: Truth, distance: float) -> dict[str, EdgeScores]:
    """Score the points that were called edge points.

    A point is a true edge point when it lies within ``distance`` of a true edge. Under "all" any
    edge class counts as found; under "sharp" and "fillet" the class must be right too.

    Args:
        edge: `EdgeClass` of every point, shape (N,).
        truth: Truth with ``edge_distance``, and ``edge_class`` for the scores of a class.
        distance: Distance d [mm].
    """
    assert truth.edge_distance is not None
    near = truth.edge_distance <= distance
    scores = {"all": _edge_scores(edge != EdgeClass.NONE, near)}
    if truth.edge_class is not None:
        for kind in (EdgeClass.SHARP, EdgeClass.FILLET):
            scores[kind.name.lower()] = _edge_scores(
                edge == kind, near & (truth.edge_class == kind)
            )
    return scores


def _edge_scores(found: np.ndarray, true: np.ndarray) -> EdgeScores:
    hits = int(np.count_nonzero(found & true))
    found_count, true_count = int(np.count_nonzero(found)), int(np.count_nonzero(true))
    return EdgeScores(
        found=found_count,
        true=true_count,
        precision=hits / found_count if found_count else float("nan"),
        recall=hits / true_count if true_count else float("nan"),
        f1=2 * hits / (found_count + true_count) if found_count + true_count else float("nan"),
    )


def score_fillets(fillets: Fillets, truth: Truth) -> FilletScores | None:
    """Score the radii of fillets; None where no true radius is known.

    Args:
        fillets: The fillets found, with the one that every point lies on.
        truth: Truth with ``radius``.
    """
    if truth.radius is None or not np.isfinite(truth.radius).any():
        return None
    there = np.flatnonzero(fillets.point >= 0)
    owner, true = fillets.point[there], truth.radius[there].astype(np.float64)
    on = np.isfinite(true)
    count = len(fillets)
    points = np.bincount(owner, minlength=count)
    right = 2 * np.bincount(owner, on, count) > points
    order = np.lexsort((true[on], owner[on]))
    lies, value = owner[on][order], true[on][order]
    begin, end = np.searchsorted(lies, [np.arange(count), np.arange(1, count + 1)])
    which = np.flatnonzero(right)
    middle = value[(begin[which] + end[which] - 1) // 2]
    error = np.abs(fillets.radius[which] / middle - 1.0)
    weight = points[which] / max(int(points[which].sum()), 1)
    some = len(error) > 0
    return FilletScores(
        found=count,
        right=len(which),
        median=float(np.median(error)) if some else float("nan"),
        worst=float(error.max()) if some else float("nan"),
        within_5=float(weight[error <= 0.05].sum()) if some else float("nan"),
        within_10=float(weight[error <= 0.10].sum()) if some else float("nan"),
    )


def score_artefacts(outlier: np.ndarray, artefact: np.ndarray) -> ArtefactScores:
    """Score the points that cleaning marked.

    Args:
        outlier: Whether a point was marked, shape (N,).
        artefact: `Artefact` of every point, shape (N,).
    """
    marked = np.asarray(outlier) != 0
    scores = _edge_scores(marked, artefact != Artefact.CLEAN)
    classes = {}
    for kind in (Artefact.MIXED, Artefact.SPIKE, Artefact.MULTI_BOUNCE):
        one = _edge_scores(marked, artefact == kind)
        classes[kind.name.lower().replace("_", "-")] = (one.true, one.recall)
    return ArtefactScores(
        found=scores.found, true=scores.true, precision=scores.precision, recall=scores.recall,
        f1=scores.f1, classes=classes,
    )  # fmt: skip


def point_spacing(result: Any, truth: Truth) -> tuple[float, str] | None:
    """Return the median point spacing [mm] and how it was found; None when there are no positions.

    The spacing that the segmentation measured is taken (the larger of along and across the
    stripes); without it, the median distance to the nearest neighbour at a sample of the points.
    """
    measured = getattr(result, "measured", None)
    if measured is not None:
        spacing = float(max(measured.spacing_along, measured.spacing_across))
        if np.isfinite(spacing) and spacing > 0:
            return spacing, "measured spacing"
    points = getattr(result, "points", None)
    points = truth.position if points is None else points
    if points is None:
        return None
    points = np.asarray(points, np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 2:
        return None
    from scipy.spatial import cKDTree

    sample = points[:: max(1, len(points) // _SAMPLE)]
    gap = cKDTree(points).query(sample, k=2)[0][:, 1]
    gap = gap[gap > 0]
    return (float(np.median(gap)), "nearest neighbours") if len(gap) else None
