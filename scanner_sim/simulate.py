"""`simulate`: a part and a scanner give scans, and the truth about every point."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octoseg_ti.errors import DataError
from octoseg_ti.types import NONE, Artefact, Scans, Truth
from scanner_sim.bounce import add_bounces
from scanner_sim.effects import Stream, quantised, range_errors, stream
from scanner_sim.line_kernel import peaks_of_solid
from scanner_sim.line_profile import Fan, Peaks, peaks
from scanner_sim.optics import noise_law
from scanner_sim.part import FlatPart
from scanner_sim.scanner import DEFAULT_VIEWS, StripeScanner, View
from scanner_sim.stage import stage_error
from scanner_sim.truth import build_truth

if TYPE_CHECKING:
    from collections.abc import Callable

    from scanner_sim.part import Part

_TRIAL_RAYS = 40_000
_SURPLUS = 1.01  # aim this far above the wanted number; what is too much is thinned out
_ATTEMPTS = 6
_CHUNK = 1 << 18  # rays that are followed at once, where arrays of them all exist
_SHARE = 0.5  # a point this share of the stated noise off its place has an artefact
_EXACT = 1e-3  # ... but no point that is closer than this [mm]


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
    length: np.ndarray
    """Measured distance from the laser [mm], without noise."""
    fall: np.ndarray
    """Depth below the laser for a unit of the ray's length."""
    cosine: np.ndarray
    """Cosine between laser and normal."""
    camera_cosine: np.ndarray
    """Cosine between the line to the camera and the normal."""
    excess: np.ndarray
    """Brightness at the middle of the peak."""
    artefact: np.ndarray
    """`Artefact` of the point."""
    shape: tuple[int, int]
    """Stripes and rays of a stripe."""


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
) -> tuple[Scans, list[_Pass], list[np.ndarray], float, float]:
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
            passes.append(_scan(flat, part.box, scanner, view, across, along, (seed, v)))
            report("scan", (v + 1) / len(views))
        root = np.random.SeedSequence(seed)
        generators = [np.random.default_rng(s) for s in root.spawn(len(views) + 1)]
        keep = [_losses(p, scanner, generators[v], (seed, v)) for v, p in enumerate(passes)]
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
        low, high = _extent(limits, scanner, view)
        area += float(np.prod((high - low)[:2]))
    across = math.sqrt(area / _TRIAL_RAYS * scanner.aspect)
    if wanted is None:
        return across, across / scanner.aspect
    trial = [
        _scan(flat, limits, scanner, view, across, across / scanner.aspect, (0, v))
        for v, view in enumerate(views)
    ]
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

    x = stage, y = where the ray meets the plane z = 0, z = height; all in the frame of the view
    [mm].
    """
    middle = limits.mean(axis=0)
    corners = np.array([[limits[i, 0], limits[j, 1], limits[k, 2]]
                        for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip
    local = (corners - middle) @ view.rotation()
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
    seeds: tuple[int, int],
) -> _Pass:
    """Return all points that laser and camera both see, in scan order, without noise and losses.

    Args:
        flat: The solid.
        limits: Its box [mm], shape (2, 3).
        scanner: The scanner.
        view: The direction of the pass.
        across: Distance of the stripes [mm].
        along: Distance of the rays [mm].
        seeds: Seed of the simulation and number of the view, for the errors of the stage.
    """
    rotation = view.rotation()
    middle = limits.mean(axis=0)
    low, high = _extent(limits, scanner, view)
    x = _spread(low[0], high[0], across)
    y = _spread(low[1], high[1], along)
    stripes, columns = len(x), len(y)
    ray = np.stack([np.zeros(columns), y, np.full(columns, -scanner.stand_off)], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    nominal = _sources(x, scanner, rotation, middle)
    off = stage_error(scanner, x, stream(*seeds, Stream.JITTER), stream(*seeds, Stream.PERIOD))
    fan = Fan(_sources(x + off, scanner, rotation, middle), ray @ rotation.T, rotation)
    found = _peaks(flat, scanner, fan, middle)
    mark = np.zeros(len(found.ray), np.uint8)
    if scanner.specular > 0.0:
        found, mark = add_bounces(flat, scanner, fan, middle, y, found)
    if scanner.threshold > 0.0:
        bright = found.light >= scanner.threshold
        found, mark = Peaks(*(column[bright] for column in found)), mark[bright]
    stripe, column = found.ray // columns, found.ray % columns
    sight = fan.ray[column]
    to_camera = fan.source[stripe] + rotation @ scanner.camera - found.position
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    # A spike's true place may be one that could not be measured, edge on.
    cosine = np.maximum(-np.einsum("ij,ij->i", found.normal, sight), 0.02)
    camera_cosine = np.maximum(np.einsum("ij,ij->i", found.normal, to_camera), 0.02)
    reached = fan.source[stripe] + found.length[:, None] * sight
    off_surface = np.abs(np.einsum("ij,ij->i", reached - found.position, found.normal)) / cosine
    law = noise_law(scanner, cosine, camera_cosine, found.excess)
    wrong = off_surface > np.maximum(_SHARE * law, _EXACT)
    mark = np.where(wrong & (mark == Artefact.CLEAN), np.uint8(Artefact.MIXED), mark)
    return _Pass(
        stripe=stripe.astype(np.int32), column=column.astype(np.int32), source=nominal,
        position=found.position, normal=found.normal, surface=found.surface, sight=sight,
        length=found.length, fall=-sight @ rotation[:, 2], cosine=cosine,
        camera_cosine=camera_cosine, excess=found.excess,
        artefact=np.where(wrong, mark, np.uint8(Artefact.CLEAN)), shape=(stripes, columns),
    )  # fmt: skip


def _sources(
    x: np.ndarray, scanner: StripeScanner, rotation: np.ndarray, middle: np.ndarray
) -> np.ndarray:
    """Return positions of the laser [mm], world, shape (S, 3)."""
    source = np.stack([x, np.zeros(len(x)), np.full(len(x), scanner.stand_off)], axis=1)
    world: np.ndarray = source @ rotation.T + middle
    return world


def _peaks(flat: FlatPart, scanner: StripeScanner, fan: Fan, middle: np.ndarray) -> Peaks:
    """Return the peaks of all stripes, in bounded memory."""
    if scanner.effects and isinstance(flat, FlatPart):
        return peaks_of_solid(flat, scanner, fan, middle)
    columns = len(fan.ray)
    step = max(_CHUNK // columns, 1)
    pieces = []
    for start in range(0, len(fan.source), step):
        part = fan._replace(source=fan.source[start : start + step])
        found = peaks(flat, scanner, part, middle)
        pieces.append(found._replace(ray=found.ray + start * columns))
    return Peaks(*(np.concatenate(column) for column in zip(*pieces, strict=True)))


def _spread(low: float, high: float, pitch: float) -> np.ndarray:
    """Return places at a pitch, amid a range: no ray then runs along a side of the part."""
    count = max(int((high - low) / pitch), 1)
    return 0.5 * (low + high) + pitch * (np.arange(count) - 0.5 * (count - 1))


def _losses(
    scan: _Pass, scanner: StripeScanner, generator: np.random.Generator, seeds: tuple[int, int]
) -> np.ndarray:
    """Return which points arrive: without lost stripes, ragged ends and single losses.

    A scanner without further effects draws them and the noise from one generator; the others have
    a stream for each loss, with a draw for every ray.
    """
    count, stripes = len(scan.stripe), len(scan.source)
    if scanner.effects:
        lines = stream(*seeds, Stream.STRIPES).random(stripes) >= scanner.lost_stripes
        trim = stream(*seeds, Stream.ENDS).poisson(scanner.lost_ends, (2, stripes))
        draws = stream(*seeds, Stream.SINGLE).random(scan.shape)
        single = draws[scan.stripe, scan.column] >= scanner.dropout
    else:
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
            world = _measured(scan, chosen, scanner, (seed, v), along)
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


def _measured(
    scan: _Pass, chosen: np.ndarray, scanner: StripeScanner, seeds: tuple[int, int], along: float
) -> np.ndarray:
    """Return where the scanner says that points are [mm], world, shape (N, 3).

    Random errors come first, then the steps of the detector; the stage is where its scale says.
    """
    key = scan.stripe[chosen].astype(np.int64) * scan.shape[1] + scan.column[chosen]
    error = range_errors(
        scanner, seed=seeds[0], view=seeds[1], shape=scan.shape, chosen=key, along=along,
        cosine=scan.cosine[chosen], camera_cosine=scan.camera_cosine[chosen],
        excess=scan.excess[chosen],
    )  # fmt: skip
    length = quantised(scanner, scan.length[chosen] + error, scan.fall[chosen])
    measured: np.ndarray = scan.source[scan.stripe[chosen]] + length[:, None] * scan.sight[chosen]
    return measured
