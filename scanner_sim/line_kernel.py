"""The peaks of `scanner_sim.line_profile` for solids, in kernels over a chunk of stripes.

One follows the rays over the width of the line, one looks from their spots to the camera, one
reduces them to the peak of every row; arrays of all rays exist for one chunk only. When the middle
ray and the two outer ones meet the same surface, all three seen or all three not, the others
between them are taken to do likewise, and are only cut with that surface: what is narrower than
half the line may then be overlooked by one row.
"""

import math
from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, ti
from scanner_sim.crossings import crossings, surface_normal
from scanner_sim.line_profile import Fan, Peaks
from scanner_sim.optics import merging, pixels_per_slope, shine, sub_rays
from scanner_sim.part import FlatPart
from scanner_sim.quadric import gradient
from scanner_sim.raycast import INTO, nearest_hit, upload_program
from scanner_sim.scanner import StripeScanner
from scanner_sim.target import LIFT, CsgTarget

_FAR = 1e30
_IDLE = -2.0  # in place of a surface: nothing is to be seen in this row
_CHUNK = 1 << 17


@ti.dataclass
class Optics:
    """The probe in one pass, world frame [mm]; see `scanner_sim.optics`."""

    across: vec3
    down: vec3
    camera: vec3
    baseline: ti.f64
    stand_off: ti.f64
    half_depth: ti.f64
    sine: ti.f64
    cosine: ti.f64
    pixels: ti.f64
    least_incidence: ti.f64
    least_camera: ti.f64
    matte: ti.f64
    shine: ti.f64
    lobe: ti.f64
    full: ti.f64
    gap: ti.f64

    @ti.func
    def place(self, depth: ti.f64, aside: ti.f64) -> ti.f64:
        """Return where a spot lies on the detector [pixel]."""
        x = self.baseline - aside
        slope = (depth * self.sine - x * self.cosine) / (x * self.sine + depth * self.cosine)
        return slope * self.pixels

    @ti.func
    def depth(self, place: ti.f64) -> ti.f64:
        """Return the depth of a spot in the laser plane, the inverse of `place`."""
        slope = place / self.pixels
        top = self.baseline * (self.cosine + slope * self.sine)
        return top / (self.sine - slope * self.cosine)

    @ti.func
    def brightness(self, ray: vec3, normal: vec3, back: vec3) -> ti.f64:
        """Return the brightness of a spot; a matte one at normal incidence has 1."""
        cosine = -normal.dot(ray)
        result = self.matte * cosine
        if self.shine > 0.0:
            mirrored = ray + 2.0 * cosine * normal
            off = ti.acos(ti.max(-1.0, ti.min(1.0, mirrored.dot(back)))) / self.lobe
            result += self.shine * ti.exp(-0.5 * off * off)
        return result


@ti.func
def _nearest_to(kind, data: ti.template(), s, origin, ray, wanted):
    """Return the crossing of a ray with surface s that is nearest to a distance."""
    found = crossings(kind, data, s, origin, ray)
    best = found[0]
    for k in range(1, 4):
        if ti.abs(found[k] - wanted) < ti.abs(best - wanted):
            best = found[k]
    return best


@ti.func
def _turn(turn, count):
    """Return the ray whose turn it is: the middle one, the outer two, then those between."""
    k = turn - 2 if turn - 2 < count // 2 else turn - 1
    if turn == 0:
        k = count // 2
    elif turn == 1:
        k = 0
    elif turn == 2:
        k = count - 1
    return k


@ti.func
def _alike(spots: ti.template(), i, middle, last):
    """Say whether the middle ray and the outer two met one surface, and are all seen or all not."""
    same = True
    for n in ti.static((1, 2)):
        here = spots[i, middle + n]
        same = same and spots[i, n] == here and spots[i, last + n] == here
    lit = spots[i, middle + 3] > 0.0
    return same and (spots[i, 3] > 0.0) == lit and (spots[i, last + 3] > 0.0) == lit


@ti.func
def _brightness(optics: ti.template(), kinds: ti.template(), data: ti.template(),
                hit, origin, ray, camera):  # fmt: skip
    """Return the brightness of what a ray has met; 0 beyond the limits of the scanner."""
    bright = 0.0
    surface = ti.i32(hit[1])
    if surface >= 0:
        place = origin + hit[0] * ray
        normal = hit[2] * surface_normal(kinds[surface], data, surface, place)
        back = (camera - place).normalized()
        depth = hit[0] * ray.dot(optics.down)
        if (
            -normal.dot(ray) >= optics.least_incidence
            and normal.dot(back) >= optics.least_camera
            and ti.abs(optics.stand_off - depth) <= optics.half_depth
        ):
            bright = optics.brightness(ray, normal, back)
    return bright


@ti.kernel
def _follow_rays(
    optics: Optics,
    first: ti.i32,
    stop: ti.i32,
    # In:
    code_in: I32Rows,
    first_in: I32Array,
    grid_in: F64Rows,
    kinds_in: I32Array,
    data_in: F64Rows,
    sources_in: F64Rows,
    rays_in: F64Rows,
    line_in: F64Rows,
    # Out:
    spots_inout: F64Rows,
):
    """Write distance, surface, side and brightness of the rays whose turn it is, four a ray.

    The brightness is negative as long as nobody has looked from the spot to the camera.
    """
    for i in range(sources_in.shape[0] * rays_in.shape[0]):
        ray = row(rays_in, i % rays_in.shape[0])
        source = row(sources_in, i // rays_in.shape[0])
        count = line_in.shape[0]
        middle = 4 * (count // 2)
        known = first >= 3 and _alike(spots_inout, i, middle, 4 * (count - 1))
        lit = spots_inout[i, middle + 3] > 0.0
        idle = first > 0 and spots_inout[i, middle + 1] == _IDLE
        for turn in range(stop if idle else first, stop):
            k = 4 * _turn(turn, count)
            origin = source + line_in[k // 4, 0] * optics.across
            hit = vec3(_FAR, -1.0, 0.0)
            if not known:
                hit = nearest_hit(
                    code_in, first_in, grid_in, kinds_in, data_in, origin, ray, _FAR, INTO
                )  # fmt: skip
            elif lit:
                hit = vec3(0.0, spots_inout[i, middle + 1], spots_inout[i, middle + 2])
                s = ti.i32(hit[1])
                far = spots_inout[i, middle]
                hit[0] = _nearest_to(kinds_in[s], data_in, s, origin, ray, far)
            bright = _brightness(
                optics, kinds_in, data_in, hit, origin, ray, source + optics.camera
            )  # fmt: skip
            for n in ti.static(range(3)):
                spots_inout[i, k + n] = hit[n]
            spots_inout[i, k + 3] = bright if known else -bright


@ti.kernel
def _look_back(
    optics: Optics,
    first: ti.i32,
    stop: ti.i32,
    # In:
    code_in: I32Rows,
    first_in: I32Array,
    grid_in: F64Rows,
    kinds_in: I32Array,
    data_in: F64Rows,
    sources_in: F64Rows,
    rays_in: F64Rows,
    line_in: F64Rows,
    # Out:
    spots_inout: F64Rows,
):
    """Make the brightness positive where the camera sees the spot, and 0 where it does not."""
    for i in range(sources_in.shape[0] * rays_in.shape[0]):
        ray = row(rays_in, i % rays_in.shape[0])
        source = row(sources_in, i // rays_in.shape[0])
        for turn in range(first, stop):
            k = 4 * _turn(turn, line_in.shape[0])
            if spots_inout[i, k + 3] < 0.0:
                surface = ti.i32(spots_inout[i, k + 1])
                place = source + line_in[k // 4, 0] * optics.across + spots_inout[i, k] * ray
                normal = surface_normal(kinds_in[surface], data_in, surface, place)
                back = source + optics.camera - place
                far = back.norm()
                start = place + LIFT * spots_inout[i, k + 2] * normal
                hit = nearest_hit(
                    code_in, first_in, grid_in, kinds_in, data_in, start, back / far, far, INTO
                )  # fmt: skip
                bright = -spots_inout[i, k + 3]
                spots_inout[i, k + 3] = 0.0 if hit[1] > -0.5 else bright


@ti.kernel
def _find_peaks(
    optics: Optics,
    # In:
    rays_in: F64Rows,
    line_in: F64Rows,
    spots_in: F64Rows,
    # Out:
    place_out: F64Rows,
    order_out: I32Rows,
    value_out: F64Rows,
    hit_out: I32Rows,
):
    """Find the brightest group of spots of every row, and its centroid.

    Values are measured and true distance, brightness and excess; hits are spot, surface, side.
    """
    for i in range(spots_in.shape[0]):
        ray = row(rays_in, i % rays_in.shape[0])
        fall = ray.dot(optics.down)
        count = line_in.shape[0]
        middle = count // 2
        top = line_in[middle, 1]
        seen = 0
        for k in range(count):
            place_out[i, k] = optics.place(spots_in[i, 4 * k] * fall, line_in[k, 0])
            if spots_in[i, 4 * k + 3] > 0.0:
                at = seen
                while at > 0 and place_out[i, order_out[i, ti.max(at - 1, 0)]] > place_out[i, k]:
                    order_out[i, at] = order_out[i, at - 1]
                    at -= 1
                order_out[i, at] = k
                seen += 1
        first, best_first, best_last, total, best_total = 0, 0, -1, 0.0, -1.0
        for n in range(seen):
            k = order_out[i, n]
            before = order_out[i, ti.max(n - 1, 0)]
            if n > 0 and place_out[i, k] - place_out[i, before] > optics.gap:
                first, total = n, 0.0
            total += top * ti.min(spots_in[i, 4 * k + 3] * line_in[k, 1] / top, optics.full)
            if total > best_total:
                best_first, best_last, best_total = first, n, total
        hit_out[i, 0] = -1
        if seen > 0:
            start = place_out[i, order_out[i, best_first]]
            moment, light, excess, strongest, spot = 0.0, 0.0, 0.0, -1.0, -1
            for n in range(best_first, best_last + 1):
                k = order_out[i, n]
                shown = spots_in[i, 4 * k + 3] * line_in[k, 1] / top
                weight = top * ti.min(shown, optics.full)
                moment += weight * (place_out[i, k] - start)
                light += shown * top
                excess = ti.max(excess, shown)
                if spot != middle and (k == middle or weight > strongest):
                    spot, strongest = k, weight
            value_out[i, 0] = optics.depth(start + moment / best_total) / fall
            value_out[i, 1] = spots_in[i, 4 * spot]
            value_out[i, 2], value_out[i, 3] = light, excess
            hit_out[i, 0] = spot
            for n in ti.static((1, 2)):
                hit_out[i, n] = ti.i32(spots_in[i, 4 * spot + n])


def peaks_of_solid(solid: CsgTarget, scanner: StripeScanner, fan: Fan) -> Peaks:
    """Return the peaks of some stripes; see `scanner_sim.line_profile.peaks`."""
    target = solid.flat
    runtime.ensure_started()
    offsets, shares = sub_rays(scanner)
    line = runtime.upload(np.column_stack([offsets, shares]))
    optics = _optics(scanner, fan.rotation)
    part = upload_program(target)
    ray = runtime.upload(fan.ray)
    columns = len(fan.ray)
    step = max(_CHUNK // columns, 1)
    pieces = []
    for start in range(0, len(fan.source), step):
        source = fan.source[start : start + step]
        rows = len(source) * columns
        value = runtime.empty((rows, 4), np.float64)
        hit = runtime.empty((rows, 3), np.int32)
        spots = runtime.empty((rows, 4 * len(offsets)), np.float64)
        rays = (*part, runtime.upload(source), ray, line, spots)
        # The middle ray first, then the outer ones where there is light to be expected; the others
        # follow these where they agree.
        for first, stop in ((0, 1), (1, min(3, len(offsets))), (3, len(offsets))):
            if first < stop:
                if first == 1:
                    _rest(spots, source, columns, offsets)
                _follow_rays(optics, first, stop, *rays)
                _look_back(optics, first, stop, *rays)
        place = runtime.empty((rows, len(offsets)), np.float64)
        order = runtime.empty((rows, len(offsets)), np.int32)
        _find_peaks(optics, ray, line, spots, place, order, value, hit)
        runtime.sync()
        pieces.append(_gather(target, fan, source, offsets, start, value, hit))
    return Peaks(*(np.concatenate(column) for column in zip(*pieces, strict=True)))


def _rest(spots: Any, source: np.ndarray, columns: int, offsets: np.ndarray) -> None:
    """Let rows rest that lie amid the dark of one surface, or of none.

    Their middle ray and those around them, as far as the line reaches and a row to either side,
    have met the same surface, and none of them can be measured: too steep, or hidden from the
    camera. Two thirds of the rows of a view from the side are of this kind.
    """
    stripes, count = len(source), len(offsets)
    if stripes < 3 or columns < 3:
        return
    pitch = float(np.linalg.norm(np.diff(source, axis=0), axis=1).min())
    around = math.ceil(float(np.abs(offsets).max()) / pitch) if pitch > 0.0 else stripes
    if 2 * around + 1 > stripes:
        return
    host = runtime.download(spots).reshape(stripes, columns, count, 4)
    middle = count // 2
    dark = host[:, :, middle, 3] == 0.0
    # One number a row: the surface where it is dark, a number that no surface has elsewhere.
    state = np.where(dark, host[:, :, middle, 1], -9.0)
    idle = np.zeros_like(dark)
    inner = state[around : stripes - around, 1:-1]
    same = inner > -9.0
    for i in range(2 * around + 1):
        for j in range(3):
            same &= state[i : stripes - 2 * around + i, j : columns - 2 + j] == inner
    idle[around : stripes - around, 1:-1] = same
    host[idle] = 0.0
    host[idle, middle, 1] = _IDLE
    if not isinstance(spots, np.ndarray):
        spots.from_numpy(host.reshape(spots.shape))


def _gather(
    target: FlatPart, fan: Fan, source: np.ndarray, offsets: np.ndarray, start: int,
    value: object, hit: object,
) -> Peaks:  # fmt: skip
    """Return the rows of a chunk that have a peak."""
    values, hits = runtime.download(value), runtime.download(hit)
    own = np.flatnonzero(hits[:, 0] >= 0)
    length, far, light, excess = values[own].T
    spot, surface, side = hits[own].T
    ray = fan.ray[own % len(fan.ray)]
    position = source[own // len(fan.ray)] + far[:, None] * ray
    position += offsets[spot][:, None] * fan.rotation[:, 0]
    normal = gradient(target.surfaces, surface, position) * side[:, None]
    if len(offsets) == 1:
        length = far  # one ray: what it met, without the way over the detector and back
    return Peaks(own + start * len(fan.ray), length, position, normal, surface, light, excess)


def _optics(scanner: StripeScanner, rotation: np.ndarray) -> Optics:
    """Return the probe in the world frame."""
    angle = scanner.triangulation_angle
    depth = scanner.depth_of_field
    return Optics(
        across=vec3(rotation[:, 0]),
        down=vec3(-rotation[:, 2]),
        camera=vec3(rotation @ scanner.camera),
        baseline=scanner.camera[0],
        stand_off=scanner.stand_off,
        half_depth=_FAR if depth is None else depth / 2,
        sine=math.sin(angle),
        cosine=math.cos(angle),
        pixels=pixels_per_slope(scanner),
        least_incidence=math.cos(scanner.incidence_limit),
        least_camera=math.cos(scanner.camera_limit),
        matte=1.0 - scanner.specular,
        shine=shine(scanner),
        lobe=scanner.lobe,
        full=_FAR if scanner.saturation is None else scanner.saturation,
        gap=merging(scanner),
    )
