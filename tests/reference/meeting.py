"""Where surfaces meet, over lists of leaves, by looking at every pair."""

from __future__ import annotations

import numpy as np

from reference.graph import components


def contacts(own: list[list[int]], pairs: list[tuple[int, int]]) -> dict[tuple[int, int], int]:
    """Return in how many leaves and pairs of leaves every two surfaces are both found."""
    found: dict[tuple[int, int], int] = {}
    for a, b in pairs + [(c, c) for c in range(len(own))]:
        if a != b and len(own[a]) == len(own[b]) == 1 and own[a] == own[b]:
            continue
        for one in own[a]:
            for other in own[b]:
                if one != other:
                    key = (min(one, other), max(one, other))
                    found[key] = found.get(key, 0) + 1
    return found


def pieces(own: list[list[int]], pairs: list[tuple[int, int]]) -> list[list[int]]:
    """Return the piece of every entry, by the number of its first entry."""
    number = {(c, s): 0 for c, mine in enumerate(own) for s in mine}
    number = {entry: k for k, entry in enumerate(number)}
    edges = [(number[a, s], number[b, s]) for a, b in pairs for s in own[a] if s in own[b]]
    root = components(list(range(len(number))), edges)
    return [[root[number[c, s]] for s in mine] for c, mine in enumerate(own)]


def explained_by_others(
    label: np.ndarray, second: np.ndarray, off: np.ndarray, count: int, limit: float
) -> list[int]:
    """Return the surfaces whose points are within the limit of those they would choose next.

    Only the rule for surfaces that are no errors of form: give points far enough apart in tilt.
    """
    size = [int((label == m).sum()) for m in range(count)]
    gone: list[int] = []
    kept: set[int] = set()
    for m in sorted(range(count), key=lambda m: size[m]):
        mine = np.flatnonzero(label == m)
        if len(mine) == 0 or m in kept:
            continue
        far = [min(off[i, 0], 4.0) ** 2 if second[i] >= 0 else 16.0 for i in mine]
        heirs = [int(second[i]) if second[i] >= 0 else m for i in mine]
        main = {h for h in set(heirs) if 5 * heirs.count(h) >= len(mine)}
        if np.mean(far) <= limit and not main & set(gone):
            gone.append(m)
            kept |= main
    return gone
