"""What happens stripe by stripe: cleaning, spacing, noise, edge-pair normals, registration."""

from __future__ import annotations

import math
from itertools import pairwise
from statistics import NormalDist

import numpy as np


def runs(start: np.ndarray) -> list[range]:
    """Return the rows of every stripe."""
    return [range(int(a), int(b)) for a, b in pairwise(start)]


def to_line(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Return the distance of a point from a line."""
    length = float((b - a) @ (b - a))
    t = 0.0 if length == 0.0 else float((p - a) @ (b - a)) / length
    return float(np.linalg.norm(p - (a + t * (b - a))))


def doubtful(
    points: np.ndarray, start: np.ndarray, *, off: float, step: float, far: float, short: int
) -> list[int]:
    """Return points off every line beside them, and those of short pieces between steps."""
    rows = set()
    for stripe in runs(start):
        pieces: list[list[int]] = [[]]
        for i in stripe:
            lines = [(i - 1, i + 1), (i - 2, i - 1), (i + 1, i + 2)]
            known = [line for line in lines if all(j in stripe for j in line)]
            if all(to_line(points[i], *(points[j] for j in line)) > off for line in known):
                rows.add(i)
            pieces[-1].append(i)
            if i + 1 in stripe and np.linalg.norm(points[i + 1] - points[i]) > step:
                joined = False
                if i - 1 in stripe:
                    joined |= to_line(points[i + 1], points[i - 1], points[i]) <= off
                if i + 2 in stripe:
                    joined |= to_line(points[i], points[i + 1], points[i + 2]) <= off
                if not joined or np.linalg.norm(points[i + 1] - points[i]) > far:
                    pieces.append([])
        rows.update(i for piece in pieces if len(piece) < short for i in piece)
    return sorted(rows)


def stripe_roughness(points: np.ndarray, start: np.ndarray) -> float:
    """Return the noise from the distances to the line through the two neighbours [mm]."""
    off = [to_line(points[i], points[i - 1], points[i + 1]) for s in runs(start) for i in s[1:-1]]
    upper = sorted(off)[int(0.75 * (len(off) - 1))] if off else 0.0
    return upper / NormalDist().inv_cdf(0.875) / math.sqrt(1.5)


def stripe_spacing(points: np.ndarray, start: np.ndarray, view: np.ndarray) -> tuple[float, float]:
    """Return the median distance to the next point, and to the nearest one of the next stripe."""
    stripes = runs(start)
    along = [np.linalg.norm(points[i + 1] - points[i]) for s in stripes for i in s[:-1]]
    across = [
        np.linalg.norm(points[list(following)] - points[i], axis=1).min()
        for stripe, following in pairwise(stripes)
        if view[stripe[0]] == view[following[0]]
        for i in stripe
    ]
    return (
        float(np.median(along)) if along else 0.0,
        float(np.median(across)) if across else 0.0,
    )


def lower_three_quarters(values: list[float]) -> float:
    """Return the mean of the lower three quarters, 0 of nothing."""
    kept = sorted(values)[: max(1, int(0.75 * len(values)))]
    return math.fsum(kept) / len(kept) if kept else 0.0


def stripe_noise(
    points: np.ndarray, normals: np.ndarray, start: np.ndarray, gap: float, lag: int = 3
) -> tuple[float, float]:
    """Return range noise [mm] and noise of the normals [rad] from second differences.

    Of the difference between a normal and the middle of two others, the part along the surface.
    """
    second, tilt = [], []
    for stripe in runs(start):
        for i in stripe:
            if not normals[i].any():
                continue
            p = points[i]
            if i - 1 in stripe and i + 1 in stripe:
                a, b = points[i - 1] - p, points[i + 1] - p
                if max(np.linalg.norm(a), np.linalg.norm(b)) <= gap:
                    second.append(abs(float((a + b) @ normals[i])))
            if i - lag in stripe and i + lag in stripe:
                m, n = normals[i - lag], normals[i + lag]
                far = np.linalg.norm(points[i - lag] - points[i + lag]) > 2 * lag * gap
                if m.any() and n.any() and not far:
                    off = normals[i] - (m + n) / 2
                    tilt.append(float(np.linalg.norm(off - (off @ normals[i]) * normals[i])))
    # Expected trimmed means of the distributions that pure noise of unit size would give.
    normal, q = NormalDist(), NormalDist().inv_cdf(0.875)  # three quarters lie within -q..q
    half_normal = 2 * (normal.pdf(0) - normal.pdf(q)) / 0.75
    q = math.sqrt(-2 * math.log(0.25))  # three quarters of a Rayleigh variable lie below q
    rayleigh = (math.sqrt(math.pi / 2) * math.erf(q / math.sqrt(2)) - q * 0.25) / 0.75
    # A difference a - 2 p + b has 1 + 4 + 1 variances; n - (m + n) / 2 has 1 + 1/4 + 1/4.
    noise = lower_three_quarters(second) / half_normal / math.sqrt(6)
    component = lower_three_quarters(tilt) / rayleigh / math.sqrt(1.5)
    return noise, component * math.sqrt(2)


def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the cross product, written out."""
    return np.array(
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    )


def strip_triangles(
    first: np.ndarray, second: np.ndarray, rule: str, axis: np.ndarray
) -> list[tuple[int, int, tuple[int, int]]]:
    """Return the edge pairs between two lines (Fig. 5): origin on the second line, first edge's end
    on the first, and the new vertex as (line 0 or 1, place)."""
    triangles = []
    a, b = 0, 0  # origin: second[a]; end of the first edge: first[b]
    while a + 1 < len(second) or b + 1 < len(first):
        if a + 1 == len(second):
            case = 1
        elif b + 1 == len(first):
            case = 2
        elif rule == "paper":
            # The distance along y is counted from the origin, with its sign.
            y_1 = float((first[b + 1] - second[a]) @ axis)
            y_2 = float((second[a + 1] - second[a]) @ axis)
            case = 1 if y_1 <= y_2 else 2
        else:
            diagonal_1 = math.dist(first[b + 1], second[a])
            diagonal_2 = math.dist(second[a + 1], first[b])
            case = 1 if diagonal_1 <= diagonal_2 else 2
        if case == 1:  # Fig. 5a: the second edge becomes the next first edge
            triangles.append((a, b, (0, b + 1)))
            b += 1
        else:  # Fig. 5b: the origin moves
            triangles.append((a, b, (1, a + 1)))
            a += 1
    return triangles


def edge_pair_normals(
    points: np.ndarray,
    start: np.ndarray,
    view: np.ndarray,
    *,
    gap: float,
    rule: str,
    weight: str,
    origin: np.ndarray | None,
) -> np.ndarray:
    """Return the mean normal of all edge pairs that use a point, on the side of the probe."""
    stripes = runs(start)
    axes = {}
    for v in set(view.tolist()):
        along = sum(points[s[-1]] - points[s[0]] for s in stripes if view[s[0]] == v)
        length = np.linalg.norm(along)
        axes[v] = along / length if length > 0 else along
    total = np.zeros((len(points), 3))
    for one, two in pairwise(stripes):
        v = int(view[one[0]])
        if v != view[two[0]]:
            continue
        for a, b, (line, place) in strip_triangles(
            points[list(one)], points[list(two)], rule, axes[v]
        ):
            corners = (two[a], one[b], (one, two)[line][place])
            p, q, r = (points[c] for c in corners)
            if max(math.dist(p, q), math.dist(q, r), math.dist(r, p)) > gap:
                continue
            n = cross(q - p, r - p)
            if weight == "unit":
                size = math.hypot(*n)
                # Three points on a line have no normal.
                flat = size <= 1e-12 * math.dist(p, q) * math.dist(p, r)
                n = np.zeros(3) if flat else n / size
            for c in corners:
                total[c] += n
    size = np.linalg.norm(total, axis=1, keepdims=True)
    normals = np.divide(total, size, out=np.zeros_like(total), where=size > 0)
    for v in set(view.tolist()):
        mine = view == v
        if origin is not None:
            side = np.sign(np.einsum("ni,ni->n", normals[mine], origin[v] - points[mine]))
        else:
            middle = points[mine].mean(axis=0)
            side = np.sign(np.einsum("ni,ni->n", normals[mine], points[mine] - middle))
        if side.sum() < 0:
            normals[mine] = -normals[mine]
    return normals


def to_world(
    points: np.ndarray, normals: np.ndarray, view: np.ndarray, T_world_view: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Apply the pose of its view to every point."""
    moved = np.array([(T_world_view[v] @ [*p, 1.0])[:3] for p, v in zip(points, view, strict=True)])
    turned = np.array([T_world_view[v][:3, :3] @ n for n, v in zip(normals, view, strict=True)])
    return moved, turned
