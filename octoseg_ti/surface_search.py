"""The search for the surfaces of a part, round after round.

Groups that the flood fill found are explained by analytic surfaces; every point takes the surface
near it that it fits best; points that fit none form new groups, until nothing new is found. Then
surfaces that are one are merged, and surfaces that their neighbours explain are given up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.surfaces import evaluate_surfaces
from octoseg_ti.device.unionfind import components
from octoseg_ti.fitting.covariance import covariances
from octoseg_ti.fitting.refining import refine
from octoseg_ti.stages.contacts import smooth_contacts
from octoseg_ti.stages.extraction import Tolerance, explain
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.labelling import (
    Labelling,
    Rule,
    common_label,
    label_lists,
    own_lists,
    surface_table,
)
from octoseg_ti.stages.leaves import (
    Leaves,
    Samples,
    joined_samples,
    members_of,
    sample_leaves,
    sizes_of,
)
from octoseg_ti.stages.merging import cut_out, explained_by_others, merge_surfaces
from octoseg_ti.stages.refitting import FEWEST, fitted_to_others, refitted
from octoseg_ti.stages.rounds import hidden_rounds, refitted_rounds
from octoseg_ti.stages.sets import (
    Surfaces,
    flat_sets,
    no_surfaces,
    rms_of,
    sets_of,
    spread,
)
from octoseg_ti.stages.settling import DOUBT, settle
from octoseg_ti.types import NONE, SurfaceKind

NARROW = 2.0
"""Normals of narrow faces, and of points at edges, may be off so many times more than others."""
EXPLAINED = 2.0
"""A surface is given up when its neighbours explain its points with this mean square, in noises."""
AROUND = 1.0
"""Points within so many smallest cells tell on which of two surfaces one lies."""
FREE = 10.0
"""A free form has at least this many times the points of the smallest patch."""

_ROUNDS = 2
# Points of a leaf that speak for it: of all its points, and of those that fit nothing.
_SAMPLES, _REST = 4, 6
# ... and with the points around those; what these count.
_AROUND, _HARDLY = 12, 1e-3
# A leaf takes part in a new group when so many of its points fit nothing, or one in so many.
_LEFT_POINTS, _LEFT_SHARE = 2, 3
# Samples away from other surfaces tell alone, if there are so many of them.
_INNER = 40
# Samples when it is settled which points are its own, and of one leaf at most.
_SETTLED, _DENSE = 600, 32
_MERGES = 8
# By how much the cost of a surface found late must be lower, in squares of noises.
_HANDICAP = 2.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surfaced:
    """The surfaces of a part and the points on them."""

    surfaces: Surfaces
    """The surfaces, relative to the corner of the grid."""
    covariance: np.ndarray
    """Of their parameters, as `Segmentation.covariance`, shape (M, 8, 8)."""
    label: np.ndarray
    """Surface of every sorted point, -1 = none, shape (n,), i32."""
    own: np.ndarray
    """Surfaces with points in every leaf, ascending, then -1; shape (C, most), i32."""
    off: np.ndarray
    """Distance of every point from the surface that would be next [noises], shape (n,), f32; a
    large one where there is none."""


class _Search:
    """What the rounds of the search share."""

    def __init__(
        self, grid: Grid, leaves: Leaves, tolerance: Tolerance, rule: Rule, limit: float = 0.0
    ) -> None:
        self.grid, self.leaves, self.tolerance = grid, leaves, tolerance
        self.limit = limit
        self.samples = sample_leaves(grid, leaves, _SAMPLES)
        self.surfaces = no_surfaces()
        # The surface that every sample was fitted by, -1 = none.
        self.fitted = np.full(len(self.samples), NONE, np.int32)
        self.own = own_lists(leaves, np.zeros(0, np.int64), np.zeros(0, np.int64))
        self.labelling = Labelling(grid, leaves, rule)
        self._label: np.ndarray | None = None
        self.settled = False
        # Pairs of surfaces that were found not to be one.
        self.apart = np.zeros(0, np.int64)
        # Surfaces found in what others left have to be clearly better where others fit.
        self.early = 0
        # Pairs of surfaces that meet smoothly. The last surfaces are rounds between these sides,
        # which only all of their points prove.
        self.meeting = self.sides = np.zeros((0, 2), np.int64)
        # Leaves of free forms choose nothing. What fits nothing there, or on a face that was cut
        # out of a group, is no group of its own.
        self.free = np.zeros(len(leaves), bool)
        self.face = np.zeros(len(leaves), bool)

    @property
    def label(self) -> np.ndarray:
        """Return the label of every sorted point."""
        if self._label is None and not self.settled:
            self._label = runtime.download(self.labelling.choice.label)
        elif self._label is None:
            self._label = settle(
                self.grid.point, self.leaves, *self.labelling.choice,
                surface_table(self.surfaces.kind, self.surfaces.parameters),
                reach=AROUND * float(self.leaves.size.min()),
                farthest=self.labelling.rule.reach,
                # The noise of exact positions is taken large to be safe.
                doubt=0.0 if self.tolerance.exact else DOUBT,
            )  # fmt: skip
        return self._label

    def choose(self, passes: int = 1, *, closed: bool = True) -> None:
        """Let the points choose among the surfaces near them; those of free forms where asked."""
        late = np.arange(len(self.surfaces)) >= self.early
        table = surface_table(self.surfaces.kind, self.surfaces.parameters, _HANDICAP * late)
        free = self.free if closed else None
        self._label = None
        self.own = self.labelling.choose(self.own, table, passes=passes, closed=free)

    def open_seams(self) -> None:
        """Give the leaves of free forms that the surfaces beside them explain back to these.

        A seam between views that do not quite meet can make a group of its own with what is free.
        """
        if not self.free.any() or len(self.surfaces) == 0:
            return
        before = self.own
        self.choose(passes=2, closed=False)
        self.free &= np.minimum.reduceat(self.label, self.leaves.first) < 0
        self.own = before
        self.choose(passes=2)

    def add(
        self,
        samples: Samples,
        sets: list[np.ndarray],
        *,
        apart: bool = True,
        turn: float | None = None,
    ) -> bool:
        """Explain sets of samples; say whether that gave any new surface."""
        scatter = 0.0
        if apart and len(self.surfaces):
            scatter = rms_of(self.samples, self.label[self.samples.index], self.surfaces)
        tolerance = self.tolerance._replace(scatter=scatter)
        if turn is not None:
            tolerance = tolerance._replace(turn=turn)
        # A line has no normals, and is no surface.
        known: np.ndarray = np.any(samples.normal, axis=1)
        sets = [s for s in sets if 2 * np.count_nonzero(known[s]) > len(s)]
        new, label = explain(samples, self.leaves, sets, tolerance, apart=apart)
        for members in sets:
            large = samples.weight[members].sum() >= FREE * self.tolerance.points
            explained = np.any(label[members] >= 0)
            if large or explained:
                self.free[samples.leaf[members]] = not explained
                self.face[samples.leaf[members]] |= not apart
        if len(new) == 0:
            return False
        if samples is self.samples:
            self.fitted = np.where(label >= 0, label + len(self.surfaces), self.fitted)
        self.join(new, samples.leaf, label)
        return True

    def join(self, new: Surfaces, leaf: np.ndarray, label: np.ndarray) -> None:
        """Take new surfaces in, with those, -1 = none, that lie in some leaves."""
        there = label >= 0
        cell, rank = np.nonzero(self.own >= 0)
        self.own = own_lists(
            self.leaves,
            np.concatenate([cell, leaf[there]]),
            np.concatenate([self.own[cell, rank], label[there] + len(self.surfaces)]),
        )
        self.surfaces = self.surfaces.joined(new)

    def refit(self) -> None:
        """Fit the surfaces anew to the samples that chose them, if they were fitted to others."""
        label = self.label[self.samples.index]
        changed = np.append(fitted_to_others(self.fitted, label, len(self.surfaces)), False)
        self.fitted = np.where(changed[label], label, self.fitted)
        members = members_of(label, len(self.surfaces))
        # Points beside other surfaces may belong to these: where there are enough, others count.
        inner = members_of(
            np.where(self.inner()[self.samples.leaf], label, NONE), len(self.surfaces)
        )
        members = [
            i if len(i) >= _INNER and 4 * len(i) >= len(m) else m
            for i, m in zip(inner, members, strict=True)
        ]
        self.surfaces = refitted(
            self.samples, members, changed[:-1], self.surfaces, self.tolerance.noise
        )

    def refit_settled(self) -> np.ndarray:
        """Fit the surfaces to more of their points, up to the edges: these are settled now.

        What chose a surface for being near it would pull it away from the edge.

        Returns:
            The covariances of their parameters, shape (M, 8, 8).
        """
        self.settled = True
        self._label = None
        count = len(self.surfaces)
        label = self.label
        of = label[self.samples.index]
        few = np.append(np.bincount(of[of >= 0], minlength=count) < _SETTLED, False)
        # Where leaves are large, their few samples are less than there could be.
        more = sample_leaves(
            self.grid, self.leaves, _DENSE, label=np.where(few[label], NONE, 0).astype(np.int32)
        )
        both = joined_samples(self.samples, more)
        name = np.concatenate([np.where(few[of], NONE, of), label[more.index]])
        sets = [spread(m, _SETTLED) for m in members_of(name, count)]
        noise = self.tolerance.noise
        kind, parameters = self.surfaces.kind.copy(), self.surfaces.parameters.copy()
        # Some points of the next surface can bend a plane.
        many = np.array([len(s) >= FEWEST for s in sets], bool)
        base = count - len(self.sides)
        many[base:] = False
        curved = np.flatnonzero((kind != SurfaceKind.PLANE) & many)
        flat, planes = flat_sets(both, [sets[k] for k in curved], noise)
        kind[curved[flat]], parameters[curved[flat]] = SurfaceKind.PLANE, planes[flat]
        point = both.point[np.concatenate([np.zeros(0, np.int64), *sets])]
        start = np.cumsum([0] + [len(s) for s in sets])
        refined = refine(point, start, kind, parameters, noise=noise)
        refined[base:] = parameters[base:]
        # So few degrees tell no radius alone: the planes beside a round do.
        parameters = refitted_rounds(
            self.samples, label[self.samples.index], refined, self.sides,
            noise=noise, limit=self.limit,
        )  # fmt: skip
        self.surfaces = Surfaces(kind=kind, parameters=parameters)
        return covariances(point, start, kind, parameters)

    def inner(self) -> np.ndarray:
        """Return which leaves are full of one surface, as are all that touch them; (C,), bool."""
        common = common_label(self.leaves, self.label)
        border = common[self.leaves.a] != common[self.leaves.b]
        inner = common >= 0
        inner[self.leaves.a[border]] = False
        inner[self.leaves.b[border]] = False
        return inner

    def rename(self, name: np.ndarray) -> None:
        """Give surfaces other numbers; -1 gives them up."""
        there = self.own >= 0
        cell = np.nonzero(there)[0]
        self.own = own_lists(self.leaves, cell, name[self.own[there]])

    def rest(self, *, around: bool = False) -> tuple[Samples, list[np.ndarray]]:
        """Return samples of the points that fit nothing, in connected sets.

        Points ``around`` them come with them, but hardly count: a narrow face shares most of its
        points with the faces beside it.
        """
        label, leaves = self.label, self.leaves
        left = np.add.reduceat((label < 0).astype(np.int32), leaves.first)
        there = (left > 0) & ~self.free & ~self.face
        if not around:
            there &= (left >= _LEFT_POINTS) | (_LEFT_SHARE * left >= leaves.count)
        both = there[leaves.a] & there[leaves.b]
        root = components(len(leaves), leaves.a[both], leaves.b[both])
        size = np.bincount(root[there], left[there], minlength=len(leaves))
        kept = there & (size[root] >= self.tolerance.points)
        blocked = np.where(np.repeat(kept, leaves.count), NONE if around else label, 0)
        samples = sample_leaves(
            self.grid, leaves, _AROUND if around else _REST, label=blocked.astype(np.int32)
        )
        if around:
            weight = np.where(label[samples.index] < 0, samples.weight, _HARDLY)
            samples = replace(samples, weight=weight)
        part = root[samples.leaf]
        order = np.argsort(part, kind="stable")
        cut = np.flatnonzero(np.diff(part[order])) + 1
        return samples, [s for s in np.split(order, cut) if len(s)]

    def merge(self) -> bool:
        """Merge surfaces that are one; say whether there were any."""
        label = self.label[self.samples.index]
        touching = smooth_contacts(self.leaves, self.own, self.samples, self.surfaces)
        self.meeting = pairs = touching.pairs
        key = pairs[:, 0] * len(self.surfaces) + pairs[:, 1]
        name, self.surfaces = merge_surfaces(
            self.samples,
            label,
            self.surfaces,
            touching.some(~np.isin(key, self.apart)),
            self.tolerance.noise,
        )
        changed = name != np.arange(len(name))
        if not changed.any():
            return False
        changed[name[changed]] = True
        self.apart = key[~changed[pairs].any(axis=1)]
        self.rename(name)
        self.choose()
        return True

    def give_up(self) -> bool:
        """Give up surfaces that their neighbours explain; say whether there were any."""
        off = runtime.download(self.labelling.choice.off)
        second = runtime.download(self.labelling.choice.second)
        # What faces another way explains nothing.
        most = self.labelling.rule.turn / self.labelling.rule.tilt
        second = np.where(off[:, 1] <= most, second, NONE)
        gone = explained_by_others(self.label, second, off, len(self.surfaces), EXPLAINED)
        gone[len(gone) - len(self.sides) :] = False
        if not gone.any():
            return False
        name = np.where(gone, NONE, np.arange(len(gone)))
        self.rename(name)
        self.choose()
        return True

    def add_rounds(self) -> None:
        """Add the rounds between planes that noise hides."""
        new, self.sides, on = hidden_rounds(
            self.samples, self.label[self.samples.index], self.surfaces, self.meeting,
            noise=self.tolerance.noise, limit=self.limit,
        )  # fmt: skip
        self.join(new, self.samples.leaf, on)

    def off_next(self) -> np.ndarray:
        """Return how far every point is from the surface that would be next [noises]."""
        chosen, _, off = self.labelling.choice
        # Where its surroundings decided, that is the one which the point chose itself.
        moved = self.label != runtime.download(chosen)
        return np.where(moved, 1.0, runtime.download(off)[:, 0]).astype(np.float32)

    def give_up_slivers(self) -> None:
        """Give up small surfaces that were cut out of something else, or that only normals hold.

        Next to an edge normals are those of both sides, and do not tell. A surface is there when
        its points are nearer to it than to what they would choose next, whichever way that faces.
        """
        label, count = self.label, len(self.surfaces)
        size = sizes_of(label, count)
        small = size < FREE * self.tolerance.points
        here = np.flatnonzero(np.append(small, False)[label])
        if len(here) == 0:
            return
        point, name = runtime.download(self.grid.point)[here], label[here]
        far, _ = evaluate_surfaces(point, name, self.surfaces.kind, self.surfaces.parameters)
        gone, square = cut_out(name, far / self.tolerance.noise, count)
        chosen, second, off = (runtime.download(a)[here] for a in self.labelling.choice)
        # Where its surroundings decided, a point would choose next what it chose itself.
        moved = name != chosen
        second, off[moved, 0] = np.where(moved, chosen, second), 1.0
        second = np.where(np.append(gone, False)[second], NONE, second)
        gone |= explained_by_others(name, second, off, count, EXPLAINED * square)
        if gone.any():
            self.rename(np.where(gone, NONE, np.arange(count)))
            self.choose()


def find_surfaces(
    grid: Grid,
    leaves: Leaves,
    group: np.ndarray,
    cut: np.ndarray,
    tolerance: Tolerance,
    rule: Rule,
    *,
    narrow: bool,
    limit: float,
) -> Surfaced:
    """Find the analytic surfaces of a part, and the surface of every point.

    Args:
        grid: The sparse grid.
        leaves: Its leaves.
        group: Group of every leaf that the flood fill reached, -1 = none, shape (C,), i32.
        cut: The same with groups of flat faces cut apart at the bends between them. It counts where
            a group is no sum of surfaces: each of its faces may still be one.
        tolerance: What counts as lying on a surface.
        rule: What a point may differ from the surface that it takes.
        narrow: Positions are so exact that they tell narrow faces, whose normals do not.
        limit: Rounds with smaller radii are edges, and no surfaces [mm].
    """
    search = _Search(grid, leaves, tolerance, rule, limit)
    samples = search.samples
    search.add(samples, sets_of(samples, leaves, group, tolerance.points))
    if search.free.any():
        inside = np.where(search.free, cut, NONE)
        faces = sets_of(samples, leaves, inside, tolerance.points)
        search.add(samples, faces, apart=False)
    search.early = len(search.surfaces)
    for _ in range(_ROUNDS):
        search.choose(passes=2)
        search.refit()
        search.choose()
        rest, sets = search.rest()
        if not sets or not search.add(rest, sets):
            break
    else:
        search.choose(passes=2)
    rest, sets = search.rest(around=True) if narrow else (rest, [])
    # Normals of narrow faces are those of the faces beside them.
    if sets and search.add(rest, sets, turn=NARROW * tolerance.turn):
        search.choose(passes=2)
        search.refit()
        search.choose()
    search.open_seams()
    for _ in range(_MERGES):
        merged = search.merge()
        if not search.give_up() and not merged:
            break
    search.add_rounds()
    search.early = len(search.surfaces)
    search.choose()
    covariance = search.refit_settled()
    search.choose()
    search.give_up()
    search.give_up_slivers()
    return Surfaced(
        surfaces=search.surfaces,
        covariance=covariance,
        label=search.label,
        own=label_lists(leaves, search.label),
        off=search.off_next(),
    )
