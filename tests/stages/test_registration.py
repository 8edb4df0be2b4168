"""Points and normals move with the pose of their view, and normals only turn."""

import numpy as np
import pytest
from reference import stripes as plain
from reference.clouds import rotation, unit
from reference.device_normals import edge_pair_normals

from octoseg_ti.stages.registration import to_world


def poses(seed: int, views: int) -> np.ndarray:
    T_world_view = np.tile(np.eye(4), (views, 1, 1))
    for v in range(views):
        T_world_view[v, :3, :3] = rotation(10 * seed + v)
        T_world_view[v, :3, 3] = np.random.default_rng(seed + v).uniform(-500, 500, 3)
    return T_world_view


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n", [3, 700, 3000])
def test_equals_the_reference(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    points, normals = 50 * rng.standard_normal((n, 3)), unit(rng.standard_normal((n, 3)))
    view = rng.integers(0, 5, n).astype(np.int32)
    T_world_view = poses(seed, 5)
    moved, turned = to_world(points, normals, view, T_world_view)
    expected = plain.to_world(points, normals, view, T_world_view)
    np.testing.assert_allclose(moved, expected[0], atol=1e-10, err_msg=f"seed {seed}")
    np.testing.assert_allclose(turned, expected[1], atol=1e-14, err_msg=f"seed {seed}")
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1.0, atol=1e-14)


def test_normals_of_views_of_one_plane_agree() -> None:
    """I5: normals are estimated per view, before registration, and turn with the points."""
    rng = np.random.default_rng(2)
    x, y = np.meshgrid(0.5 * np.arange(12.0), 0.4 * np.arange(25.0), indexing="ij")
    world = np.column_stack((x.ravel(), y.ravel(), 0.3 * x.ravel()))
    T_world_view = poses(7, 3)
    view = np.repeat(np.arange(3, dtype=np.int32), len(world))
    back = np.linalg.inv(T_world_view)
    local = np.concatenate([world @ back[v, :3, :3].T + back[v, :3, 3] for v in range(3)])
    start = (25 * np.arange(37)).astype(np.int32)
    probe = np.array([[3.0, 5.0, 400.0]] * 3) + rng.standard_normal((3, 3))
    origin = np.einsum("vij,vj->vi", back[:, :3, :3], probe) + back[:, :3, 3]
    normals = edge_pair_normals(np.ascontiguousarray(local), start, view, gap=3.0, origin=origin)
    moved, turned = to_world(local, normals, view, T_world_view)
    np.testing.assert_allclose(moved, np.tile(world, (3, 1)), atol=1e-9)
    true = np.array([-0.3, 0.0, 1.0]) / np.hypot(0.3, 1.0)
    np.testing.assert_allclose(turned, np.tile(true, (900, 1)), atol=1e-9)
