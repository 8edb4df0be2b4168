"""The unknowns of the fit move surfaces as their derivatives say."""

import numpy as np
import pytest
from reference.clouds import rotation
from reference.motions import moved
from reference.surfaces import CONE, PLANE, SPHERE, TORUS, distance_of

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import vec3
from octoseg_ti.device.runtime import F64Rows, ti
from octoseg_ti.device.surfaces import KINDS, cone_shape, vec4
from octoseg_ti.fitting.motions import (
    FREE,
    STATE,
    UNKNOWNS,
    anchor_radius,
    change_of_distance,
    is_free,
    step_state,
    vec7,
)
from octoseg_ti.fitting.primitives import to_parameters


@ti.func
def _row3(rows: ti.template(), i: ti.i32, at: ti.i32) -> vec3:
    """Return three numbers."""
    return vec3(rows[i, at], rows[i, at + 1], rows[i, at + 2])


@ti.kernel
def _derive(
    kind: ti.i32,
    # In:
    state_in: F64Rows,
    point_in: F64Rows,
    step_in: F64Rows,
    # Out:
    change_out: F64Rows,
    state_out: F64Rows,
):
    """Write distance and derivatives of every point, the state after the step, the free ones."""
    for i in range(point_in.shape[0]):
        origin = _row3(state_in, 0, 0)
        axis = _row3(state_in, 0, 3)
        u = _row3(state_in, 0, 6)
        shape = vec4(state_in[0, 9], state_in[0, 10], 0.0, 0.0)
        if kind == CONE:
            shape = cone_shape(shape[0], shape[1])
        p = _row3(point_in, i, 0) - origin
        local = vec3(p.dot(u), p.dot(axis.cross(u)), p.dot(axis))
        d, j = change_of_distance(kind, local, shape, anchor_radius(kind, origin, axis, shape))
        change_out[i, 0] = d
        step = vec7(0.0)
        for k in ti.static(range(7)):
            change_out[i, 1 + k] = j[k] * is_free(kind, k)
            step[k] = step_in[0, k]
        if i == 0:
            c, to_axis, to_u, a, b = step_state(kind, origin, axis, u, shape, step)
            for k in ti.static(range(3)):
                state_out[0, k] = c[k]
                state_out[0, 3 + k] = to_axis[k]
                state_out[0, 6 + k] = to_u[k]
            state_out[0, 9] = a
            state_out[0, 10] = b


def random_state(kind: int, rng: np.random.Generator) -> np.ndarray:
    """Return a state with its point off the origin and u (sphere: the axis) towards it."""
    q = rotation(int(rng.integers(1000)))
    r = rng.uniform(1.5, 3.0)
    state = np.zeros(STATE)
    state[3:6], state[6:9] = q[:, 2], q[:, 0]
    state[:3] = -r * (q[:, 2] if kind == SPHERE else q[:, 0])
    state[9:] = {
        PLANE: (0.0, 0.0),
        CONE: (0.4, r * np.cos(0.4)),
        TORUS: (r, rng.uniform(0.3, 0.8)),
    }.get(kind, (r, 0.0))
    return state


def run(kind: int, state: np.ndarray, points: np.ndarray, step: np.ndarray) -> tuple:
    """Return derivatives (N, 1 + UNKNOWNS) and the state after the step."""
    runtime.ensure_started()
    change = runtime.empty((len(points), 1 + UNKNOWNS), np.float64)
    after = runtime.empty((1, STATE), np.float64)
    arrays = [runtime.upload(a) for a in (state[None], points, step[None])]
    _derive(kind, *arrays, change, after)
    return runtime.download(change), runtime.download(after)[0]


def shifted(state: np.ndarray, kind: int, step: np.ndarray) -> np.ndarray:
    """Return the state after a step by the reference."""
    states, steps = np.zeros((1, KINDS, STATE)), np.zeros((1, KINDS, UNKNOWNS))
    states[..., 3:6], states[..., 6:9] = [0, 0, 1], [1, 0, 0]
    states[..., 9] = 1.0
    states[0, kind], steps[0, kind] = state, step
    return moved(states, steps)[0, kind]


def distances(points: np.ndarray, kind: int, state: np.ndarray) -> np.ndarray:
    states = np.zeros((1, KINDS, STATE))
    states[0, kind] = state
    parameters = to_parameters(states, np.zeros((1, 3)), np.ones(1))[0, kind]
    return distance_of(points, kind, parameters)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", range(KINDS))
def test_derivatives_are_those_of_the_motion(kind: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    state = random_state(kind, rng)
    points = rng.uniform(-0.5, 0.5, (40, 3))
    change, _ = run(kind, state, points, np.zeros(UNKNOWNS))
    np.testing.assert_allclose(change[:, 0], distances(points, kind, state), atol=1e-12)
    small = 1e-6
    for k in range(UNKNOWNS):
        step = np.zeros(UNKNOWNS)
        step[k] = small
        ahead = distances(points, kind, shifted(state, kind, step))
        behind = distances(points, kind, shifted(state, kind, -step))
        expected = (ahead - behind) / (2 * small) * FREE[kind, k]
        what = f"kind {kind}, seed {seed}, unknown {k}"
        np.testing.assert_allclose(change[:, 1 + k], expected, atol=1e-7, err_msg=what)


@pytest.mark.parametrize("kind", range(KINDS))
def test_steps_are_those_of_the_reference(kind: int) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        state = random_state(kind, rng)
        step = rng.uniform(-0.2, 0.2, UNKNOWNS) * FREE[kind]
        _, after = run(kind, state, np.zeros((1, 3)), step)
        np.testing.assert_allclose(
            after, shifted(state, kind, step), atol=1e-13, err_msg=f"kind {kind}, seed {seed}"
        )
