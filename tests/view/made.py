"""A small part with known answers: a plate with a dome, a ramp and a drum, scanned in stripes."""

import numpy as np

from octoseg_ti import Params, Scans, Segmentation, Truth
from octoseg_ti.params import GridParams
from octoseg_ti.types import Cells, Measurement, StopReason, SurfaceKind

DOME, RAMP, DRUM = np.array([18.0, 20.0]), 38.0, np.array([30.0, 33.0])


def surface(x, y):
    """Return height, normal and surface number (0 plate, 1 ramp, 2 dome, 3 drum) at (x, y)."""
    z, face = np.zeros_like(x), np.zeros(x.shape, int)
    n = np.zeros((*x.shape, 3))
    n[..., 2] = 1
    on = x > RAMP
    z[on], face[on] = (x[on] - RAMP) * 0.6, 1
    n[on] = np.array([-0.6, 0, 1]) / np.hypot(0.6, 1)
    d2 = (x - DOME[0]) ** 2 + (y - DOME[1]) ** 2
    on = d2 < 81
    top = np.sqrt(np.maximum(100 - d2[on], 0))
    z[on], face[on] = top - np.sqrt(19), 2
    n[on] = np.stack([x[on] - DOME[0], y[on] - DOME[1], top], axis=-1) / 10
    on = (x - DRUM[0]) ** 2 + (y - DRUM[1]) ** 2 < 16
    z[on], face[on] = 6.0, 3
    n[on] = [0, 0, 1]
    return z, n, face


def scan(step=0.25, views=1):
    """Return (Scans, Truth) of a raster of stripes along y."""
    x, y = np.meshgrid(np.arange(0, 60, step), np.arange(0, 40, step), indexing="ij")
    z, n, face = surface(x, y)
    stripe = np.repeat(np.arange(len(x)), x.shape[1])
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    # Distance to the nearest point of another surface, over the raster.
    other = np.zeros(face.shape, bool)
    for axis in (0, 1):
        for shift in (1, -1):
            other |= np.roll(face, shift, axis) != face
    other[[0, -1]] = other[:, [0, -1]] = False
    from scipy.ndimage import distance_transform_edt

    distance = step * distance_transform_edt(~other)
    count = len(points)
    face = face.reshape(-1)
    rank = np.empty(4, int)
    rank[np.argsort(-np.bincount(face), kind="stable")] = np.arange(4)
    scans = Scans(
        points=points,
        stripe=stripe.astype(np.int32),
        column=np.tile(np.arange(x.shape[1]), len(x)).astype(np.int32),
        view=(stripe * views // len(x)).astype(np.int32),
        time_ns=(stripe * 1_000_000).astype(np.int64),
        T_world_view=np.tile(np.eye(4), (views, 1, 1)),
        origin=np.tile([30.0, 20.0, 200.0], (views, 1)),
        stripe_origin=np.stack([x[:, 0], 0 * x[:, 0] + 20, 0 * x[:, 0] + 200], axis=1),
        name="plate",
    )
    truth = Truth(
        patch=rank[face].astype(np.int32),
        surface=face.astype(np.int32),
        kind=np.array([0, 0, 3, 0], np.int8)[face],
        normal=n.reshape(-1, 3),
        position=points,
        edge_distance=distance.reshape(-1).astype(np.float32),
        edge_class=np.ones(count, np.uint8),
        info={"part": "plate", "seed": "0"},
    )
    return scans, truth


def grid(points, normals, initial=8.0, deepest=3, tolerance=0.01):
    """Return the leaves of a plain octree of normals, and the leaf of every point."""
    low = points.min(axis=0) - 1e-6
    todo = np.arange(len(points))
    leaves, of_point = [], np.full(len(points), -1)
    for level in range(deepest + 1):
        size = initial / 2**level
        index = np.floor((points[todo] - low) / size).astype(int)
        cell, inverse = np.unique(index, axis=0, return_inverse=True)
        rest = []
        for k in range(len(cell)):
            own = todo[inverse.reshape(-1) == k]
            mean = normals[own].mean(axis=0)
            sigma = 1 - np.linalg.norm(mean)
            if sigma > tolerance and level < deepest and len(own) >= 3:
                rest.append(own)
                continue
            of_point[own] = len(leaves)
            stop = StopReason.HOMOGENEOUS if sigma <= tolerance else StopReason.MIN_SIZE
            leaves.append((low + cell[k] * size, size, level, len(own), mean, sigma, stop))
        if not rest:
            break
        todo = np.concatenate(rest)
    corner, size, level, count, normal, sigma, stop = (
        np.array(c) for c in zip(*leaves, strict=True)
    )
    cells = Cells(
        corner=corner, size=size.astype(float), level=level.astype(np.int8),
        count=count.astype(np.int32), normal=normal.astype(np.float32),
        sigma=sigma.astype(np.float32), stop=stop.astype(np.uint8),
        edge=(stop == StopReason.MIN_SIZE).astype(np.uint8),
        label=np.full(len(leaves), -1, np.int32), initial_size=initial,
    )  # fmt: skip
    return cells, of_point


def segmentation(scans, truth):
    """Return a Segmentation with a few wrong points, an outlier and a point without a cell."""
    normals = truth.normal.astype(np.float32)
    cells, of_point = grid(scans.points, truth.normal)
    edge = cells.edge[of_point]
    labels = np.where(edge > 0, -1, truth.patch).astype(np.int32)
    wrong = (scans.points[:, 0] > 50) & (scans.points[:, 1] < 6)
    labels[wrong] = 0
    level = cells.level[of_point].copy()
    outlier = np.zeros(len(labels), np.uint8)
    outlier[10], labels[10], level[10] = 1, -1, -1
    normals[10] = 0
    kinds = np.array([truth.kind[truth.patch == k][0] for k in range(4)], np.int8)
    parameters = np.full((4, 8), np.nan)
    for k, kind in enumerate(kinds):
        on = truth.patch == k
        parameters[k, :3] = scans.points[on].mean(axis=0)
        parameters[k, 3:6] = truth.normal[on].mean(axis=0)
        if kind == SurfaceKind.SPHERE:
            parameters[k, :3], parameters[k, 6] = [*DOME, -np.sqrt(19)], 10.0
    covariance = np.full((4, 8, 8), np.nan)
    covariance[kinds == SurfaceKind.SPHERE, 6, 6] = 0.0123**2
    return Segmentation(
        points=scans.points, normals=normals, labels=labels, edge=edge.astype(np.uint8),
        level=level, outlier=outlier, kind=kinds, surface=np.arange(4, dtype=np.int32),
        parameters=parameters, covariance=covariance,
        residual=np.array([0.001, 0.002, 0.0035, np.nan]), cells=cells,
        stripe=scans.stripe, view=scans.view,
        params=Params(grid=GridParams(tolerance=0.01, divisions=2, min_cell=1.0)),
        measured=Measurement(
            spacing_along=0.25, spacing_across=0.25, noise=0.01, normal_noise=0.02
        ),
        passes=5, seconds={"normals": 0.012, "grid": 0.034, "grid.split": 0.03, "regions": 0.005},
        name="plate.mcap",
    )  # fmt: skip
