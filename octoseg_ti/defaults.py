"""How the default derives its parameters from what was measured on the data."""

from __future__ import annotations

import math
from dataclasses import replace

from octoseg_ti.params import Params
from octoseg_ti.types import Measurement

LEAST_TOLERANCE = 0.03
"""Deviation of the normals below which a cell counts as flat even on perfect data: 1.7 degrees."""
LEAST_EDGE_TOLERANCE = 0.055
"""... and below which a smallest cell is no edge. By the law s = sqrt(6) tolerance r a sphere of 13
spacings radius fills a smallest cell of 1.8 spacings with this deviation."""
NOISE_FLOORS = 2.0
"""The tolerance stands this many noise floors of the normals above zero."""
CELL_SPACINGS = 1.8
"""Smallest cell in point spacings: about three points in a cell."""
GAP_SPACINGS = 3.0
"""A strip of triangles breaks where an edge is longer than this many spacings."""
PIECE_GAPS = 3.0
"""Points of one piece of a surface are linked over so many times that length: where stripes graze a
face they are farther apart than elsewhere."""
BACK_GAPS = 2.0
"""What cleaning left out comes back where it is linked to a patch over so many times it."""
REACH_SPACINGS = 3.0
"""A point finds its partner in another view within this many spacings."""
SPIKE_SPACINGS = 0.1
"""A spike stands off from the surfaces around it by this many spacings: a sphere of 13 spacings
radius falls away by as much at 1.6 spacings."""
SPIKE_NOISES = 4.0
"""... and by this many standard deviations of the noise."""
ISOLATION_SPACINGS = 2.5
"""Neighbours farther than this many spacings do not hold a point."""
PATCH_CELLS = 16.0
"""A patch covers at least the area of this many smallest cells: a square of four by four."""
SMOOTH_PASSES = (2, 6)
"""Passes of the filter of normals: two restore an edge after the first mean, more do not help."""
SMOOTH_LEFT = 0.5
"""After n means over neighbours this over n of the noise of the normals is left. (A normal is made
of differences of heights, so errors cancel out faster than independent ones do.)"""
HOMOGENEITY = (7.0, 0.1, 0.25)
"""Angle between touching cells: this many tolerances, at least and at most so many radians."""

SURFACE_NOISE = (1.3, 0.02)
"""A point deviates from its surface by this many standard deviations of the noise, plus so many
spacings, for surfaces are fitted to noisy points."""
EXACT_NOISE = (0.5, 0.002)
"""... but of the latter no more than so many standard deviations, plus so many spacings, which
rounding leaves on perfect data."""
TURNS = (0.25, 4.0)
"""A sample lies on a surface when its normal is off by no more than this angle [rad], or so many
deviations of the normals."""
CHANCE = 0.0015
"""... or by so much that one in so many points that lie anywhere, at a distance of up to a spacing
from it, and face anywhere would: where positions are exact they tell by themselves, and normals of
narrow faces are those of their neighbourhood."""
PROOF = 30.0
"""How sure a surface has to be, as a logarithm: of so many surfaces through a few points each,
tried anywhere, hardly one has the other points that it needs by chance. Where views are apart by
more than the noise, chance does not tell: the points of a view share an error, and agree on what is
not there."""
WINDOW = 6.0
"""A point lies on a surface by chance when it is within this many noises, both sides together,
of all places a spacing apart."""
FREEDOM = 3
"""Points that the simplest surface goes through anyway."""
LEAST_TILT = 0.05
"""Deviation of the normals from those of a surface even on perfect data [rad]: edges smear them."""


def spacing_of(measured: Measurement) -> float:
    """Return the larger of the two spacings [mm]: it limits what can be resolved."""
    return max(measured.spacing_along, measured.spacing_across)


def passes_for(normal_noise: float) -> int:
    """Return how often normals are to be filtered: 0 where the least tolerance holds without.

    Args:
        normal_noise: Deviation of the normals from those of the surface [rad].
    """
    aim = LEAST_TOLERANCE / NOISE_FLOORS
    if normal_noise <= aim:
        return 0
    least, most = SMOOTH_PASSES
    return min(most, max(least, math.ceil(SMOOTH_LEFT * normal_noise / aim) - 1))


def derive(params: Params, measured: Measurement) -> Params:
    """Return the parameters with every None replaced by a value derived from the measurement.

    Args:
        params: Parameters, some of them None.
        measured: Spacing and noise of the data.
    """
    spacing = spacing_of(measured)
    cleaning, normals, grid, regions = params.cleaning, params.normals, params.grid, params.regions
    if cleaning.spike is None:
        stand_off = max(SPIKE_SPACINGS * spacing, SPIKE_NOISES * measured.noise)
        cleaning = replace(cleaning, spike=stand_off)
    if cleaning.isolation is None:
        cleaning = replace(cleaning, isolation=ISOLATION_SPACINGS * spacing)
    # What nothing holds and is too small for a patch is no loss.
    area = PATCH_CELLS * (CELL_SPACINGS * spacing) ** 2
    one = measured.spacing_along * measured.spacing_across
    smallest = max(3, round(area / one)) if one > 0 else 3
    if cleaning.detached is None:
        cleaning = replace(cleaning, detached=smallest)
    if normals.gap is None:
        normals = replace(normals, gap=GAP_SPACINGS * spacing)
    if normals.smooth is None:
        normals = replace(normals, smooth=passes_for(measured.normal_noise))
    if normals.weight is None:
        normals = replace(normals, weight="area" if normals.smooth else "unit")
    registration = params.registration
    if registration.reach is None:
        registration = replace(registration, reach=REACH_SPACINGS * spacing)
    if grid.tolerance is None:
        floor = NOISE_FLOORS * measured.normal_noise
        grid = replace(grid, tolerance=min(1.0, max(LEAST_TOLERANCE, floor)))
    if grid.edge_tolerance is None:
        grid = replace(grid, edge_tolerance=max(LEAST_EDGE_TOLERANCE, grid.tolerance or 0.0))
    if grid.min_cell is None:
        grid = replace(grid, min_cell=CELL_SPACINGS * spacing)
    assert grid.tolerance is not None and grid.edge_tolerance is not None
    if regions.homogeneity is None:
        times, least, most = HOMOGENEITY
        angle = min(most, max(least, times * grid.edge_tolerance))
        regions = replace(regions, homogeneity=angle)
    if regions.min_points is None:
        regions = replace(regions, min_points=smallest)
    surfaces = params.surfaces
    if surfaces.noise is None:
        times, share = SURFACE_NOISE
        noise = max(measured.noise, measured.surface_noise)
        more, rounding = EXACT_NOISE
        off = min(share * spacing, more * noise + rounding * spacing)
        surfaces = replace(surfaces, noise=times * noise + off)
    if surfaces.tilt is None:
        surfaces = replace(surfaces, tilt=max(LEAST_TILT, measured.normal_noise))
    assert surfaces.tilt is not None and regions.min_points is not None
    exact = math.sqrt(one) / surfaces.noise if one > 0 and surfaces.noise else 1.0
    if surfaces.turn is None:
        times, deviations = TURNS
        by_chance = math.acos(max(0.0, 1.0 - CHANCE * exact))
        turn = max(times, deviations * surfaces.tilt, by_chance)
        surfaces = replace(surfaces, turn=turn)
    if surfaces.min_points is None:
        fewest = regions.min_points
        if exact > WINDOW and measured.view_noise <= measured.noise:
            # The more each point tells, the fewer prove a surface.
            fewest = min(fewest, FREEDOM + math.ceil(PROOF / math.log(exact / WINDOW)))
        surfaces = replace(surfaces, min_points=fewest)
    return replace(
        params,
        cleaning=cleaning,
        normals=normals,
        registration=registration,
        grid=grid,
        regions=regions,
        surfaces=surfaces,
    )
