"""Where two surfaces fit a point about as well, what lies around it tells which one it is on.

Next to an edge, and where surfaces touch without one, two surfaces are nearer to each other than
the noise, and points that choose for themselves are mixed. Two ways tell them apart:

- Surfaces that cross: on the part's side of the edge each is in front of the other, or each behind,
  as the points of both around there tell. A point is on the one that it is farther along towards:
  the error of its height changes both distances alike, and has no say.
- Surfaces that touch: the evidence of a point is how much more the other surface costs. Added up
  around a point, capped so that what is beyond doubt on one side does not outweigh the other, it
  has its zero where they touch: on either side the mean cost of the wrong one is higher.
"""

from typing import Any

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.linalg import box_gap, row, vec3
from octoseg_ti.device.runtime import F32Rows, F64Rows, I32Array, I32Rows, ti
from octoseg_ti.device.surfaces import surface_in_row
from octoseg_ti.stages.leaves import Leaves
from octoseg_ti.types import SurfaceKind

DOUBT = 9.0
"""A choice is beyond doubt when the next surface costs this much more: three deviations."""

_ACROSS = 0.35  # surfaces that meet at a larger angle [rad] cross; so do all planes
_PLANE = int(SurfaceKind.PLANE)


@ti.func
def _lead(
    label_in: ti.template(), second_in: ti.template(), off_in: ti.template(),
    a: ti.i32, b: ti.i32, j: ti.i32,
):  # fmt: skip
    """Return by how much point j, of surface a or b, is on the first rather than the second."""
    other = ti.select(label_in[j] == a, b, a)
    sure = ti.max(0.0, ti.min(ti.cast(off_in[j, 2], ti.f64), DOUBT))
    lead = ti.select(second_in[j] == other, sure, DOUBT)
    return ti.select(label_in[j] == a, lead, -lead)


@ti.func
def _ask(
    leaf: ti.template(), surface_in: ti.template(), label_in: ti.template(),
    second_in: ti.template(), off_in: ti.template(), point_in: ti.template(),
    p: vec3, a: ti.i32, b: ti.i32, reach: ti.f64,
) -> vec3:  # fmt: skip
    """Ask the points of a leaf, the nearer the more.

    Returns how much they lead for surface a, and where those of each lie about the other.
    """
    total, ahead_a, ahead_b = 0.0, 0.0, 0.0
    for j in range(leaf[0], leaf[1]):
        if label_in[j] == a or label_in[j] == b:
            q = row(point_in, j)
            weight = 1.0 - (q - p).norm_sqr() / (reach * reach)
            if weight > 0.0:
                total += weight * _lead(label_in, second_in, off_in, a, b, j)
                of = ti.select(label_in[j] == a, b, a)
                h, _ = surface_in_row(surface_in, of, ti.cast(surface_in[of, 8], ti.i32), q)
                if label_in[j] == a:
                    ahead_a += weight * h
                else:
                    ahead_b += weight * h
    return vec3(total, ahead_a, ahead_b)


@ti.kernel
def _settle(
    reach: ti.f64,
    farthest: ti.f64,
    doubt: ti.f64,
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
            a, b = label_in[i], second_in[i]
            label_out[i] = a
            if a >= 0 and b >= 0 and off_in[i, 0] <= farthest:
                p = row(point_in, i)
                f, n = surface_in_row(surface_in, a, ti.cast(surface_in[a, 8], ti.i32), p)
                g, m = surface_in_row(surface_in, b, ti.cast(surface_in[b, 8], ti.i32), p)
                flat = surface_in[a, 8] == _PLANE and surface_in[b, 8] == _PLANE
                crossing = flat or n.cross(m).norm() > _ACROSS
                if crossing or off_in[i, 2] < doubt:
                    told = vec3(0.0, 0.0, 0.0)
                    for k in range(link_in[c, 2] - 1, link_in[c, 3]):
                        d = c
                        if k >= link_in[c, 2]:
                            d = neighbor_in[k]
                        if box_gap(box_in, d, p) < reach * reach:
                            leaf = ti.Vector([link_in[d, 0], link_in[d, 1]])
                            told += _ask(
                                leaf, surface_in, label_in, second_in, off_in, point_in,
                                p, a, b, reach,
                            )  # fmt: skip
                    if crossing and told[1] * told[2] != 0.0:
                        told[0] = ti.math.sign(told[1]) * g - ti.math.sign(told[2]) * f
                    if told[0] < 0.0:
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
    doubt: float = DOUBT,
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
        doubt: Where surfaces touch, a choice is in doubt when the next one costs less than this
            more; 0 = each point tells best, as where the noise is not known to be so large.

    Returns:
        Surface of every sorted point, -1 = none, shape (n,), i32.
    """
    runtime.ensure_started()
    if len(surfaces) == 0:
        return runtime.download(label)
    settled = runtime.empty(label.shape[0], np.int32)
    link = np.stack(
        [leaves.first, leaves.first + leaves.count, leaves.start[:-1], leaves.start[1:]], axis=1
    )
    _settle(
        reach, farthest, doubt, points, runtime.upload(surfaces),
        label, second, off,
        runtime.upload(leaves.box), runtime.upload(link), runtime.upload(leaves.neighbor), settled,
    )  # fmt: skip
    return runtime.download(settled)
