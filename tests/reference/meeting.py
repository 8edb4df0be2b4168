"""Where surfaces meet, over lists of leaves, by looking at every pair."""

from __future__ import annotations

import numpy as np

from reference.graph import components


def contacts(
    own: list[list[int]], pairs: list[tuple[int, int]]
) -> dict[tuple[int, int], list[int]]:
    """Return in which leaves, and first leaves of pairs, every two surfaces are both found."""
    found: dict[tuple[int, int], list[int]] = {}
    for a, b in pairs + [(c, c) for c in range(len(own))]:
        if a != b and len(own[a]) == len(own[b]) == 1 and own[a] == own[b]:
            continue
        for one in own[a]:
            for other in own[b]:
                if one != other:
                    key = (min(one, other), max(one, other))
                    found.setdefault(key, []).append(a)
    return found


def pieces(
    own: list[list[int]],
    pairs: list[tuple[int, int]],
    points: dict[tuple[int, int], np.ndarray] | None = None,
    gap: float = np.inf,
) -> list[list[int]]:
    """Return the piece of every entry, by the number of its first entry.

    With the points of every entry, boxes around them are no farther apart than a gap.
    """

    def near(a: int, b: int, s: int) -> bool:
        if points is None:
            return True
        one, other = points[a, s], points[b, s]
        apart = np.maximum(one.min(axis=0) - other.max(axis=0), other.min(axis=0) - one.max(axis=0))
        return float(np.linalg.norm(np.maximum(apart, 0.0))) <= gap

    number = {(c, s): 0 for c, mine in enumerate(own) for s in mine}
    number = {entry: k for k, entry in enumerate(number)}
    edges = [
        (number[a, s], number[b, s])
        for a, b in pairs
        for s in own[a]
        if s in own[b] and near(a, b, s)
    ]
    root = components(list(range(len(number))), edges)
    return [[root[number[c, s]] for s in mine] for c, mine in enumerate(own)]


def explained_by_others(
    label: np.ndarray, second: np.ndarray, off: np.ndarray, count: int, limit: float
) -> list[int]:
    """Return the surfaces whose points are within the limit of those they would choose next.

    And errors of form: what is a little off one that is four times as large, smoothly. Eight noises
    away nothing explains a point.
    """
    second = np.where(off[:, 0] < 8.0, second, -1)
    size = [int((label == m).sum()) for m in range(count)]
    gone: list[int] = []
    kept: set[int] = set()
    for m in sorted(range(count), key=lambda m: size[m]):
        mine = np.flatnonzero(label == m)
        if len(mine) == 0 or m in kept:
            continue

        def mean(column: int, cap: float, mine: np.ndarray = mine) -> float:
            far = [min(off[i, column], cap) ** 2 if second[i] >= 0 else cap**2 for i in mine]
            return float(np.mean(far))

        heirs = [int(second[i]) if second[i] >= 0 else m for i in mine]
        main = {h for h in set(heirs) if 5 * heirs.count(h) >= len(mine)}
        most = max(sorted(set(heirs)), key=heirs.count)
        form = most != m and 5 * heirs.count(most) >= 4 * len(mine) and 4 * len(mine) <= size[most]
        form = form and mean(0, 8.0) <= 16.0 and mean(1, 6.0) <= 9.0
        if (mean(0, 4.0) <= limit or form) and not main & set(gone):
            gone.append(m)
            kept |= main
    return gone
