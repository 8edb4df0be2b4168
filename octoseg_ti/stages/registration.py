"""Stage 3: carry points and normals of every view into the world by the recorded poses (I6)."""

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F64Rows, I32Array, ti


@ti.kernel
def _transform(
    # In:
    point_in: F64Rows,
    normal_in: F64Rows,
    view_in: I32Array,
    pose_in: F64Rows,
    # Out:
    point_out: F64Rows,
    normal_out: F64Rows,
):
    """Apply the pose of its view to every point, and its rotation to the normal."""
    for i in view_in:
        v = view_in[i]
        for r in ti.static(range(3)):
            p = pose_in[v, 4 * r + 3]
            m = 0.0
            for c in ti.static(range(3)):
                p += pose_in[v, 4 * r + c] * point_in[i, c]
                m += pose_in[v, 4 * r + c] * normal_in[i, c]
            point_out[i, r] = p
            normal_out[i, r] = m


def to_world(
    points: np.ndarray, normals: np.ndarray, view: np.ndarray, T_world_view: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Carry points and normals from the frames of their views to the world.

    Args:
        points: Positions in the frame of the view [mm], shape (N, 3), f64.
        normals: Unit normals in the frame of the view, shape (N, 3), f64.
        view: View of every point, shape (N,), i32.
        T_world_view: Rigid poses, shape (V, 4, 4), f64.

    Returns:
        Positions [mm] and normals in the world, shape (N, 3), f64.
    """
    runtime.ensure_started()
    n = len(points)
    moved, turned = runtime.empty((n, 3), np.float64), runtime.empty((n, 3), np.float64)
    _transform(
        runtime.upload(points),
        runtime.upload(normals),
        runtime.upload(view),
        runtime.upload(np.asarray(T_world_view, np.float64).reshape(-1, 16)),
        moved,
        turned,
    )
    return runtime.download(moved), runtime.download(turned)
