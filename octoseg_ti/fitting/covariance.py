"""How sure the parameters of surfaces are: covariances by the points that they were fitted to."""

import numpy as np

from octoseg_ti.device.surfaces import (
    CONE,
    CYLINDER,
    KINDS,
    PLANE,
    SPHERE,
    TORUS,
    evaluate_surfaces,
)

PARAMETERS = 8
"""Point (3), axis or normal (3), a and b."""

WAYS = {
    PLANE: (0, 3, 4),
    CYLINDER: (1, 2, 3, 4, 5),
    CONE: (0, 1, 2, 3, 4, 5),
    SPHERE: (0, 1, 2, 5),
    TORUS: (0, 1, 2, 3, 4, 5, 6),
}
"""What a surface of every kind can do, in the order of `ways_of`: its point moves along the axis or
across it in two directions, its axis turns towards these two, a and b grow. A plane stays the same
where its point moves within it, a cylinder where that moves along the axis."""

# The parameters that a kind has.
_HAS = {
    PLANE: (0, 1, 2, 3, 4, 5),
    CYLINDER: (0, 1, 2, 3, 4, 5, 6),
    CONE: (0, 1, 2, 3, 4, 5, 6),
    SPHERE: (0, 1, 2, 6),
    TORUS: (0, 1, 2, 3, 4, 5, 6, 7),
}
# What of a column other columns leave is rounding below this share of it: what no point holds gets
# a large, finite deviation.
_ROUNDING = 1e-12


def covariances(
    points: np.ndarray, start: np.ndarray, kind: np.ndarray, parameters: np.ndarray
) -> np.ndarray:
    """Return the covariances of the parameters of surfaces fitted by least orthogonal distances.

    To first order, for independent noise: s^2 (J'J)^-1, with J the change of the distances by what
    the surface can do, and s^2 the sum of the squares of the distances over the points less the
    unknowns.

    Args:
        points: The points that every surface was fitted to, one group after the other [mm], shape
            (S, 3), f64.
        start: First point of every surface, and S at the end, shape (M + 1,).
        kind: `SurfaceKind` of every surface, shape (M,), one of the five analytic kinds.
        parameters: As in `Segmentation.parameters`, shape (M, 8).

    Returns:
        As in `Segmentation.covariance`, shape (M, 8, 8), f64; NaN where there are no more points
        than unknowns.
    """
    kind, start = np.asarray(kind, np.int32), np.asarray(start, np.int64)
    count = np.diff(start)
    owner = np.repeat(np.arange(len(kind), dtype=np.int32), count)
    far, normal = evaluate_surfaces(points, owner, kind, parameters)
    change = distance_gradient(points, normal, kind[owner], parameters[owner])
    found = np.full((len(kind), PARAMETERS, PARAMETERS), np.nan)
    for code in range(KINDS):
        which = np.flatnonzero((kind == code) & (count > len(WAYS[code])))
        if len(which) == 0:
            continue
        place, there = padded(start, which)
        ways = ways_of(parameters[which, 3:6])[:, :, WAYS[code]]
        columns = np.einsum("mni,mik->kmn", change[place], ways) * there
        root = np.einsum("mik,mkj->mij", ways, np.linalg.inv(_triangles(columns)))
        square = np.sum((far[place] * there) ** 2, axis=1) / (count[which] - len(WAYS[code]))
        has = np.isin(np.arange(PARAMETERS), _HAS[code])
        whole = square[:, None, None] * np.einsum("mik,mjk->mij", root, root)
        found[which] = np.where(has & has[:, None], whole, np.nan)
    return found


def distance_gradient(
    points: np.ndarray, normal: np.ndarray, kind: np.ndarray, parameters: np.ndarray
) -> np.ndarray:
    """Return how the distances of points to surfaces change with the parameters of these.

    Args:
        points: Positions [mm], shape (S, 3).
        normal: Outward normal of the surface at the foot of every point, shape (S, 3).
        kind: `SurfaceKind` of the surface of every point, shape (S,).
        parameters: Its parameters, shape (S, 8).

    Returns:
        Shape (S, 8); for changes of the axis that keep its length, 0 for what a kind has not.
    """
    q, axis = points - parameters[:, :3], parameters[:, 3:6]
    height, slope = np.einsum("si,si->s", q, axis), np.einsum("si,si->s", normal, axis)
    away = q - height[:, None] * axis
    rho = np.sqrt(np.einsum("si,si->s", away, away))
    a = np.where((kind == CYLINDER) | (kind == SPHERE), -1.0, 0.0)
    cone, ring = kind == CONE, kind == TORUS
    half = parameters[cone, 6]
    # Behind the apex of a cone its angle changes nothing.
    a[cone] = -np.maximum(rho[cone] * np.sin(half) + height[cone] * np.cos(half), 0.0)
    a[ring] = -np.einsum("si,si->s", normal, away)[ring] / np.maximum(rho[ring], 1e-300)
    turned = slope[:, None] * q - height[:, None] * normal
    return np.column_stack([-normal, turned, a, np.where(ring, -1.0, 0.0)])


def padded(start: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of some groups in a table, and which entries are points and no padding.

    Args:
        start: First point of every group, and S at the end, shape (M + 1,).
        which: The groups, at least one, shape (m,).
    """
    place = start[which, None] + np.arange((start[which + 1] - start[which]).max())
    there = place < start[which + 1, None]
    return np.where(there, place, 0), there


def ways_of(axis: np.ndarray) -> np.ndarray:
    """Return the seven ways in which parameters can change, by columns, shape (M, 8, 7)."""
    # Any two directions across the axis: the first is across the coordinate that it has least of.
    least = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    u = np.cross(axis, least)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axis, u)
    ways = np.zeros((len(axis), PARAMETERS, 7))
    for k, direction in enumerate((axis, u, v)):
        ways[:, :3, k] = direction
    ways[:, 3:6, 3], ways[:, 3:6, 4] = u, v
    ways[:, 6, 5] = ways[:, 7, 6] = 1.0
    return ways


def _triangles(columns: np.ndarray) -> np.ndarray:
    """Return R of J = QR, by the modified Gram-Schmidt process.

    Radius and centre of a shallow piece of a sphere change the distances almost alike. R tells what
    is left of that to half as many digits as J'J would lose.

    Args:
        columns: J of every surface, shape (unknowns, M, points); used up.

    Returns:
        Upper triangles, shape (M, unknowns, unknowns).
    """
    unknowns, many, _ = columns.shape
    triangle = np.zeros((many, unknowns, unknowns))
    whole = np.sqrt(np.einsum("kmn,kmn->km", columns, columns))
    for k in range(unknowns):
        left = np.sqrt(np.einsum("mn,mn->m", columns[k], columns[k]))
        least = _ROUNDING * np.where(whole[k] > 0.0, whole[k], 1.0)
        triangle[:, k, k] = np.maximum(left, least)
        unit = columns[k] / triangle[:, k, k, None]
        for j in range(k + 1, unknowns):
            triangle[:, k, j] = np.einsum("mn,mn->m", unit, columns[j])
            columns[j] -= triangle[:, k, j, None] * unit
    return triangle
