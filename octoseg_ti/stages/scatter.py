"""How far points scatter about the smooth surface through their neighbourhood.

Second differences along a stripe see what two neighbours do not share. What decides whether a point
lies on a surface is more than that: steps of the range, speckle over several points, views that do
not quite meet. It is measured where it matters, as the residual of the best analytic surface
through neighbourhoods of about a hundred points of one region: of half of them, for edges run
through some of the others. (Where faces are a few neighbourhoods large, edges would run through
nearly all if regions did not keep them apart.) A quadric does for most of them; where many bend too
much for one, surfaces are fitted.

Poses are in error from view to view, not from point to point: in one place views meet well, in
another they do not, and in most there may be one view only. So where views meet, the scatter of
each about a surface of its own is told from what they are apart, and nearly the most of the latter
counts.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.fitting.primitives import FREEDOM, fit_all
from octoseg_ti.fitting.quadrics import QUADRIC_FREEDOM, Quadrics, fit_quadrics
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.leaves import ranges

# Neighbourhoods, and the points of each.
_COUNT, _POINTS = 256, 128
_FEWEST = 24
# The points of a neighbourhood are among so many times as many in Morton order.
_WINDOW = 4
# The median counts, up to so many times the lower quartile: edges may run through most.
_CALM, _MIDDLE, _EDGES = 0.25, 0.6, 1.5
# A quadric is no surface any more where it turns by so much from the middle to the rim [rad].
_BEND = 0.35
# Up to this share of the neighbourhoods may bend so much: then the others tell alone.
_BENT = 0.25
# Where it leaves so many times what it leaves of the calm ones, there is an edge.
_EDGE = 8.0
# Views are apart by this quantile of what they are where they meet, if they do in so many places.
_APART, _MEETINGS = 0.75, 16
# Chance alone tells them apart by less than this share of the scatter.
_CHANCE = 0.3
# Odd numbers with well mixed bits (the first digits of the roots of 2, 3 and 5, times 2^64).
_MIX = np.array([0x6A09E667F3BCC909, 0xBB67AE8584CAA73B, 0x3C6EF372FE94F82B], np.uint64)


def surface_noise(
    grid: Grid, leaves: np.ndarray, group: np.ndarray, view: np.ndarray
) -> tuple[float, float] | None:
    """Return the standard deviation of points about the surface through their neighbourhood [mm].

    With it comes the part of it by which views are apart [mm], 0 where they meet.

    Args:
        grid: The sparse grid: points that follow one another in Morton order are near each other.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        group: Region of every leaf, -1 = none, shape (C,), i32.
        view: View of every point, in the order in which they went into the grid, shape (n,), i32.

    Returns:
        Both deviations; None where no region is large enough to tell.
    """
    index, begin = _neighborhoods(runtime.download(grid.key), grid.first[leaves], group)
    count = np.diff(begin)
    if len(count) == 0:
        return None
    point = runtime.download(grid.point).take(index, axis=0)
    order = _shuffled(point, np.repeat(np.arange(len(count)), count))
    index, point = index[order], point.take(order, axis=0)
    normal = runtime.download(grid.normal).take(index, axis=0)
    rms, bent = _residuals(point, normal, begin)
    # Where a quadric does, quadrics do for the views too; half of the places tell enough.
    asked = np.flatnonzero(~bent[::2]) * 2
    rows = ranges(begin[asked], count[asked])
    seen = view[runtime.download(grid.order)[index[rows]]]
    within, apart = _by_view(point, normal, rows, seen, np.repeat(asked, count[asked]), rms)
    if apart <= _CHANCE * within:
        return _typical(rms), 0.0
    return max(_typical(rms), float(np.hypot(within, apart))), apart


def _neighborhoods(
    key: np.ndarray, first: np.ndarray, region: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return neighbourhoods all over a part, each within one region.

    Args:
        key: Morton keys of the sorted points, shape (n,).
        first: First point of every leaf, ascending, shape (C,).
        region: Region of every leaf, -1 = none, shape (C,).

    Returns:
        The sorted points of each, one neighbourhood after the other, ascending, shape (S,); and the
        first of these of every neighbourhood, and S at the end, shape (G + 1,).
    """
    after = np.append(first[1:], len(key))
    count = after - first
    inside = np.flatnonzero(region >= 0)
    if len(inside) == 0:
        return inside, np.zeros(1, np.int64)
    # Whole boxes: which points of a box come first would depend on the order of the input.
    ends = np.cumsum(count[inside])
    place = np.arange(_COUNT) * ends[-1] // _COUNT
    leaf = np.searchsorted(ends, place, "right")
    begin = np.unique(np.searchsorted(key, key[place + after[inside[leaf]] - ends[leaf]]))
    limit = np.searchsorted(key, key[np.minimum(begin + _WINDOW * _POINTS, len(key) - 1)])
    # The leaves region after region, those of one region in Morton order: a neighbourhood takes up
    # some places in a row, from that of the first point of its box on.
    order = inside[np.argsort(region[inside], kind="stable")]
    ends = np.cumsum(count[order])
    shift = after[order] - ends  # from the place of a point to the point
    where = np.empty(len(first), np.int64)
    where[order] = np.arange(len(order))
    leaf = np.searchsorted(first, begin, "right") - 1
    start = begin - shift[where[leaf]]
    within = ends[np.searchsorted(region[order], region[leaf], "right") - 1]
    farthest = np.minimum(start + _POINTS, within) - 1
    point = farthest + shift[np.searchsorted(ends, farthest, "right")]
    end = farthest + np.searchsorted(key, key[point], "right") - point
    # What each has of a leaf.
    low, high = np.searchsorted(ends, start, "right"), np.searchsorted(ends, end - 1, "right") + 1
    part, owner = ranges(low, high - low), np.repeat(np.arange(len(begin)), high - low)
    low = np.maximum(start[owner], (ends - count[order])[part]) + shift[part]
    high = np.minimum(np.minimum(end[owner], ends[part]) + shift[part], limit[owner])
    length = np.maximum(high - low, 0)
    size = np.bincount(owner, length).astype(np.int64)
    kept = size[owner] >= _FEWEST
    return ranges(low[kept], length[kept]), np.append(0, np.cumsum(size[size >= _FEWEST]))


def _shuffled(point: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the points group by group, in an order that only their coordinates tell.

    So no sum over them depends on the order of the input. Groups have numbers below 1024.
    """
    mixed = np.ascontiguousarray(point).view(np.uint64) @ _MIX
    mixed = (mixed ^ (mixed >> np.uint64(32))) * _MIX[0]
    # Places in the last bits: to sort keys is faster than to sort places by them.
    last = np.uint64((1 << len(point).bit_length()) - 1)
    key = (group.astype(np.uint64) << np.uint64(54)) | (mixed >> np.uint64(10))
    key = np.sort((key & ~last) | np.arange(len(point), dtype=np.uint64))
    return (key & last).astype(np.int64)


def _typical(rms: np.ndarray) -> float:
    """Return what surfaces leave of a usual neighbourhood without an edge [mm]."""
    calm, middle = np.nanquantile(rms, [_CALM, _MIDDLE])
    return float(min(middle, _EDGES * calm))


def _by_view(
    point: np.ndarray,
    normal: np.ndarray,
    rows: np.ndarray,
    view: np.ndarray,
    group: np.ndarray,
    rms: np.ndarray,
) -> tuple[float, float]:
    """Return how far points scatter about quadrics of their views, and how far views are apart.

    Args:
        point: Points [mm], shape (S, 3).
        normal: Their normals, shape (S, 3).
        rows: Those of some groups, shape (k,).
        view: The views of these, shape (k,).
        group: Their groups, shape (k,).
        rms: What one surface leaves of every group [mm], shape (G,).

    Returns:
        What quadrics of the views leave of a usual group in which they meet, and the deviation of
        the views from the surface that they share [mm]; both 0 where too few meet.
    """
    if len(view) == 0 or np.all(view == view[0]):
        return 0.0, 0.0
    views = int(view.max()) + 1
    key = group * views + view
    count = np.bincount(key, minlength=len(rms) * views).reshape(-1, views)
    large = count >= _FEWEST
    large &= np.count_nonzero(large, axis=1)[:, None] > 1
    if np.count_nonzero(large) < 2 * _MEETINGS:
        return 0.0, 0.0
    kept = np.flatnonzero(large.ravel()[key])
    rows = rows[kept[np.argsort(key[kept], kind="stable")]]
    name, count = np.nonzero(large)[0], count[large]
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int32)
    square = count * _of_quadrics(fit_quadrics(point[rows], normal[rows], start), count) ** 2
    # In an order that has nothing to do with the numbers of the views.
    rising = np.lexsort((square, name))
    number = np.bincount(name, count, len(rms))
    meet = number > 0
    within = np.sqrt(np.bincount(name[rising], square[rising], len(rms))[meet] / number[meet])
    plain = within <= _EDGES * np.quantile(within, _CALM)
    if np.count_nonzero(plain) < _MEETINGS:
        return 0.0, 0.0
    apart = np.sqrt(np.maximum(rms[meet][plain] ** 2 - within[plain] ** 2, 0.0))
    return _typical(within), float(np.quantile(apart, _APART))


def _of_quadrics(found: Quadrics, count: np.ndarray) -> np.ndarray:
    """Return what quadrics leave [mm], had they no freedom, shape (G,)."""
    return np.asarray(found.rms[:, 1] * np.sqrt(count / np.maximum(count - QUADRIC_FREEDOM, 1)))


def _residuals(
    point: np.ndarray, normal: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return what the surface through every group leaves [mm], and whether it is bent, shapes (G,).

    A few bent ones are left out: NaN.

    Args:
        point: Points of the groups, one group after the other [mm], shape (S, 3).
        normal: Their normals, shape (S, 3).
        start: First point of every group, and S at the end, shape (G + 1,).
    """
    count = np.diff(start)
    found = fit_quadrics(point, normal, start)
    rms = _of_quadrics(found, count)
    bent = (found.bend > _BEND) & (rms <= _EDGE * np.quantile(rms, _CALM))
    if np.count_nonzero(bent) <= _BENT * len(bent):
        rms[bent] = np.nan
    else:
        mine = np.repeat(bent, count)
        ends = np.concatenate([[0], np.cumsum(count[bent])]).astype(np.int32)
        fit = fit_all(point[mine], normal[mine], None, ends)
        spare = count[bent, None] / (count[bent, None] - FREEDOM[None, :])
        best = np.where(np.isfinite(fit.rms), fit.rms * np.sqrt(spare), np.inf).min(axis=1)
        rms[bent] = np.minimum(rms[bent], best)
    return rms, bent
