"""Seeded scans, truth and results of a stepped, rounded part: real shapes, no simulator."""

from __future__ import annotations

import numpy as np

from octoseg_ti.params import Params
from octoseg_ti.types import Cells, Fillets, Measurement, Scans, Segmentation, Truth


def make(
    stripes: int = 12,
    width: int = 40,
    *,
    views: int = 1,
    noise: float = 0.01,
    seed: int = 0,
    offset: float = 0.0,
) -> tuple[Scans, Truth]:
    """Return scans with ragged stripes, and their truth, in a turned and shifted world frame."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    x = np.linspace(0.0, 100.0, stripes)
    parts = []
    for v in range(views):
        for s in range(stripes):
            y = np.linspace(0.0, 60.0, width) + rng.uniform(-0.05, 0.05, width)
            parts.append(
                (np.full(width, v), np.full(width, v * stripes + s), np.arange(width), x[s], y)
            )
    view = np.concatenate([p[0] for p in parts]).astype(np.int32)
    stripe = np.concatenate([p[1] for p in parts]).astype(np.int32)
    column = np.concatenate([p[2] for p in parts]).astype(np.int32)
    y = np.concatenate([p[4] for p in parts])
    x = np.repeat([p[3] for p in parts], width) + rng.uniform(-1e-3, 1e-3, len(y))
    keep = rng.random(len(y)) > 0.05
    view, stripe, column, x, y = view[keep], stripe[keep], column[keep], x[keep], y[keep]
    z, normal, patch = _surface(x, y)
    position = np.stack([x, y, z], axis=1) @ turn.T + offset
    normal = normal @ turn.T
    ray = turn @ np.array([0.2, 0.1, -0.97])
    points = position + noise * rng.standard_normal((len(y), 1)) * ray
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :3, :3] = turn
    poses[:, :3, 3] = rng.uniform(-5, 5, (views, 3)) + offset
    scans = Scans(
        points=points,
        stripe=stripe,
        column=column,
        view=view if views > 1 else None,
        time_ns=stripe.astype(np.int64) * 10_000_000,
        T_world_view=poses,
        origin=poses[:, :3, 3] + 200.0 * turn[:, 2],
        stripe_origin=rng.uniform(0, 200, (int(stripe.max()) + 1, 3)) + offset,
        name="factory",
    )
    sizes = np.bincount(patch)
    rank = np.empty(len(sizes), np.int32)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
    ids = rank[patch]
    ids[rng.random(len(ids)) < 0.02] = -1
    truth = Truth(
        patch=ids,
        surface=patch.astype(np.int32),
        kind=np.where(patch == 2, 1, np.where(patch == 3, 3, 0)).astype(np.int8),
        position=position,
        normal=normal,
        edge_distance=np.abs(np.sin(x) * y).astype(np.float32),
        edge_class=(column % 3).astype(np.uint8),
        radius=np.where(column % 5 == 0, 1.5, np.nan).astype(np.float32),
        artefact=(column % 4).astype(np.uint8),
        info={"part": "factory", "seed": str(seed), "noise": str(noise)},
    )
    return scans, truth


def _surface(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return heights, normals and ids of a part: ground, block with a ramp, cylinder, dome."""
    z = np.zeros_like(x)
    normal = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    patch = np.zeros(len(x), np.int64)
    block = (x > 10) & (x < 40)
    z[block], patch[block] = 20.0, 1
    ramp = block & (y > 45)
    z[ramp] -= 0.5 * (y[ramp] - 45)
    normal[ramp], patch[ramp] = np.array([0.0, 0.5, 1.0]) / np.hypot(0.5, 1.0), 4
    tube = (x > 50) & (x < 75)
    z[tube] = 5.0 + np.sqrt(np.maximum(12.6**2 - (x[tube] - 62.5) ** 2, 0.0))
    normal[tube] = np.stack([x[tube] - 62.5, 0 * x[tube], z[tube] - 5.0], axis=1) / 12.6
    patch[tube] = 2
    dome = np.hypot(x - 87, y - 30) < 11
    z[dome] = np.sqrt(121.0 - (x[dome] - 87) ** 2 - (y[dome] - 30) ** 2)
    normal[dome] = np.stack([x[dome] - 87, y[dome] - 30, z[dome]], axis=1) / 11.0
    patch[dome] = 3
    return z, normal, patch


def make_result(scans: Scans, truth: Truth, *, cells: int = 200, seed: int = 0) -> Segmentation:
    """Return a result with every array filled with values of its range."""
    rng = np.random.default_rng(seed)
    n = len(scans)
    patches = truth.patch_count
    labels = truth.patch.copy()
    parameters = rng.standard_normal((patches, 8))
    parameters[:, 7] = np.nan
    root = 1e-3 * rng.standard_normal((patches, 8, 3))
    covariance = np.einsum("kim,kjm->kij", root, root)
    covariance[::3] = np.nan
    covariance[:, 7] = covariance[:, :, 7] = np.nan
    assert truth.normal is not None
    normals = truth.normal.astype(np.float32)
    normals[::17] = 0.0
    level = rng.integers(0, 4, cells).astype(np.int8)
    size = 8.0 / 2.0**level
    corner = np.floor(rng.uniform(-60, 60, (cells, 3)) / size[:, None]) * size[:, None]
    grid = Cells(
        corner=corner,
        size=size,
        level=level,
        count=rng.integers(1, 90, cells).astype(np.int32),
        normal=rng.standard_normal((cells, 3)).astype(np.float32),
        sigma=rng.random(cells).astype(np.float32),
        stop=rng.integers(0, 4, cells).astype(np.uint8),
        edge=rng.integers(0, 4, cells).astype(np.uint8),
        label=rng.integers(-1, patches, cells).astype(np.int32),
        initial_size=8.0,
    )
    fillets = Fillets(
        patches=rng.integers(0, patches, (5, 2)).astype(np.int32),
        radius=rng.random(5),
        deviation=0.01 * rng.random(5),
        concave=rng.integers(0, 2, 5).astype(np.uint8),
        points=rng.integers(0, n, 5).astype(np.int32),
        strip=rng.integers(-1, 5, patches).astype(np.int32),
        point=rng.integers(-1, 5, n).astype(np.int32),
    )
    return Segmentation(
        points=scans.points,
        normals=normals,
        labels=labels,
        edge=(rng.random(n) < 0.2).astype(np.uint8) * rng.integers(1, 4, n).astype(np.uint8),
        level=rng.integers(-1, 6, n).astype(np.int8),
        outlier=(rng.random(n) < 0.01).astype(np.uint8),
        kind=rng.integers(-1, 6, patches).astype(np.int8),
        surface=rng.integers(0, patches, patches).astype(np.int32),
        parameters=parameters,
        covariance=covariance,
        residual=rng.random(patches),
        cells=grid,
        fillets=fillets,
        stripe=scans.stripe,
        view=scans.view,
        params=Params(),
        measured=Measurement(
            spacing_along=0.26, spacing_across=0.25, noise=0.01, normal_noise=0.05
        ),
        passes=5,
        seconds={"normals": 0.0123456789, "grid": 0.02, "regions": 1 / 3},
        name=scans.name,
    )
