"""`simulate`: a part and a scanner give scans, and the truth about every point."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.types import Scans, Truth
from scanner_sim.poses import with_pose_errors
from scanner_sim.quadric import gradient
from scanner_sim.raycast import cast
from scanner_sim.scanner import DEFAULT_VIEWS, StripeScanner, View
from scanner_sim.truth import build_truth

if TYPE_CHECKING:
    from collections.abc import Callable

    from scanner_sim.part import FlatPart, Part

_TRIAL_RAYS = 40_000
_SURPLUS = 1.01  # aim this far above the wanted number; what is too much is thinned out
_LIFT = 1e-6  # shadow rays start this far above the surface [mm]
_ATTEMPTS = 6


class _Pass(NamedTuple):
    """The points of one view, in scan order; frame of the view unless it says world."""

    stripe: np.ndarray
    column: np.ndarray
    source: np.ndarray
    """Position of the laser at every stripe [mm], world, shape (stripes, 3)."""
    position: np.ndarray
    """True position [mm], world."""
    normal: np.ndarray
    """True normal, world."""
    surface: np.ndarray
    sight: np.ndarray
    """Direction of the laser's ray, world, unit."""


def simulate(
    part: Part,
    scanner: StripeScanner | None = None,
    *,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Scans, Truth]:
    """Scan a part, and say what is true about every point.

    A point exists where the laser's ray first meets the part, if the camera sees that place too
    (both shadows), at an angle that both bear. The same arguments give the same arrays, on any
    number of threads.

    Args:
        part: The solid, in mm.
        scanner: The scanner; None takes `StripeScanner` with its defaults.
        seed: Seed of noise and losses; every view draws from its own child of it.
        progress: Called with the name of the work and the share that is done, 0..1.

    Returns:
        Scans in the frames of their views (``frame="view"``), and the truth in world coordinates.

    Raises:
        DataError: The part is unbounded, the scanner sees nothing of it, or it cannot deliver as
            many points as asked for at the pitches that were given.
    """
    scanner = scanner or StripeScanner()
    report = progress or (lambda name, done: None)
    flat = part.flat()
    views = scanner.views or part.views or DEFAULT_VIEWS
    wanted = scanner.points or part.nominal_points
    free = scanner.stripe_pitch is None and scanner.point_pitch is None
    report("scan", 0.0)
    across, along = _pitches(flat, part.box, scanner, views, wanted if free else scanner.points)
    for _ in range(_ATTEMPTS):
        passes = []
        for v, view in enumerate(views):
            passes.append(_scan(flat, part.box, scanner, view, across, along))
            report("scan", (v + 1) / len(views))
        root = np.random.SeedSequence(seed)
        generators = [np.random.default_rng(s) for s in root.spawn(len(views) + 1)]
        keep = [_losses(p, scanner, g) for p, g in zip(passes, generators, strict=False)]
        count = int(sum(k.sum() for k in keep))
        if not (free and wanted) or wanted <= count <= 1.05 * wanted or count == 0:
            break
        scale = math.sqrt(count / (wanted * _SURPLUS))
        across, along = across * scale, along * scale
    if count == 0:
        raise DataError(
            f"the scanner sees nothing of part {part.name or 'without a name'!r}",
            hint="look at views, field_of_view, depth_of_field and the limits of the angles",
        )
    exact = wanted if free else scanner.points
    if exact is not None:
        _thin(keep, exact, generators[-1])
    scans = _assemble(passes, keep, scanner, views, part, generators)
    report("truth", 0.0)
    assert scans.stripe is not None and scans.column is not None
    truth = build_truth(
        flat,
        position=np.concatenate([p.position[k] for p, k in zip(passes, keep, strict=True)]),
        normal=np.concatenate([p.normal[k] for p, k in zip(passes, keep, strict=True)]),
        surface=np.concatenate([p.surface[k] for p, k in zip(passes, keep, strict=True)]),
        stripe=scans.stripe,
        column=scans.column,
        reach=2.0 * max(across, along) / max(math.cos(scanner.incidence_limit), 0.3),
        info={
            "part": part.name,
            "seed": str(seed),
            "range_noise_mm": repr(scanner.range_noise),
            "stripe_pitch_mm": repr(across),
            "point_pitch_mm": repr(along),
        },
    )
    report("truth", 1.0)
    truth = replace(truth, T_world_view=scans.T_world_view)
    return with_pose_errors(scans, scanner, seed), truth


def _pitches(
    flat: FlatPart, limits: np.ndarray, scanner: StripeScanner, views: tuple[View, ...],
    wanted: int | None,
) -> tuple[float, float]:  # fmt: skip
    """Return stripe and point pitch [mm]; what is open follows from the number of points wanted."""
    across, along = scanner.stripe_pitch, scanner.point_pitch
    if across is None and along is not None:
        across = along * scanner.aspect
    if along is None and across is not None:
        along = across / scanner.aspect
    if across is not None and along is not None:
        return across, along
    area = 0.0
    for view in views:
        low, high = _extent(limits, scanner, view)
        area += float(np.prod((high - low)[:2]))
    across = math.sqrt(area / _TRIAL_RAYS * scanner.aspect)
    if wanted is None:
        return across, across / scanner.aspect
    trial = [_scan(flat, limits, scanner, view, across, across / scanner.aspect) for view in views]
    # Points go with the square of the fineness, ends of stripes (lost ones) only linearly.
    points = float(sum(len(scan.stripe) for scan in trial))
    points *= (1.0 - scanner.dropout) * (1.0 - scanner.lost_stripes)
    ends = sum(len(np.unique(scan.stripe)) for scan in trial) * scanner.lost_ends
    across /= (ends + math.sqrt(ends**2 + points * wanted * _SURPLUS)) / max(points, 1.0)
    return across, across / scanner.aspect


def _extent(
    limits: np.ndarray, scanner: StripeScanner, view: View
) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest stage and ray position that meet the part's box, shape (3,) each.

    x = stage, y = where the ray meets the plane z = 0, seen from the laser, z = height; all in the
    frame of the view [mm].
    """
    middle = limits.mean(axis=0)
    corners = np.array([[limits[i, 0], limits[j, 1], limits[k, 2]]
                        for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip
    local = (corners - middle) @ view.rotation() - (0.0, view.offset, 0.0)
    if local[:, 2].max() >= scanner.stand_off:
        raise DataError(
            f"the part reaches the probe: its box ends {local[:, 2].max():.0f} mm above its "
            f"middle, the laser stands at {scanner.stand_off:.0f} mm",
            hint="raise stand_off",
        )
    local[:, 1] *= scanner.stand_off / (scanner.stand_off - local[:, 2])
    low, high = local.min(axis=0), local.max(axis=0)
    if scanner.field_of_view is not None:
        half = scanner.field_of_view / 2
        low[1], high[1] = max(low[1], -half), min(high[1], half)
    return low, high


def _scan(
    flat: FlatPart,
    limits: np.ndarray,
    scanner: StripeScanner,
    view: View,
    across: float,
    along: float,
) -> _Pass:
    """Return all points that laser and camera both see, in scan order, without noise and losses."""
    rotation = view.rotation()
    middle = limits.mean(axis=0)
    low, high = _extent(limits, scanner, view)
    x = _spread(low[0], high[0], across)
    y = _spread(low[1], high[1], along)
    stripes, columns = len(x), len(y)
    source = np.stack(
        [x, np.full(stripes, view.offset), np.full(stripes, scanner.stand_off)], axis=1
    )
    ray = np.stack([np.zeros(columns), y, np.full(columns, -scanner.stand_off)], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    source_world = source @ rotation.T + middle
    ray_world = ray @ rotation.T
    origins = np.repeat(source_world, columns, axis=0)
    directions = np.tile(ray_world, (stripes, 1))
    hits = cast(flat, origins, directions, np.full(len(origins), math.inf))
    found = np.flatnonzero(hits.surface >= 0)
    surface = hits.surface[found]
    sight = directions[found]
    position = origins[found] + hits.distance[found, None] * sight
    normal = gradient(flat.surfaces, surface, position) * hits.side[found, None]
    stripe, column = found // columns, found % columns
    camera = (source[stripe] + scanner.camera) @ rotation.T + middle
    to_camera = camera - position
    far = np.linalg.norm(to_camera, axis=1)
    to_camera /= far[:, None]
    seen = -np.einsum("ij,ij->i", normal, sight) >= math.cos(scanner.incidence_limit)
    seen &= np.einsum("ij,ij->i", normal, to_camera) >= math.cos(scanner.camera_limit)
    if scanner.depth_of_field is not None:
        height = (position - middle) @ rotation[:, 2]
        seen &= np.abs(height) <= scanner.depth_of_field / 2
    open_ = np.flatnonzero(seen)
    shadow = cast(
        flat, position[open_] + _LIFT * normal[open_], to_camera[open_], far[open_], any_hit=True
    )
    chosen = open_[shadow.surface < 0]
    return _Pass(
        stripe=stripe[chosen].astype(np.int32), column=column[chosen].astype(np.int32),
        source=source_world, position=position[chosen], normal=normal[chosen],
        surface=surface[chosen], sight=sight[chosen],
    )  # fmt: skip


def _spread(low: float, high: float, pitch: float) -> np.ndarray:
    """Return places at a pitch, amid a range: no ray then runs along a side of the part."""
    count = max(int((high - low) / pitch), 1)
    return 0.5 * (low + high) + pitch * (np.arange(count) - 0.5 * (count - 1))


def _losses(scan: _Pass, scanner: StripeScanner, generator: np.random.Generator) -> np.ndarray:
    """Return which points arrive: without lost stripes, ragged ends and single losses."""
    count, stripes = len(scan.stripe), len(scan.source)
    lines = generator.random(stripes) >= scanner.lost_stripes
    trim = generator.poisson(scanner.lost_ends, (2, stripes))
    single = generator.random(count) >= scanner.dropout
    starts = np.searchsorted(scan.stripe, np.arange(stripes))
    ends = np.searchsorted(scan.stripe, np.arange(stripes), side="right")
    place = np.arange(count)
    keep = place - starts[scan.stripe] >= trim[0][scan.stripe]
    keep &= ends[scan.stripe] - 1 - place >= trim[1][scan.stripe]
    return keep & lines[scan.stripe] & single


def _thin(keep: list[np.ndarray], wanted: int, generator: np.random.Generator) -> None:
    """Drop points at random, in place, until the wanted number is left."""
    flags = np.concatenate(keep)
    left = np.flatnonzero(flags)
    if len(left) < wanted:
        raise DataError(
            f"the scan has {len(left)} points, fewer than the {wanted} asked for",
            hint="leave stripe_pitch and point_pitch open, or lower them",
        )
    dropped = generator.choice(left, len(left) - wanted, replace=False)
    flags[dropped] = False
    start = 0
    for part in keep:
        part[:] = flags[start : start + len(part)]
        start += len(part)


def _assemble(
    passes: list[_Pass], keep: list[np.ndarray], scanner: StripeScanner, views: tuple[View, ...],
    part: Part, generators: list[np.random.Generator],
) -> Scans:  # fmt: skip
    """Return the scans: noise along the line of sight, points in the frames of their views."""
    middle = part.box.mean(axis=0)
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    points, stripe, times = [], [], []
    first = 0
    for v, (scan, chosen) in enumerate(zip(passes, keep, strict=True)):
        poses[v, :3, :3] = views[v].rotation()
        poses[v, :3, 3] = middle
        noise = generators[v].normal(0.0, scanner.range_noise, int(chosen.sum()))
        world = scan.position[chosen] + noise[:, None] * scan.sight[chosen]
        points.append((world - middle) @ poses[v, :3, :3])
        stripe.append(scan.stripe[chosen] + first)
        columns = int(scan.column.max(initial=0)) + 1
        period = 1e9 / scanner.stripe_rate
        # The camera reads its rows one after the other within the period of a stripe.
        moment = (stripe[-1] + scan.column[chosen] / columns) * period
        times.append(moment.astype(np.int64))
        first += len(scan.source)
    return Scans(
        points=np.concatenate(points),
        stripe=np.concatenate(stripe).astype(np.int32),
        column=np.concatenate([p.column[k] for p, k in zip(passes, keep, strict=True)]),
        view=np.repeat(np.arange(len(views), dtype=np.int32), [int(k.sum()) for k in keep]),
        time_ns=np.concatenate(times),
        T_world_view=poses,
        origin=np.stack([p.source.mean(axis=0) for p in passes]),
        stripe_origin=np.concatenate([p.source for p in passes]),
        frame="view",
        name=part.name,
    )
