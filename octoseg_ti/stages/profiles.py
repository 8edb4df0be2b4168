"""The profile across the edge of two surfaces: sharp, or rounded by a ball that rolls along both.

Two analytic surfaces and a signed radius describe a whole edge. The ball touches both surfaces, so
its centre is as far from either, on the side of the material (a convex edge, radius below 0) or of
the air (a concave one, above 0). Newton's steps find the centre that belongs to a point. Between
the two lines of contact the ball is the surface, beyond them the surfaces are. Radius 0 is the
sharp edge. So plane and plane give a cylinder, plane and cylinder a torus, and nothing has to be
said about either; tangency is built in, and one number is left to estimate.
"""

from typing import Any, NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row, vec3
from octoseg_ti.device.runtime import F64Array, F64Rows, I32Array, I32Rows, ti
from octoseg_ti.device.surfaces import surface_at, vec4
from octoseg_ti.types import EdgeClass

SHARP, SMOOTH = int(EdgeClass.SHARP), int(EdgeClass.SMOOTH)

BALL, FIRST, SECOND, NOWHERE = 0, 1, 2, 3
"""Where a point lies on a profile: between the lines of contact, beyond the first or the second
line, or there is no edge near it."""

_STEPS = 4
_CLOSE, _FAR = (
    1e-6,
    1e-3,
)  # a centre is found when so near its distances [mm]; it is none so far off
_PARALLEL = 1e-6  # squared sine of the angle between surfaces below which they have no edge

_SHARP = 1e-9  # a smaller radius is none [mm]

vec9 = ti.types.vector(9, ti.f64)


class Places(NamedTuple):
    """Where points lie on the profiles of edges, one entry a point and edge."""

    off: np.ndarray
    """Distance from the profile [mm], positive in the air, f64."""
    along: np.ndarray
    """Distance from the nearer line of contact, along the surface [mm]; 0 between the lines of a
    round edge. Infinite where there is no edge near."""
    region: np.ndarray
    """BALL, FIRST, SECOND or NOWHERE."""
    bend: np.ndarray
    """Cosine of the turn."""
    cosine: np.ndarray
    """Cosine of the angle between the normals of the point and of the profile."""
    height: np.ndarray
    """Heights above both surfaces, added up [mm]: above 0 = a concave edge."""

    @property
    def turn(self) -> np.ndarray:
        """Angle by which the surface turns from one side of the edge to the other [rad]."""
        return np.arccos(np.clip(self.bend, -1.0, 1.0))

    @property
    def spread(self) -> np.ndarray:
        """Tangent of half that angle."""
        bend = np.clip(self.bend, -1.0, 1.0)
        return np.sqrt((1.0 - bend) / np.maximum(1.0 + bend, 1e-12))


@ti.func
def _side_at(surface_in: ti.template(), s: ti.i32, p: vec3) -> vec4:
    """Return (normal of a surface at a point (3), height of that), on the side of the air."""
    axis = vec3(surface_in[s, 3], surface_in[s, 4], surface_in[s, 5])
    d, n = surface_at(
        ti.cast(surface_in[s, 8], ti.i32), p, row(surface_in, s), axis, surface_in[s, 6],
        surface_in[s, 7],
    )  # fmt: skip
    side = surface_in[s, 9]
    return vec4(side * n[0], side * n[1], side * n[2], side * d)


@ti.func
def _place_on_profile(
    surface_in: ti.template(), a: ti.i32, b: ti.i32, p: vec3, side_a: vec4, side_b: vec4,
    radius: ti.f64, hollow: ti.f64,
) -> vec9:  # fmt: skip
    """Return (off, along, region, cosine of the turn, change of off, normal (3), height).

    The change is that with the radius; the height is the sum of the heights above both surfaces.

    The normal is that of the profile at the point, zero where there is none.

    Args:
        surface_in: Surfaces as rows of parameters (8), kind, side.
        a: The first surface.
        b: The second one.
        p: The point.
        side_a: What `_side_at` says of the first surface there.
        side_b: What it says of the second one.
        radius: Radius of the ball [mm], 0 or more.
        hollow: 1 for a concave edge, -1 for a convex one.
    """
    c = p
    signed = hollow * radius
    ca = side_a[3]
    cb = side_b[3]
    ma = vec3(side_a[0], side_a[1], side_a[2])
    mb = vec3(side_b[0], side_b[1], side_b[2])
    da = ca
    db = cb
    step = 0
    while step < _STEPS and ti.abs(ca - signed) + ti.abs(cb - signed) > _CLOSE:
        g = ma.dot(mb)
        det = 1.0 - g * g
        step += 1
        if det > _PARALLEL:
            x = signed - ca
            y = signed - cb
            c += ((x - g * y) / det) * ma + ((y - g * x) / det) * mb
            at_a = _side_at(surface_in, a, c)
            at_b = _side_at(surface_in, b, c)
            ca = at_a[3]
            cb = at_b[3]
            ma = vec3(at_a[0], at_a[1], at_a[2])
            mb = vec3(at_b[0], at_b[1], at_b[2])
        else:
            step = _STEPS
    off = da
    if ti.abs(db) < ti.abs(da):
        off = db
    result = vec9(off, ti.math.inf, ti.cast(NOWHERE, ti.f64), 1.0, 0.0, 0.0, 0.0, 0.0, da + db)
    g = ma.dot(mb)
    det = 1.0 - g * g
    if det > _PARALLEL and ti.abs(ca - signed) + ti.abs(cb - signed) < _FAR:
        u = p - c
        x = -hollow * u.dot(ma)
        y = -hollow * u.dot(mb)
        toward_a = x - g * y
        toward_b = y - g * x
        size = u.norm()
        change = 0.0
        region = BALL
        along = 0.0
        normal = vec3(0.0, 0.0, 0.0)
        if toward_a >= 0.0 and toward_b >= 0.0:
            off = -hollow * (size - radius)
            if radius < _SHARP:
                along = size
                off = -hollow * size
            if size > 0.0:
                normal = (-hollow / size) * u
                change = hollow * (1.0 + hollow * u.dot(ma + mb) / (size * (1.0 + g)))
        elif toward_a >= toward_b:
            region = FIRST
            normal = ma
            off = da
            along = (u + (hollow * x) * ma).norm()
        else:
            region = SECOND
            normal = mb
            off = db
            along = (u + (hollow * y) * mb).norm()
        result = vec9(
            off, along, ti.cast(region, ti.f64), g, change, normal[0], normal[1], normal[2], da + db
        )
    return result


@ti.func
def place_on_profile(
    surface_in: ti.template(), a: ti.i32, b: ti.i32, p: vec3, radius: ti.f64, hollow: ti.f64
) -> vec9:
    """Return what `_place_on_profile` does of a point about which nothing is known yet."""
    side_a = _side_at(surface_in, a, p)
    side_b = _side_at(surface_in, b, p)
    return _place_on_profile(surface_in, a, b, p, side_a, side_b, radius, hollow)


@ti.kernel
def _place(
    entries: ti.i32,
    # In:
    point_in: F64Rows,
    normal_in: F64Rows,
    surface_in: F64Rows,
    pair_in: I32Rows,
    radius_in: F64Array,
    entry_in: I32Rows,
    # Out:
    place_out: F64Rows,
):
    """Place the point of every entry on the profile of its edge."""
    for e in range(entries):
        m = entry_in[e, 1]
        radius = ti.abs(radius_in[m])
        hollow = ti.select(radius_in[m] < 0.0, -1.0, 1.0)
        f = place_on_profile(
            surface_in, pair_in[m, 0], pair_in[m, 1], row(point_in, entry_in[e, 0]), radius, hollow
        )
        for k in ti.static(range(4)):
            place_out[k, e] = f[k]
        place_out[4, e] = vec3(f[5], f[6], f[7]).dot(row(normal_in, entry_in[e, 0]))
        place_out[5, e] = f[8]


@ti.kernel
def _sum_up(
    stride: ti.i32,
    cap: ti.f64,
    # In:
    point_in: F64Rows,
    surface_in: F64Rows,
    task_in: I32Rows,
    shape_in: F64Rows,
    limit_in: F64Array,
    entry_in: I32Array,
    # Out:
    sum_inout: F64Rows,
):
    """Sum capped squares, gradient, curvature and points on the ball over the points of a task.

    All shapes of a task, as many for each, share what is known of a point. What costs more than the
    limit of the task is not added up any further.
    """
    shapes = shape_in.shape[0] // task_in.shape[0]
    for u in range(task_in.shape[0] * stride):
        if u % stride == 0:
            t = u // stride
            a = task_in[t, 0]
            b = task_in[t, 1]
            for j in range(task_in[t, 2], task_in[t, 3]):
                p = row(point_in, entry_in[j])
                side_a = _side_at(surface_in, a, p)
                side_b = _side_at(surface_in, b, p)
                for k in range(t * shapes, (t + 1) * shapes):
                    if sum_inout[k, 0] <= limit_in[t]:
                        f = _place_on_profile(
                            surface_in, a, b, p, side_a, side_b, shape_in[k, 0], shape_in[k, 1]
                        )
                        off = f[0]
                        if ti.abs(off) < cap:
                            sum_inout[k, 0] = sum_inout[k, 0] + off * off
                            if ti.cast(f[2], ti.i32) == BALL:
                                sum_inout[k, 1] = sum_inout[k, 1] + off * f[4]
                                sum_inout[k, 2] = sum_inout[k, 2] + f[4] * f[4]
                                sum_inout[k, 3] = sum_inout[k, 3] + 1.0
                        else:
                            sum_inout[k, 0] = sum_inout[k, 0] + cap * cap


@ti.func
def _may_lie(edge_in: ti.template(), strip_in: ti.template(), m: ti.i32, label: ti.i32) -> ti.i32:
    """Say whether a point with this label may lie on edge m: on a side; on a strip if it is round.

    A round edge also takes points without a label.
    """
    found = ti.cast(label == edge_in[m, 0] or label == edge_in[m, 1], ti.i32)
    if found == 0 and edge_in[m, 2] != SHARP and edge_in[m, 2] != SMOOTH:
        found = ti.cast(label < 0, ti.i32)
        for k in range(edge_in[m, 3], edge_in[m, 4]):
            found |= ti.cast(strip_in[k] == label, ti.i32)
    return found


@ti.kernel
def _reach_along(
    limit: ti.types.vector(3, ti.f64),
    # In:
    point_in: F64Rows,
    label_in: I32Array,
    surface_in: F64Rows,
    edge_in: I32Rows,
    radius_in: F64Array,
    strip_in: I32Array,
    entry_in: I32Rows,
    # Out:
    along_out: F64Array,
):
    """Write how far points of leaves are from an edge along the surface; infinite: not beside it.

    An edge lies on both surfaces: what is far from the other one is far from a sharp edge. A smooth
    joint has no line: all points of its sides are beside it.
    """
    for e in range(entry_in.shape[0]):
        m = entry_in[e, 0]
        sharp = edge_in[m, 2] == SHARP
        radius = ti.abs(radius_in[m])
        hollow = ti.select(radius_in[m] < 0.0, -1.0, 1.0)
        for k in range(entry_in[e, 2]):
            i = entry_in[e, 1] + k
            along = ti.math.inf
            if _may_lie(edge_in, strip_in, m, label_in[i]) == 1:
                far = 0.0
                if sharp:
                    other = ti.select(label_in[i] == edge_in[m, 0], edge_in[m, 1], edge_in[m, 0])
                    far = _side_at(surface_in, other, row(point_in, i))[3]
                if edge_in[m, 2] == SMOOTH:
                    along = 0.0
                elif ti.abs(far) <= limit[0]:
                    f = place_on_profile(
                        surface_in, edge_in[m, 0], edge_in[m, 1], row(point_in, i), radius, hollow
                    )
                    ball = ti.cast(f[2], ti.i32) == BALL
                    fits = ti.abs(f[0]) <= ti.select(ball, limit[1], limit[2]) or (ball and sharp)
                    if fits and f[1] <= limit[0]:
                        along = f[1]
            along_out[entry_in[e, 3] + k] = along


def place(
    points: Any,
    normals: Any,
    surfaces: np.ndarray,
    pairs: np.ndarray,
    radius: np.ndarray,
    point: np.ndarray,
    edge: np.ndarray,
) -> Places:
    """Return where points lie on the profiles of edges.

    Args:
        points: Positions [mm], shape (n, 3) (kernel array).
        normals: Normals, shape (n, 3) (kernel array).
        surfaces: Surfaces as rows of parameters (8), kind, side: 1 where the outward normal points
            into the air, else -1; shape (M, 10).
        pairs: The two surfaces of every edge, shape (P, 2).
        radius: Signed radius of every edge [mm], above 0 = concave, shape (P,).
        point: Point of every entry, shape (E,).
        edge: Edge of every entry, shape (E,).
    """
    runtime.ensure_started()
    entries = len(point)
    if entries == 0:
        return Places(*np.zeros((6, 0)))
    out = runtime.empty((6, entries), np.float64)
    entry = np.empty((entries, 2), np.int32)
    entry[:, 0], entry[:, 1] = point, edge
    _place(
        entries,
        points,
        normals,
        runtime.upload(surfaces),
        runtime.upload(pairs.astype(np.int32)),
        runtime.upload(radius.astype(np.float64)),
        runtime.upload(entry),
        out,
    )
    return Places(*runtime.download(out))


def points_beside(
    points: Any,
    label: np.ndarray,
    surfaces: np.ndarray,
    edges: np.ndarray,
    strips: np.ndarray,
    radius: np.ndarray,
    edge: np.ndarray,
    first: np.ndarray,
    count: np.ndarray,
    *,
    reach: float,
    on_ball: float,
    on_side: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points of ranges that are beside an edge.

    Beside a smooth joint are all points of its sides; beside a sharp edge those on its profile;
    beside a round one also those of its strips, and those without a label.

    Args:
        points: Positions [mm], shape (n, 3) (kernel array).
        label: Surface of every point, -1 = none, shape (n,), i32.
        surfaces: As for `place`.
        edges: Both surfaces of every edge, its `EdgeClass`, and the range of its strips, (P, 5).
        strips: Labels of points that lie on round edges, edge after edge.
        radius: Signed radius of every edge [mm], above 0 = concave, shape (P,).
        edge: Edge of every range, shape (E,).
        first: First point of every range, shape (E,).
        count: Its points, shape (E,).
        reach: Largest distance along the surface [mm]; and from the other one, at sharp edges.
        on_ball: Largest distance from the profile of a round edge between its lines [mm].
        on_side: Largest distance from the profile on the sides [mm].

    Returns:
        The points, the range of each, and how far it is from the edge along the surface [mm], 0 at
        smooth joints; range after range.
    """
    runtime.ensure_started()
    if len(edge) == 0:
        none = np.zeros(0, np.int64)
        return none, none, np.zeros(0)
    ends = np.cumsum(count, dtype=np.int64)
    along = runtime.empty(int(ends[-1]), np.float64)
    _reach_along(
        (reach, on_ball, on_side),
        points,
        runtime.upload(label),
        runtime.upload(surfaces),
        runtime.upload(edges.astype(np.int32)),
        runtime.upload(radius.astype(np.float64)),
        runtime.upload(strips.astype(np.int32)),
        runtime.upload(np.column_stack([edge, first, count, ends - count]).astype(np.int32)),
        along,
    )
    far = runtime.download(along)[: ends[-1]]
    beside = np.flatnonzero(far < np.inf)
    which = np.repeat(np.arange(len(edge)), count)[beside]
    return beside + (first - (ends - count))[which], which, far[beside]


def sums(
    points: Any,
    surfaces: np.ndarray,
    task: np.ndarray,
    shape: np.ndarray,
    entry: np.ndarray,
    cap: float,
    limit: np.ndarray | None = None,
) -> np.ndarray:
    """Return how well profiles fit.

    Args:
        points: Positions [mm], shape (n, 3) (kernel array).
        surfaces: As for `place`.
        task: First surface, second surface, first and last entry of every task, shape (T, 4).
        shape: Radius [mm] and 1 for concave, -1 for convex of every profile, shape (T, R, 2).
        entry: Points, listed for tasks, shape (E,).
        cap: Distances beyond this count as this [mm].
        limit: Where a sum of squares is above that of its task [mm^2], shape (T,), sums may leave
            out points; None = none does.

    Returns:
        Shape (T, R, 4): sum of the squares of distances [mm^2], half its gradient and curvature
        with respect to the radius, and the points between the lines of contact.
    """
    runtime.ensure_started()
    total = runtime.zeros((shape.shape[0] * shape.shape[1], 4), np.float64)
    if len(task):
        _sum_up(
            runtime.stride_of(len(task)),
            cap,
            points,
            runtime.upload(surfaces),
            runtime.upload(task.astype(np.int32)),
            runtime.upload(shape.reshape(-1, 2).astype(np.float64)),
            runtime.upload(np.full(len(task), np.inf) if limit is None else limit),
            runtime.upload(entry.astype(np.int32)),
            total,
        )
    return runtime.download(total)[: shape.shape[0] * shape.shape[1]].reshape(*shape.shape[:2], 4)
