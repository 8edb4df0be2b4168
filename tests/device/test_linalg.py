"""Eigenvalues and eigenvectors of symmetric matrices, also of degenerate ones."""

import numpy as np
import pytest
from reference.clouds import rotation

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import angle_of, row, symmetric_eigen
from octoseg_ti.device.runtime import F64Array, F64Rows, ti


@ti.kernel
def _solve(
    # In:
    matrix_in: F64Rows,
    # Out:
    value_out: F64Rows,
    vector_out: F64Rows,
):
    """Write eigenvalues, and eigenvectors one after the other; matrices as xx xy xz yy yz zz."""
    for i in range(matrix_in.shape[0]):
        a, u, v, w = symmetric_eigen(
            matrix_in[i, 0],
            matrix_in[i, 1],
            matrix_in[i, 2],
            matrix_in[i, 3],
            matrix_in[i, 4],
            matrix_in[i, 5],
        )
        for k in ti.static(range(3)):
            value_out[i, k] = a[k]
            vector_out[i, k] = u[k]
            vector_out[i, 3 + k] = v[k]
            vector_out[i, 6 + k] = w[k]


@ti.kernel
def _copy_rows(
    # In:
    row_in: F64Rows,
    # Out:
    row_out: F64Rows,
):
    """Write every row twice as long."""
    for i in range(row_in.shape[0]):
        twice = 2.0 * row(row_in, i)
        for k in ti.static(range(3)):
            row_out[i, k] = twice[k]


@ti.kernel
def _angles(
    # In:
    cosine_in: F64Array,
    # Out:
    angle_out: F64Array,
):
    """Write the angle of every cosine."""
    for i in cosine_in:
        angle_out[i] = angle_of(cosine_in[i])


def solve(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues (n, 3), and eigenvectors as columns (n, 3, 3)."""
    runtime.ensure_started()
    packed = matrices[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    n = len(matrices)
    value, vector = runtime.empty((n, 3), np.float64), runtime.empty((n, 9), np.float64)
    _solve(runtime.upload(packed), value, vector)
    return runtime.download(value), runtime.download(vector).reshape(n, 3, 3).transpose(0, 2, 1)


def check(matrices: np.ndarray, what: str) -> None:
    value, vector = solve(matrices)
    size = np.abs(matrices).max(axis=(1, 2))[:, None]
    expected = np.linalg.eigvalsh(matrices)
    assert np.all(np.abs(value - expected) <= 1e-14 * size), what
    # Eigenvectors of equal eigenvalues are free to turn; what defines them is this.
    gram = np.einsum("nij,nik->njk", vector, vector)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-14)
    off = matrices @ vector - vector * value[:, None, :]
    assert np.all(np.abs(off) <= 1e-14 * size[:, :, None]), what


@pytest.mark.parametrize("seed", range(5))
def test_random_matrices(seed: int) -> None:
    a = np.random.default_rng(seed).standard_normal((500, 3, 3))
    check(a + a.transpose(0, 2, 1), f"seed {seed}")


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1.0, 1e12])
@pytest.mark.parametrize(
    "values",
    [
        (1.0, 1.0, 1.0),
        (0.0, 0.0, 1.0),
        (0.0, 1.0, 1.0),
        (1.0, 1.0, 2.0),
        (1.0, 2.0, 2.0),
        (1.0, 1.0 + 1e-12, 1.0 + 2e-12),
        (-1.0, 0.0, 1.0),
        (1e-16, 1e-8, 1.0),
    ],
)
def test_degenerate_matrices(values: tuple[float, float, float], scale: float) -> None:
    turned = []
    for seed in range(40):
        q = rotation(seed)
        m = scale * (q * values) @ q.T
        turned.append((m + m.T) / 2)
    check(np.array(turned), f"{values} times {scale}")


def test_diagonal_matrices_in_every_order() -> None:
    import itertools

    diagonal = np.array([np.diag(p) for p in itertools.permutations((3.0, -1.0, 2.0))])
    value, vector = solve(diagonal)
    np.testing.assert_array_equal(value, np.tile([-1.0, 2.0, 3.0], (6, 1)))
    for m, a in zip(diagonal, vector, strict=True):
        np.testing.assert_array_equal(np.abs(a).T @ np.diag(m), [-1.0, 2.0, 3.0])


def test_zero_matrix_has_axes() -> None:
    value, vector = solve(np.zeros((1, 3, 3)))
    np.testing.assert_array_equal(value, 0.0)
    np.testing.assert_array_equal(vector[0], np.eye(3))


def test_row() -> None:
    runtime.ensure_started()
    rows = np.random.default_rng(0).standard_normal((7, 3))
    out = runtime.empty((7, 3), np.float64)
    _copy_rows(runtime.upload(rows), out)
    np.testing.assert_array_equal(runtime.download(out), 2.0 * rows)


def test_angles_of_cosines() -> None:
    runtime.ensure_started()
    true = np.concatenate([[0.0], np.geomspace(1e-7, 0.5 * np.pi, 999), [0.5 * np.pi]])
    cosine = np.clip(np.cos(true), 0.0, 1.0)
    out = runtime.empty(len(true), np.float64)
    _angles(runtime.upload(cosine), out)
    angle = runtime.download(out)
    assert angle[0] == 0.0
    np.testing.assert_allclose(angle, np.arccos(cosine), rtol=3e-8, atol=2.1e-8)
