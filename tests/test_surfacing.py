"""Surfaces and the points on them, through the whole pipeline."""

import numpy as np

from octoseg_ti import Scans, SurfaceKind, segment


def stripes(height: np.ndarray, step: float, seed: int, noise: float) -> Scans:
    """Return a height map z(y, x) as scans, a stripe for every row; NaN is no point."""
    rows, columns = np.indices(height.shape)
    there = np.isfinite(height)
    rng = np.random.default_rng(seed)
    z = height + rng.normal(0.0, noise, height.shape)
    points = np.stack([step * columns[there], step * rows[there], z[there]], axis=1)
    return Scans(points=points, stripe=rows[there].astype(np.int32))


def test_pieces_of_a_surface_are_patches_where_a_gap_parts_them() -> None:
    """A shadow of ten spacings across a plane: boxes touch over it, points do not."""
    height = np.zeros((100, 120))
    height[:, 55:65] = np.nan
    result = segment(stripes(height, 0.3, 0, 0.01))
    assert result.patch_count == 2
    assert len(np.unique(result.surface)) == 1
    left, right = result.points[:, 0] < 0.3 * 55, result.points[:, 0] >= 0.3 * 65
    assert len(np.unique(result.labels[left])) == 1 and len(np.unique(result.labels[right])) == 1


def test_the_ragged_rim_of_a_shadow_is_no_surface() -> None:
    """Beside a round shadow a few points fall off the face, here more and there less."""
    rng = np.random.default_rng(1)
    y, x = np.indices((120, 160))
    far = np.hypot(x - 80, y - 60)
    height = 0.02 * x
    height[far < 25] = np.nan
    drop = np.convolve(rng.normal(size=128), np.ones(9) / 3.0, "valid")[:, None]
    height -= 0.072 * np.clip(29 - far, 0, None) * (1.0 + 0.5 * drop) * (x < 80)
    result = segment(stripes(height, 0.5, 1, 0.05))
    assert result.kind.tolist() == [SurfaceKind.PLANE]
