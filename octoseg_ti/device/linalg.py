"""Small linear algebra for kernels: rows, boxes, angles, eigenvectors of symmetric 3x3 matrices."""

from octoseg_ti.device.runtime import ti

vec2 = ti.types.vector(2, ti.f64)
vec3 = ti.types.vector(3, ti.f64)
mat3 = ti.types.matrix(3, 3, ti.f64)

_SWEEPS = 12
# Coefficients of `angle_of`, the highest power first.
_ARC = (
    -0.0012624911,
    0.0066700901,
    -0.0170881256,
    0.0308918810,
    -0.0501743046,
    0.0889789874,
    -0.2145988016,
    1.5707963050,
)


@ti.func
def row(rows: ti.template(), i: ti.i32) -> vec3:
    """Return row ``i`` of an array of shape (n, 3)."""
    return vec3(rows[i, 0], rows[i, 1], rows[i, 2])


@ti.func
def box_gap(box_in: ti.template(), b: ti.i32, p: ti.template()) -> ti.f64:
    """Return the squared distance from a place to box ``b``: lower and upper corner in a row."""
    gap = 0.0
    for k in ti.static(range(3)):
        off = ti.max(box_in[b, k] - p[k], p[k] - box_in[b, 3 + k], 0.0)
        gap += off * off
    return gap


@ti.func
def angle_of(cosine: ti.f64) -> ti.f64:
    """Return the angle of a cosine between 0 and 1, to 3e-8 rad, much faster than acos does.

    Abramowitz and Stegun, Handbook of Mathematical Functions, 4.4.46.
    """
    series = 0.0
    for k in ti.static(range(len(_ARC))):
        series = series * cosine + _ARC[k]
    return ti.sqrt(1.0 - cosine) * series


@ti.func
def _rotation(diagonal_p: ti.f64, diagonal_q: ti.f64, off: ti.f64) -> vec3:
    """Return (cosine, sine, tangent) of the Jacobi rotation that zeroes ``off``."""
    t = 0.0
    if off != 0.0:
        theta = (diagonal_q - diagonal_p) / (2.0 * off)
        t = 1.0 / (ti.abs(theta) + ti.sqrt(theta * theta + 1.0))
        if theta < 0.0:
            t = -t
    c = 1.0 / ti.sqrt(t * t + 1.0)
    return vec3(c, t * c, t)


@ti.func
def symmetric_eigen(xx: ti.f64, xy: ti.f64, xz: ti.f64, yy: ti.f64, yz: ti.f64, zz: ti.f64):
    """Return (eigenvalues ascending, their eigenvectors u, v, w) of a symmetric matrix.

    Cyclic Jacobi rotations: slower than a closed formula and exact to rounding also for nearly
    equal eigenvalues, where the formula fails (flat and isotropic neighbourhoods are exactly that
    case).
    """
    a = vec3(xx, yy, zz)
    b = vec3(xy, xz, yz)
    u = vec3(1.0, 0.0, 0.0)
    v = vec3(0.0, 1.0, 0.0)
    w = vec3(0.0, 0.0, 1.0)
    sweep = 0
    while sweep < _SWEEPS:
        if ti.abs(b[0]) + ti.abs(b[1]) + ti.abs(b[2]) <= 1e-16 * (
            ti.abs(a[0]) + ti.abs(a[1]) + ti.abs(a[2])
        ):
            sweep = _SWEEPS
        else:
            r = _rotation(a[0], a[1], b[0])
            a = vec3(a[0] - r[2] * b[0], a[1] + r[2] * b[0], a[2])
            b = vec3(0.0, r[0] * b[1] - r[1] * b[2], r[1] * b[1] + r[0] * b[2])
            p = r[0] * u - r[1] * v
            v = r[1] * u + r[0] * v
            u = p
            r = _rotation(a[0], a[2], b[1])
            a = vec3(a[0] - r[2] * b[1], a[1], a[2] + r[2] * b[1])
            b = vec3(r[0] * b[0] - r[1] * b[2], 0.0, r[1] * b[0] + r[0] * b[2])
            p = r[0] * u - r[1] * w
            w = r[1] * u + r[0] * w
            u = p
            r = _rotation(a[1], a[2], b[2])
            a = vec3(a[0], a[1] - r[2] * b[2], a[2] + r[2] * b[2])
            b = vec3(r[0] * b[0] - r[1] * b[1], r[1] * b[0] + r[0] * b[1], 0.0)
            p = r[0] * v - r[1] * w
            w = r[1] * v + r[0] * w
            v = p
        sweep += 1
    if a[0] > a[1]:
        a = vec3(a[1], a[0], a[2])
        p = u
        u = v
        v = p
    if a[1] > a[2]:
        a = vec3(a[0], a[2], a[1])
        p = v
        v = w
        w = p
    if a[0] > a[1]:
        a = vec3(a[1], a[0], a[2])
        p = u
        u = v
        v = p
    return a, u, v, w
