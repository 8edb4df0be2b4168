"""Which doubtful points lie on a surface that their surroundings show.

A surface has points all around: of the plane through a point of it and two near neighbours, many
other neighbours are part. Through a point off the surface only planes go that cut the surface in a
line, with few neighbours on it. Every view is asked for itself, so that views which are not well
aligned do not speak against each other.

Only what lies around the doubtful points is looked at: it is sorted into the buckets of a hash of
cubes, by the number of the bucket and then of the point, so that any number of threads finds the
same neighbours in the same order.
"""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.radix import sort_pairs
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, I64Array, ti
from octoseg_ti.device.unionfind import find, unite

REACH = 24
"""Neighbours of a view that are asked, the nearest ones."""
ANCHORED, KEPT = 2, 1
"""Verdicts: held by points beyond doubt or by another view; on a surface of doubtful points."""

_PARTNERS = 8  # of these, the nearest that planes are laid through
_AGREE = 0.45  # least share of the neighbours on the plane, each by its nearness
_ENOUGH = 0.55  # a plane with this share need not be bettered
_SLIM = 0.1  # neighbours that spread less than this share of the radius are a line, not a plane
_CLOSE = 0.3  # a line holds a point which is as near, in radii, to points beyond doubt
_OBLIQUE = 0.3  # least sine between two directions that a plane is laid through
_HELD = 0.2  # share of its points that holds a group
_FAR = 1e9
_BUCKETS = 64  # a doubtful point
_BITS = (12, 20)  # of the number of a bucket, from .. to

ivec2: Any = ti.types.vector(2, ti.i32)
ivec3: Any = ti.types.vector(3, ti.i32)
vec6 = ti.types.vector(6, ti.f64)


@ti.func
def _carried(point: ti.template(), view: ti.template(), pose: ti.template(), i: ti.i32) -> vec3:
    """Return a point in the world."""
    v = view[i]
    p = vec3(pose[v, 3], pose[v, 7], pose[v, 11])
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            p[r] += pose[v, 4 * r + c] * point[i, c]
    return p


@ti.func
def _cube(p: vec3, size: ti.f64) -> ivec3:
    """Return the cube that holds a place; what is too far for a number of 32 bits shares some."""
    scale = 1.0 / size
    inside = ti.max(-_FAR, ti.min(_FAR, p * scale))
    return ti.cast(ti.floor(inside), ti.i32)


@ti.func
def _bucket(c: ivec3, view: ti.i32, mask: ti.i32) -> ti.i32:
    """Return the bucket of a cube in a view (primes of Teschner et al. 2003)."""
    h = (c[0] * 73856093) ^ (c[1] * 19349663) ^ (c[2] * 83492791) ^ (view * 15485863)
    return (h ^ (h >> 15)) & mask


@ti.kernel
def _mark_near(
    size: ti.f64,
    # In:
    chosen_in: I32Array,
    point_in: F64Rows,
    view_in: I32Array,
    pose_in: F64Rows,
    # Out:
    mark_inout: I32Array,
):
    """Mark the buckets of the 27 cubes around every chosen point, of all views together."""
    for s in chosen_in:
        c = _cube(_carried(point_in, view_in, pose_in, chosen_in[s]), size)
        for m in range(27):
            step = ivec3(m // 9 - 1, m // 3 % 3 - 1, m % 3 - 1)
            mark_inout[_bucket(c + step, 0, mark_inout.shape[0] - 1)] = 1


@ti.kernel
def _find_near(
    size: ti.f64,
    # In:
    mark_in: I32Array,
    point_in: F64Rows,
    view_in: I32Array,
    pose_in: F64Rows,
    # Out:
    bucket_out: I32Array,
):
    """Write the bucket of every point in its view, -1 where its cube is not marked."""
    for i in bucket_out:
        c = _cube(_carried(point_in, view_in, pose_in, i), size)
        mask = mark_in.shape[0] - 1
        bucket_out[i] = -1
        if mark_in[_bucket(c, 0, mask)] == 1:
            bucket_out[i] = _bucket(c, view_in[i], mask)


@ti.kernel
def _lay_out(
    # In:
    key_in: I64Array,
    index_in: I32Array,
    point_in: F64Rows,
    view_in: I32Array,
    pose_in: F64Rows,
    slot_in: I32Array,
    # Out:
    place_out: F64Rows,
    who_out: I32Rows,
    first_out: I32Array,
    at_out: I32Array,
):
    """Write place, view and number among the chosen ones, bucket after bucket."""
    for k in key_in:
        i = index_in[k]
        p = _carried(point_in, view_in, pose_in, i)
        for c in ti.static(range(3)):
            place_out[k, c] = p[c]
        who_out[k, 0] = view_in[i]
        who_out[k, 1] = slot_in[i]
        if slot_in[i] >= 0:
            at_out[slot_in[i]] = k
        if k == 0 or key_in[ti.max(k - 1, 0)] != key_in[k]:
            first_out[ti.cast(key_in[k], ti.i32)] = k


@ti.func
def _insert(
    s: ti.i32, q: ti.i32, d: ti.f64, count: ti.i32, near: ti.template(), far: ti.template()
) -> ti.i32:
    """Put a neighbour in its place in the list, and return how many there are now."""
    j = ti.min(count, REACH - 1)
    if count < REACH or d < far[s, j]:
        moving = 1
        while moving == 1:
            moving = 0
            if j > 0:
                if far[s, j - 1] > d:
                    near[s, j] = near[s, j - 1]
                    far[s, j] = far[s, j - 1]
                    j -= 1
                    moving = 1
        near[s, j] = q
        far[s, j] = d
    return ti.min(count + 1, REACH)


@ti.func
def _collect(
    s: ti.i32, k: ti.i32, asked: ti.i32, radius: ti.f64, place: ti.template(),
    who: ti.template(), key: ti.template(), first: ti.template(), near: ti.template(),
    far: ti.template(),
) -> ivec2:  # fmt: skip
    """List the nearest neighbours of a view, nearest first.

    Returns their number, and whether a point beyond doubt is close.
    """
    p = row(place, k)
    c = _cube(p, radius)
    count, close = 0, 0
    for m in range(27):
        here = c + ivec3(m // 9 - 1, m // 3 % 3 - 1, m % 3 - 1)
        h = _bucket(here, asked, first.shape[0] - 1)
        q = first[h]
        while q >= 0:
            other = row(place, q)
            d = (other - p).norm()
            if d < radius and q != k and who[q, 0] == asked:
                # Cubes can share a bucket: each point counts in its own cube only.
                e = _cube(other, radius) - here
                if e[0] == 0 and e[1] == 0 and e[2] == 0:
                    if who[q, 1] < 0 and d < _CLOSE * radius:
                        close = 1
                    count = _insert(s, q, d, count, near, far)
            q += 1
            if q == key.shape[0]:
                q = -1
            elif key[q] != h:
                q = -1
    return ivec2(count, close)


@ti.func
def _weigh(
    normal: vec3, along: vec3, p: vec3, s: ti.i32, count: ti.i32, radius: ti.f64,
    off: ti.f64, place: ti.template(), near: ti.template(), far: ti.template(),
) -> vec3:  # fmt: skip
    """Return weight and number of the neighbours on a plane through p, and their least spread."""
    across = normal.cross(along)
    weight, n = 0.0, 0.0
    x, y, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(count):
        d = row(place, near[s, j]) - p
        if ti.abs(d.dot(normal)) < off:
            weight += 1.0 - far[s, j] / radius
            u, v = d.dot(along), d.dot(across)
            n, x, y, xx, xy, yy = n + 1.0, x + u, y + v, xx + u * u, xy + u * v, yy + v * v
    # Without p: a point off a surface makes a plane with any line of it.
    x, y = x / ti.max(n, 1.0), y / ti.max(n, 1.0)
    xx, xy, yy = (
        xx / ti.max(n, 1.0) - x * x,
        xy / ti.max(n, 1.0) - x * y,
        yy / ti.max(n, 1.0) - y * y,
    )
    least = 0.5 * (xx + yy) - ti.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    return vec3(weight, n, least)


@ti.func
def _lay_planes(
    s: ti.i32, k: ti.i32, count: ti.i32, radius: ti.f64, off: ti.f64,
    place: ti.template(), near: ti.template(), far: ti.template(),
) -> vec6:  # fmt: skip
    """Return share and weight of the best plane, its normal, and 1 if it is more than a line."""
    p = row(place, k)
    total = 0.0
    for j in range(count):
        total += 1.0 - far[s, j] / radius
    share, held, best, value, flat = 0.0, 0.0, vec3(0.0, 0.0, 0.0), 0.0, 0.0
    partners = ti.min(count, _PARTNERS)
    pair = 0
    while pair < partners * partners and value < 1.0 + _ENOUGH:
        a, b = pair // partners, pair % partners
        pair += 1
        if a < b:
            first = row(place, near[s, a]) - p
            normal = first.cross(row(place, near[s, b]) - p)
            size = normal.norm()
            if size > _OBLIQUE * far[s, a] * far[s, b]:
                normal /= size
                along = first / far[s, a]
                found = _weigh(normal, along, p, s, count, radius, off, place, near, far)
                wide = ti.cast(found[2] > (_SLIM * radius) ** 2, ti.f64)
                # Any plane is better than any line.
                new = found[0] / total
                new += wide * ti.cast(new >= _AGREE, ti.f64)
                if found[1] > 2.5 and new > value:
                    share, held, best, value, flat = found[0] / total, found[0], normal, new, wide
    return vec6(share, held, best[0], best[1], best[2], flat)


@ti.kernel
def _judge(
    radius: ti.f64,
    off: ti.f64,
    backing: ti.f64,
    # In:
    at_in: I32Array,
    place_in: F64Rows,
    who_in: I32Rows,
    key_in: I64Array,
    first_in: I32Array,
    # Out:
    near_out: I32Rows,
    far_out: F64Rows,
    normal_out: F64Rows,
    verdict_out: I32Array,
):
    """Ask the own view of every chosen point whether it lies on a surface."""
    ti.loop_config(block_dim=64)
    for s in at_in:
        k = at_in[s]
        n = _collect(
            s, k, who_in[k, 0], radius, place_in, who_in, key_in, first_in, near_out, far_out
        )
        for j in range(n[0], REACH):
            near_out[s, j] = -1
        found = _lay_planes(s, k, n[0], radius, off, place_in, near_out, far_out)
        verdict = 0
        # A line of points holds none, unless it is close to a surface: a narrow face has one point
        # a stripe.
        if found[0] >= _AGREE and (found[5] > 0.5 or n[1] == 1):
            verdict = ti.select(found[5] > 0.5, KEPT, ANCHORED)
            sure = 0.0
            normal = vec3(found[2], found[3], found[4])
            for j in range(n[0]):
                q = near_out[s, j]
                d = row(place_in, q) - row(place_in, k)
                if who_in[q, 1] < 0 and ti.abs(d.dot(normal)) < off:
                    sure += 1.0 - far_out[s, j] / radius
            if sure >= backing:
                verdict = ANCHORED
            for c in ti.static(range(3)):
                normal_out[s, c] = normal[c]
        verdict_out[s] = verdict


@ti.kernel
def _ask_others(
    views: ti.i32,
    rule: vec3,
    # In:
    asking_in: I32Array,
    at_in: I32Array,
    place_in: F64Rows,
    who_in: I32Rows,
    key_in: I64Array,
    first_in: I32Array,
    # Out:
    near_out: I32Rows,
    far_out: F64Rows,
    verdict_inout: I32Array,
):
    """Ask the other views, one after the other, until one of them holds the point."""
    ti.loop_config(block_dim=64)
    for a in asking_in:
        s = asking_in[a]
        k = at_in[s]
        radius, off, backing = rule[0], rule[1], rule[2]
        asked = 0
        while asked < views:
            if asked != who_in[k, 0]:
                n = _collect(
                    s, k, asked, radius, place_in, who_in, key_in, first_in, near_out, far_out
                )
                found = _lay_planes(s, k, n[0], radius, off, place_in, near_out, far_out)
                if found[0] >= _AGREE and found[5] > 0.5 and found[1] >= backing:
                    verdict_inout[s] = ANCHORED
                    asked = views
            asked += 1


@ti.kernel
def _join(
    off: ti.f64,
    # In:
    at_in: I32Array,
    place_in: F64Rows,
    who_in: I32Rows,
    near_in: I32Rows,
    normal_in: F64Rows,
    verdict_in: I32Array,
    # Out:
    parent_inout: I32Array,
):
    """Join neighbours of a view on one plane."""
    for s in at_in:
        if verdict_in[s] > 0:
            normal = row(normal_in, s)
            for j in range(REACH):
                q = near_in[s, j]
                if q >= 0:
                    t = who_in[q, 1]
                    if t >= 0:
                        d = row(place_in, q) - row(place_in, at_in[s])
                        if verdict_in[t] > 0 and ti.abs(d.dot(normal)) < off:
                            if normal.norm_sqr() > 0.5:
                                unite(parent_inout, s, t)


@ti.kernel
def _name_groups(
    # Out:
    parent_inout: I32Array,
    root_out: I32Array,
):
    """Write the smallest member of every group."""
    for s in root_out:
        root_out[s] = find(parent_inout, s)


def find_support(
    points: np.ndarray,
    view: np.ndarray,
    poses: np.ndarray,
    doubtful: np.ndarray,
    *,
    radius: float,
    off: float,
    backing: float,
    detached: int,
) -> np.ndarray:
    """Say which doubtful points lie on a surface that is more than a small detached group.

    Args:
        points: Positions in the frames of their views [mm], shape (N, 3), f64.
        view: View of every point, shape (N,), i32.
        poses: Poses that carry them to one world, shape (V, 4, 4), f64.
        doubtful: Rows of the points in doubt, rising, shape (S,), i32.
        radius: Neighbours are looked for so far [mm], above 0.
        off: A point is on a plane when it is nearer than this [mm].
        backing: Neighbours that hold a point, each counting from 1 where it is to 0 at the radius.
        detached: Points of a group that is a surface without other points to hold it.

    Returns:
        True for a point that does, shape (S,), bool.
    """
    runtime.ensure_started()
    chosen = len(doubtful)
    bits = int(np.clip(np.ceil(np.log2(_BUCKETS * chosen)), *_BITS))
    mark = runtime.zeros(1 << bits, np.int32)
    point, seen = runtime.upload(points), runtime.upload(view)
    pose = runtime.upload(np.asarray(poses, np.float64).reshape(-1, 16))
    _mark_near(radius, runtime.upload(doubtful), point, seen, pose, mark)
    bucket = runtime.empty(len(points), np.int32)
    _find_near(radius, mark, point, seen, pose, bucket)
    number = runtime.download(bucket)
    around = np.flatnonzero(number >= 0).astype(np.int32)
    key, index = sort_pairs(
        runtime.upload(number[around].astype(np.int64)), runtime.upload(around), bits
    )
    slot = np.full(len(points), -1, np.int32)
    slot[doubtful] = np.arange(chosen, dtype=np.int32)
    place = runtime.empty((len(around), 3), np.float64)
    who = runtime.empty((len(around), 2), np.int32)
    first, at = runtime.upload(np.full(1 << bits, -1, np.int32)), runtime.empty(chosen, np.int32)
    _lay_out(key, index, point, seen, pose, runtime.upload(slot), place, who, first, at)
    near = runtime.empty((chosen, REACH), np.int32)
    far = runtime.empty((chosen, REACH), np.float64)
    normal, verdict = runtime.empty((chosen, 3), np.float64), runtime.empty(chosen, np.int32)
    _judge(radius, off, backing, at, place, who, key, first, near, far, normal, verdict)
    parent = runtime.upload(np.arange(chosen, dtype=np.int32))
    _join(off, at, place, who, near, normal, verdict, parent)
    root = runtime.empty(chosen, np.int32)
    _name_groups(parent, root)
    # Other views are asked where the own one leaves the matter open.
    own, group = runtime.download(verdict), runtime.download(root)
    asking = np.flatnonzero((own == 0) | ~large_or_held(own, group, detached)[group])
    if len(asking):
        shared = (at, place, who, key, first, near, far, verdict)
        rule = (radius, off, backing)
        _ask_others(len(poses), rule, runtime.upload(asking.astype(np.int32)), *shared)
    answer = runtime.download(verdict)
    return (answer > 0) & large_or_held(answer, group, detached)[group]


def large_or_held(verdict: np.ndarray, group: np.ndarray, detached: int) -> np.ndarray:
    """Say of every group, by its number, whether it is large, or held by other points."""
    size = np.bincount(group[verdict > 0], minlength=len(group))
    held = np.bincount(group[verdict == ANCHORED], minlength=len(group))
    return (size >= detached) | (held >= np.maximum(1.0, _HELD * size))
