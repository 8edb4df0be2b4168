"""Regions as a graph of touching boxes: every pair of cells is looked at."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass
class Leaf:
    """A leaf of the grid: its node number, place, and means."""

    node: int
    level: int
    place: np.ndarray
    count: int
    normal: np.ndarray
    point: np.ndarray


def touch(a: Leaf, b: Leaf, depth: int) -> bool:
    """Say whether two closed boxes share a point, in whole units of the finest cell."""
    sa, sb = 1 << (depth - a.level), 1 << (depth - b.level)
    low_a, low_b = a.place * sa, b.place * sb
    return bool(np.all(low_a <= low_b + sb) and np.all(low_b <= low_a + sa))


def touching_pairs(leaves: list[Leaf], depth: int) -> list[tuple[Leaf, Leaf]]:
    """Return every pair of leaves whose closed boxes touch."""
    low = np.array([c.place.astype(np.int64) << (depth - c.level) for c in leaves]).reshape(-1, 3)
    high = low + np.array([1 << (depth - c.level) for c in leaves], np.int64)[:, None]
    pairs = []
    for i, a in enumerate(leaves):
        near = np.all((low[i] <= high[i + 1 :]) & (low[i + 1 :] <= high[i]), axis=1)
        pairs += [(a, leaves[i + 1 + int(j)]) for j in np.flatnonzero(near)]
    return pairs


def agree(
    a: Leaf, b: Leaf, *, homogeneity: float, chord: float, slack: float, signed: bool
) -> tuple[bool, float]:
    """Say whether two cells belong to one surface, and how near the answer is to the other one."""
    nb = b.normal
    if not signed and a.normal @ nb < 0:
        nb = -nb
    between = b.point - a.point
    angle = math.cos(homogeneity)
    margin = abs(float(a.normal @ nb) - angle)
    good = float(a.normal @ nb) >= angle
    if math.isfinite(chord):
        lift = abs(float(between @ (a.normal + nb))) / 2
        limit = chord * float(np.linalg.norm(between)) + slack
        margin = min(margin, abs(lift - limit))
        good = good and lift <= limit
    return good, margin


def components(nodes: list[int], edges: list[tuple[int, int]]) -> dict[int, int]:
    """Return the smallest node of the connected component of every node, by walking from each."""
    beside: dict[int, list[int]] = {n: [] for n in nodes}
    for a, b in edges:
        beside[a].append(b)
        beside[b].append(a)
    root: dict[int, int] = {}
    for seed in sorted(nodes):
        if seed in root:
            continue
        queue = [seed]
        root[seed] = seed
        while queue:
            for b in beside[queue.pop(0)]:
                if b not in root:
                    root[b] = seed
                    queue.append(b)
    return root


def flood_fill(
    leaves: list[Leaf], pairs: list[tuple[Leaf, Leaf]], takes_part: Callable[[Leaf], bool], **rule
) -> tuple[dict[int, int], float]:
    """Return the group of every leaf that takes part, and the narrowest decision."""
    edges, closest = [], math.inf
    for a, b in pairs:
        if takes_part(a) and takes_part(b):
            good, margin = agree(a, b, **rule)
            closest = min(closest, margin)
            if good:
                edges.append((a.node, b.node))
    return components([c.node for c in leaves if takes_part(c)], edges), closest


def inner_cells(
    leaves: list[Leaf], pairs: list[tuple[Leaf, Leaf]], group: dict[int, int], size: dict[int, int]
) -> set[int]:
    """Return the leaves of groups that touch no leaf of a larger group."""
    border = set()
    for a, b in pairs:
        if a.node in group and b.node in group:
            size_a, size_b = size[group[a.node]], size[group[b.node]]
            if size_a < size_b:
                border.add(a.node)
            if size_b < size_a:
                border.add(b.node)
    return set(group) - border


def group_sizes(leaves: list[Leaf], group: dict[int, int]) -> dict[int, int]:
    """Return the points of every group."""
    size: dict[int, int] = {}
    for c in leaves:
        if c.node in group:
            size[group[c.node]] = size.get(group[c.node], 0) + c.count
    return size


def strips(leaves: list[Leaf], pairs: list[tuple[Leaf, Leaf]], group: dict[int, int]) -> set[int]:
    """Return the leaves of groups that have less than half of their area in inner cells."""
    inner = inner_cells(leaves, pairs, group, group_sizes(leaves, group))
    found = set()
    for name in set(group.values()):
        mine = [c for c in leaves if group.get(c.node) == name]
        whole = sum(0.25**c.level for c in mine)
        core = sum(0.25**c.level for c in mine if c.node in inner)
        if core < 0.5 * whole:
            found |= {c.node for c in mine}
    return found


def number_groups(leaves: list[Leaf], group: dict[int, int], min_points: int) -> dict[int, int]:
    """Return the label of every leaf of a group: by size, then by name; small groups have none."""
    size = group_sizes(leaves, group)
    large = [g for g in sorted(size) if size[g] >= max(1, min_points)]
    large.sort(key=lambda g: (-size[g], g))
    return {node: large.index(g) for node, g in group.items() if g in large}


def turning(
    leaves: list[Leaf],
    pairs: list[tuple[Leaf, Leaf]],
    group: dict[int, int],
    noise: float,
    finest: float,
) -> tuple[dict[int, float], dict[int, int]]:
    """Return the root mean square turning over one smallest cell, and the number of neighbours.

    Pairs that are farther apart than a smallest cell count less, by the square of their distance.
    """
    turn = dict.fromkeys((c.node for c in leaves), 0.0)
    far = dict.fromkeys(turn, 0.0)
    neighbours = dict.fromkeys(turn, 0)
    for a, b in pairs:
        if group.get(a.node, -1) != group.get(b.node, -2):
            continue
        m = b.normal if a.normal @ b.normal >= 0 else -b.normal
        t = float((a.normal - m) @ (a.normal - m)) - noise**2 * (1 / a.count + 1 / b.count)
        d = float((a.point - b.point) @ (a.point - b.point)) / finest**2
        weight = 1.0 / max(1.0, d)
        for c in (a, b):
            turn[c.node] += weight * t
            far[c.node] += weight * d
            neighbours[c.node] += 1
    return (
        {n: math.sqrt(max(0.0, turn[n]) / far[n]) if far[n] > 0 else 0.0 for n in turn},
        neighbours,
    )
