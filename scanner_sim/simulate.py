"""`simulate`: a part and a scanner give scans, and the truth about every point.

`scan_views` gives the same scans pass by pass, for consumers that cannot wait or hold them all.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.types import Scans, Truth
from scanner_sim.poses import as_recorded, recorded_poses
from scanner_sim.scanner import DEFAULT_VIEWS, StripeScanner, View
from scanner_sim.target import as_target, far_enough

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from scanner_sim.part import Part
    from scanner_sim.target import Target

_TRIAL_RAYS = 40_000
_SURPLUS = 1.01  # aim this far above the wanted number; what is too much is thinned out
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


class _Arrived(NamedTuple):
    """A pass, which of its points arrive, and the random numbers of its view from here on."""

    scan: _Pass
    keep: np.ndarray
    generator: np.random.Generator


class _View(NamedTuple):
    """The scans of a view, and what is true about their points; world coordinates."""

    scans: Scans
    position: np.ndarray
    normal: np.ndarray
    surface: np.ndarray


def simulate(
    part: Part | Target,
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
    stream = scan_views(part, scanner, seed=seed, progress=progress)
    pieces = list(stream)
    assert stream.truth is not None
    return joined(pieces), stream.truth


class ScanStream:
    """The scans of a part, one view after the other; iterate over it once.

    Every item is complete: the points of one view, with the numbers that they have in the whole
    scan, and the poses of all views so far. Afterwards ``truth`` tells about all points.
    """

    truth: Truth | None = None
    """The truth about the points of all items, one after the other; None before the end, and
    where it was not asked for."""

    def __init__(
        self, views: Iterator[_View], finish: Callable[[list[_View]], Truth] | None, at_once: bool
    ) -> None:
        """Join what makes the views and what makes the truth of them."""
        self._views, self._finish = views, finish
        self.at_once = at_once
        """Every view is given as soon as it is scanned; False = all are scanned first, because a
        wanted number of points is reached by thinning the whole."""

    def __iter__(self) -> Iterator[Scans]:
        """Scan view after view."""
        known: list[_View] = []
        for view in self._views:
            if self._finish is not None:
                known.append(view._replace(scans=replace(view.scans, points=np.empty((0, 3)))))
            yield view.scans
        if self._finish is not None:
            self.truth = self._finish(known)


def scan_views(
    part: Part | Target,
    scanner: StripeScanner | None = None,
    *,
    seed: int = 0,
    truth: bool = True,
    progress: Callable[[str, float], None] | None = None,
) -> ScanStream:
    """Scan a part view by view: the same arrays as `simulate`, as they are made.

        stream = scan_views(part, scanner, seed=7)
        for scans in stream:
            writer.add(scans)
        stream.truth

    With given pitches and no wanted number of points one view at a time is in memory, beside what
    the truth needs (about 100 bytes a point). A wanted number takes all views first, because it is
    reached by thinning the whole.

    Args:
        part: The solid, in mm.
        scanner: The scanner; None takes `StripeScanner` with its defaults.
        seed: Seed of noise and losses; every view draws from its own child of it.
        truth: Keep what the truth about all points needs; without it memory stays bounded.
        progress: Called with the name of the work and the share that is done, 0..1.

    Returns:
        A stream of `Scans`. Its errors are those of `simulate`, raised while it is read.
    """
    scanner = scanner or StripeScanner()
    report = progress or (lambda name, done: None)
    target = as_target(part)
    far = far_enough(target, scanner.stand_off, StripeScanner().stand_off)
    scanner = replace(scanner, stand_off=far)
    views = scanner.views or target.views or DEFAULT_VIEWS
    wanted = scanner.points or target.nominal_points
    free = scanner.stripe_pitch is None and scanner.point_pitch is None
    exact = wanted if free else scanner.points
    report("scan", 0.0)
    across, along = _pitches(target, scanner, views, exact)

    def passes(across: float, along: float) -> Iterator[_Arrived]:
        for v, seq in zip(range(len(views)), _children(seed, len(views)), strict=False):
            scan = _scan(target, scanner, views[v], across, along)
            generator = np.random.default_rng(seq)
            report("scan", (v + 1) / len(views))
            yield _Arrived(scan, _losses(scan, scanner, generator), generator)

    arrived: Iterable[_Arrived] = passes(across, along)
    if exact is not None:
        for _ in range(_ATTEMPTS):
            arrived = list(arrived)
            count = int(sum(one.keep.sum() for one in arrived))
            if not free or exact <= count <= 1.05 * exact or count == 0:
                break
            scale = math.sqrt(count / (exact * _SURPLUS))
            across, along = across * scale, along * scale
            arrived = passes(across, along)
        arrived = list(arrived)
        thinning = np.random.default_rng(_children(seed, len(views))[-1])
        if any(one.keep.any() for one in arrived):
            _thin([one.keep for one in arrived], exact, thinning)

    def finish(known: list[_View]) -> Truth:
        report("truth", 0.0)
        answer = target.truth(
            position=np.concatenate([one.position for one in known]),
            normal=np.concatenate([one.normal for one in known]),
            surface=np.concatenate([one.surface for one in known]),
            stripe=np.concatenate([_given(one.scans.stripe) for one in known]),
            column=np.concatenate([_given(one.scans.column) for one in known]),
            reach=2.0 * max(across, along) / max(math.cos(scanner.incidence_limit), 0.3),
            info={
                "part": target.name,
                "seed": str(seed),
                "range_noise_mm": repr(scanner.range_noise),
                "stripe_pitch_mm": repr(across),
                "point_pitch_mm": repr(along),
            },
        )
        report("truth", 1.0)
        return replace(answer, T_world_view=_true_poses(target, views))

    pieces = _assemble(arrived, scanner, views, target, seed)
    return ScanStream(pieces, finish if truth else None, at_once=exact is None)


def joined(pieces: list[Scans]) -> Scans:
    """Return the scans of all views of a stream as one."""
    names = ("points", "stripe", "column", "view", "time_ns")
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in pieces]) for name in names
    }
    return replace(pieces[-1], **arrays)


def _given(array: np.ndarray | None) -> np.ndarray:
    assert array is not None
    return array


def _children(seed: int, views: int) -> list[np.random.SeedSequence]:
    """Return the seeds of the views, and one for what concerns the whole."""
    return np.random.SeedSequence(seed).spawn(views + 1)


def _true_poses(target: Target, views: tuple[View, ...]) -> np.ndarray:
    """Return the true pose of every view: its frame lies in the middle of the part."""
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    poses[:, :3, :3] = [view.rotation() for view in views]
    poses[:, :3, 3] = target.box.mean(axis=0)
    return poses


def _pitches(
    target: Target, scanner: StripeScanner, views: tuple[View, ...], wanted: int | None
) -> tuple[float, float]:
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
        low, high = _extent(target.box, scanner, view)
        area += float(np.prod((high - low)[:2]))
    across = math.sqrt(area / _TRIAL_RAYS * scanner.aspect)
    if wanted is None:
        return across, across / scanner.aspect
    trial = [_scan(target, scanner, view, across, across / scanner.aspect) for view in views]
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
    target: Target,
    scanner: StripeScanner,
    view: View,
    across: float,
    along: float,
) -> _Pass:
    """Return all points that laser and camera both see, in scan order, without noise and losses."""
    rotation = view.rotation()
    middle = target.box.mean(axis=0)
    low, high = _extent(target.box, scanner, view)
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
    hits = target.trace(origins, directions, np.full(len(origins), math.inf))
    found = np.flatnonzero(hits.surface >= 0)
    surface = hits.surface[found]
    sight = directions[found]
    position = origins[found] + hits.distance[found, None] * sight
    normal = hits.normal[found]
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
    shadow = target.hidden(position[open_], normal[open_], to_camera[open_], far[open_])
    chosen = open_[~shadow]
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
    arrived: Iterable[_Arrived], scanner: StripeScanner, views: tuple[View, ...], target: Target,
    seed: int,
) -> Iterator[_View]:  # fmt: skip
    """Give the scans of view after view: noise along the line of sight, frames of the views."""
    true = _true_poses(target, views)
    recorded = recorded_poses(true, scanner, seed)
    origin, stripe_origin = np.empty((0, 3)), np.empty((0, 3))
    period = 1e9 / scanner.stripe_rate
    first = count = 0
    for v, (scan, chosen, generator) in enumerate(arrived):
        noise = generator.normal(0.0, scanner.range_noise, int(chosen.sum()))
        position = scan.position[chosen]
        world = position + noise[:, None] * scan.sight[chosen]
        stripe = scan.stripe[chosen] + first
        columns = int(scan.column.max(initial=0)) + 1
        # The camera reads its rows one after the other within the period of a stripe.
        moment = (stripe + scan.column[chosen] / columns) * period
        place = as_recorded(scan.source, true[v], recorded[v])
        origin = np.concatenate([origin, place.mean(axis=0, keepdims=True)])
        stripe_origin = np.concatenate([stripe_origin, place])
        first, count = first + len(scan.source), count + len(world)
        scans = Scans(
            points=(world - true[v, :3, 3]) @ true[v, :3, :3],
            stripe=stripe.astype(np.int32),
            column=scan.column[chosen],
            view=np.full(len(world), v, np.int32),
            time_ns=moment.astype(np.int64),
            T_world_view=recorded[: v + 1],
            origin=origin,
            stripe_origin=stripe_origin,
            frame="view",
            name=target.name,
        )
        yield _View(scans, position, scan.normal[chosen], scan.surface[chosen])
    if count == 0:
        raise DataError(
            f"the scanner sees nothing of part {target.name or 'without a name'!r}",
            hint="look at views, field_of_view, depth_of_field and the limits of the angles",
        )
