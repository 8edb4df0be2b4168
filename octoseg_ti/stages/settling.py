"""Where two surfaces fit a point about as well, what lies around it tells which one it is on.

Next to a shallow edge, and where surfaces touch without one, two surfaces are nearer to each other
than the noise, and points that choose for themselves are mixed. The evidence of a point is how much
more the other surface costs; added up around a point, capped so that what lies beyond doubt on one
side does not outweigh the other, it has its zero on the edge: on either side of a line the mean
cost of the wrong surface is the higher one.
"""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import row
from octoseg_ti.device.runtime import F32Rows, F64Rows, I32Array, I32Rows, ti
from octoseg_ti.device.surfaces import surface_in_row
from octoseg_ti.stages.leaves import Leaves
from octoseg_ti.types import SurfaceKind

DOUBT = 9.0
"""A choice is beyond doubt when the next surface costs this much more: three deviations."""


_ACROSS = 0.35  # surfaces that meet at a larger angle [rad] cross; so do all planes
_PLANE = int(SurfaceKind.PLANE)


@ti.func
def box_gap(box_in: ti.template(), c: ti.i32, p: ti.template()) -> ti.f64:
    """Return the squared distance from a place to the box of leaf c."""
    gap = 0.0
    for k in ti.static(range(3)):
        off = ti.max(box_in[c, k] - p[k], p[k] - box_in[c, 3 + k], 0.0)
        gap += off * off
    return gap


@ti.func
def _evidence(
    label_in: ti.template(), second_in: ti.template(), off_in: ti.template(),
    a: ti.i32, b: ti.i32, j: ti.i32,
):  # fmt: skip
    """Return by how much point j, of surface a or b, is on the first rather than the second."""
    other = ti.select(label_in[j] == a, b, a)
    lead = ti.select(second_in[j] == other, ti.min(ti.cast(off_in[j, 2], ti.f64), DOUBT), DOUBT)
    return ti.select(label_in[j] == a, lead, -lead)


@ti.kernel
def _settle(
    reach: ti.f64,
    farthest: ti.f64,
    # In:
    point_in: F64Rows,
    surface_in: F64Rows,
    label_in: I32Array,
    second_in: I32Array,
    off_in: F32Rows,
    box_in: F64Rows,
    link_in: I32Rows,
    neighbor_in: I32Array,
    # Out:
    label_out: I32Array,
):
    """Let the points around every point in doubt decide."""
    for c in range(box_in.shape[0]):
        for i in range(link_in[c, 0], link_in[c, 1]):
            a = label_in[i]
            b = second_in[i]
            label_out[i] = a
            if a >= 0 and b >= 0 and off_in[i, 0] <= farthest:
                p = row(point_in, i)
                f, n = surface_in_row(surface_in, a, ti.cast(surface_in[a, 8], ti.i32), p)
                g, m = surface_in_row(surface_in, b, ti.cast(surface_in[b, 8], ti.i32), p)
                crossing = surface_in[a, 8] == _PLANE and surface_in[b, 8] == _PLANE
                if n.cross(m).norm() > _ACROSS:
                    crossing = True
                if crossing or off_in[i, 2] < DOUBT:
                    total = 0.0
                    # Where the points of each lie about the other.
                    ahead = ti.Vector([0.0, 0.0])
                    for k in range(link_in[c, 2] - 1, link_in[c, 3]):
                        d = c
                        if k >= link_in[c, 2]:
                            d = neighbor_in[k]
                        if box_gap(box_in, d, p) < reach * reach:
                            for j in range(link_in[d, 0], link_in[d, 1]):
                                if label_in[j] == a or label_in[j] == b:
                                    q = row(point_in, j)
                                    near = 1.0 - (q - p).norm_sqr() / (reach * reach)
                                    if near > 0.0:
                                        total += near * _evidence(
                                            label_in, second_in, off_in, a, b, j
                                        )
                                        if crossing:
                                            of = ti.select(label_in[j] == a, b, a)
                                            h, _ = surface_in_row(
                                                surface_in, of, ti.cast(surface_in[of, 8], ti.i32), q
                                            )
                                            if label_in[j] == a:
                                                ahead[0] += near * h
                                            else:
                                                ahead[1] += near * h
                    if crossing and ahead[0] * ahead[1] != 0.0:
                        total = ti.math.sign(ahead[0]) * g - ti.math.sign(ahead[1]) * f
                    if total < 0.0:
                        label_out[i] = b


def settle(
    points: Any,
    leaves: Leaves,
    label: Any,
    second: Any,
    off: Any,
    surfaces: np.ndarray,
    *,
    reach: float,
    farthest: float,
) -> np.ndarray:
    """Return the labels of all points, settled by what lies around them where two would do.

    Args:
        points: Sorted positions [mm], shape (n, 3), f64 (kernel array).
        leaves: The leaves: those that touch that of a point are looked at.
        label: What the points chose by themselves (`labelling.Choice`), shape (n,) (kernel array).
        second: What would come next; -1 = beyond doubt, shape (n,) (kernel array).
        off: Distance from that, and by how much it costs more, shape (n, 3) (kernel array).
        surfaces: The surfaces (`labelling.surface_table`), shape (M, 10).
        reach: Points within this distance count [mm].
        farthest: Only a surface within so many noises of a point can be its own.

    Returns:
        Surface of every sorted point, -1 = none, shape (n,), i32.
    """
    runtime.ensure_started()
    if len(surfaces) == 0:
        return runtime.download(label)
    settled = runtime.empty(label.shape[0], np.int32)
    place = runtime.download(points)
    box = np.concatenate(
        [np.minimum.reduceat(place, leaves.first), np.maximum.reduceat(place, leaves.first)], axis=1
    )
    link = np.stack(
        [leaves.first, leaves.first + leaves.count, leaves.start[:-1], leaves.start[1:]], axis=1
    )
    _settle(
        reach, farthest, points, runtime.upload(surfaces),
        label, second, off,
        runtime.upload(box), runtime.upload(link), runtime.upload(leaves.neighbor), settled,
    )  # fmt: skip
    return runtime.download(settled)
