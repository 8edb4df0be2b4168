"""Meshes lie on their surface, face the probe, and cover what was scanned."""

from types import SimpleNamespace

import numpy as np
import pytest

from octoseg_ti.types import SurfaceKind
from octoseg_ti.view.surface_mesh import patch_mesh

UP = np.array([0.0, 0, 1])
AXIS = np.array([2.0, -1, 2]) / 3
FRAME = np.stack([np.array([1.0, 2, 0]) / np.sqrt(5), np.cross(AXIS, [1, 2, 0]) / np.sqrt(5), AXIS])
BASE = np.array([5.0, -7, 300])


def ring(u):
    return np.stack([np.cos(u), np.sin(u), 0 * u], axis=1)


def surface(kind, count=5000):
    """Return (local points, local outward normals, a, b, area) of a piece of a surface."""
    rng = np.random.default_rng(4)
    u, t = rng.uniform(-2, 2, count), rng.uniform(0, 1, count)
    if kind == SurfaceKind.PLANE:
        p = np.stack([20 * t, 5 * u, 0 * u], axis=1)
        return p, np.tile(UP, (count, 1)), np.nan, np.nan, 20 * 20
    if kind == SurfaceKind.CYLINDER:
        return 8 * ring(u) + 20 * t[:, None] * UP, ring(u), 8.0, np.nan, 4 * 8 * 20
    if kind == SurfaceKind.CONE:
        h = np.sqrt(25 + 200 * t)  # even by area between h = 5 and 15
        p = h[:, None] * (np.tan(0.5) * ring(u) + UP)
        n = np.cos(0.5) * ring(u) - np.sin(0.5) * UP
        return p, n, 0.5, np.nan, 2 * np.tan(0.5) / np.cos(0.5) * (15**2 - 5**2)
    if kind == SurfaceKind.SPHERE:
        z = 0.2 + 0.8 * t
        n = np.sqrt(1 - z * z)[:, None] * ring(np.pi / 2 * u) + z[:, None] * UP
        return 6 * n, n, 6.0, np.nan, 2 * np.pi * 36 * 0.8
    v = rng.uniform(-1, 1, count)
    n = np.cos(v)[:, None] * ring(u) + np.sin(v)[:, None] * UP
    return 12 * ring(u) + 3 * n, n, 12.0, 3.0, 4 * 3 * (12 * 2 + 3 * 2 * np.sin(1))


def result(kind, side=1, count=5000):
    p, n, a, b, area = surface(kind, count)
    return SimpleNamespace(
        points=p @ FRAME + BASE, normals=side * n @ FRAME, labels=np.zeros(count, int),
        kind=np.array([kind]), parameters=np.array([[*BASE, *AXIS, a, b]]),
    ), area  # fmt: skip


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("kind", [k for k in SurfaceKind if 0 <= k < SurfaceKind.FREE_FORM])
def test_meshes(kind, side):
    made, area = result(kind, side)
    mesh = patch_mesh(made, 0)
    local = (mesh.vertices - BASE) @ FRAME.T
    x, y, z = local.T
    r = np.hypot(x, y)
    off = {
        SurfaceKind.PLANE: z,
        SurfaceKind.CYLINDER: r - 8,
        SurfaceKind.CONE: r - np.abs(z) * np.tan(0.5),
        SurfaceKind.SPHERE: np.linalg.norm(local, axis=1) - 6,
        SurfaceKind.TORUS: np.hypot(r - 12, z) - 3,
    }[kind]
    assert np.abs(off).max() < 1e-9
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    total = np.linalg.norm(cross, axis=1).sum() / 2
    assert 0.93 < total / area < 1.2
    # Counter-clockwise seen from the probe, on which side it may have been.
    assert (np.einsum("ij,ij->i", cross, mesh.normals[mesh.triangles[:, 0]]) >= -1e-9).all()
    near = np.linalg.norm(mesh.vertices[:, None] - made.points[None, ::10], axis=2).argmin(axis=1)
    assert (np.einsum("ij,ij->i", mesh.normals, made.normals[::10][near]) > 0.5).all()
    assert set(mesh.triangles.ravel()) == set(range(len(mesh.vertices)))


def test_a_closed_tube_has_no_seam():
    made, _ = result(SurfaceKind.CYLINDER)
    rng = np.random.default_rng(1)
    u, h = rng.uniform(-np.pi, np.pi, 5000), rng.uniform(0, 20, 5000)
    made.points = (8 * ring(u) + h[:, None] * UP) @ FRAME + BASE
    made.normals = ring(u) @ FRAME
    mesh = patch_mesh(made, 0)
    edges = np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edge, count = np.unique(edges, axis=0, return_counts=True)
    border = mesh.vertices[edge[count == 1]].mean(axis=1)
    height = (border - BASE) @ AXIS
    assert ((height < 2) | (height > 18)).all()  # the two rims only


def test_no_surface_no_mesh():
    made, _ = result(SurfaceKind.PLANE)
    for kind in (SurfaceKind.NONE, SurfaceKind.FREE_FORM):
        made.kind = np.array([kind])
        assert patch_mesh(made, 0) is None
    made.kind = np.array([SurfaceKind.PLANE])
    made.parameters = np.full((1, 8), np.nan)
    assert patch_mesh(made, 0) is None
    made.labels[:] = -1
    made.parameters[:] = 1.0
    assert patch_mesh(made, 0) is None
