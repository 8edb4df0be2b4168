"""Plain answers to compare with: open sides of points, free sectors, what is beyond a border."""

from __future__ import annotations

import numpy as np

from octoseg_ti.stages.rims import BEFORE, BEHIND, DOWN, ENDED, HIDDEN, NEXT, PASSED, UP, Lines

LANES, TOWARDS, SLOPE = 2.0, 0.3, 0.02


def stripe_of(lines: Lines, i: int) -> int:
    return int(np.searchsorted(lines.start, i, side="right")) - 1


def on_ray(lines: Lines, i: int, t: int) -> int:
    """Point of stripe t on the ray of point i, -1 if there is none or t is of another view.

    Of two that are as near the later one counts.
    """
    s = stripe_of(lines, i)
    if not 0 <= t < len(lines.view) or lines.view[t] != lines.view[s]:
        return -1
    mine = np.arange(lines.start[t], lines.start[t + 1])
    off = np.abs(lines.lane[mine] - lines.lane[i])
    return int(mine[off == off.min()][-1]) if off.min() <= LANES else -1


def inside(lines: Lines, i: int, j: int) -> int:
    """Point j if it is on the stripe of point i, else -1."""
    s = stripe_of(lines, i)
    return j if lines.start[s] <= j < lines.start[s + 1] else -1


def open_sides(lines: Lines, i: int, gap: float) -> int:
    def near(j: int) -> bool:
        return j >= 0 and bool(np.linalg.norm(lines.points[j] - lines.points[i]) <= gap)

    s, side = stripe_of(lines, i), 0
    ahead, back = near(inside(lines, i, i + 1)), near(inside(lines, i, i - 1))
    up, down = near(on_ray(lines, i, s + 1)), near(on_ray(lines, i, s - 1))
    side += NEXT * (back and not ahead) + BEFORE * (ahead and not back)
    return side + UP * (down and not up) + DOWN * (up and not down)


def look_beyond(
    lines: Lines, field: np.ndarray, i: int, side: int, normal: np.ndarray, outward: np.ndarray,
    gap: float, off: float,
) -> int:  # fmt: skip
    s, p, found = stripe_of(lines, i), lines.points[i], 0

    def crossing(q: np.ndarray, t: int) -> float | None:
        height = (q - p) @ normal
        away = normal if lines.source is None else lines.source[t] - q
        if height >= -off - SLOPE * np.linalg.norm(q - p) or away @ normal <= 0:
            return None
        return float(np.linalg.norm(q - away * height / (away @ normal) - p))

    def towards(j: int) -> bool:
        way = p - lines.points[j]
        return bool(way @ outward >= TOWARDS * np.linalg.norm(way))

    for bit, step in ((NEXT, 1), (BEFORE, -1)):
        if side & bit and towards(i - step):
            k = inside(lines, i, i + step)
            if k >= 0:
                far = crossing(lines.points[k], s)
                found |= BEHIND if far is not None and far <= gap else HIDDEN
            else:
                low, high = field[lines.view[s]]
                found |= ENDED if low < lines.lane[i] < high else HIDDEN
    for bit, step in ((UP, 1), (DOWN, -1)):
        if side & bit and towards(on_ray(lines, i, s - step)):
            stripes = np.flatnonzero(lines.view == lines.view[s])
            stripes = stripes[stripes > s] if step > 0 else stripes[stripes < s][::-1]
            seen = [(on_ray(lines, i, t), t) for t in stripes]
            seen = [(k, t) for k, t in seen if k >= 0]
            if not seen:
                found |= ENDED if len(stripes) else PASSED
                continue
            far = crossing(lines.points[seen[0][0]], seen[0][1])
            if far is not None and far <= gap:
                found |= BEHIND
                continue
            steps = lines.points[[k for k, _ in seen[1:]]] - p
            above = steps @ normal > off + SLOPE * np.linalg.norm(steps, axis=1)
            free = far is not None and lines.source is not None and not above.any()
            found |= BEHIND if free else HIDDEN
    return found


def free_sectors(
    points: np.ndarray, i: int, normal: np.ndarray, radius: float, sectors: int
) -> int:
    """Most free sectors beside each other in the tangent plane of point i."""
    u = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) <= 0.7 else np.array([0.0, 1.0, 0.0])
    u = u - (u @ normal) * normal
    u /= np.linalg.norm(u)
    step = points - points[i]
    far = np.linalg.norm(step, axis=1)
    step = step[(far <= radius) & (far > 0)]
    turn = np.arctan2(step @ np.cross(normal, u), step @ u) / (2 * np.pi)
    held = set((np.floor(turn * sectors).astype(int) % sectors).tolist())
    free = [(first + k) % sectors not in held for first in range(sectors) for k in range(sectors)]
    runs = np.array(free).reshape(sectors, sectors)
    return int(np.cumprod(runs, axis=1).sum(axis=1).max())
