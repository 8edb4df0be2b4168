"""A surface as a state that moves, and back."""

import numpy as np
import pytest
from reference.surfaces import CONE, CYLINDER, PLANE, SPHERE, TORUS, distance_of, patch_of

from octoseg_ti.fitting.primitives import to_parameters, to_states

KINDS = np.array((PLANE, CYLINDER, CONE, SPHERE, TORUS), np.int32)


@pytest.mark.parametrize("seed", range(5))
def test_there_and_back_is_the_same_surface(seed: int) -> None:
    rng = np.random.default_rng(seed)
    patches = [patch_of(kind, rng, 200) for kind in KINDS]
    true = np.array([parameters for _, _, parameters in patches])
    centre = np.array([points.mean(axis=0) for points, _, _ in patches])
    extent = rng.uniform(1.0, 20.0, len(KINDS))
    state = to_states(KINDS, true, centre, extent)
    assert np.isfinite(state[np.arange(5), KINDS]).all()
    assert np.isfinite(state[..., 0]).sum() == len(KINDS)
    axis, u = state[np.arange(5), KINDS, 3:6], state[np.arange(5), KINDS, 6:9]
    np.testing.assert_allclose(np.einsum("gi,gi->g", axis, u), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0)
    back = to_parameters(state, centre, extent)[np.arange(5), KINDS]
    np.testing.assert_array_equal(np.isfinite(back), np.isfinite(true))
    for kind, (points, _, parameters), surface in zip(KINDS, patches, back, strict=True):
        there = points + rng.normal(0.0, 1.0, points.shape)
        np.testing.assert_allclose(
            distance_of(there, kind, surface), distance_of(there, kind, parameters), atol=1e-7
        )
