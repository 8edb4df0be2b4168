"""Moves surfaces until the squares of the orthogonal distances of points to them are least.

Levenberg-Marquardt (Marquardt 1963), one surface a task and serial inside, so that no sum depends
on threads. All kinds share one set of seven unknowns: a shift of the surface (3), two turns that
tilt its axis, two numbers of its shape; a kind leaves out those that do not move it.
"""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec2, vec3
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, ti
from octoseg_ti.device.surfaces import (
    CONE,
    CYLINDER,
    KINDS,
    PLANE,
    SPHERE,
    TORUS,
    cone_shape,
    profile,
    vec4,
)
from octoseg_ti.stages.starts import STATE

UNKNOWNS = 7
FREE = np.zeros((KINDS, UNKNOWNS), bool)
"""Which unknowns move a surface of every kind: shift u, v, axis; turn u, v; shape a, b."""
FREE[PLANE, [2, 3, 4]] = True
FREE[CYLINDER, [0, 1, 3, 4, 5]] = True
FREE[CONE, [0, 1, 3, 4, 5, 6]] = True
FREE[SPHERE, [0, 1, 2, 5]] = True
FREE[TORUS] = True

TUKEY = 4.685
"""Where the weight of a point ends, in standard deviations: 95 % efficient for normal noise."""

_FAR = 1e4  # a surface that runs farther off, in extents, is left there
_WORST = 1e9  # damping at which no step helps any more

# Columns of the work of a task: two states (the best and the one on trial), each with its sum of
# squares, gradient and normal equations (lower triangle by rows), then the damping and a factor.
_COST, _GRADIENT, _NORMAL = STATE, STATE + 1, STATE + 1 + UNKNOWNS
_BLOCK = _NORMAL + 28
_FACTOR = 2 * _BLOCK
_STEP = _FACTOR + 28
WORK = _STEP + UNKNOWNS

vec7 = ti.types.vector(7, ti.f64)
vec28 = ti.types.vector(28, ti.f64)


@ti.func
def _free(kind: ti.i32, k: ti.i32) -> ti.i32:
    """Return 1 if unknown ``k`` moves a surface of this kind; bits in the order of `FREE`."""
    bits = 127
    if kind == PLANE:
        bits = 0b0011100
    elif kind == CYLINDER:
        bits = 0b0111011
    elif kind == CONE:
        bits = 0b1111011
    elif kind == SPHERE:
        bits = 0b0100111
    return (bits >> k) & 1


@ti.func
def _linearise(
    kind: ti.i32,
    g: ti.i32,
    reach: ti.f64,
    point: ti.template(),
    weight: ti.template(),
    start: ti.template(),
    frame: ti.template(),
    work: ti.template(),
    t: ti.i32,
    at: ti.i32,
):
    """Write cost, gradient and normal equations of the state in column ``at``.

    ``reach`` is where the weight of a point ends (Tukey's biweight); infinite = least squares.
    """
    origin = vec3(work[t, at], work[t, at + 1], work[t, at + 2])
    axis = vec3(work[t, at + 3], work[t, at + 4], work[t, at + 5])
    u = vec3(work[t, at + 6], work[t, at + 7], work[t, at + 8])
    v = axis.cross(u)
    shape = vec4(work[t, at + 9], work[t, at + 10], 0.0, 0.0)
    if kind == CONE:
        shape = cone_shape(shape[0], shape[1])
    centre = row(frame, g)
    scale = frame[g, 3]
    cost = 0.0
    gradient = vec7(0.0)
    normal = vec28(0.0)
    for i in range(start[g], start[g + 1]):
        p = (row(point, i) - centre) * scale - origin
        x = p.dot(u)
        y = p.dot(v)
        z = p.dot(axis)
        rho = ti.sqrt(x * x + y * y)
        f = profile(kind, rho, z, shape)
        c = f[1] / ti.max(rho, 1e-12)
        by_shape = vec2(-1.0, -1.0)
        if kind == CONE:
            by_shape = vec2(-rho * shape[3] - z * shape[2], -1.0)
        elif kind == TORUS:
            by_shape = vec2(-f[1], -1.0)
        j = vec7(
            -c * x,
            -c * y,
            -f[2],
            c * y * z - y * f[2],
            x * f[2] - c * x * z,
            by_shape[0],
            by_shape[1],
        )
        w = weight[i]
        square = f[0] * f[0]
        if reach < 1e300:
            left = ti.max(1.0 - square / (reach * reach), 0.0)
            cost += w * reach * reach * (1.0 - left * left * left) / 3.0
            w *= left * left
        else:
            cost += w * square
        wd = w * f[0]
        gradient += wd * j
        for a in ti.static(range(7)):
            wj = w * j[a]
            for b in ti.static(range(a + 1)):
                normal[a * (a + 1) // 2 + b] += wj * j[b]
    work[t, at + _COST] = cost
    for a in ti.static(range(7)):
        work[t, at + _GRADIENT + a] = gradient[a]
    for a in ti.static(range(28)):
        work[t, at + _NORMAL + a] = normal[a]


@ti.func
def _solve_step(kind: ti.i32, damping: ti.f64, work: ti.template(), t: ti.i32):
    """Write the damped step from the best state: Cholesky with loops, small to compile."""
    for a in range(7):
        for b in range(a + 1):
            k = a * (a + 1) // 2 + b
            s = 0.0
            if _free(kind, a) == 1 and _free(kind, b) == 1:
                s = work[t, _NORMAL + k]
            if a == b:
                s = s * (1.0 + damping) + 1e-300
            for c in range(b):
                s -= work[t, _FACTOR + a * (a + 1) // 2 + c] * (
                    work[t, _FACTOR + b * (b + 1) // 2 + c]
                )
            if a == b:
                # What no point holds is not moved.
                whole = work[t, _NORMAL + k]
                if _free(kind, a) == 0 or s <= 1e-14 * whole or s <= 1e-290:
                    s = 1e30
                s = ti.sqrt(s)
            else:
                s = s / work[t, _FACTOR + b * (b + 1) // 2 + b]
            work[t, _FACTOR + k] = s
    for a in range(7):
        s = 0.0
        if _free(kind, a) == 1:
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
def _try_step(work: ti.template(), t: ti.i32):
    """Write the state that the step leads to, on trial."""
    origin = row_at(work, t, 0)
    axis = row_at(work, t, 3)
    u = row_at(work, t, 6)
    v = axis.cross(u)
    step = row_at(work, t, _STEP)
    origin += step[0] * u + step[1] * v + step[2] * axis
    axis = (axis + work[t, _STEP + 4] * u - work[t, _STEP + 3] * v).normalized()
    u = (u - axis.dot(u) * axis).normalized()
    for k in ti.static(range(3)):
        work[t, _BLOCK + k] = origin[k]
        work[t, _BLOCK + 3 + k] = axis[k]
        work[t, _BLOCK + 6 + k] = u[k]
    work[t, _BLOCK + 9] = work[t, 9] + work[t, _STEP + 5]
    work[t, _BLOCK + 10] = work[t, 10] + work[t, _STEP + 6]


@ti.func
def row_at(rows: ti.template(), i: ti.i32, at: ti.i32) -> vec3:
    """Return three numbers of row ``i`` from column ``at`` on."""
    return vec3(rows[i, at], rows[i, at + 1], rows[i, at + 2])


@ti.func
def _possible(kind: ti.i32, work: ti.template(), t: ti.i32) -> ti.i32:
    """Return 1 if the state on trial is a surface, and not farther off than any is followed."""
    ok = 1
    if row_at(work, t, _BLOCK).norm() > _FAR or not (ti.abs(work[t, _BLOCK + 9]) < _FAR):
        ok = 0
    if kind != CONE and (work[t, _BLOCK + 9] < 0.0 or work[t, _BLOCK + 10] < 0.0):
        ok = 0
    return ok


@ti.kernel
def _iterate(
    tasks: ti.i32,
    stride: ti.i32,
    rounds: ti.i32,
    tolerance: ti.f64,
    # In:
    point_in: F64Rows,
    weight_in: F64Array,
    start_in: I32Array,
    frame_in: F64Rows,
    reach_in: F64Array,
    # Out:
    work_inout: F64Rows,
):
    """Improve the best state of every task until steps gain too little or the rounds are over."""
    for u in range(tasks * stride):
        if u % stride == 0 and start_in[u // stride // KINDS + 1] > start_in[u // stride // KINDS]:
            t = u // stride
            g = t // KINDS
            kind = t % KINDS
            damping = 1e-3
            at = 0  # the first round measures the start itself
            k = 0
            while k < rounds:
                k += 1
                fits = 1
                if at > 0:
                    fits = _possible(kind, work_inout, t)
                if fits == 1:
                    _linearise(
                        kind,
                        g,
                        reach_in[t],
                        point_in,
                        weight_in,
                        start_in,
                        frame_in,
                        work_inout,
                        t,
                        at,
                    )
                gain = 1.0
                if at > 0:
                    before = work_inout[t, _COST]
                    after = work_inout[t, _BLOCK + _COST]
                    if fits == 1 and after <= before:
                        for c in range(_BLOCK):
                            work_inout[t, c] = work_inout[t, _BLOCK + c]
                        damping = ti.max(0.1 * damping, 1e-12)
                        gain = (before - after) / ti.max(before, 1e-300)
                    else:
                        damping = damping * 10.0
                if gain <= tolerance or damping > _WORST:
                    k = rounds
                else:
                    _solve_step(kind, damping, work_inout, t)
                    _try_step(work_inout, t)
                    at = _BLOCK


def iterate(
    points: np.ndarray,
    weight: np.ndarray,
    start: np.ndarray,
    frame: np.ndarray,
    reach: np.ndarray,
    state: np.ndarray,
    *,
    rounds: int,
    tolerance: float = 1e-7,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit every kind to every group, from given states on.

    Args:
        points: Positions [mm], shape (S, 3), f64.
        weight: Weights, shape (S,), f64.
        start: First sample of every group, and S at the end, shape (G + 1,), i32.
        frame: Centre [mm] and 1 / extent of every group, shape (G, 4), f64.
        reach: Distance at which the weight of a point ends, in extents, shape (G, KINDS);
            infinite = least squares.
        state: Where to start, shape (G, KINDS, STATE), as of `starts`.
        rounds: Most passes over the points.
        tolerance: Relative gain of a step at which to stop.

    Returns:
        The states; their costs, shape (G, KINDS); and the normal equations J'WJ there, shape
        (G, KINDS, UNKNOWNS, UNKNOWNS), zero where an unknown is not free.
    """
    runtime.ensure_started()
    groups = len(start) - 1
    tasks = groups * KINDS
    work = np.zeros((tasks, WORK))
    work[:, :STATE] = state.reshape(tasks, STATE)
    device = runtime.upload(work)
    _iterate(
        tasks,
        runtime.workers()[1],
        rounds,
        tolerance,
        runtime.upload(points),
        runtime.upload(weight),
        runtime.upload(start),
        runtime.upload(frame),
        runtime.upload(reach.reshape(tasks)),
        device,
    )
    work = runtime.download(device)[:tasks].reshape(groups, KINDS, WORK)
    normal = np.zeros((groups, KINDS, UNKNOWNS, UNKNOWNS))
    a, b = np.tril_indices(UNKNOWNS)
    normal[..., a, b] = normal[..., b, a] = work[..., _NORMAL : _NORMAL + 28]
    normal *= FREE[None, :, :, None] & FREE[None, :, None, :]
    return work[..., :STATE], work[..., _COST], normal
