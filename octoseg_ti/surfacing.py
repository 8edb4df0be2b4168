"""From groups of cells to patches: surfaces are found, and their pieces are numbered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from octoseg_ti.defaults import PIECE_GAPS
from octoseg_ti.device import runtime
from octoseg_ti.params import Params
from octoseg_ti.patches import Regions, relabelled
from octoseg_ti.stages.extraction import Tolerance
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.labelling import Labelling, Rule, label_lists, surface_table
from octoseg_ti.stages.leaves import Leaves, leaf_graph, sizes_of
from octoseg_ti.stages.pieces import Entries, measure_entries, pieces
from octoseg_ti.stages.settling import settle
from octoseg_ti.surface_search import AROUND, EXPLAINED, FREE, NARROW, Surfaced, find_surfaces
from octoseg_ti.types import NONE

# Positions are exact, and tell by themselves, where a surface needs no more than this share of the
# points of a patch.
_ALONE = 0.33
# Distances beyond this many noises count as this many.
_CAP = 4.0
# A point that fits nothing joins a patch within so many times the usual reach.
_LOOSE = 3.0


def fit_surfaces(grid: Grid, leaves: np.ndarray, found: Regions, params: Params) -> Regions:
    """Explain regions by analytic surfaces, and give the points to these.

    Args:
        grid: The sparse grid.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        found: The regions of the flood fill. Those that no analytic surface explains are kept.
        params: Parameters, all filled in.
    """
    chosen = params.surfaces
    noise, tilt, turn, fewest = chosen.noise, chosen.tilt, chosen.turn, chosen.min_points
    least = params.regions.min_points
    assert noise is not None and tilt is not None and turn is not None
    assert fewest is not None and least is not None
    graph = leaf_graph(grid, leaves.astype(np.int32), found.touching)
    rule = Rule(noise, tilt)
    exact = fewest <= _ALONE * least
    if exact:
        rule = rule._replace(turn=max(rule.turn, NARROW * turn))
    surfaced = find_surfaces(
        grid, graph, found.group[leaves], found.cut[leaves],
        Tolerance(noise, turn, fewest, exact), rule, narrow=exact,
        limit=params.edges.fillet_radius,
    )  # fmt: skip
    piece, entries = connected_pieces(grid.point, graph, surfaced, params.normals.gap)
    label, surface = number_pieces(surfaced, entries, piece, least, fewest)
    label, surface, free = _with_free_forms(label, surface, found, least)
    if len(surface):
        table = surface_table(
            surfaced.surfaces.kind[surface], surfaced.surfaces.parameters[surface]
        )
        # What is left joins the nearest patch: with any normal, as edges have, or somewhat farther
        # off. What is neither near nor faces that way is something else.
        label = _join(grid, graph, label, table, rule._replace(turn=float(np.pi)))
        label = _join(grid, graph, label, table, rule._replace(reach=_LOOSE * rule.reach))
    found = replace(
        found,
        count=len(surface) + free,
        surface=np.concatenate([surface, np.full(free, NONE, np.int32)]),
        kind=surfaced.surfaces.kind,
        parameters=surfaced.surfaces.parameters,
        covariance=surfaced.covariance,
        graph=graph,
    )
    return relabelled(grid, leaves, found, label)


def _join(
    grid: Grid, graph: Leaves, label: np.ndarray, table: np.ndarray, rule: Rule
) -> np.ndarray:
    """Let the points without a patch choose one near them.

    Args:
        grid: The sparse grid.
        graph: Its leaves.
        label: Patch of every sorted point, -1 = none, shape (n,), i32.
        table: The surfaces of the first patches; the others are free forms.
        rule: What a point may differ from its surface.

    Returns:
        As ``label``.
    """
    left = np.flatnonzero(label < 0)
    if len(left) == 0:
        return label
    free = label.max() >= len(table)
    own = label_lists(graph, np.where(label < len(table), label, NONE) if free else label)
    closed = np.ones(len(graph), bool)
    closed[np.searchsorted(graph.first, left, side="right") - 1] = False
    labelling = Labelling(grid, graph, rule)
    labelling.choose(own, table, closed=closed)
    chosen, second, off = labelling.choice
    label, others = label.copy(), np.full_like(label, NONE)
    label[left], others[left] = runtime.download(chosen)[left], runtime.download(second)[left]
    return settle(
        grid.point, graph, runtime.upload(label), runtime.upload(others), off, table,
        reach=AROUND * float(graph.size.min()), farthest=rule.reach,
    )  # fmt: skip


def _with_free_forms(
    label: np.ndarray, surface: np.ndarray, found: Regions, least: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """Give the regions that surfaces do not explain back what they leave: these are free forms.

    Args:
        label: Patch of every sorted point, -1 = none, shape (n,), i32.
        surface: Surface of every patch.
        found: The regions of the flood fill.
        least: A region with fewer points is no patch.

    Returns:
        Patch of every point, the free forms last; surface of every other patch; and how many free
        forms there are.
    """
    size = sizes_of(found.label, found.count)
    left = sizes_of(found.label[label < 0], found.count)
    stays = (2 * left >= size) & (left >= least)
    stay = np.flatnonzero(stays)
    if len(stay) == 0:
        return label, surface, 0
    # Nothing tells a small surface within a free form from a part of it.
    size = sizes_of(label, len(surface))
    inside = np.append(stays, False)[found.label]
    within = sizes_of(label[inside], len(surface))
    kept = (size >= FREE * least) | (2 * within < size)
    number = np.full(len(surface) + 1, NONE, np.int32)
    number[:-1][kept] = np.arange(np.count_nonzero(kept), dtype=np.int32)
    label, surface = number[label], surface[kept]
    number = np.full(found.count + 1, NONE, np.int32)
    number[stay] = len(surface) + np.arange(len(stay), dtype=np.int32)
    return np.where(label < 0, number[found.label], label), surface, len(stay)


def connected_pieces(
    points: Any, leaves: Leaves, found: Surfaced, gap: float | None
) -> tuple[np.ndarray, Entries]:
    """Return the connected pieces of the surfaces, as `pieces` does, and the points in each leaf.

    Args:
        points: Sorted positions [mm], shape (n, 3), f64 (kernel array).
        leaves: The leaves.
        found: The surfaces and their points.
        gap: The longest edge of a triangle [mm]; pieces are no farther apart than a few of these.
            None = not known.
    """
    entries = measure_entries(points, leaves, found.own, found.label, found.off, _CAP)
    farthest = np.inf if gap is None else PIECE_GAPS * gap
    return pieces(leaves, found.own, entries.box, farthest), entries


def number_pieces(
    found: Surfaced, entries: Entries, piece: np.ndarray, least: float, fewest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Number the connected pieces of the surfaces by size.

    Args:
        found: The surfaces and their points.
        entries: Their points in every leaf (`measure_entries`).
        piece: Piece of every entry of their lists (`pieces`), shape (C, most), i32.
        least: A piece with fewer points is no patch, nor is one that other surfaces explain,
        fewest: unless it is the largest of its surface and has so many.

    Returns:
        Patch of every sorted point, -1 = none, shape (n,), i32; and the surface of every patch.
    """
    there = found.own >= 0
    surface, mine = found.own[there], piece[there]  # pieces are named by one of their entries
    size = np.bincount(mine, entries.size, len(mine)).astype(np.int64)
    most = np.zeros(len(found.surfaces), np.int64)
    np.maximum.at(most, surface, size)
    main = (size > 0) & (size == most[surface])
    # Where surfaces touch smoothly one goes on within the other, and gets some of its points.
    square = np.bincount(mine, entries.square, len(mine)) / np.maximum(size, 1)
    within = square <= EXPLAINED
    kept = size >= np.where(main, max(fewest, 1), max(least, 1))
    names = np.flatnonzero(kept & (main | ~within))
    names = names[np.argsort(-size[names], kind="stable")]
    number = np.full(len(size), NONE, np.int32)
    number[names] = np.arange(len(names), dtype=np.int32)
    label = np.append(number[mine], np.int32(NONE)).take(entries.of_point)
    return label, surface[names]
