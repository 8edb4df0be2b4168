"""The peaks of `scanner_sim.line_profile` for solids, in one kernel a chunk of stripes.

All rays over the width of the line are followed and reduced to the peak on the spot, so arrays of
all of them never exist. When the middle ray and the two outer ones meet the same surface, all three
seen or all three not, the others between them are taken to do likewise, and are only cut with that
surface: what is narrower than half the line may then be overlooked by one row.
"""

import math

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, ti
from octoseg_ti.types import SurfaceKind
from scanner_sim.line_profile import LIFT, Fan, Peaks
from scanner_sim.optics import merging, pixels_per_slope, shine, sub_rays
from scanner_sim.part import FlatPart
from scanner_sim.quadric import gradient
from scanner_sim.raycast import crossings, nearest_hit
from scanner_sim.scanner import MAX_SUB_RAYS, StripeScanner

_PLANE, _CYLINDER = int(SurfaceKind.PLANE), int(SurfaceKind.CYLINDER)
_CONE, _SPHERE = int(SurfaceKind.CONE), int(SurfaceKind.SPHERE)
_FAR = 1e30
_CHUNK = 1 << 19


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
def _normal(kind, data: ti.template(), s, p):
    """Return the gradient of the distance to surface s."""
    q = p - vec3(data[s, 0], data[s, 1], data[s, 2])
    axis = vec3(data[s, 3], data[s, 4], data[s, 5])
    result = axis
    if kind == _SPHERE:
        result = q / ti.max(q.norm(), 1e-300)
    elif kind != _PLANE:
        height = q.dot(axis)
        off = q - height * axis
        radius = off.norm()
        outward = off / ti.max(radius, 1e-300)
        if kind == _CYLINDER:
            result = outward
        elif kind == _CONE:
            result = ti.cos(data[s, 6]) * outward - ti.sin(data[s, 6]) * axis
        else:
            ring = radius - data[s, 6]
            tube = ti.max(ti.sqrt(ring * ring + height * height), 1e-300)
            result = (ring * outward + height * axis) / tube
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
def _seen(optics: ti.template(), code: ti.template(), boxes: ti.template(), kinds: ti.template(),
          data: ti.template(), origin, ray, camera, known):  # fmt: skip
    """Return (distance, surface or -1, side, brightness) of the spot of one ray; 0 = not seen.

    Args:
        optics: The probe.
        code: Program of the part.
        boxes: Its boxes.
        kinds: Kinds of its surfaces.
        data: Its surfaces.
        origin: Where the ray starts.
        ray: Its direction.
        camera: Position of the camera.
        known: What a ray beside it has met, or a surface of -2: then all is looked for.
    """
    hit = vec3(known[0], known[1], known[2])
    bright = 0.0
    if known[1] < -1.5:
        hit = nearest_hit(code, boxes, kinds, data, origin, ray, _FAR, 0)
    elif known[3] > 0.0:
        s = ti.i32(known[1])
        hit[0] = _nearest_to(kinds[s], data, s, origin, ray, known[0])
    surface = ti.i32(hit[1])
    if surface >= 0 and (known[1] < -1.5 or known[3] > 0.0):
        place = origin + hit[0] * ray
        normal = hit[2] * _normal(kinds[surface], data, surface, place)
        back = camera - place
        far = back.norm()
        back = back / far
        depth = hit[0] * ray.dot(optics.down)
        if (
            -normal.dot(ray) >= optics.least_incidence
            and normal.dot(back) >= optics.least_camera
            and ti.abs(optics.stand_off - depth) <= optics.half_depth
        ):
            bright = optics.brightness(ray, normal, back)
            if known[1] < -1.5:
                start = place + LIFT * normal
                if nearest_hit(code, boxes, kinds, data, start, back, far, 1)[1] > -0.5:
                    bright = 0.0
    return ti.Vector([hit[0], hit[1], hit[2], bright])


@ti.func
def _peak(optics: ti.template(), place: ti.template(), bright: ti.template(),
          line: ti.template()):  # fmt: skip
    """Return (centroid, number of the spot that stands for it, brightness, excess) of a profile."""
    count = line.shape[0]
    middle = count // 2
    order = ti.Vector([0] * MAX_SUB_RAYS)
    seen = 0
    for k in range(count):
        if bright[k] > 0.0:
            at = seen
            while at > 0 and place[order[ti.max(at - 1, 0)]] > place[k]:
                order[at] = order[at - 1]
                at -= 1
            order[at] = k
            seen += 1
    top = line[middle, 1]
    first, best_first, best_last = 0, 0, -1
    total, best_total = 0.0, -1.0
    for n in range(seen):
        k = order[n]
        if n > 0 and place[k] - place[order[ti.max(n - 1, 0)]] > optics.gap:
            first = n
            total = 0.0
        total += top * ti.min(bright[k] * line[k, 1] / top, optics.full)
        if total > best_total:
            best_first, best_last, best_total = first, n, total
    moment, light, excess, strongest = 0.0, 0.0, 0.0, -1.0
    spot = -1
    start = place[order[best_first]]
    for n in range(best_first, best_last + 1):
        k = order[n]
        shown = bright[k] * line[k, 1] / top
        weight = top * ti.min(shown, optics.full)
        moment += weight * (place[k] - start)
        light += bright[k] * line[k, 1]
        excess = ti.max(excess, shown)
        if spot != middle and (k == middle or weight > strongest):
            spot = k
            strongest = weight
    return ti.Vector([start + moment / best_total, ti.f64(spot), light, excess])


@ti.kernel
def _find_peaks(
    optics: Optics,
    # In:
    code_in: I32Rows,
    boxes_in: F64Rows,
    kinds_in: I32Array,
    data_in: F64Rows,
    sources_in: F64Rows,
    rays_in: F64Rows,
    line_in: F64Rows,
    # Out:
    value_out: F64Rows,
    hit_out: I32Rows,
):
    """Follow the rays over the line's width for every stripe and row, and find the peak."""
    for i in range(sources_in.shape[0] * rays_in.shape[0]):
        source = row(sources_in, i // rays_in.shape[0])
        ray = row(rays_in, i % rays_in.shape[0])
        camera = source + optics.camera
        count = line_in.shape[0]
        place = ti.Vector([0.0] * MAX_SUB_RAYS)
        bright = ti.Vector([0.0] * MAX_SUB_RAYS)
        far = ti.Vector([0.0] * MAX_SUB_RAYS)
        face = ti.Vector([-1] * MAX_SUB_RAYS)
        side = ti.Vector([0] * MAX_SUB_RAYS)
        for turn in range(count):
            k = _turn(turn, count)
            origin = source + line_in[k, 0] * optics.across
            known = ti.Vector([0.0, -2.0, 0.0, 0.0])
            middle, last = count // 2, count - 1
            if turn >= 3:
                alike = face[0] == face[middle] and face[last] == face[middle]
                alike = alike and side[0] == side[middle] and side[last] == side[middle]
                lit = bright[middle] > 0.0
                alike = alike and (bright[0] > 0.0) == lit and (bright[last] > 0.0) == lit
                if alike:
                    known = ti.Vector(
                        [far[middle], ti.f64(face[middle]), ti.f64(side[middle]), bright[middle]]
                    )
            spot = _seen(
                optics, code_in, boxes_in, kinds_in, data_in, origin, ray, camera, known
            )  # fmt: skip
            far[k], face[k], side[k], bright[k] = (
                spot[0], ti.i32(spot[1]), ti.i32(spot[2]), spot[3]
            )  # fmt: skip
            place[k] = optics.place(spot[0] * ray.dot(optics.down), line_in[k, 0])
        peak = _peak(optics, place, bright, line_in)
        spot_index = ti.i32(peak[1])
        value_out[i, 0] = optics.depth(peak[0]) / ray.dot(optics.down)
        value_out[i, 1] = far[ti.max(spot_index, 0)]
        value_out[i, 2] = peak[2]
        value_out[i, 3] = peak[3]
        hit_out[i, 0] = spot_index
        hit_out[i, 1] = face[ti.max(spot_index, 0)]
        hit_out[i, 2] = side[ti.max(spot_index, 0)]


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


def peaks_of_solid(target: FlatPart, scanner: StripeScanner, fan: Fan, middle: np.ndarray) -> Peaks:
    """Return the peaks of some stripes; see `scanner_sim.line_profile.peaks`."""
    runtime.ensure_started()
    del middle  # the planes of the view follow from the fan itself
    offsets, shares = sub_rays(scanner)
    line = runtime.upload(np.column_stack([offsets, shares]))
    optics = _optics(scanner, fan.rotation)
    boxes = target.boxes if len(target.boxes) else np.zeros((1, 6))
    part = [runtime.upload(a) for a in (target.code, boxes, target.surfaces.kind,
                                        target.surfaces.data, fan.ray)]  # fmt: skip
    columns = len(fan.ray)
    step = max(_CHUNK // columns, 1)
    pieces = []
    for start in range(0, len(fan.source), step):
        source = fan.source[start : start + step]
        value = runtime.empty((len(source) * columns, 4), np.float64)
        hit = runtime.empty((len(source) * columns, 3), np.int32)
        _find_peaks(optics, *part[:4], runtime.upload(source), part[4], line, value, hit)
        runtime.sync()
        pieces.append(_gather(target, fan, source, offsets, start, value, hit))
    return Peaks(*(np.concatenate(column) for column in zip(*pieces, strict=True)))


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
