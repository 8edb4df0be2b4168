"""`simulate`: a part and a scanner give scans, and the truth about every point.

`scan_views` gives the same scans pass by pass, for consumers that cannot wait or hold them all.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.types import NONE, Artefact, Scans, Truth
from scanner_sim.passes import Pass, arrivals, extent, measured, scan_pass
from scanner_sim.poses import as_recorded, recorded_poses
from scanner_sim.scanner import DEFAULT_VIEWS, StripeScanner, View
from scanner_sim.target import as_target, far_enough

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from scanner_sim.part import Part
    from scanner_sim.target import Target

_TRIAL_RAYS = 40_000
_FEW_TRIAL_RAYS = 12_000
_SURPLUS = 1.01  # aim this far above the wanted number; what is too much is thinned out
_ATTEMPTS = 6


class _Arrived(NamedTuple):
    """A pass, which of its points arrive, and the random numbers of its view from here on."""

    scan: Pass
    keep: np.ndarray
    generator: np.random.Generator


class _View(NamedTuple):
    """The scans of a view, and what is true about their points; world coordinates."""

    scans: Scans
    position: np.ndarray
    normal: np.ndarray
    surface: np.ndarray
    artefact: np.ndarray


def simulate(
    part: Part | Target,
    scanner: StripeScanner | None = None,
    *,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Scans, Truth]:
    """Scan a part, and say what is true about every point.

    A point exists where the laser's line first meets the part, if the camera sees that place too
    (both shadows), at an angle that both bear. A line with a width and the other effects of
    `StripeScanner` are measured as a probe does: by the peak of the light in every row of its
    detector. The same arguments give the same arrays, on any number of threads.

    Artefacts: the true place of a mixed point is that of the line's middle ray, or of its brightest
    one where the middle one is not in the peak; a spike's is where the laser of its row meets the
    part, and it is in no patch. A point is clean when the peak, noise aside, lies within half the
    stated noise (`scanner_sim.optics.noise_law`) or a micrometre of its true surface, along the
    line of sight.

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


def measure(part: Part | Target, scanner: StripeScanner, *, seed: int = 0) -> Scans:
    """Return the scans of `simulate` alone, for who does without the truth: several times faster.

    Raises:
        DataError: As `simulate`.
    """
    return joined(list(scan_views(part, scanner, seed=seed, truth=False)))


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
    scanner = far_enough(scanner, target)
    views = scanner.views or target.views or DEFAULT_VIEWS
    wanted = scanner.points or target.nominal_points
    free = scanner.stripe_pitch is None and scanner.point_pitch is None
    exact = wanted if free else scanner.points
    report("scan", 0.0)
    across, along = _pitches(target, scanner, views, exact)

    def passes(across: float, along: float) -> Iterator[_Arrived]:
        for v, seq in zip(range(len(views)), _children(seed, len(views)), strict=False):
            scan = scan_pass(target, scanner, views[v], across, along, (seed, v))
            generator = np.random.default_rng(seq)
            report("scan", (v + 1) / len(views))
            yield _Arrived(scan, arrivals(scan, scanner, generator, (seed, v)), generator)

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
                **{name: repr(getattr(scanner, name)) for name in scanner.effects},
            },
        )
        if scanner.effects:
            answer = _with_artefacts(answer, np.concatenate([one.artefact for one in known]))
        report("truth", 1.0)
        return replace(answer, T_world_view=_true_poses(target, views))

    pieces = _assemble(arrived, scanner, views, target, seed, along)
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


def _with_artefacts(truth: Truth, artefact: np.ndarray) -> Truth:
    """Return the truth with artefacts; spikes leave their patches, which are ordered anew."""
    patch = np.where(artefact == Artefact.SPIKE, NONE, truth.patch).astype(np.int32)
    size = np.bincount(patch[patch >= 0], minlength=truth.patch_count)
    rank = np.full(len(size) + 1, NONE, np.int32)
    order = np.argsort(-size, kind="stable")
    order = order[size[order] > 0]
    rank[order] = np.arange(len(order))
    return replace(truth, patch=rank[patch], artefact=artefact)


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
        low, high = extent(target.box, scanner, view)
        area += float(np.prod((high - low)[:2]))
    # The trial of the plain scanner is finer than it need be: its scans are on record.
    rays = _FEW_TRIAL_RAYS if scanner.effects else _TRIAL_RAYS
    across = math.sqrt(area / rays * scanner.aspect)
    if wanted is None:
        return across, across / scanner.aspect
    # Without its width a line gives as many points, but for some at edges.
    thin = replace(scanner, line_width=0.0, specular=0.0)
    trial = [
        scan_pass(target, thin, view, across, across / scanner.aspect, (0, v))
        for v, view in enumerate(views)
    ]
    # Points go with the square of the fineness, ends of stripes (lost ones) only linearly.
    points = float(sum(len(scan.stripe) for scan in trial))
    points *= (1.0 - scanner.dropout) * (1.0 - scanner.lost_stripes)
    ends = sum(len(np.unique(scan.stripe)) for scan in trial) * scanner.lost_ends
    across /= (ends + math.sqrt(ends**2 + points * wanted * _SURPLUS)) / max(points, 1.0)
    return across, across / scanner.aspect


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
    seed: int, along: float,
) -> Iterator[_View]:  # fmt: skip
    """Give the scans of view after view: noise along the line of sight, frames of the views."""
    true = _true_poses(target, views)
    recorded = recorded_poses(true, scanner, seed)
    origin, stripe_origin = np.empty((0, 3)), np.empty((0, 3))
    period = 1e9 / scanner.stripe_rate
    first = count = 0
    for v, (scan, chosen, generator) in enumerate(arrived):
        position = scan.position[chosen]
        if scanner.effects:
            world = measured(scan, chosen, scanner, (seed, v), along)
        else:
            noise = generator.normal(0.0, scanner.range_noise, int(chosen.sum()))
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
        yield _View(
            scans, position, scan.normal[chosen], scan.surface[chosen], scan.artefact[chosen]
        )
    if count == 0:
        raise DataError(
            f"the scanner sees nothing of part {target.name or 'without a name'!r}",
            hint="look at views, field_of_view, depth_of_field and the limits of the angles",
        )
