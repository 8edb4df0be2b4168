"""Stage 3, on request: align overlapping views to each other, from the recorded poses on (I6).

Pairs of views are aligned by generalised ICP (Segal, Haehnel & Thrun, "Generalized-ICP", RSS
2009) through small_gicp; a graph over all pairs makes one motion of every view out of these, and
joint steps from point to plane over all pairs at once (the symmetric objective of Rusinkiewicz,
ACM Trans. Graph. 38(4), 2019) bring it home. Points near edges, where a normal is none, take no
part.

All motions here are small twists (rotation vector times the radius of the points, shift) about the
middle of the points, so that the six numbers have one unit: mm.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octoseg_ti.alignment import Registration
from octoseg_ti.device import runtime
from octoseg_ti.errors import MissingPackageError

_MOST = 100_000
"""Points of a view that take part at most; more are thinned evenly."""
_START = 10_000
"""... and for the start by ICP, which only has to come near."""
_NEIGHBORS = 9
_RIM = 0.25
"""A point is on the rim of its view when the mean of its neighbours lies this share of their
distance aside."""
_AGREE = np.cos(np.radians(20.0))
"""Partners whose normals differ by more lie on different faces."""
_LEAST = 50
"""Fewer matches are no overlap."""
_OPEN = 1e-3
"""A direction is open where the normals' share along it (mean square) is below this."""
_MOST_OPEN = 0.05
"""... and at most below this, where a lower bound has let a view slide."""
_SLIDE = 4.0
"""A view that moves by more than this many times its largest gap has slid."""
_NEAR = 0.75
"""Farthest partner in the joint steps, in spacings: a farther one lies beyond the rim of the
overlap, and what is wrong with its normal counts with its distance."""
_MANY = 20_000
"""The partners of fewer points are found before threads have started to look for them."""
_ROUNDS = 25
_STILL = 2e-5
"""Steps below this end the rounds [mm]."""
_TUKEY = 4.685


class _View(NamedTuple):
    """The smooth points of one view about the common middle, and a tree of them."""

    points: np.ndarray
    normals: np.ndarray
    """Mean normals of small neighbourhoods."""
    tree: Any
    spacing: float
    """Median distance to the nearest neighbour across all directions [mm]."""


class _Matches(NamedTuple):
    """Matched points of two views where the views are now."""

    place: np.ndarray
    """Points of the first view, shape (M, 3)."""
    normal: np.ndarray
    """Mean of the two normals, unit, shape (M, 3)."""
    gap: np.ndarray
    """Distance from plane to point, second minus first, along the normal, shape (M,)."""
    spread: float
    """Mean square difference of the two normals."""


class _Equations(NamedTuple):
    """Normal equations of a pair for the motion of its first view relative to the second."""

    matrix: np.ndarray
    """Shape (6, 6); directions that the pair leaves open are taken out."""
    right: np.ndarray
    """Shape (6,)."""
    open: np.ndarray
    """Unit directions that are open, shape (6, k)."""


def refine_poses(
    points: np.ndarray,
    normals: np.ndarray,
    view: np.ndarray,
    T_world_view: np.ndarray | None,
    *,
    reach: float,
    overlap: float,
) -> Registration:
    """Align the views to each other.

    In every group of views that overlap, the first keeps its pose. A view without enough overlap
    keeps its pose too, and so does every direction of motion that the overlaps leave open.

    Args:
        points: Positions in the world by the recorded poses [mm], shape (N, 3), f64.
        normals: Unit normals in the world, shape (N, 3), f64; zero = none.
        view: View of every point, shape (N,), i32.
        T_world_view: Recorded poses, shape (V, 4, 4); None = points came without.
        reach: Farthest partner of a point in another view [mm].
        overlap: Least share of the smaller of two views that must have partners in the other.

    Returns:
        Poses before and after, and how well they fit.

    Raises:
        MissingPackageError: small_gicp is not installed.
    """
    try:
        import small_gicp
    except ImportError as error:
        raise MissingPackageError("small_gicp", "icp", "refining the registration") from error
    count = int(view.max(initial=0)) + 1
    recorded = np.tile(np.eye(4), (count, 1, 1))
    if T_world_view is not None:
        count = len(T_world_view)
        recorded = np.array(T_world_view, np.float64)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    views = [_smooth_points(points[view == v] - middle, normals[view == v]) for v in range(count)]
    radius = _radius(views)
    still = np.tile(np.eye(4), (count, 1, 1))
    pairs = _overlapping(views, reach, overlap)
    least = _OPEN
    while True:
        datum, left, fixed = _groups(pairs, count)
        motion, loose = still, np.zeros(count, np.int32)
        if not pairs:
            break
        started = _aligned_pairs(small_gicp, views, pairs, reach, radius, fixed, least)
        # A pair that has slid away must not spoil the start.
        if _cost(views, pairs, started, reach) < _cost(views, pairs, still, reach):
            motion = started
        motion, loose = _jointly(views, pairs, motion, reach, radius, fixed, least)
        # A view that moves by far more than the gaps that it had has slid along a direction that is
        # open in truth, and looks held by what is wrong with some normals.
        gaps = _residuals(views, pairs, still, reach)[1]
        lost = _displacement(motion, radius) > min(reach, _SLIDE * float(gaps.max()) + 1e-3)
        if not lost.any():
            break
        if least < _MOST_OPEN:
            least *= 3.0
        else:
            pairs = [(i, j) for i, j in pairs if not (lost[i] or lost[j])]
    before = _residuals(views, pairs, still, reach)[1]
    matches, after = _residuals(views, pairs, motion, reach)
    shift = np.tile(np.eye(4), (count, 1, 1))
    shift[:, :3, 3] = middle
    back = np.tile(np.eye(4), (count, 1, 1))
    back[:, :3, 3] = -middle
    moved = (motion != np.eye(4)).any(axis=(1, 2))
    refined = np.where(moved[:, None, None], shift @ motion @ back @ recorded, recorded)
    return Registration(
        recorded=recorded, refined=refined, datum=datum, left=left, open=loose,
        pairs=np.array(pairs, np.int32).reshape(-1, 2), matches=matches, before=before, after=after,
    )  # fmt: skip


def _smooth_points(points: np.ndarray, normals: np.ndarray) -> _View:
    """Return the points of a view away from edges, with the mean normals of neighbourhoods."""
    from scipy.spatial import cKDTree

    known = np.flatnonzero((normals != 0.0).any(axis=1))
    step = -(-len(known) // _MOST) if len(known) else 1
    points, normals = points[known[::step]], normals[known[::step]]
    if len(points) <= _NEIGHBORS:
        return _View(np.empty((0, 3)), np.empty((0, 3)), None, 0.0)
    distance, near = cKDTree(points).query(points, _NEIGHBORS, workers=_threads(points))
    mean = normals[near].mean(axis=1)
    length = np.sqrt(np.einsum("ij,ij->i", mean, mean))
    # Noise alone shortens the mean by its variance, an edge by far more.
    least = 1.0 - max(0.005, 3.0 * (1.0 - float(np.median(length))))
    # On the rim of a view all neighbours lie to one side, and the mean normal leans to that side.
    aside = points[near].mean(axis=1) - points
    aside = np.sqrt(np.einsum("ij,ij->i", aside, aside))
    smooth = np.flatnonzero((length >= least) & (aside <= _RIM * distance[:, -1]))
    if len(smooth) == 0:
        return _View(np.empty((0, 3)), np.empty((0, 3)), None, 0.0)
    points = np.ascontiguousarray(points[smooth])
    normals = mean[smooth] / length[smooth, None]
    return _View(points, normals, cKDTree(points), float(np.median(distance[:, 4])))


def _threads(points: np.ndarray) -> int:
    """Return how many threads look for the neighbours of points."""
    return runtime.ensure_started().threads if len(points) >= _MANY else 1


def _radius(views: list[_View]) -> float:
    """Return the root mean square distance of all points from the middle [mm]."""
    squares = sum(float(np.einsum("ij,ij->", v.points, v.points)) for v in views)
    number = sum(len(v.points) for v in views)
    return float(np.sqrt(squares / number)) if squares > 0.0 else 1.0


def _match(first: _View, second: _View, moves: np.ndarray, reach: float) -> _Matches:
    """Return what matches between two views, each point of either with its nearest in the other.

    Args:
        first: One view.
        second: The other.
        moves: Their motions, shape (2, 4, 4).
        reach: Farthest partner [mm].
    """
    places, facing, gaps, spread = [], [], [], []
    for sign, (a, b), (p, q) in ((1.0, (first, second), (0, 1)), (-1.0, (second, first), (1, 0))):
        change = np.linalg.inv(moves[q]) @ moves[p]
        carried = _carry(change, a.points)
        distance, partner = b.tree.query(
            carried, distance_upper_bound=reach, workers=_threads(carried)
        )
        here = np.flatnonzero(np.isfinite(distance))
        partner = partner[here]
        n = np.einsum("ij,nj->ni", change[:3, :3], a.normals[here])
        m = b.normals[partner]
        agree = np.einsum("ij,ij->i", n, m) >= _AGREE
        here, partner, n, m = here[agree], partner[agree], n[agree], m[agree]
        both = n + m
        both /= np.sqrt(np.einsum("ij,ij->i", both, both))[:, None]
        both = np.einsum("ij,nj->ni", moves[q][:3, :3], both)
        ours, theirs = _carry(moves[p], a.points[here]), _carry(moves[q], b.points[partner])
        places.append((ours + theirs) / 2.0)
        facing.append(both)
        gaps.append(sign * np.einsum("ij,ij->i", theirs - ours, both))
        spread.append(np.einsum("ij,ij->i", n - m, n - m))
    difference = np.concatenate(spread)
    return _Matches(
        np.concatenate(places), np.concatenate(facing), np.concatenate(gaps),
        float(difference.mean()) if len(difference) else 0.0,
    )  # fmt: skip


def _carry(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (N, 3) moved by a 4x4 motion; einsum keeps the sums in one order."""
    turned: np.ndarray = np.einsum("ij,nj->ni", motion[:3, :3], points)
    return turned + motion[:3, 3]


def _overlapping(views: list[_View], reach: float, overlap: float) -> list[tuple[int, int]]:
    """Return the pairs of views that share enough, in order."""
    still = np.tile(np.eye(4), (2, 1, 1))
    pairs = []
    for i, first in enumerate(views):
        for j in range(i + 1, len(views)):
            fewer = min(len(first.points), len(views[j].points))
            if fewer < _LEAST:
                continue
            # Every shared place matches twice, once from either side.
            shared = len(_match(first, views[j], still, reach).gap) / 2.0
            if shared >= max(_LEAST, overlap * fewer):
                pairs.append((i, j))
    return pairs


def _groups(pairs: list[tuple[int, int]], count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first view of every group, the views without a pair, and a mask of both."""
    group = np.arange(count)
    for _ in range(count):
        for i, j in pairs:
            group[[i, j]] = group[[i, j]].min()
    paired = np.zeros(count, bool)
    paired[[v for pair in pairs for v in pair]] = True
    first = (group == np.arange(count)) & paired
    datum, left = np.flatnonzero(first), np.flatnonzero(~paired)
    return datum.astype(np.int32), left.astype(np.int32), first | ~paired


def _equations(found: _Matches, radius: float, least: float = _OPEN) -> _Equations:
    """Return the normal equations of a pair, with robust weights and without open directions."""
    if len(found.gap) == 0:
        return _Equations(np.zeros((6, 6)), np.zeros(6), np.eye(6))
    middle = float(np.median(found.gap))
    scale = 1.4826 * float(np.median(np.abs(found.gap - middle)))
    # The gaps may all be large before the first step, so the scale counts from zero as well.
    scale = max(scale, 1.4826 * float(np.median(np.abs(found.gap))), 1e-9)
    weight = np.maximum(1.0 - (found.gap / (_TUKEY * scale)) ** 2, 0.0) ** 2
    lever = np.cross(found.place, found.normal) / radius
    jacobian = np.concatenate([lever, found.normal], axis=1)
    matrix = np.einsum("n,ni,nj->ij", weight, jacobian, jacobian)
    right = np.einsum("n,ni,n->i", weight, jacobian, found.gap)
    share, axes = np.linalg.eigh(matrix / max(float(weight.sum()), 1e-300))
    # Noise of the normals looks like a little curvature; what is not clearly more is open.
    closed = axes[:, share >= max(least, found.spread)]
    projector = closed @ closed.T
    loose = axes[:, share < max(least, found.spread)]
    return _Equations(projector @ matrix @ projector, projector @ right, loose)


def _solve(
    pairs: list[tuple[int, int]], equations: list[_Equations], fixed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the twists of all views that fit all pairs best, and how many directions are open.

    Only differences of the motions of two views enter, so the system is that of a graph. What it
    leaves open beside the fixed views is not moved along.
    """
    count = len(fixed)
    system, right = np.zeros((count, 6, count, 6)), np.zeros((count, 6))
    for (i, j), pair in zip(pairs, equations, strict=True):
        system[i, :, i] += pair.matrix
        system[j, :, j] += pair.matrix
        system[i, :, j] -= pair.matrix
        system[j, :, i] -= pair.matrix
        right[i] += pair.right
        right[j] -= pair.right
    free = np.flatnonzero(~fixed)
    twists, loose = np.zeros((count, 6)), np.zeros(count, np.int32)
    if len(free) == 0:
        return twists, loose
    block = system[free][:, :, free].reshape(6 * len(free), -1)
    # Views of many and of few points get one scale, so that one limit fits all.
    size = np.sqrt(np.maximum(np.diag(block).reshape(-1, 6).sum(axis=1), 1e-300)).repeat(6)
    values, axes = np.linalg.eigh(block / size[:, None] / size[None, :])
    held = values > 1e-9 * values[-1]
    along = axes[:, held]
    answer = along @ ((along.T @ (right[free].ravel() / size)) / values[held]) / size
    twists[free] = answer.reshape(-1, 6)
    share = (axes[:, ~held] ** 2).sum(axis=1).reshape(-1, 6).sum(axis=1)
    loose[free] = np.rint(share).astype(np.int32)
    return twists, loose


def _twisted(motion: np.ndarray, twists: np.ndarray, radius: float) -> np.ndarray:
    """Return the motions after small further twists, shape (V, 4, 4)."""
    from scipy.spatial.transform import Rotation

    step = np.tile(np.eye(4), (len(twists), 1, 1))
    step[:, :3, :3] = Rotation.from_rotvec(twists[:, :3] / radius).as_matrix()
    step[:, :3, 3] = twists[:, 3:]
    still = (twists == 0.0).all(axis=1)
    return np.where(still[:, None, None], motion, step @ motion)


def _displacement(motion: np.ndarray, radius: float) -> np.ndarray:
    """Return how far motions carry points at most, in root mean square over the part [mm]."""
    turn = np.linalg.norm(motion[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(2.0)
    return np.hypot(np.linalg.norm(motion[:, :3, 3], axis=1), turn * radius)


def _aligned_pairs(
    small_gicp: Any,
    views: list[_View],
    pairs: list[tuple[int, int]],
    reach: float,
    radius: float,
    fixed: np.ndarray,
    least: float,
) -> np.ndarray:
    """Return the motions that agree best with the ICP of every pair, shape (V, 4, 4)."""
    from scipy.spatial.transform import Rotation

    still = np.tile(np.eye(4), (2, 1, 1))
    clouds: dict[int, Any] = {}
    for v in sorted({v for pair in pairs for v in pair}):
        step = -(-len(views[v].points) // _START)
        cloud = small_gicp.PointCloud(np.ascontiguousarray(views[v].points[::step]))
        tree = small_gicp.KdTree(cloud)  # one thread: the same tree in every run
        small_gicp.estimate_normals_covariances(cloud, tree, num_neighbors=20, num_threads=1)
        clouds[v] = (cloud, tree)
    wanted = []
    for i, j in pairs:
        found = small_gicp.align(
            clouds[j][0], clouds[i][0], clouds[j][1], registration_type="GICP",
            max_correspondence_distance=reach, num_threads=1, max_iterations=40,
            rotation_epsilon=1e-6, translation_epsilon=1e-5,
        )  # fmt: skip
        change = np.asarray(found.T_target_source)
        turn = Rotation.from_matrix(change[:3, :3]).as_rotvec() * radius
        pair = _equations(_match(views[i], views[j], still, reach), radius, least)
        right = np.einsum("ij,j->i", pair.matrix, np.concatenate([turn, change[:3, 3]]))
        wanted.append(pair._replace(right=right))
    return _twisted(np.tile(np.eye(4), (len(fixed), 1, 1)), _solve(pairs, wanted, fixed)[0], radius)


def _jointly(
    views: list[_View],
    pairs: list[tuple[int, int]],
    motion: np.ndarray,
    reach: float,
    radius: float,
    fixed: np.ndarray,
    least: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the motions after joint steps from point to plane, and the directions left open."""
    loose = np.zeros(len(fixed), np.int32)
    for number in range(_ROUNDS):
        wide = reach * 0.5**number
        equations = []
        for i, j in pairs:
            near = _near(views, i, j, reach)
            found = _match(views[i], views[j], motion[[i, j]], max(near, wide))
            equations.append(_equations(found, radius, least))
        twists, loose = _solve(pairs, equations, fixed)
        motion = _twisted(motion, twists, radius)
        if wide <= near and float(np.abs(twists).max(initial=0.0)) < _STILL:
            break
    return motion, loose


def _near(views: list[_View], i: int, j: int, reach: float) -> float:
    """Return how far a partner may be once the views lie on each other [mm]."""
    return min(reach, _NEAR * max(views[i].spacing, views[j].spacing))


def _residuals(
    views: list[_View], pairs: list[tuple[int, int]], motion: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return number of matches and root mean square distance [mm] of every pair, shape (P,)."""
    count, rms = [], []
    for i, j in pairs:
        found = _match(views[i], views[j], motion[[i, j]], reach)
        count.append(len(found.gap))
        mean = float(np.einsum("i,i->", found.gap, found.gap)) / max(len(found.gap), 1)
        rms.append(np.sqrt(mean) if len(found.gap) else np.nan)
    return np.array(count, np.int32), np.array(rms, np.float64)


def _cost(
    views: list[_View], pairs: list[tuple[int, int]], motion: np.ndarray, reach: float
) -> float:
    """Return the median distance from point to plane over all pairs [mm]."""
    gaps = [np.abs(_match(views[i], views[j], motion[[i, j]], reach).gap) for i, j in pairs]
    together = np.concatenate(gaps)
    return float(np.median(together)) if len(together) else np.inf
