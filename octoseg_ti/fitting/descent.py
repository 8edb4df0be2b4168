"""Moves surfaces until the squares of the orthogonal distances of points to them are least.

Levenberg-Marquardt (Marquardt 1963), one surface a task and serial inside, so that no sum depends
on threads.
"""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, ti
from octoseg_ti.device.surfaces import (
    CONE,
    CYLINDER,
    KINDS,
    PLANE,
    SPHERE,
    TORUS,
    cone_shape,
    vec4,
)
from octoseg_ti.fitting.motions import (
    STATE,
    UNKNOWNS,
    anchor_radius,
    bounded,
    change_of_distance,
    is_free,
    step_state,
    vec7,
)

_SOME = 100  # points that the first passes look at
_PATIENCE, _AGAIN = 4, 2  # passes until it is seen which kinds may be left, and until the next time
_LEAVE = 4.0  # a kind that is so many times worse than another, in mean square, may be left
_REST = 0.02  # the gain of a step, in variances of a point, that moves nothing worth telling
_EXACT = 1e-26  # mean square distance, in extents, that is rounding
_FAR = 1e4  # a surface that runs farther off, in extents, is left there
_DAMPING_START, _WORST = 1e-2, 1e9  # at the worst no step helps any more

# Columns of the work of a task: two states (the best and the one on trial), each with its sum of
# squares, gradient and normal equations (lower triangle by rows), then the damping and a factor.
_COST, _GRADIENT, _NORMAL = STATE, STATE + 1, STATE + 1 + UNKNOWNS
_BLOCK = _NORMAL + 28
_FACTOR = 2 * _BLOCK
_STEP = _FACTOR + 28
_DAMPING, _GAIN = _STEP + UNKNOWNS, _STEP + UNKNOWNS + 1
_WORK = _GAIN + 1

vec28 = ti.types.vector(28, ti.f64)


@ti.func
def _triple(rows: ti.template(), i: ti.i32, at: ti.i32) -> vec3:
    """Return three numbers of row ``i`` from column ``at`` on."""
    return vec3(rows[i, at], rows[i, at + 1], rows[i, at + 2])


@ti.func
def _shape(kind: ti.i32, work: ti.template(), t: ti.i32, at: ti.i32) -> vec4:
    """Return the shape of the state in column ``at`` as `profile` reads it."""
    shape = vec4(work[t, at + 9], work[t, at + 10], 0.0, 0.0)
    if kind == CONE:
        shape = cone_shape(shape[0], shape[1])
    return shape


@ti.func
def _linearise(
    t: ti.i32,
    every: ti.i32,
    points: ti.template(),
    weights: ti.template(),
    starts: ti.template(),
    frames: ti.template(),
    reach: ti.f64,
    work: ti.template(),
):
    """Write cost, gradient and normal equations of the state on trial.

    The reach is where the weight of a point ends (Tukey's biweight); infinite = least squares.
    """
    kind = t % KINDS
    g = t // KINDS
    origin = _triple(work, t, _BLOCK)
    axis = _triple(work, t, _BLOCK + 3)
    u = _triple(work, t, _BLOCK + 6)
    shape = _shape(kind, work, t, _BLOCK)
    anchor = anchor_radius(kind, origin, axis, shape)
    scale = frames[g, 3]
    origin = row(frames, g) + origin / scale
    axis = scale * axis
    v = axis.cross(u)
    u = scale * u
    cost = 0.0
    gradient = vec7(0.0)
    normal = vec28(0.0)
    for k in range((starts[g + 1] - starts[g] + every - 1) // every):
        i = starts[g] + k * every
        p = row(points, i) - origin
        local = vec3(p.dot(u), p.dot(v), p.dot(axis))
        d, j = change_of_distance(kind, local, shape, anchor)
        w = weights[i]
        if reach < 1e300:
            left = ti.max(1.0 - d * d / (reach * reach), 0.0)
            cost += w * reach * reach * (1.0 - left * left * left) / 3.0
            w *= left * left
        else:
            cost += w * d * d
        gradient += (w * d) * j
        for a in ti.static(range(7)):
            wj = w * j[a]
            for b in ti.static(range(a + 1)):
                normal[a * (a + 1) // 2 + b] += wj * j[b]
    work[t, _BLOCK + _COST] = cost
    for a in ti.static(range(7)):
        work[t, _BLOCK + _GRADIENT + a] = gradient[a]
    for a in ti.static(range(28)):
        work[t, _BLOCK + _NORMAL + a] = normal[a]


@ti.func
def _solve_step(kind: ti.i32, damping: ti.f64, work: ti.template(), t: ti.i32):
    """Write the damped step from the best state: Cholesky with loops, small to compile."""
    for a in range(7):
        for b in range(a + 1):
            k = a * (a + 1) // 2 + b
            s = 0.0
            if is_free(kind, a) == 1 and is_free(kind, b) == 1:
                s = work[t, _NORMAL + k]
            if a == b:
                s = s * (1.0 + damping) + 1e-300
            for c in range(b):
                s -= (
                    work[t, _FACTOR + a * (a + 1) // 2 + c]
                    * (work[t, _FACTOR + b * (b + 1) // 2 + c])
                )
            if a == b:
                # What no point holds is not moved.
                whole = work[t, _NORMAL + k]
                if is_free(kind, a) == 0 or s <= 1e-14 * whole or s <= 1e-290:
                    s = 1e30
                s = ti.sqrt(s)
            else:
                s = s / work[t, _FACTOR + b * (b + 1) // 2 + b]
            work[t, _FACTOR + k] = s
    for a in range(7):
        s = 0.0
        if is_free(kind, a) == 1:
            s = -work[t, _GRADIENT + a]
        for c in range(a):
            s -= work[t, _FACTOR + a * (a + 1) // 2 + c] * work[t, _STEP + c]
        work[t, _STEP + a] = s / work[t, _FACTOR + a * (a + 1) // 2 + a]
    for back in range(7):
        a = 6 - back
        s = work[t, _STEP + a]
        for c in range(a + 1, 7):
            s -= work[t, _FACTOR + c * (c + 1) // 2 + a] * work[t, _STEP + c]
        work[t, _STEP + a] = s / work[t, _FACTOR + a * (a + 1) // 2 + a]


@ti.func
def _try_step(kind: ti.i32, work: ti.template(), t: ti.i32):
    """Write the state that the step leads to, on trial; of infinite cost where it is none."""
    step = vec7(0.0)
    for k in ti.static(range(7)):
        step[k] = work[t, _STEP + k]
    step = bounded(kind, step)
    shape = _shape(kind, work, t, 0)
    origin, axis, u, a, b = step_state(
        kind, _triple(work, t, 0), _triple(work, t, 3), _triple(work, t, 6), shape, step
    )
    for k in ti.static(range(3)):
        work[t, _BLOCK + k] = origin[k]
        work[t, _BLOCK + 3 + k] = axis[k]
        work[t, _BLOCK + 6 + k] = u[k]
    work[t, _BLOCK + 9] = a
    work[t, _BLOCK + 10] = b
    possible = origin.norm() <= _FAR and ti.abs(a) <= _FAR
    if kind == TORUS and b <= 0.0:
        possible = False
    work[t, _BLOCK + _COST] = 0.0
    if not possible:
        work[t, _BLOCK + _COST] = ti.math.inf


@ti.func
def _keep_better(work: ti.template(), t: ti.i32):
    """Keep the state on trial if it is better than the best; note what it gained."""
    before = work[t, _COST]
    after = work[t, _BLOCK + _COST]
    damping = work[t, _DAMPING]
    gain = 1.0
    if after <= before:
        for c in range(_BLOCK):
            work[t, c] = work[t, _BLOCK + c]
        damping = ti.max(0.1 * damping, 1e-12)
        if before < 1e300:
            gain = (before - after) / ti.max(before, 1e-300)
    else:
        damping *= 10.0
    if damping > _WORST:
        gain = 0.0
    work[t, _DAMPING] = damping
    work[t, _GAIN] = gain


@ti.kernel
def _descend(
    tasks: ti.i32,
    stride: ti.i32,
    rounds: ti.i32,
    # In:
    task_in: I32Array,
    point_in: F64Rows,
    weight_in: F64Array,
    start_in: I32Array,
    every_in: I32Array,
    frame_in: F64Rows,
    reach_in: F64Array,
    # Out:
    work_inout: F64Rows,
):
    """Let every task listed take so many steps, or fewer where it comes to rest."""
    for e in range(tasks * stride):
        if e % stride == 0:
            t = task_in[e // stride]
            g = t // KINDS
            every = every_in[g]
            seen = (start_in[g + 1] - start_in[g] + every - 1) // every
            most = rounds
            if t % KINDS == PLANE and reach_in[t] >= 1e300:
                most = 1  # its start is the solution
            for _ in range(most):
                if work_inout[t, _BLOCK + _COST] < 1e300:
                    _linearise(
                        t, every, point_in, weight_in, start_in, frame_in, reach_in[t], work_inout
                    )
                _keep_better(work_inout, t)
                _solve_step(t % KINDS, work_inout[t, _DAMPING], work_inout, t)
                _try_step(t % KINDS, work_inout, t)
                if work_inout[t, _GAIN] * seen <= _REST or work_inout[t, _COST] <= _EXACT * seen:
                    break


def _contained(cost: np.ndarray) -> np.ndarray:
    """Return the least cost of the simpler kinds that every kind can look like, (G, KINDS)."""
    simpler = np.full_like(cost, np.inf)
    simpler[:, [CYLINDER, SPHERE]] = cost[:, [PLANE]]
    for kind in (CONE, TORUS):
        simpler[:, kind] = cost[:, [PLANE, CYLINDER]].min(axis=1)
    simpler[:, TORUS] = np.minimum(simpler[:, TORUS], cost[:, SPHERE])
    return simpler


class _Run:
    """Fits under way: the work of every task, and which still move."""

    def __init__(
        self, data: list[Any], state: np.ndarray, count: np.ndarray, robust: bool, leave: bool
    ) -> None:
        self.robust, self.leave = robust, leave
        self.data, self.groups, self.count = data, len(count), count
        self.work = np.zeros((self.groups * KINDS, _WORK))
        self.work[:, :STATE] = state.reshape(-1, STATE)
        self.work[:, _COST] = np.inf
        self.going = np.isfinite(state[..., 0]) & (count > 0)[:, None]

    @property
    def cost(self) -> np.ndarray:
        """Sums of squares, (G, KINDS); infinite where there was nothing to start from."""
        return self.work[:, _COST].reshape(self.groups, KINDS)

    def take(self, other: "_Run") -> None:
        """Take over what another run has fitted better."""
        better = other.cost < 0.999 * self.cost
        self.work[better.ravel()] = other.work[better.ravel()]
        self.going |= better

    def improve(self, every: np.ndarray, rounds: int) -> None:
        """Let what moves come to rest, seen by every so manieth point of its group."""
        self.work[:, _BLOCK : _BLOCK + STATE] = self.work[:, :STATE]
        self.work[:, _BLOCK + _COST] = 0.0
        self.work[:, _COST] = np.where(self.going.ravel(), np.inf, self.work[:, _COST])
        self.work[:, _DAMPING] = _DAMPING_START
        going = self.going.copy()
        going[:, PLANE] &= self.robust  # else its start is the solution
        device, stride = runtime.upload(self.work), runtime.workers()[1]
        points, weight, start, frame, reach = self.data
        data = points, weight, start, runtime.upload(every), frame, reach
        seen = (-(-self.count // every))[:, None]
        active = np.flatnonzero(self.going).astype(np.int32)
        passes = _PATIENCE if self.leave else rounds
        while len(active) and rounds > 0:
            passes = min(passes, rounds)
            _descend(len(active), stride, passes, runtime.upload(active), *data, device)
            self.work = runtime.download(device)[: self.groups * KINDS]
            cost, gain = self.cost, self.work[:, _GAIN].reshape(self.groups, KINDS)
            going &= (gain * seen > _REST) & (cost > _EXACT * seen)
            if self.leave:
                worse = cost > _LEAVE * cost.min(axis=1, keepdims=True)
                left = (gain < 0.1) & (worse | (cost >= _contained(cost)))
                left[:, PLANE] = False
                self.going &= ~left
                going &= ~left
            rounds, passes = rounds - passes, _AGAIN
            active = np.flatnonzero(going).astype(np.int32)


def iterate(
    points: np.ndarray,
    weight: np.ndarray,
    start: np.ndarray,
    frame: np.ndarray,
    reach: np.ndarray,
    state: np.ndarray,
    *,
    rounds: int,
    thin: bool = True,
    whole: bool = True,
    leave: bool = True,
) -> np.ndarray:
    """Fit every kind to every group, from given states on.

    First some hundred points of each group are fitted, then all of them. A kind that is far behind
    another, or behind a simpler one that it contains, and gains little is left where it is.

    Args:
        points: Positions [mm], shape (S, 3), f64.
        weight: Weights, shape (S,), f64.
        start: First sample of every group, and S at the end, shape (G + 1,), i32.
        frame: Centre [mm] and 1 / extent of every group, shape (G, 4), f64.
        reach: Distance at which the weight of a point ends, in extents, shape (G, KINDS);
            infinite = least squares.
        state: Where to start, shape (T, G, KINDS, STATE): the first try, and others for what may
            come to rest in a wrong place; NaN = none.
        rounds: Most passes over the points, of either sort.
        thin: Look at some of the points first, where there are many.
        whole: Look at all the points in the end.
        leave: Leave kinds that fall behind; not for a robust fit, as outliers favour some kinds.

    Returns:
        The states, shape (G, KINDS, STATE).
    """
    runtime.ensure_started()
    groups, count = len(start) - 1, np.diff(start)
    flat = np.ascontiguousarray(reach.reshape(groups * KINDS))
    data = [runtime.upload(a) for a in (points, weight, start, frame, flat)]
    robust = bool(np.isfinite(flat).any())
    run = _Run(data, state[0], count, robust, leave)
    every = np.maximum(count // _SOME, 1).astype(np.int32)
    if thin and (np.any(every > 1) or len(state) > 1 or not whole):
        run.improve(every, rounds)
    for again in state[1:]:
        other = _Run(data, again, count, robust, False)
        flat_enough = run.cost[:, PLANE] <= _LEAVE * run.cost.min(axis=1)
        other.going &= ~(flat_enough[:, None] & leave)
        other.improve(every, rounds)
        run.take(other)
    if whole:
        run.improve(np.ones(groups, np.int32), rounds)
    return run.work.reshape(groups, KINDS, _WORK)[..., :STATE]
