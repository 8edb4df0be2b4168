"""Agreement of two partitions: Hoover's five counts, mean IoU, adjusted Rand index.

Everything is computed from the sparse table of overlaps (true patch x predicted region), so the
points are passed over once. Points whose true patch is unknown (-1) take no part; points without a
predicted region (-1) count in the size of their patch and in no region.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class HooverCounts:
    """The five counts of Hoover et al. 1996, "An experimental comparison of range image ..."."""

    correct: int
    """Pairs of one patch and one region that overlap by at least T of both."""
    over: int
    """Patches covered (>= T) by two or more regions that each lie in the patch by >= T."""
    under: int
    """Regions covered (>= T) by two or more patches that each lie in the region by >= T."""
    missed: int
    """Patches in none of these instances."""
    noise: int
    """Regions in none of these instances."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlap:
    """Sparse table of the points shared by true patches (P) and predicted regions (R)."""

    patch: np.ndarray
    """Label of every true patch, shape (P,), ascending."""
    region: np.ndarray
    """Label of every region with a point of known truth, shape (R,), ascending."""
    patch_size: np.ndarray
    """Points of every patch, labelled or not, shape (P,), i64."""
    region_size: np.ndarray
    """Points of every region whose truth is known, shape (R,), i64."""
    outside: np.ndarray
    """Regions with more than half of their points where the truth is unknown, shape (R,), bool."""
    row: np.ndarray
    """Patch of every filled place of the table, as an index into ``patch``, shape (M,)."""
    column: np.ndarray
    """Region of every filled place, as an index into ``region``, shape (M,)."""
    count: np.ndarray
    """Shared points of every filled place, shape (M,), i64."""

    @property
    def points(self) -> int:
        """Number of points whose true patch is known."""
        return int(self.patch_size.sum())

    @property
    def labelled(self) -> int:
        """Number of these that have a region."""
        return int(self.region_size.sum())


def overlap_table(truth: np.ndarray, labels: np.ndarray) -> Overlap:
    """Count the points that patches and regions share.

    Args:
        truth: True patch of every point, shape (N,); negative = unknown.
        labels: Predicted region of every point, shape (N,); negative = none.
    """
    known = truth >= 0
    patch, row = compact(truth[known])
    label = labels[known]
    on = label >= 0
    region, column = compact(label[on])
    patch_size = np.bincount(row, minlength=len(patch))
    region_size = np.bincount(column, minlength=len(region))
    unknown = labels[~known & (labels >= 0)]
    place = np.minimum(np.searchsorted(region, unknown), max(len(region) - 1, 0))
    met = region[place] == unknown if len(region) else np.zeros(len(unknown), bool)
    beyond = np.bincount(place[met], minlength=len(region))
    width = max(len(region), 1)
    key = row[on].astype(np.int64) * width + column
    if len(patch) * width <= 4 * len(key) + 1_000_000:
        dense = np.bincount(key, minlength=1)
        place = np.flatnonzero(dense)
        count = dense[place]
    else:
        place, count = np.unique(key, return_counts=True)
    return Overlap(
        patch=patch,
        region=region,
        patch_size=patch_size,
        region_size=region_size,
        outside=beyond > region_size,
        row=place // width,
        column=place % width,
        count=count,
    )


def compact(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (the labels that occur, the index of every element's label among them)."""
    top = int(labels.max(initial=-1)) + 1
    if top > 4 * len(labels) + 1024:
        found, index = np.unique(labels, return_inverse=True)
        return found, index
    present = np.zeros(top, bool)
    present[labels] = True
    return np.flatnonzero(present), (np.cumsum(present) - 1)[labels]


def hoover(table: Overlap, threshold: float) -> HooverCounts:
    """Count the instances of Hoover et al. 1996, section 4.

    A patch or region that could be part of several instances keeps the one whose two overlap
    measures (share of the patches covered, share of the regions covered) have the highest mean;
    among equals a correct instance goes before an over- and that before an under-segmentation.

    Args:
        table: Overlaps of patches and regions.
        threshold: Tolerance T, 0.5 < T <= 1.
    """
    row, column, count = table.row, table.column, table.count
    of_patch = count / table.patch_size[row]
    of_region = count / table.region_size[column]
    found: list[tuple[float, str, np.ndarray, np.ndarray]] = []
    for m in np.flatnonzero((of_patch >= threshold) & (of_region >= threshold)):
        score = float(of_patch[m] + of_region[m]) / 2
        found.append((score, "correct", row[m : m + 1], column[m : m + 1]))
    # The sliver by which a region on unknown truth enters a patch does not split that patch.
    part = (of_region >= threshold) & ~table.outside[column]
    for places in _groups(np.flatnonzero(part), row):
        k, parts = row[places[0]], column[places]
        shared = count[places].sum()
        if shared / table.patch_size[k] >= threshold:
            score = (shared / table.patch_size[k] + shared / table.region_size[parts].sum()) / 2
            found.append((float(score), "over", np.array([k]), parts))
    for places in _groups(np.flatnonzero(of_patch >= threshold), column):
        k, parts = column[places[0]], row[places]
        shared = count[places].sum()
        if shared / table.region_size[k] >= threshold:
            score = (shared / table.region_size[k] + shared / table.patch_size[parts].sum()) / 2
            found.append((float(score), "under", parts, np.array([k])))
    found.sort(key=lambda instance: -instance[0])
    patch_free = np.ones(len(table.patch), bool)
    region_free = np.ones(len(table.region), bool)
    counts = {"correct": 0, "over": 0, "under": 0}
    for _, name, patches, regions in found:
        if patch_free[patches].all() and region_free[regions].all():
            patch_free[patches] = False
            region_free[regions] = False
            counts[name] += 1
    # A region that lies mostly where nobody knows the truth cannot be called wrong.
    noise = int((region_free & ~table.outside).sum())
    return HooverCounts(**counts, missed=int(patch_free.sum()), noise=noise)


def _groups(places: np.ndarray, owner: np.ndarray) -> list[np.ndarray]:
    """Return the places of every owner that has two or more, in the order of the owners."""
    places = places[np.argsort(owner[places], kind="stable")]
    starts = np.flatnonzero(np.diff(owner[places])) + 1
    return [group for group in np.split(places, starts) if len(group) >= 2]


def best_match(table: Overlap) -> tuple[np.ndarray, np.ndarray]:
    """Match patches and regions one to one so that the sum of their IoU is largest.

    Returns:
        Column of the matched region of every patch, shape (P,), -1 = none; and its IoU, shape (P,).
    """
    from scipy.optimize import linear_sum_assignment

    patches = len(table.patch)
    matched = np.full(patches, -1)
    value = np.zeros(patches)
    union = table.patch_size[table.row] + table.region_size[table.column] - table.count
    iou = table.count / union
    # A patch never needs a region beyond its best P: the others take P - 1 of these at most.
    order = np.lexsort((-iou, table.row))
    first = np.searchsorted(table.row[order], table.row[order])
    order = order[np.arange(len(order)) - first < patches]
    kept, column = np.unique(table.column[order], return_inverse=True)
    if len(kept):
        dense = np.zeros((patches, len(kept)))
        dense[table.row[order], column] = iou[order]
        rows, columns = linear_sum_assignment(dense, maximize=True)
        hit = dense[rows, columns] > 0
        matched[rows[hit]] = kept[columns[hit]]
        value[rows] = dense[rows, columns]
    return matched, value


def mean_iou(table: Overlap) -> float:
    """Mean IoU of the patches under the best one-to-one matching; an unmatched patch counts 0."""
    return float(best_match(table)[1].mean()) if len(table.patch) else float("nan")


def adjusted_rand(table: Overlap, *, labelled_only: bool = False) -> float:
    """Adjusted Rand index (Hubert and Arabie 1985) of the points whose true patch is known.

    Args:
        table: Overlaps of patches and regions.
        labelled_only: Leave points without a region out; else they form one more cluster.
    """
    shared = np.bincount(table.row, weights=table.count, minlength=len(table.patch))
    unlabelled = table.patch_size - shared
    if labelled_only:
        cells, rows, columns = table.count, shared, table.region_size
    else:
        cells = np.concatenate([table.count, unlabelled])
        rows = table.patch_size
        columns = np.append(table.region_size, unlabelled.sum())
    total = _pairs(np.array([np.sum(rows)]))
    if total == 0:
        return float("nan")
    both, in_rows, in_columns = _pairs(cells), _pairs(rows), _pairs(columns)
    expected = in_rows * in_columns / total
    highest = (in_rows + in_columns) / 2
    return 1.0 if highest == expected else (both - expected) / (highest - expected)


def _pairs(sizes: np.ndarray) -> float:
    """Return the number of pairs of points within groups of these sizes."""
    sizes = np.asarray(sizes, np.float64)
    return float((sizes * (sizes - 1) / 2).sum())
