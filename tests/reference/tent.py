"""Two planes that meet in a ridge, as stripes: the smallest part."""

import numpy as np

from octoseg_ti.types import Scans, Truth


def make_tent(seed: int = 3, noise: float = 0.0) -> tuple[Scans, Truth]:
    """Return two planes that meet in a ridge, as 40 stripes of about 60 points.

    The ridge runs along x at y = 15 mm, the flanks fall by 30 degrees; every stripe is a plane of
    constant x, a few samples are missing, so the stripes are ragged.
    """
    rng = np.random.default_rng(seed)
    stripe, column = (a.ravel() for a in np.mgrid[0:40, 0:60])
    keep = rng.random(stripe.size) > 0.02
    stripe, column = stripe[keep], column[keep]
    x, y = 0.5 * stripe, 0.5 * column
    slope = np.tan(np.radians(30.0))
    z = 20.0 - slope * np.abs(y - 15.0)
    true = np.column_stack((x, y, z))
    left = y < 15.0
    side = np.where(left, -np.sin(np.radians(30.0)), np.sin(np.radians(30.0)))
    normal = np.column_stack((np.zeros_like(y), side, np.full_like(y, np.cos(np.radians(30.0)))))
    points = true.copy()
    points[:, 2] += noise * rng.standard_normal(len(points))
    scans = Scans(
        points=points,
        stripe=stripe.astype(np.int32),
        column=column.astype(np.int32),
        view=np.zeros(len(points), np.int32),
        time_ns=(stripe * 20_000_000).astype(np.int64),
        T_world_view=np.eye(4)[None],
        origin=np.array([[10.0, 15.0, 200.0]]),
        stripe_origin=np.column_stack(
            (0.5 * np.arange(40.0), np.full(40, 15.0), np.full(40, 200.0))
        ),
        name="tent",
    )
    sizes = [np.count_nonzero(left), np.count_nonzero(~left)]
    patch = np.where(left, int(sizes[0] < sizes[1]), int(sizes[0] >= sizes[1])).astype(np.int32)
    truth = Truth(
        patch=patch,
        surface=left.astype(np.int32),
        kind=np.zeros(len(points), np.int8),
        position=true,
        normal=normal,
        edge_distance=(np.abs(y - 15.0) / np.cos(np.radians(30.0))).astype(np.float32),
        edge_class=np.ones(len(points), np.uint8),
        info={"part": "tent", "seed": str(seed), "noise": str(noise)},
    )
    return scans, truth
