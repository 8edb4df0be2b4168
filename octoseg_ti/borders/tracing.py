"""Borders between patches: sharp edges, smooth joints, and fillets with their radii.

Patches in contact, and patches with a strip between them, make pairs. A ball that rolls along both
surfaces of a pair is fitted to the points around their edge (`stages.profiles`); its radius is the
only unknown. Balls that explain points which neither surface explains are fillets, the best
supported first: each claims the points on it, and what is left has to support the next.

A fillet has a radius of up to `EdgeParams.fillet_radius`, turns over at least two point spacings,
and touches the surfaces on both of its sides. Where fillets meet, the ball that touches three
sides (`borders.corners`) and other blends (`borders.blends`) belong to no pair. A round joint that
is larger is a patch like any other, and so are cylinders that touch nothing along their sides:
bosses, holes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from octoseg_ti.borders.corners import find_corners, mark_corners, parts_of
from octoseg_ti.borders.fillets import (
    WEAK,
    claim_points,
    fit_balls,
    guess_radii,
    look_around,
    numbers_of,
    refit_sides,
    strip_pairs,
    strips_of,
)
from octoseg_ti.borders.marks import mark_points
from octoseg_ti.borders.rims import mark_rims
from octoseg_ti.borders.zones import Search, find_zones
from octoseg_ti.device.surfaces import evaluate_surfaces
from octoseg_ti.stages.profiles import BALL, FIRST, SECOND
from octoseg_ti.stages.rims import Lines
from octoseg_ti.types import NONE

_GIVEN = 0.15  # share of the points of a strip that its sides may get back, at most


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Borders:
    """What borders of patches were found, ``F`` fillets."""

    label: np.ndarray
    """Patch of every sorted point, shape (n,), i32: where the strip of a fillet runs into a side,
    its points belong to that."""
    edge: np.ndarray
    """`EdgeClass` of every sorted point, shape (n,), u8."""
    fillet: np.ndarray
    """Fillet that every sorted point lies on, -1 = none, shape (n,), i32."""
    sides: np.ndarray
    """The two patches that every fillet touches, shape (F, 2), i32."""
    radius: np.ndarray
    """Radius [mm], above 0 = concave, below 0 = convex, shape (F,), f64."""
    deviation: np.ndarray
    """Standard deviation of the radius [mm], shape (F,), f64."""
    strip: np.ndarray
    """Fillet that every patch is a strip of, -1 = none, shape (K,), i32."""


def find_borders(search: Search, lines: Lines | None = None) -> Borders:
    """Find the edges between patches, and the fillets.

    Args:
        search: The points, their patches and the surfaces of these.
        lines: The points in scan order, to find edges of which one face was scanned; None = these
            are not looked for.
    """
    zones = find_zones(search)
    around = look_around(search, zones)
    guess = guess_radii(search, zones, around)
    fit = fit_balls(search, zones, around, guess, last=False)
    chosen = claim_points(search, zones, fit)
    # Once more, with surfaces fitted anew without what was claimed.
    corners = find_corners(search, zones, fit, chosen)
    parts = parts_of(search, zones, corners, strip_pairs(search, zones, chosen))
    refit_sides(search)
    search.held[corners.point] = True
    if len(parts.strip):
        # The tubes go on over patches that are parts of corners.
        zones = find_zones(search, parts.strip)
        around = look_around(search, zones)
        guess = guess_radii(search, zones, around)
    # Such patches are no sides of fillets.
    guess = guess[0], guess[1] & ~parts.patch[zones.pairs].any(axis=1)
    fit = fit_balls(search, zones, around, guess, last=True)
    chosen = claim_points(search, zones, fit)
    fillets = np.flatnonzero(chosen)
    number = numbers_of(chosen)
    strip = strips_of(search, number)
    corners = find_corners(search, zones, fit, chosen)
    parts = parts_of(search, zones, corners, strip_pairs(search, zones, chosen))
    edge = mark_points(search, zones, fit, chosen, strip, parts.smooth)
    mark_corners(search, corners, edge)
    if lines is not None:
        mark_rims(search, lines, edge)
    sides = zones.pairs[fillets].astype(np.int32)
    return Borders(
        label=give_back(search, strip, sides, fit.radius[fillets]),
        edge=edge,
        fillet=np.take(number, search.claim),
        sides=sides,
        radius=fit.radius[fillets],
        deviation=fit.deviation[fillets],
        strip=strip,
    )


def give_back(
    search: Search, strip: np.ndarray, sides: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """Return the patch of every point, those of strips that lie on a side given to that.

    The line of contact follows from both sides and the radius, more exactly than single points can
    tell. Next to it, up to where the strip has left the side by twice the noise, the side goes on,
    as a face is what a part is measured by; but the strip stays a patch.

    Args:
        search: What is known.
        strip: Fillet that every patch is a strip of, -1 = none, shape (K,).
        sides: The two patches that every fillet touches, shape (F, 2).
        radius: Its radius [mm], above 0 = concave, shape (F,).
    """
    label = search.label.copy()
    if len(sides) == 0:
        return label
    mine = np.flatnonzero(np.append(strip, NONE)[label] >= 0)
    mine = mine[search.analytic[label[mine]]]
    fillet = strip[label[mine]]
    at = search.place(sides, radius, mine, fillet)
    for region, side in ((FIRST, 0), (SECOND, 1)):
        beyond = at.region == region
        label[mine[beyond]] = sides[fillet[beyond], side]
    mine, fillet = mine[at.region == BALL], fillet[at.region == BALL]
    own = label[mine]
    # Where the point is on the strip: its own error has no say.
    kind, parameters = search.given[:, 8].astype(np.int32), search.given[:, :8]
    far, outward = evaluate_surfaces(search.points[mine], own, kind, parameters)
    foot = search.points[mine] - far[:, None] * outward
    kind, parameters = search.table[:, 8].astype(np.int32), search.table[:, :8]
    gap = np.stack(
        [np.abs(evaluate_surfaces(foot, sides[fillet, k], kind, parameters)[0]) for k in range(2)],
        axis=1,
    )
    nearer, least = gap.argmin(axis=1), gap.min(axis=1)
    reach = np.full(search.count, WEAK * search.noise)
    for patch in np.unique(own):
        reach[patch] = min(reach[patch], np.quantile(least[own == patch], _GIVEN))
    weak = least < reach[own]
    label[mine[weak]] = sides[fillet[weak], nearer[weak]]
    return label
