"""Scores of a segmentation against the truth; never imported by a stage."""

from __future__ import annotations

from typing import Any

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.evaluation.overlap import (
    HooverCounts,
    Overlap,
    adjusted_rand,
    best_match,
    compact,
    hoover,
    mean_iou,
    overlap_table,
)
from octoseg_ti.evaluation.points import (
    has_normal,
    normal_angles,
    point_spacing,
    score_artefacts,
    score_edges,
    score_fillets,
    score_normals,
)
from octoseg_ti.evaluation.poses import pose_errors
from octoseg_ti.evaluation.scores import (
    ArtefactScores,
    EdgeScores,
    FilletScores,
    NormalScores,
    RegionScores,
    Scores,
)
from octoseg_ti.types import EdgeClass, Fillets, Truth

__all__ = [
    "ArtefactScores",
    "EdgeScores",
    "FilletScores",
    "HooverCounts",
    "NormalScores",
    "Overlap",
    "RegionScores",
    "Scores",
    "evaluate",
    "pose_errors",
    "wrong_points",
]


def evaluate(
    result: Any, truth: Any, *, overlap: float = 0.8, edge_distance: float | None = None
) -> Scores:
    """Score a segmentation against the truth.

    Points whose true patch is unknown (-1) are left out of the scores of regions; regions that lie
    mostly on such points are counted as ``on_unknown``, not as noise. Every score comes twice: over
    all points, and over the interior points. Interior points are those farther than
    ``edge_distance`` from the nearest true edge; if the truth does not know its edges, those that
    the result did not call edge points.

    Args:
        result: A `Segmentation`, or anything with ``labels`` (and, where they are to be scored,
            ``normals`` and ``edge``), or bare labels, shape (N,), int; negative = none.
        truth: A `Truth`, or bare true patches, shape (N,), int; negative = unknown.
        overlap: Tolerance T of Hoover's five counts, 0.5 < T <= 1.
        edge_distance: Distance d within which a point counts as an edge point [mm]; default twice
            the median point spacing.

    Raises:
        DataError: Arrays of different lengths, labels that are no integers, or an option that is
            out of range.
    """
    if not 0.5 < overlap <= 1.0:
        raise DataError(f"the overlap must be above 0.5 and at most 1, not {overlap:g}")
    if edge_distance is not None and not (np.isfinite(edge_distance) and edge_distance >= 0):
        raise DataError(f"the edge distance must be a length of 0 mm or more, not {edge_distance}")
    labels = _labels("labels", getattr(result, "labels", result))
    known = truth if isinstance(truth, Truth) else Truth(patch=_labels("true patches", truth))
    patch = _labels("true patches", known.patch)
    edge = _column("edge", getattr(result, "edge", None), len(labels))
    normals = _column("normals", getattr(result, "normals", None), len(labels))
    fillets = getattr(result, "fillets", None)
    if isinstance(fillets, Fillets):
        _column("fillets", fillets.point, len(labels))
    outlier = _column("outlier", getattr(result, "outlier", None), len(labels))
    for name, array in (
        ("true patches", patch),
        ("true edge distances", known.edge_distance),
        ("true edge classes", known.edge_class),
        ("true normals", known.normal),
        ("true artefacts", known.artefact),
        ("true radii", known.radius),
    ):
        _column(name, array, len(labels))

    distance, source = _distance(result, known, edge_distance)
    if known.edge_distance is not None and distance is not None:
        interior = known.edge_distance > distance
        rule = f"farther than {distance:.3g} mm from a true edge"
    elif edge is not None:
        interior = edge == EdgeClass.NONE
        rule = "not called an edge point by the result (the truth does not know its edges)"
    else:
        interior, rule = None, "nothing tells where the edges are"

    table = overlap_table(patch, labels)
    inner = None if interior is None else (patch[interior], labels[interior])
    inner_table = None if inner is None else overlap_table(*inner)
    normal_scores = normal_scores_interior = None
    if normals is not None and known.normal is not None:
        angles = normal_angles(normals, known.normal)
        missing = ~has_normal(normals)
        normal_scores = score_normals(angles, missing)
        if interior is not None:
            normal_scores_interior = score_normals(angles[interior], missing[interior])
    edges, note = {}, ""
    if edge is None:
        note = "the result has no edge points"
    elif known.edge_distance is None or distance is None:
        note = source
    else:
        edges = score_edges(edge, known, distance)
    return Scores(
        overlap=float(overlap),
        edge_distance=distance,
        edge_distance_from=source,
        interior_rule=rule,
        regions=_regions(table, patch, labels, overlap),
        regions_interior=(
            None if inner is None or inner_table is None else _regions(inner_table, *inner, overlap)
        ),
        normals=normal_scores,
        normals_interior=normal_scores_interior,
        edges=edges,
        edges_note=note,
        fillets=(score_fillets(fillets, known) if isinstance(fillets, Fillets) else None),
        artefacts=(
            None
            if outlier is None or known.artefact is None
            else score_artefacts(outlier, known.artefact)
        ),
        table=table,
        table_interior=inner_table,
    )


def wrong_points(labels: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """Say of every point whether its label is right.

    Regions are matched to patches one to one, by the largest sum of IoU.

    Args:
        labels: Predicted regions, shape (N,), int; negative = none.
        patch: True patches, shape (N,), int; negative = unknown.

    Returns:
        Shape (N,), i8: 0 = right, or unknown truth and no label; 1 = in the wrong region; 2 = no
        label where there is a patch; 3 = a label where the truth is unknown.
    """
    labels, patch = _labels("labels", labels), _labels("true patches", patch)
    _column("true patches", patch, len(labels))
    table = overlap_table(patch, labels)
    matched, _ = best_match(table)
    wanted = np.full(len(table.patch), -2, np.int64)
    hit = matched >= 0
    wanted[hit] = table.region[matched[hit]]
    known = patch >= 0
    wrong = np.where(labels >= 0, 3, 0).astype(np.int8)
    wrong[known] = labels[known] != wanted[np.searchsorted(table.patch, patch[known])]
    wrong[known & (labels < 0)] = 2
    return wrong


def _regions(table: Overlap, patch: np.ndarray, labels: np.ndarray, overlap: float) -> RegionScores:
    counts = hoover(table, overlap)
    return RegionScores(
        points=table.points,
        patches=len(table.patch),
        regions=len(table.region),
        correct=counts.correct,
        over=counts.over,
        under=counts.under,
        missed=counts.missed,
        noise=counts.noise,
        on_unknown=_on_unknown(patch, labels),
        mean_iou=mean_iou(table),
        ari=adjusted_rand(table),
        ari_labelled=adjusted_rand(table, labelled_only=True),
        labelled=table.labelled / table.points if table.points else float("nan"),
    )


def _on_unknown(patch: np.ndarray, labels: np.ndarray) -> int:
    """Count the regions of which more than half the points have no true patch."""
    on = labels >= 0
    index = compact(labels[on])[1]
    size = np.bincount(index)
    unknown = np.bincount(index, weights=patch[on] < 0)
    return int(np.count_nonzero(2 * unknown > size))


def _labels(name: str, values: Any) -> np.ndarray:
    array = np.asarray(values)
    if array.ndim != 1 or not (np.issubdtype(array.dtype, np.integer) or array.size == 0):
        raise DataError(
            f"{name} must be whole numbers of shape (N,), not {array.dtype} of shape {array.shape}"
        )
    # int8 and unsigned labels would overflow in comparisons with -1 and in sums.
    return array.astype(np.int64, copy=False)


def _column(name: str, values: Any, count: int) -> np.ndarray | None:
    array = None if values is None else np.asarray(values)
    if array is not None and (array.ndim == 0 or len(array) != count):
        raise DataError(
            f"{name}: {array.shape[0] if array.ndim else 1} entries for {count} labelled points",
            hint="score a result against the truth of the same points, in the same order",
        )
    return array


def _distance(result: Any, truth: Truth, given: float | None) -> tuple[float | None, str]:
    """Return the edge distance [mm] and where it comes from."""
    if given is not None:
        return float(given), "as given"
    if truth.edge_distance is None:
        return None, "the truth does not know its edges"
    found = point_spacing(result, truth)
    if found is None:
        return None, "no positions to measure the spacing on: give the edge distance"
    return 2 * found[0], f"2 x {found[1]}"
