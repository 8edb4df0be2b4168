"""`simulate`: a part and a scanner give scans, and the truth about every point."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.types import NONE, Artefact, Scans, Truth
from scanner_sim.passes import Pass, arrivals, extent, measured, scan_pass
from scanner_sim.scanner import DEFAULT_VIEWS, StripeScanner, View
from scanner_sim.truth import build_truth

if TYPE_CHECKING:
    from collections.abc import Callable

    from scanner_sim.part import FlatPart, Part

_TRIAL_RAYS = 40_000
_SURPLUS = 1.01  # aim this far above the wanted number; what is too much is thinned out
_ATTEMPTS = 6


def simulate(
    part: Part,
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
    scanner = scanner or StripeScanner()
    report = progress or (lambda name, done: None)
    scans, passes, keep, across, along = _deliver(part, scanner, seed, report)
    report("truth", 0.0)
    assert scans.stripe is not None and scans.column is not None
    truth = build_truth(
        part.flat(),
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
            **{name: repr(getattr(scanner, name)) for name in scanner.effects},
        },
    )
    if scanner.effects:
        truth = _with_artefacts(
            truth, np.concatenate([p.artefact[k] for p, k in zip(passes, keep, strict=True)])
        )
    report("truth", 1.0)
    return scans, truth


def measure(part: Part, scanner: StripeScanner, *, seed: int = 0) -> Scans:
    """Return the scans of `simulate` alone, for who does without the truth: several times faster.

    Raises:
        DataError: As `simulate`.
    """
    return _deliver(part, scanner, seed, lambda name, done: None)[0]


def _deliver(
    part: Part, scanner: StripeScanner, seed: int, report: Callable[[str, float], None]
) -> tuple[Scans, list[Pass], list[np.ndarray], float, float]:
    """Return the scans, all passes, which of their points arrive, stripe and point pitch [mm]."""
    flat = part.flat()
    views = scanner.views or part.views or DEFAULT_VIEWS
    wanted = scanner.points or part.nominal_points
    free = scanner.stripe_pitch is None and scanner.point_pitch is None
    report("scan", 0.0)
    across, along = _pitches(flat, part.box, scanner, views, wanted if free else scanner.points)
    for _ in range(_ATTEMPTS):
        passes = []
        for v, view in enumerate(views):
            passes.append(scan_pass(flat, part.box, scanner, view, across, along, (seed, v)))
            report("scan", (v + 1) / len(views))
        root = np.random.SeedSequence(seed)
        generators = [np.random.default_rng(s) for s in root.spawn(len(views) + 1)]
        keep = [arrivals(p, scanner, generators[v], (seed, v)) for v, p in enumerate(passes)]
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
    scans = _assemble(passes, keep, scanner, views, part, generators, seed, along)
    return scans, passes, keep, across, along


def _with_artefacts(truth: Truth, artefact: np.ndarray) -> Truth:
    """Return the truth with artefacts; spikes leave their patches, which are ordered anew."""
    patch = np.where(artefact == Artefact.SPIKE, NONE, truth.patch).astype(np.int32)
    size = np.bincount(patch[patch >= 0], minlength=truth.patch_count)
    rank = np.full(len(size) + 1, NONE, np.int32)
    order = np.argsort(-size, kind="stable")
    order = order[size[order] > 0]
    rank[order] = np.arange(len(order))
    return dataclasses.replace(truth, patch=rank[patch], artefact=artefact)


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
        low, high = extent(limits, scanner, view)
        area += float(np.prod((high - low)[:2]))
    across = math.sqrt(area / _TRIAL_RAYS * scanner.aspect)
    if wanted is None:
        return across, across / scanner.aspect
    # Without its width a line gives as many points, but for some at edges.
    thin = dataclasses.replace(scanner, line_width=0.0)
    trial = [
        scan_pass(flat, limits, thin, view, across, across / scanner.aspect, (0, v))
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
    passes: list[Pass], keep: list[np.ndarray], scanner: StripeScanner, views: tuple[View, ...],
    part: Part, generators: list[np.random.Generator], seed: int, along: float,
) -> Scans:  # fmt: skip
    """Return the scans: noise along the line of sight, points in the frames of their views."""
    middle = part.box.mean(axis=0)
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    points, stripe, times = [], [], []
    first = 0
    for v, (scan, chosen) in enumerate(zip(passes, keep, strict=True)):
        poses[v, :3, :3] = views[v].rotation()
        poses[v, :3, 3] = middle
        if scanner.effects:
            world = measured(scan, chosen, scanner, (seed, v), along)
        else:
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
