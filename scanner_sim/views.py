"""Where to look from: the indexed probe head, and passes planned so that a part is covered."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octoseg_ti.errors import DataError
from scanner_sim.scanner import StripeScanner, View
from scanner_sim.target import as_target, far_enough

if TYPE_CHECKING:
    from scanner_sim.part import Part
    from scanner_sim.target import Target

_SAMPLES = 1500
_MOST_PASSES = 1000  # side by side, for one orientation
_SEED = 20020
_HELD = 0.005  # least share of the normals along every direction of motion
_COARSE = 2  # the planner tries every second index in tilt, and every second in azimuth


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeHead:
    """A motorised head that locks in steps about two axes, as the heads of measuring machines do.

    Axis A tilts the probe away from the vertical, axis B turns the tilt around it.
    """

    step: float = math.radians(7.5)
    """Distance of the indexed angles of both axes [rad]; a full turn is a whole number of it."""
    max_tilt: float = math.radians(82.5)
    """Largest tilt of axis A [rad]: beyond it the probe would reach below the table."""

    def __post_init__(self) -> None:
        """Check both angles.

        Raises:
            DataError: The step does not divide a turn, or the tilt is out of range.
        """
        turns = 2.0 * math.pi / self.step if self.step > 0.0 else math.nan
        if not (math.isfinite(turns) and abs(turns - round(turns)) < 1e-6):
            raise DataError(f"ProbeHead: step must divide a full turn, not {self.step} rad")
        if not 0.0 <= self.max_tilt < math.pi / 2:
            raise DataError(f"ProbeHead: max_tilt must be at least 0 and below pi/2, not "
                            f"{self.max_tilt}")  # fmt: skip

    def snap(self, view: View) -> View:
        """Return the view with tilt and azimuth at the nearest index that the head can reach."""
        most = math.floor(self.max_tilt / self.step + 1e-9)
        tilt, azimuth = view.tilt, view.azimuth
        if tilt < 0.0:  # the same direction, told from the other side
            tilt, azimuth = -tilt, azimuth + math.pi
        a = min(round(tilt / self.step), most)
        b = round(azimuth / self.step) % round(2.0 * math.pi / self.step)
        return replace(view, tilt=a * self.step, azimuth=b * self.step)

    def orientations(self, coarse: int = 1) -> tuple[View, ...]:
        """Return the indexed orientations: from above, then ring by ring.

        Args:
            coarse: Only every so many-th index of both axes.
        """
        rings = math.floor(self.max_tilt / self.step + 1e-9)
        around = round(2.0 * math.pi / self.step)
        return (
            View(),
            *(
                View(tilt=a * self.step, azimuth=b * self.step)
                for a in range(coarse, rings + 1, coarse)
                for b in range(0, around, coarse)
            ),
        )


def parse_views(text: str) -> tuple[View, ...]:
    """Return the views in a text: "tilt,azimuth;..." in degrees, with "tilt,azimuth,offset" in mm.

    Raises:
        DataError: A view is not two or three numbers, or a tilt is not below 90 degrees.
    """
    views = []
    for piece in text.split(";"):
        try:
            numbers = [float(word) for word in piece.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
            raise DataError(
                f"{piece.strip()!r} is no view", hint='write "tilt,azimuth;tilt,azimuth" in degrees'
            )
        if abs(numbers[0]) >= 90.0:
            raise DataError(f"a view cannot tilt by {numbers[0]:g} degrees", hint="stay below 90")
        tilt, azimuth, offset = [*numbers, 0.0][:3]
        views.append(View(tilt=math.radians(tilt), azimuth=math.radians(azimuth), offset=offset))
    return tuple(views)


class _Samples(NamedTuple):
    """Places on a part, spread evenly over its surface."""

    position: np.ndarray
    normal: np.ndarray


def plan_views(
    part: Part | Target,
    scanner: StripeScanner | None = None,
    *,
    overlap: float = 0.3,
    coverage: float = 0.99,
    count: int | None = None,
    head: ProbeHead | None = None,
) -> tuple[View, ...]:
    """Choose orientations of the head, and passes side by side, that cover a part.

    Places are spread over the surface that can be reached from above the table. One orientation
    after the other is chosen: the one that sees most of what none before has seen. It has to share
    ``overlap`` of what it sees with those before, and the shared places have to hold it in all six
    directions of motion, so that the views can be aligned to each other; only when no such
    orientation adds anything are the others asked. Where the part is wider than
    the field of view an orientation gets parallel passes that overlap by the same share. The
    depth of field lies around the middle of the part in every pass.

    Args:
        part: The solid, in mm.
        scanner: Laser, camera and limits; its own views do not matter. None takes the defaults.
        overlap: Share of a pass that its neighbours see too, 0..0.9.
        coverage: Share of what any orientation could see at which to stop, above 0, at most 1.
        count: Stop at this number of orientations.
        head: The head; None takes `ProbeHead` with its defaults.

    Returns:
        The passes, orientation by orientation.

    Raises:
        DataError: A share is out of range, the part is unbounded, or no orientation sees any of it.
    """
    scanner, head = scanner or StripeScanner(), head or ProbeHead()
    if not 0.0 <= overlap <= 0.9:
        raise DataError(f"overlap must be 0..0.9, not {overlap}")
    if not 0.0 < coverage <= 1.0:
        raise DataError(f"coverage must be above 0 and at most 1, not {coverage}")
    if count is not None and count < 1:
        raise DataError(f"at least one view is needed, not {count}")
    target = as_target(part)
    limits = target.box
    scanner = far_enough(scanner, target)
    samples = _spread_samples(target)
    candidates = head.orientations(_COARSE)
    passes = [_side_by_side(view, limits, scanner, overlap) for view in candidates]
    seen = np.array(
        [
            np.any([_sees(target, scanner, one, samples) for one in several], axis=0)
            for several in passes
        ]
    )
    wanted = int(seen.any(axis=0).sum())
    if wanted == 0:
        raise DataError(
            f"the scanner sees nothing of part {target.name or 'without a name'!r}",
            hint="look at field_of_view, depth_of_field and the limits of the angles",
        )
    chosen: list[int] = []
    covered = np.zeros(seen.shape[1], bool)
    size = np.maximum(seen.sum(axis=1), 1)
    while covered.sum() < coverage * wanted and (count is None or len(chosen) < count):
        gain = (seen & ~covered).sum(axis=1)
        allowed = gain.copy()
        if chosen:
            enough = (seen & covered).sum(axis=1) >= overlap * size
            held = [near and _holds(samples, seen[k] & covered) for k, near in enumerate(enough)]
            allowed[~np.array(held)] = 0
        best = int(np.argmax(allowed if allowed.any() else gain))
        chosen.append(best)
        covered |= seen[best]
    return tuple(one for k in chosen for one in passes[k])


def covered_share(part: Part | Target, scanner: StripeScanner, views: tuple[View, ...]) -> float:
    """Return the share of what any indexed orientation could see that these passes see.

    The places are those of `plan_views`, so the planner is checked on what it planned for; a finer
    check is a scan.
    """
    target = as_target(part)
    limits = target.box
    scanner = far_enough(scanner, target)
    samples = _spread_samples(target)
    some = np.zeros(len(samples.position), bool)
    for view in ProbeHead().orientations(_COARSE):
        for one in _side_by_side(view, limits, scanner, 0.0):
            some |= _sees(target, scanner, one, samples)
    here = np.zeros(len(some), bool)
    for view in views:
        here |= _sees(target, scanner, view, samples)
    return float((here & some).sum() / max(int(some.sum()), 1))


def _holds(samples: _Samples, shared: np.ndarray) -> bool:
    """Return whether places that two views share leave no motion between these open.

    A motion is open where it moves all places along their surfaces: then the matrix of the aligning
    equations has a small eigenvalue.
    """
    places, normals = samples.position[shared], samples.normal[shared]
    if len(places) < 6:
        return False
    places = places - samples.position.mean(axis=0)
    radius = math.sqrt(float(np.einsum("ij,ij->", places, places)) / len(places))
    rows = np.concatenate([np.cross(places, normals) / max(radius, 1e-12), normals], axis=1)
    return float(np.linalg.eigvalsh(rows.T @ rows / len(rows))[0]) >= _HELD


def _side_by_side(
    view: View, limits: np.ndarray, scanner: StripeScanner, overlap: float
) -> tuple[View, ...]:
    """Return the passes of one orientation: parallel, and as many as the part is wide."""
    if scanner.field_of_view is None:
        return (view,)
    corners = np.array([[limits[i, 0], limits[j, 1], limits[k, 2]]
                        for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip
    local = (corners - limits.mean(axis=0)) @ view.rotation()
    # The laser fans out, so the line is shortest where the part is highest.
    width = scanner.field_of_view * (1.0 - max(local[:, 2].max(), 0.0) / scanner.stand_off)
    span = float(np.ptp(local[:, 1]))
    if width <= 0.0 or span <= width:
        return (view,)
    passes = math.ceil((span - overlap * width) / ((1.0 - overlap) * width))
    if passes > _MOST_PASSES:
        raise DataError(
            f"a field of view of {scanner.field_of_view:g} mm is too narrow for a part that is "
            f"{span:.3g} mm wide: {passes} passes side by side",
            hint="raise field_of_view",
        )
    step = (span - width) / (passes - 1)
    middle = (local[:, 1].max() + local[:, 1].min()) / 2.0
    return tuple(
        replace(view, offset=float(middle + step * (k - (passes - 1) / 2))) for k in range(passes)
    )


def _spread_samples(target: Target) -> _Samples:
    """Return places on the surface that can be reached from above the table, evenly spread.

    Parallel rays from many sides meet the part; of the places one is kept for each small cube and
    side, so that no face counts more because more rays happened to meet it.
    """
    limits = target.box
    middle = limits.mean(axis=0)
    radius = float(np.linalg.norm(limits[1] - limits[0])) / 2.0
    rng = np.random.default_rng(_SEED)
    places, normals = [], []
    views = (View(), *(View(tilt=math.radians(t), azimuth=2.0 * math.pi * (k + 0.5 * (t > 50)) / 8)
                       for t in (40.0, 75.0) for k in range(8)))  # fmt: skip
    side = max(int(math.sqrt(3.0 * _SAMPLES)), 1)
    for view in views:
        rotation = view.rotation()
        # One ray at random in every square of a grid: no grid can then fall in step with the part.
        cell = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), axis=-1)
        plane = ((cell.reshape(-1, 2) + rng.random((side * side, 2))) / side - 0.5) * 2.0 * radius
        origins = middle + plane @ rotation[:, :2].T + 2.0 * radius * rotation[:, 2]
        directions = np.tile(-rotation[:, 2], (len(origins), 1))
        hits = target.trace(origins, directions, np.full(len(origins), math.inf))
        found = np.flatnonzero(hits.surface >= 0)
        places.append(origins[found] + hits.distance[found, None] * directions[found])
        normals.append(hits.normal[found])
    position, normal = np.concatenate(places), np.concatenate(normals)
    if len(position) == 0:
        return _Samples(position, normal)
    # The cubes shrink until there are enough of them.
    size = radius / 4.0
    while True:
        cube = np.floor((position - limits[0]) / size).astype(np.int64)
        facing = np.argmax(np.abs(normal), axis=1) * 2 + (normal.sum(axis=1) > 0)
        key = np.column_stack([cube, facing])
        kept = np.unique(key, axis=0, return_index=True)[1]
        if len(kept) >= _SAMPLES or len(kept) > len(position) // 4:
            break
        size *= 0.8
    kept = np.sort(kept)
    return _Samples(position[kept], normal[kept])


def _sees(target: Target, scanner: StripeScanner, view: View, samples: _Samples) -> np.ndarray:
    """Return which places a pass measures by the rules of a scan, shape (N,), bool."""
    rotation, middle = view.rotation(), target.box.mean(axis=0)
    local = (samples.position - middle) @ rotation
    height = scanner.stand_off - local[:, 2]
    if (height <= 0.0).any():
        raise DataError("the part reaches the probe", hint="raise stand_off")
    source = np.stack(
        [local[:, 0], np.full(len(local), view.offset), np.full(len(local), scanner.stand_off)],
        axis=1,
    )
    seen = np.ones(len(local), bool)
    if scanner.field_of_view is not None:
        on_plane = (local[:, 1] - view.offset) * scanner.stand_off / height
        seen &= np.abs(on_plane) <= scanner.field_of_view / 2.0
    if scanner.depth_of_field is not None:
        seen &= np.abs(local[:, 2]) <= scanner.depth_of_field / 2.0
    for place, limit in (
        (source, scanner.incidence_limit),
        (source + scanner.camera, scanner.camera_limit),
    ):
        asked = np.flatnonzero(seen)
        towards = (place[asked] - local[asked]) @ rotation.T
        far = np.linalg.norm(towards, axis=1)
        towards /= far[:, None]
        facing = np.einsum("ij,ij->i", samples.normal[asked], towards) >= math.cos(limit)
        seen[asked[~facing]] = False
        asked, towards, far = asked[facing], towards[facing], far[facing]
        hidden = target.hidden(samples.position[asked], samples.normal[asked], towards, far)
        seen[asked[hidden]] = False
    return seen
