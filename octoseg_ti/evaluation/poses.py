"""How well poses agree with the true ones."""

from __future__ import annotations

import numpy as np

from octoseg_ti.alignment import rotation_angle
from octoseg_ti.errors import DataError


def pose_errors(T_world_view: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Return the largest error of a relative pose, over all pairs of views.

    Only relative poses count: where the whole lies in the world is no matter of registration.

    Args:
        T_world_view: Poses, view to world, shape (V, 4, 4).
        true: True poses, shape (V, 4, 4).

    Returns:
        Shift of the origin of a view as the other sees it [mm], and angle [rad]; 0 for one view.

    Raises:
        DataError: The numbers of views differ.
    """
    if T_world_view.shape != true.shape:
        raise DataError(f"{len(T_world_view)} poses cannot be compared with {len(true)} true ones")
    shift = angle = 0.0
    back, true_back = np.linalg.inv(T_world_view), np.linalg.inv(true)
    for i in range(len(true)):
        for j in range(len(true)):
            if i == j:
                continue
            error = np.linalg.inv(true_back[i] @ true[j]) @ (back[i] @ T_world_view[j])
            shift = max(shift, float(np.linalg.norm(error[:3, 3])))
            angle = max(angle, float(rotation_angle(error)))
    return shift, angle
