"""Plane, cylinder, cone, sphere and torus through many groups of points at once."""

from dataclasses import dataclass

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, ti
from octoseg_ti.device.surfaces import (
    CONE,
    CYLINDER,
    KINDS,
    PLANE,
    TORUS,
    surface_in_row,
)
from octoseg_ti.fitting.descent import iterate
from octoseg_ti.fitting.motions import FREE, STATE
from octoseg_ti.fitting.starts import gather_moments, starts, with_directions

FREEDOM = FREE.sum(axis=1)
"""Degrees of freedom of every kind."""

TUKEY = 4.685
"""Where the weight of a point ends, in standard deviations: 95 % efficient for normal noise
(Holland & Welsch 1977)."""

_ROUNDS = 12
_BINS = 64  # of distances: quarters of a power of two, up to the extent of the group
_NARROWED = 6  # most times that surfaces are fitted to the spread that they left, the last together
_SETTLED = 0.9  # of the spread before: it is not to shrink any more
_SUMS = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fits:
    """Surfaces of every kind through ``G`` groups; NaN where a group has too few points for one."""

    parameters: np.ndarray
    """As in `Segmentation.parameters`, shape (G, 5, 8), f64, by `SurfaceKind`. The axis of a sphere
    means nothing."""
    rms: np.ndarray
    """Root mean square orthogonal distance [mm], shape (G, 5); of a robust fit, weighted."""
    loss: np.ndarray
    """Mean of what the fit makes least [mm^2], shape (G, 5): the square of a distance; of a robust
    fit, one that grows no more for points out of reach. The kinds of a group can be compared."""
    tilt: np.ndarray
    """Root mean square sine between measured and surface normals, shape (G, 5)."""
    side: np.ndarray
    """Mean cosine between measured and outward surface normals, shape (G, 5): about 1 on a boss,
    -1 in a hole; nearer to 0 the normals disagree or have no sign."""
    inside: np.ndarray
    """Share of the weight that is within reach of the surface, shape (G, 5); 1 for least
    squares."""
    count: np.ndarray
    """Samples, shape (G,)."""
    extent: np.ndarray
    """Root mean square distance of the samples from their centre [mm], shape (G,)."""


@ti.kernel
def _judge(
    tasks: ti.i32,
    stride: ti.i32,
    # In:
    point_in: F64Rows,
    normal_in: F64Rows,
    weight_in: F64Array,
    start_in: I32Array,
    parameters_in: F64Rows,
    reach_in: F64Array,
    # Out:
    sum_out: F64Rows,
):
    """Sum weights, losses, squares of distances, and cosines of normals over every group."""
    for e in range(tasks * stride):
        if e % stride == 0:
            t = e // stride
            reach = reach_in[t]
            weights = vec3(0.0, 0.0, 0.0)
            squares = vec3(0.0, 0.0, 0.0)
            signed = 0.0
            size = 0.0
            for i in range(start_in[t // KINDS], start_in[t // KINDS + 1]):
                d, n = surface_in_row(parameters_in, t, t % KINDS, row(point_in, i))
                w = weight_in[i]
                left = 1.0
                loss = d * d
                if reach < 1e300:
                    left = ti.max(1.0 - loss / (reach * reach), 0.0)
                    loss = reach * reach * (1.0 - left * left * left) / 3.0
                m = row(normal_in, i)
                c = m.dot(n)
                v = w * left * left
                weights += vec3(w, ti.select(left > 0.0, w, 0.0), v)
                squares += vec3(w * loss, v * d * d, v * c * c)
                signed += v * c
                size += v * m.norm_sqr()
            for k in ti.static(range(3)):
                sum_out[t, k] = weights[k]
                sum_out[t, 3 + k] = squares[k]
            sum_out[t, 6] = signed
            sum_out[t, 7] = size


@ti.kernel
def _count_distances(
    tasks: ti.i32,
    groups: ti.i32,
    stride: ti.i32,
    # In:
    point_in: F64Rows,
    weight_in: F64Array,
    start_in: I32Array,
    parameters_in: F64Rows,
    least_in: F64Array,
    # Out:
    bin_inout: I32Array,
):
    """Count the points of every group by the logarithm of their distance, try after try."""
    for e in range(tasks * stride):
        if e % stride == 0:
            t = e // stride
            g = t // KINDS % groups
            for i in range(start_in[g], start_in[g + 1]):
                d, _ = surface_in_row(parameters_in, t, t % KINDS, row(point_in, i))
                ratio = ti.abs(d) / least_in[g]
                if weight_in[i] > 0.0:
                    k = 0
                    if ratio > 1.0:
                        k = ti.min(ti.cast(4.0 * ti.log(ratio) / ti.log(2.0), ti.i32), _BINS - 1)
                    k += t * _BINS
                    bin_inout[k] = bin_inout[k] + 1


def to_parameters(state: np.ndarray, centre: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Return states as parameters of surfaces.

    Args:
        state: As of `iterate`, shape (..., G, KINDS, STATE).
        centre: Centre of every group [mm], shape (G, 3).
        extent: Extent of every group [mm], shape (G,).

    Returns:
        As in `Segmentation.parameters`, shape (..., G, KINDS, 8).
    """
    parameters = np.full((*state.shape[:-1], 8), np.nan)
    point, axis = state[..., :3].copy(), state[..., 3:6].copy()
    # The line of a cone with its normal away from the axis, and the axis out of the apex.
    h, s = state[..., CONE, 9], state[..., CONE, 10]
    cosine, sine = np.cos(h), np.sin(h)
    side = np.where(cosine < 0.0, -1.0, 1.0)
    sine, s = sine * side, s * side
    axis[..., CONE, :] *= np.where(sine < 0.0, -1.0, 1.0)[..., None]
    sine = np.maximum(np.abs(sine), 1e-6)
    point[..., CONE, :] -= (s / sine)[..., None] * axis[..., CONE, :]
    parameters[..., :3] = centre[:, None, :] + extent[:, None, None] * point
    parameters[..., 3:6] = axis
    parameters[..., 6] = extent[:, None] * state[..., 9]
    parameters[..., CONE, 6] = np.arctan2(sine, np.abs(cosine))
    parameters[..., PLANE, 6] = np.nan
    parameters[..., TORUS, 7] = extent * state[..., TORUS, 10]
    return parameters


def to_states(
    kind: np.ndarray, parameters: np.ndarray, centre: np.ndarray, extent: np.ndarray
) -> np.ndarray:
    """Return surfaces as states of their kinds: `to_parameters` the other way round.

    Args:
        kind: `SurfaceKind` of every group, one of the five analytic kinds, shape (G,).
        parameters: As in `Segmentation.parameters`, shape (G, 8).
        centre: Centre of every group [mm], shape (G, 3).
        extent: Extent of every group [mm], shape (G,).

    Returns:
        As of `iterate`, shape (G, KINDS, STATE); NaN for the other kinds.
    """
    rows, e = np.arange(len(kind)), extent[:, None]
    point, axis = (parameters[:, :3] - centre) / e, parameters[:, 3:6]
    height = np.einsum("gi,gi->g", point, axis)
    # What moves on along the axis is beside the centre, the point of a plane nearest to it.
    flat, free = kind == PLANE, (kind == CYLINDER) | (kind == CONE)
    point = np.where(flat[:, None], height[:, None] * axis, point)
    point = np.where(free[:, None], point - height[:, None] * axis, point)
    own = np.zeros((len(kind), STATE))
    own[:, :3], own[:, 3:6] = point, axis
    own[:, 9] = np.where(flat, 0.0, parameters[:, 6] / extent)
    own[:, 10] = np.where(kind == TORUS, parameters[:, 7] / extent, 0.0)
    cone = kind == CONE
    own[cone, 9] = parameters[cone, 6]
    own[cone, 10] = -height[cone] * np.sin(parameters[cone, 6])
    state = np.full((len(kind), KINDS, STATE), np.nan)
    state[rows, kind] = own
    return with_directions(state)


class _Samples:
    """The samples of all groups, ready for kernels."""

    def __init__(
        self, points: np.ndarray, normals: np.ndarray, weight: np.ndarray, start: np.ndarray
    ) -> None:
        self.groups = len(start) - 1
        self.points, self.normals = runtime.upload(points), runtime.upload(normals)
        self.weight, self.start = runtime.upload(weight), runtime.upload(start)

    def spread(self, parameters: np.ndarray, extent: np.ndarray) -> np.ndarray:
        """Return the median absolute distance as a standard deviation [mm], to a tenth.

        Args:
            parameters: Of several tries, shape (T, G, 5, 8).
            extent: Extent of every group [mm], shape (G,).

        Returns:
            Shape (T, G, 5).
        """
        tasks = parameters.size // 8
        bins = runtime.zeros(tasks * _BINS, np.int32)
        least = extent / 2.0 ** (_BINS / 4)
        models = runtime.upload(parameters.reshape(tasks, 8))
        _count_distances(
            tasks,
            self.groups,
            runtime.workers()[1],
            self.points,
            self.weight,
            self.start,
            models,
            runtime.upload(least),
            bins,
        )
        counts = runtime.download(bins)[: tasks * _BINS].reshape(*parameters.shape[:-1], _BINS)
        below = np.cumsum(counts, axis=-1)
        half = np.argmax(2 * below >= below[..., -1:], axis=-1)
        half[~np.isfinite(parameters[..., 0])] = _BINS
        return 1.4826 * least[:, None] * 2.0 ** ((half + 0.5) / 4.0)

    def sums(self, parameters: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return the sums of `_judge`, shape (G, 5, _SUMS)."""
        tasks = self.groups * KINDS
        sums = runtime.empty((tasks, _SUMS), np.float64)
        _judge(
            tasks,
            runtime.workers()[1],
            self.points,
            self.normals,
            self.weight,
            self.start,
            runtime.upload(parameters.reshape(tasks, 8)),
            runtime.upload(reach.reshape(tasks)),
            sums,
        )
        return runtime.download(sums)[:tasks].reshape(self.groups, KINDS, _SUMS)


def fit_all(
    points: np.ndarray,
    normals: np.ndarray,
    weight: np.ndarray | None,
    start: np.ndarray,
    *,
    noise: float | np.ndarray = 0.0,
    robust: bool = False,
) -> Fits:
    """Fit every analytic kind to every group of points, by least orthogonal distances.

    Args:
        points: Samples of the groups, one group after the other [mm], shape (S, 3), f64.
        normals: Measured normals, shape (S, 3), f64; zero where there is none. They help to start,
            and are compared with the surfaces; their sign only decides about the side.
        weight: Weight of every sample, shape (S,), f64, not negative; None = 1.
        start: First sample of every group, and S at the end, shape (G + 1,), i32.
        noise: Deviation of a point from its surface [mm], of all or of every group, shape (G,):
            the least scale by which ``robust`` judges a point. Give it: a robust fit to exact data
            may settle on a few points that happen to agree.
        robust: Take the weight from points far off (Tukey's biweight, scale from the median
            distance), so that up to a fifth of the points may belong to something else.

    Returns:
        The fits; nearly flat groups get spheres and cylinders of huge radius, never infinite ones.
        A kind that is far behind another one of the same group is not followed to its least rms.
    """
    runtime.ensure_started()
    groups = len(start) - 1
    points = np.ascontiguousarray(points, np.float64)
    normals = np.ascontiguousarray(normals, np.float64)
    weight = np.ones(len(points)) if weight is None else np.asarray(weight, np.float64)
    start = np.ascontiguousarray(start, np.int32)
    m = gather_moments(points, normals, weight, start)
    extent = np.where(m.extent > 0.0, m.extent, 1.0)
    frame = np.column_stack((m.centre, 1.0 / extent))
    samples = _Samples(points, normals, weight, start)
    given = samples.points, samples.weight, start, frame
    reach = np.full((groups, KINDS), np.inf)
    first = starts(points, normals, weight, start, m)
    state = iterate(*given, reach, first, rounds=_ROUNDS, whole=not robust, leave=not robust)
    scale = np.broadcast_to(np.asarray(noise, np.float64), groups)[:, None]
    # Least squares may have followed the outliers to a wrong place: then a start is better.
    tries = np.concatenate((state[None], first)) if robust else state[None]
    before, last = np.full((groups, KINDS), np.inf), not robust
    for narrowed in range(1, _NARROWED + 1):
        if last:
            break
        spreads = samples.spread(to_parameters(tries, m.centre, extent), extent)
        spread = np.maximum(spreads.min(axis=0), scale)
        last = narrowed == _NARROWED or bool(np.all(spread > _SETTLED * before))
        before = spread
        if last:
            spread = np.repeat(spread.min(axis=1, keepdims=True), KINDS, axis=1)
        reach = TUKEY * spread
        state = iterate(
            *given, reach / extent[:, None], tries, rounds=_ROUNDS, whole=last, leave=False
        )
        tries = state[None]
    parameters = to_parameters(state, m.centre, extent)
    sums = samples.sums(parameters, reach)
    count = np.diff(start)
    total, counted, size = (np.maximum(sums[..., k], 1e-300) for k in (0, 2, 7))
    rms = np.sqrt(sums[..., 4] / counted)
    bad = (count[:, None] <= FREEDOM[None, :]) | ~np.isfinite(rms)
    return Fits(
        parameters=np.where(bad[..., None], np.nan, parameters),
        rms=np.where(bad, np.nan, rms),
        loss=np.where(bad, np.nan, sums[..., 3] / total),
        tilt=np.where(bad, np.nan, np.sqrt(np.maximum(1.0 - sums[..., 5] / size, 0.0))),
        side=np.where(bad, np.nan, sums[..., 6] / size),
        inside=np.where(bad, np.nan, sums[..., 1] / total),
        count=count,
        extent=extent,
    )
