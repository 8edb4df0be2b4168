"""Errors of relative poses, with known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference.clouds import rotation

from octoseg_ti.errors import DataError
from octoseg_ti.evaluation import pose_errors


def test_known_errors() -> None:
    true = np.tile(np.eye(4), (3, 1, 1))
    for v in range(3):
        true[v, :3, :3] = rotation(v)
        true[v, :3, 3] = (10.0 * v, -3.0, 7.0)
    assert pose_errors(true, true) == pytest.approx((0.0, 0.0), abs=1e-12)
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = rotation(9), (100.0, 5.0, -40.0)
    assert pose_errors(whole @ true, true) == pytest.approx((0.0, 0.0), abs=1e-12)
    angle = math.radians(0.02)
    error = np.eye(4)
    error[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    error[:3, 3] = (0.03, 0.0, -0.04)
    wrong = true.copy()
    wrong[2] = true[2] @ error
    assert pose_errors(wrong, true) == pytest.approx((0.05, angle), rel=1e-6)
    half = true.copy()
    half[1, :3, :3] = half[1, :3, :3] @ np.diag([-1.0, -1.0, 1.0])
    assert pose_errors(half, true)[1] == pytest.approx(math.pi)
    assert pose_errors(true[:1], true[:1]) == (0.0, 0.0)
    with pytest.raises(DataError, match="2 poses cannot be compared with 3"):
        pose_errors(true[:2], true)
