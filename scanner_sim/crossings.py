"""Where a ray crosses one surface, and the distance and normal of surfaces, as Taichi functions."""

from octoseg_ti.device.runtime import ti
from octoseg_ti.types import SurfaceKind

_PLANE, _CYLINDER = int(SurfaceKind.PLANE), int(SurfaceKind.CYLINDER)
_CONE, _SPHERE = int(SurfaceKind.CONE), int(SurfaceKind.SPHERE)
FAR = 1e30
_HALVINGS = 48
_STILL = 4e-16  # a step this small, beside the root, is none


@ti.func
def vector(rows: ti.template(), i, k):
    """Read three neighbouring columns of a row."""
    return ti.Vector([rows[i, k], rows[i, k + 1], rows[i, k + 2]])


@ti.func
def distance(kind, data: ti.template(), s, p):
    """Return the signed distance of a point to surface s."""
    q = p - vector(data, s, 0)
    axis = vector(data, s, 3)
    height = q.dot(axis)
    result = height
    if kind != _PLANE:
        radius = (q - height * axis).norm()
        if kind == _CYLINDER:
            result = radius - data[s, 6]
        elif kind == _SPHERE:
            result = q.norm() - data[s, 6]
        elif kind == _CONE:
            result = radius * ti.cos(data[s, 6]) - height * ti.sin(data[s, 6])
        else:
            ring = radius - data[s, 6]
            result = ti.sqrt(ring * ring + height * height) - data[s, 7]
    return result


@ti.func
def surface_normal(kind, data: ti.template(), s, p):
    """Return the gradient of the distance to surface s."""
    q = p - vector(data, s, 0)
    axis = vector(data, s, 3)
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
def _quadratic(a, b, c):
    """Return the roots of a t^2 + 2 b t + c, without cancellation; far away when there is none."""
    roots = ti.Vector([FAR, FAR])
    disc = b * b - a * c
    if disc >= 0.0:
        q = -(b + ti.sqrt(disc)) if b > 0.0 else -(b - ti.sqrt(disc))
        if ti.abs(a) > 1e-14:
            roots[0] = q / a
        if ti.abs(q) > 1e-300:
            roots[1] = c / q
    return roots


@ti.func
def _between(c3, c2, c1, c0, lead, low, high):
    """Return the root of lead t^4 + c3 t^3 + c2 t^2 + c1 t + c0 between two signs.

    Newton's steps while they stay between the signs, halvings where they do not.
    """
    rising = (((lead * low + c3) * low + c2) * low + c1) * low + c0 < 0.0
    t = 0.5 * (low + high)
    for _ in range(_HALVINGS):
        value = (((lead * t + c3) * t + c2) * t + c1) * t + c0
        slope = ((4.0 * lead * t + 3.0 * c3) * t + 2.0 * c2) * t + c1
        if (value < 0.0) == rising:
            low = t
        else:
            high = t
        following = 0.5 * (low + high)
        if slope != 0.0:
            step = t - value / slope
            if low < step < high:
                following = step
        moved = ti.abs(following - t)
        t = following
        if moved <= _STILL * ti.max(1.0, ti.abs(t)):
            break
    return t


@ti.func
def _quartic(c2, c1, c0, limit):
    """Return the roots of t^4 + c2 t^2 + c1 t + c0 within the limits, between its extrema.

    The extrema are the roots of the derivative, found between the extrema of that one.
    """
    roots = ti.Vector([FAR, FAR, FAR, FAR])
    turn = ti.sqrt(-c2 / 6.0) if c2 < 0.0 else 0.0
    bends = ti.Vector([-limit, ti.max(-limit, -turn), ti.min(limit, turn), limit])
    extrema = ti.Vector([-limit, limit, limit, limit, limit])
    found = 1
    for k in range(3):
        low, high = bends[k], bends[k + 1]
        slope_low = (4.0 * low * low + 2.0 * c2) * low + c1
        slope_high = (4.0 * high * high + 2.0 * c2) * high + c1
        if (slope_low < 0.0) != (slope_high < 0.0):
            extrema[found] = _between(4.0, 0.0, 2.0 * c2, c1, 0.0, low, high)
            found += 1
    count = 0
    for k in range(4):
        low, high = extrema[k], extrema[k + 1]
        value_low = ((low * low + c2) * low + c1) * low + c0
        value_high = ((high * high + c2) * high + c1) * high + c0
        if (value_low < 0.0) != (value_high < 0.0):
            roots[count] = _between(0.0, c2, c1, c0, 1.0, low, high)
            count += 1
    return roots


@ti.func
def crossings(kind, data: ti.template(), s, origin, direction):
    """Return where a ray crosses surface s: up to four distances, unused ones far away."""
    found = ti.Vector([FAR, FAR, FAR, FAR])
    axis = vector(data, s, 3)
    a = data[s, 6]
    # Measured from the place nearest to the centre, the numbers stay small and exact.
    start = (vector(data, s, 0) - origin).dot(direction)
    q = origin + start * direction - vector(data, s, 0)
    along = direction.dot(axis)
    height = q.dot(axis)
    if kind == _PLANE:
        if ti.abs(along) > 1e-14:
            found[0] = start - height / along
    elif kind == _SPHERE:
        pair = _quadratic(1.0, q.dot(direction), q.dot(q) - a * a)
        found[0], found[1] = start + pair[0], start + pair[1]
    elif kind == _CYLINDER or kind == _CONE:
        off = q - height * axis
        turn = direction - along * axis
        k = ti.tan(a) * ti.tan(a) if kind == _CONE else 0.0
        rest = 0.0 if kind == _CONE else a * a
        pair = _quadratic(
            turn.dot(turn) - k * along * along,
            off.dot(turn) - k * height * along,
            off.dot(off) - k * height * height - rest,
        )
        for m in ti.static(range(2)):
            # The other half of the double cone is no part of the surface.
            if kind == _CYLINDER or height + pair[m] * along >= 0.0:
                found[m] = start + pair[m]
    else:
        b = data[s, 7]
        m = q.dot(q)
        limit = (a + b) * (a + b) - m
        if limit > 0.0:
            k = m + a * a - b * b
            found = _quartic(
                2.0 * k - 4.0 * a * a * (1.0 - along * along),
                8.0 * a * a * height * along,
                k * k - 4.0 * a * a * (m - height * height),
                ti.sqrt(limit) + 1e-6,
            )
            for n in range(4):
                if found[n] < FAR:
                    found[n] = start + _polished(
                        data, s, origin + start * direction, direction, found[n]
                    )
    return found


@ti.func
def _polished(data: ti.template(), s, origin, direction, t):
    """Return a root of the torus after two Newton steps on the distance itself."""
    for _ in range(2):
        q = origin + t * direction - vector(data, s, 0)
        axis = vector(data, s, 3)
        height = q.dot(axis)
        off = q - height * axis
        ring = off.norm() - data[s, 6]
        tube = ti.sqrt(ring * ring + height * height)
        slope = (ring / off.norm() * off.dot(direction) + height * axis.dot(direction)) / tube
        if ti.abs(slope) > 1e-6:
            t -= (tube - data[s, 7]) / slope
    return t
