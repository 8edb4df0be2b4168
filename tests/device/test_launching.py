"""Launches by plan do what Taichi's own do, and leave to it what does not fit."""

import numpy as np
import pytest

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F32Rows, F64Rows, I32Array, I64Array, ti


@ti.kernel
def _mix(
    a: ti.i32,
    b: ti.f64,
    v: ti.types.vector(3, ti.f64),
    w: ti.types.vector(2, ti.i32),
    # In:
    x_in: F64Rows,
    k_in: I64Array,
    # Out:
    y_out: F32Rows,
    i_inout: I32Array,
):
    for i in i_inout:
        i_inout[i] += a + w[0] * ti.cast(k_in[i], ti.i32) + w[1]
        for j in range(3):
            y_out[i, j] = ti.cast(b * x_in[i, j] + v[j], ti.f32)


def arguments(n: int, seed: int) -> list:
    rng = np.random.default_rng(seed)
    return [
        int(rng.integers(9)),
        float(rng.random()),
        tuple(rng.random(3).tolist()),
        (int(rng.integers(9)), -3),
        rng.random((n, 3)),
        rng.integers(0, 99, n),
        np.zeros((n, 3), np.float32),
        rng.integers(0, 99, n).astype(np.int32),
    ]


def expected(values: list) -> tuple[np.ndarray, np.ndarray]:
    a, b, v, w, x, k, _, i = values
    return (b * x + np.array(v)).astype(np.float32), i + a + w[0] * k.astype(np.int32) + w[1]


@pytest.mark.parametrize("seed", range(5))
def test_by_plan_and_by_the_long_way(seed: int) -> None:
    runtime.ensure_started()
    for n in (1, 7, 5000):
        values = arguments(n, seed)
        y, i = expected(values)
        _mix(*values)
        np.testing.assert_array_equal(values[6], y)
        np.testing.assert_array_equal(values[7], i)
        # A list for a vector does not fit the plan, and is launched all the same.
        values = arguments(n, seed)
        _mix(*values[:2], list(values[2]), *values[3:])
        np.testing.assert_array_equal(values[6], y)
    assert _mix._primal.octoseg_plan[1] is not None


def test_arrays_read_only_empty_and_within_others_are_launched_by_plan() -> None:
    runtime.ensure_started()
    _mix(*arguments(4, 0))
    values = arguments(9, 3)
    y, i = expected(values)
    values[4].flags.writeable = False
    values[5].flags.writeable = False
    for k in (4, 5, 6, 7):
        values[k] = values[k][2:6]
    _mix(*values)
    np.testing.assert_array_equal(values[6], y[2:6])
    np.testing.assert_array_equal(values[7], i[2:6])
    for k in (4, 5, 6, 7):
        values[k] = values[k][:0]
    _mix(*values)


@pytest.mark.parametrize(
    ("place", "wrong"),
    [
        (0, "many"),
        (0, 1.5),
        (1, None),
        (2, (1.0, 2.0)),
        (4, np.zeros((4, 3), np.float32)),
        (4, np.zeros(12)),
        (5, np.zeros(8, np.int64)[::2]),
        (7, None),
    ],
)
def test_what_does_not_fit_is_refused_by_taichi(place: int, wrong: object) -> None:
    runtime.ensure_started()
    values = arguments(4, 0)
    _mix(*values)
    values[place] = wrong
    with pytest.raises(Exception, match=r".") as caught:
        _mix(*values)
    assert not isinstance(caught.value, SystemError)
    with pytest.raises(Exception, match=r"Too many|argument"):
        _mix(*arguments(4, 0), 5)
