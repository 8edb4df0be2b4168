"""Plain versions of `octoseg_ti.stages.support`: neighbours by search, planes one by one."""

from __future__ import annotations

import itertools

import numpy as np

REACH, PARTNERS = 24, 8
AGREE, ENOUGH, SLIM, CLOSE, OBLIQUE, HELD = 0.45, 0.55, 0.1, 0.3, 0.3, 0.2


def nearest(world: np.ndarray, rows: np.ndarray, i: int, radius: float) -> list[int]:
    """Return the nearest of some rows around a point, nearest first."""
    far = np.linalg.norm(world[rows] - world[i], axis=1)
    order = [int(rows[k]) for k in np.argsort(far, kind="stable") if far[k] < radius]
    return [q for q in order if q != i][:REACH]


def best_plane(
    world: np.ndarray, i: int, near: list[int], radius: float, off: float
) -> tuple[float, float, np.ndarray, bool]:
    """Return share, weight and normal of the best plane, and whether it is more than a line."""
    best: tuple[float, float, np.ndarray, bool] = (0.0, 0.0, np.zeros(3), False)
    value = 0.0
    d = world[near] - world[i] if near else np.empty((0, 3))
    far = np.linalg.norm(d, axis=1)
    weight = 1.0 - far / radius
    for a, b in itertools.combinations(range(min(PARTNERS, len(near))), 2):
        if value >= 1.0 + ENOUGH:
            break
        normal = np.cross(d[a], d[b])
        size = float(np.linalg.norm(normal))
        if size <= OBLIQUE * far[a] * far[b]:
            continue
        normal = normal / size
        on = np.abs(d @ normal) < off
        if on.sum() < 3:
            continue
        flat = np.array([d[a] / far[a], np.cross(normal, d[a] / far[a])]) @ d[on].T
        spread = np.linalg.eigvalsh(np.cov(flat, bias=True))
        wide = bool(spread[0] > (SLIM * radius) ** 2)
        share = float(weight[on].sum() / weight.sum())
        new = share + (1.0 if wide and share >= AGREE else 0.0)
        if new > value:
            value, best = new, (share, float(weight[on].sum()), normal, wide)
    return best


def find_support(
    world: np.ndarray,
    view: np.ndarray,
    doubtful: list[int],
    *,
    radius: float,
    off: float,
    backing: float,
    detached: int,
) -> np.ndarray:
    """Say which doubtful points lie on a surface that is more than a small detached group."""
    doubt = set(doubtful)
    verdict, links = dict.fromkeys(doubtful, 0), {i: {i} for i in doubtful}
    planes = {}
    for i in doubtful:
        near = nearest(world, np.flatnonzero(view == view[i]), i, radius)
        share, _, normal, wide = best_plane(world, i, near, radius, off)
        far = np.linalg.norm(world[near] - world[i], axis=1) if near else np.empty(0)
        sure = [q not in doubt for q in near]
        close = any(s and f < CLOSE * radius for s, f in zip(sure, far, strict=True))
        if share < AGREE or not (wide or close):
            continue
        on = [abs(float((world[q] - world[i]) @ normal)) < off for q in near]
        held = sum(1 - f / radius for f, s, o in zip(far, sure, on, strict=True) if s and o)
        verdict[i] = 1 if wide and held < backing else 2
        planes[i] = [q for q, o in zip(near, on, strict=True) if o]
    for i, on in planes.items():
        for j in on:
            if j in planes:
                group = links[i] | links[j]
                for k in group:
                    links[k] = group
    asked = {i for i in doubtful if verdict[i] == 0 or not lasting(links[i], verdict, detached)}
    for i in asked:
        for v in sorted(set(view.tolist()) - {int(view[i])}):
            near = nearest(world, np.flatnonzero(view == v), i, radius)
            share, weight, _, wide = best_plane(world, i, near, radius, off)
            if share >= AGREE and wide and weight >= backing:
                verdict[i] = 2
                break
    return np.array([verdict[i] > 0 and lasting(links[i], verdict, detached) for i in doubtful])


def lasting(group: set[int], verdict: dict[int, int], detached: int) -> bool:
    """Say whether a group is large, or held by other points."""
    size = sum(verdict[i] > 0 for i in group)
    held = sum(verdict[i] == 2 for i in group)
    return size >= detached or held >= max(1.0, HELD * size)
