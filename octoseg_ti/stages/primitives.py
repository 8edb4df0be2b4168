"""Plane, cylinder, cone, sphere and torus through many groups of points at once."""

from dataclasses import dataclass

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, ti
from octoseg_ti.device.surfaces import CONE, CYLINDER, KINDS, SPHERE, TORUS, surface_at
from octoseg_ti.stages.fitting import FREE, TUKEY, iterate
from octoseg_ti.stages.starts import gather_moments, starts

UNKNOWNS = FREE.sum(axis=1)
"""Degrees of freedom of every kind."""

_ROUNDS = 12
_SPREAD_BINS = 64  # quarters of a power of two, from the smallest spread that is told apart


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fits:
    """Surfaces of every kind through ``G`` groups; NaN where a group has too few points for one."""

    parameters: np.ndarray
    """As in `Segmentation.parameters`, shape (G, 5, 8), f64, by `SurfaceKind`."""
    rms: np.ndarray
    """Root mean square orthogonal distance [mm], shape (G, 5), of the points that count."""
    tilt: np.ndarray
    """Root mean square sine between measured and surface normals, shape (G, 5)."""
    side: np.ndarray
    """Mean cosine between measured and outward surface normals, shape (G, 5): about 1 on a boss,
    -1 in a hole; nearer to 0 the normals disagree or have no sign."""
    inside: np.ndarray
    """Share of the weight that is within reach of the surface, shape (G, 5); 1 for least
    squares."""
    normal: np.ndarray
    """J'WJ at the solution, for its shift [mm], tilt and shape, shape (G, 5, 7, 7)."""
    count: np.ndarray
    """Points with weight, shape (G,)."""


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
    bin_inout: I32Array,
    sum_out: F64Rows,
):
    """Sum weights, squares of distances, sines and cosines of normals; bin the distances."""
    for u in range(tasks * stride):
        if u % stride == 0:
            t = u // stride
            g = t // KINDS
            origin = row(parameters_in, t)
            axis = vec3(parameters_in[t, 3], parameters_in[t, 4], parameters_in[t, 5])
            least = parameters_in[t, 8]
            total = 0.0
            within = 0.0
            square = 0.0
            signed = 0.0
            cosine = 0.0
            counted = 0.0
            size = 0.0
            for i in range(start_in[g], start_in[g + 1]):
                d, n = surface_at(
                    t % KINDS,
                    row(point_in, i),
                    origin,
                    axis,
                    parameters_in[t, 6],
                    parameters_in[t, 7],
                )
                w = weight_in[i]
                total += w
                left = ti.max(1.0 - (d / reach_in[t]) ** 2, 0.0)
                if left > 0.0:
                    within += w
                w *= left * left
                counted += w
                square += w * d * d
                m = row(normal_in, i)
                c = m.dot(n)
                signed += w * c
                cosine += w * c * c
                size += w * m.norm_sqr()
                if least > 0.0 and weight_in[i] > 0.0:
                    k = ti.cast(4.0 * ti.log(ti.max(ti.abs(d) / least, 1.0)) / ti.log(2.0), ti.i32)
                    k = t * _SPREAD_BINS + ti.min(ti.max(k, 0), _SPREAD_BINS - 1)
                    bin_inout[k] = bin_inout[k] + 1
            sum_out[t, 0] = total
            sum_out[t, 1] = within
            sum_out[t, 2] = square
            sum_out[t, 3] = signed
            sum_out[t, 4] = cosine
            sum_out[t, 5] = counted
            sum_out[t, 6] = size


def to_parameters(state: np.ndarray, centre: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Return states as parameters of surfaces.

    Args:
        state: As of `iterate`, shape (G, KINDS, STATE).
        centre: Centre of every group [mm], shape (G, 3).
        extent: Extent of every group [mm], shape (G,).

    Returns:
        As in `Segmentation.parameters`, shape (G, KINDS, 8).
    """
    parameters = np.full((*state.shape[:2], 8), np.nan)
    e = extent[:, None]
    point, axis = state[..., :3].copy(), state[..., 3:6].copy()
    # The line of a cone with its normal away from the axis and the axis out of the apex.
    h, s = state[:, CONE, 9], state[:, CONE, 10]
    cosine, sine = np.cos(h), np.sin(h)
    side = np.where(cosine < 0.0, -1.0, 1.0)
    sine, s = sine * side, s * side
    axis[:, CONE] *= np.where(sine < 0.0, -1.0, 1.0)[:, None]
    sine = np.maximum(np.abs(sine), 1e-6)
    point[:, CONE] -= (s / sine)[:, None] * axis[:, CONE]
    parameters[..., :3] = centre[:, None, :] + e[..., None] * point
    parameters[..., 3:6] = axis
    parameters[:, CONE, 6] = np.arctan2(sine, np.abs(cosine))
    for kind in (CYLINDER, SPHERE, TORUS):
        parameters[:, kind, 6] = e[:, 0] * state[:, kind, 9]
    parameters[:, TORUS, 7] = e[:, 0] * state[:, TORUS, 10]
    return parameters


def _judged(
    groups: int,
    samples: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    least: np.ndarray,
    reach: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sums of every group and kind, and the median absolute distance."""
    tasks = groups * KINDS
    models = np.column_stack((parameters.reshape(tasks, 8), least.reshape(tasks)))
    bins = runtime.zeros(tasks * _SPREAD_BINS, np.int32)
    sums = runtime.empty((tasks, 7), np.float64)
    points, normals, weight, start = samples
    _judge(
        tasks,
        runtime.workers()[1],
        points,
        normals,
        weight,
        start,
        runtime.upload(models),
        runtime.upload(reach.reshape(tasks)),
        bins,
        sums,
    )
    below = np.cumsum(runtime.download(bins).reshape(tasks, _SPREAD_BINS), axis=1)
    half = np.argmax(2 * below >= below[:, -1:], axis=1).reshape(groups, KINDS)
    median = least * 2.0 ** ((half + 0.5) / 4.0)
    return runtime.download(sums)[:tasks].reshape(groups, KINDS, 7), median


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
            the least scale by which ``robust`` judges a point.
        robust: Take the weight from points far off (Tukey's biweight, scale from the median
            distance), so that up to a fifth of the points may belong to something else.

    Returns:
        The fits; nearly flat groups get spheres and cylinders of huge radius, never infinite ones.
    """
    runtime.ensure_started()
    groups = len(start) - 1
    if weight is None:
        weight = np.ones(len(points))
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    start = np.asarray(start, np.int32)
    m = gather_moments(points, normals, weight, start)
    extent = np.where(m.extent > 0.0, m.extent, 1.0)
    state = starts(points, normals, weight, start, m)
    frame = np.column_stack((m.centre, 1.0 / extent))
    samples = tuple(runtime.upload(a) for a in (points, normals, weight, start))
    held = points, weight, start, frame
    endless = np.full((groups, KINDS), np.inf)
    least = np.repeat(extent[:, None] / 2.0 ** (_SPREAD_BINS / 4), KINDS, axis=1)
    reach = endless
    state, normal = iterate(*held, reach, state, rounds=_ROUNDS)
    scale = np.broadcast_to(np.asarray(noise, np.float64), groups)[:, None]
    for _ in range(3 if robust else 0):
        parameters = to_parameters(state, m.centre, extent)
        median = _judged(groups, samples, parameters, least, endless)[1]
        reach = TUKEY * np.maximum(1.4826 * median, scale)
        state, normal = iterate(*held, reach / extent[:, None], state, rounds=_ROUNDS)
    parameters = to_parameters(state, m.centre, extent)
    sums = _judged(groups, samples, parameters, np.zeros((groups, KINDS)), reach)[0]
    return _fits(parameters, sums, normal, extent, np.diff(start))


def _fits(
    parameters: np.ndarray,
    sums: np.ndarray,
    normal: np.ndarray,
    extent: np.ndarray,
    count: np.ndarray,
) -> Fits:
    """Return what the sums say; NaN where points are too few for the unknowns."""
    few = count[:, None] <= UNKNOWNS[None, :]
    counted, size = np.maximum(sums[..., 5], 1e-300), np.maximum(sums[..., 6], 1e-300)
    rms = np.sqrt(sums[..., 2] / counted)
    # A shift of 1 mm is 1 / extent; so is a change of a length by 1 mm. Turns have no unit.
    unit = np.ones((*rms.shape, FREE.shape[1]))
    unit[..., [0, 1, 2, 5, 6]] = 1.0 / extent[:, None, None]
    unit[:, CONE, 5] = 1.0
    normal = normal * unit[..., :, None] * unit[..., None, :] * (extent**2)[:, None, None, None]
    bad = few | ~np.isfinite(rms)
    return Fits(
        parameters=np.where(bad[..., None], np.nan, parameters),
        rms=np.where(bad, np.nan, rms),
        tilt=np.where(bad, np.nan, np.sqrt(np.maximum(1.0 - sums[..., 4] / size, 0.0))),
        side=np.where(bad, np.nan, sums[..., 3] / size),
        inside=np.where(bad, np.nan, sums[..., 1] / np.maximum(sums[..., 0], 1e-300)),
        normal=normal,
        count=count,
    )
