"""Which surfaces touch, and how they meet where they do."""

from typing import NamedTuple

import numpy as np

from octoseg_ti.device.surfaces import evaluate_surfaces
from octoseg_ti.stages.leaves import Leaves, Samples
from octoseg_ti.stages.sets import Surfaces
from octoseg_ti.types import NONE

# Surfaces whose normals differ by more than this where they meet [rad] meet at an edge.
_EDGE = 0.7


class Contacts(NamedTuple):
    """Pairs of surfaces that touch."""

    pairs: np.ndarray
    """The surfaces, smaller number first, ascending, shape (P, 2)."""
    turn: np.ndarray
    """Least angle between them where they touch [rad], shape (P,)."""
    step: np.ndarray
    """Least distance between them where they touch [mm], shape (P,)."""

    def some(self, kept: np.ndarray) -> "Contacts":
        """Return some of the pairs."""
        return Contacts(self.pairs[kept], self.turn[kept], self.step[kept])


def smooth_contacts(
    leaves: Leaves, own: np.ndarray, samples: Samples, surfaces: Surfaces
) -> Contacts:
    """Return the pairs of surfaces that touch and do not meet at an edge: only these can be one.

    Args:
        leaves: The leaves.
        own: Surfaces with points in every leaf, ascending, then -1; shape (C, most), i32.
        samples: Samples of all leaves, in their order.
        surfaces: The surfaces.

    Returns:
        Of the pairs with points in one leaf, or in leaves that touch, those whose normals agree
        somewhere there.
    """
    one, other, leaf = _touches(leaves, own)
    width = len(surfaces)
    key = np.minimum(one, other).astype(np.int64) * width + np.maximum(one, other)
    order = np.argsort(key, kind="stable")
    key, one, other = key[order], one[order], other[order]
    point = samples.point.take(np.searchsorted(samples.leaf, leaf[order]), axis=0)
    off_one, n = evaluate_surfaces(point, one, surfaces.kind, surfaces.parameters)
    off_other, m = evaluate_surfaces(point, other, surfaces.kind, surfaces.parameters)
    cosine = np.einsum("ij,ij->i", n, m)
    # Which side is outside does not matter.
    step = np.abs(off_one - np.where(cosine < 0.0, -off_other, off_other))
    first = np.flatnonzero(np.diff(key, prepend=-1))
    if len(first) == 0:
        return Contacts(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0))
    facing = np.minimum(np.maximum.reduceat(np.abs(cosine), first), 1.0)
    pairs = np.stack(np.divmod(key[first], max(width, 1)), axis=1)
    found = Contacts(pairs, np.arccos(facing), np.minimum.reduceat(step, first))
    return found.some(facing >= np.cos(_EDGE))


def _touches(leaves: Leaves, own: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return two surfaces, and a leaf, for every place where surfaces touch, each shape (T,)."""
    held = (own >= 0).sum(axis=1)
    cells = np.arange(len(own), dtype=np.int32)
    a, b = np.concatenate([leaves.a, cells]), np.concatenate([leaves.b, cells])
    only = _only_surface(own)
    some = (only[a] < 0) | (only[a] != only[b])
    some[some] = (held[a[some]] > 0) & (held[b[some]] > 0)
    a, b = a[some], b[some]
    each = held[a] * held[b]
    at = np.repeat(np.arange(len(a)), each)
    rank = np.arange(len(at)) - np.repeat(np.cumsum(each) - each, each)
    one, other = own[a[at], rank // held[b[at]]], own[b[at], rank % held[b[at]]]
    differ = one != other
    return one[differ], other[differ], a[at[differ]]


def _only_surface(own: np.ndarray) -> np.ndarray:
    """Return the surface of leaves that have one, -1 of others, shape (C,)."""
    return np.where(own[:, 1] < 0, own[:, 0], NONE)
