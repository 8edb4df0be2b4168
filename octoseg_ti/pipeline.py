"""`segment`: from scan lines to patches, one stage after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from octoseg_ti.alignment import Registration
from octoseg_ti.arrange import Arranged, arrange, as_scans, probe_positions, without
from octoseg_ti.borders.rims import scan_lines
from octoseg_ti.borders.tracing import Borders, find_borders
from octoseg_ti.borders.zones import Search
from octoseg_ti.defaults import derive, spacing_of
from octoseg_ti.device import runtime
from octoseg_ti.device.profiling import Trace
from octoseg_ti.mirrors import without_mirror_images
from octoseg_ti.params import Params, SurfaceParams, preset_params
from octoseg_ti.patches import Regions, assemble, grow_regions, relabelled
from octoseg_ti.stages.cleaning import mark_outliers
from octoseg_ti.stages.edges import edges_by_level, edges_by_radius, edges_by_reason
from octoseg_ti.stages.extraction import Surfaces
from octoseg_ti.stages.filtering import filter_normals, independent_lag, square_lag
from octoseg_ti.stages.grid import Grid, build_grid
from octoseg_ti.stages.measure import stripe_noise, stripe_roughness, stripe_spacing
from octoseg_ti.stages.moments import LEVEL, STOP
from octoseg_ti.stages.neighbors import PASSES, neighbor_normals
from octoseg_ti.stages.normals import edge_pair_sums, oriented_normals
from octoseg_ti.stages.refinement import refine_poses
from octoseg_ti.stages.registration import to_world
from octoseg_ti.stages.scatter import surface_noise
from octoseg_ti.surfacing import fit_surfaces
from octoseg_ti.types import Measurement, Scans, Segmentation

STAGES = (
    "cleaning", "normals", "registration", "measure", "grid", "edges", "regions", "surfaces",
    "borders", "patches",
)  # fmt: skip
"""The stages, in order."""

# A cell bends away from its mean plane by 0.13 tolerance times its size at most while its normals
# are within the tolerance; twice that can only be a step.
_FLATNESS = 0.25
_LONGEST = 1e30


def segment(
    data: Scans | np.ndarray,
    params: Params | None = None,
    *,
    normals: np.ndarray | None = None,
    stripe: np.ndarray | None = None,
    view: np.ndarray | None = None,
    preset: str = "default",
    trace: Trace | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Segmentation:
    """Segment scans, or any point cloud, into surface patches.

    Args:
        data: Scans, or positions [mm], shape (N, 3).
        params: Parameters; what is None is derived from the data. Default: those of the preset.
        normals: Unit normals of bare positions, shape (N, 3); estimated when missing.
        stripe: Stripe number of bare positions, shape (N,), in order along each stripe; without it
            normals come from neighbourhoods.
        view: View number of bare positions, shape (N,).
        preset: "default", or "paper" for the literal method; used when ``params`` is None.
        trace: Collects the wall time of the stages.
        progress: Called with the name of every stage and the share of work done before it.

    Returns:
        The segmentation, rows in the order of the input. Rows with NaN and rows that cleaning
        marked keep their place, with label -1 and outlier 1.

    Raises:
        DataError: The input cannot be segmented; the message says why.
        ValueError: Unknown preset.
    """
    if params is None:
        params = preset_params(preset)
    scans = as_scans(data, normals, stripe, view)
    runtime.ensure_started()
    trace = trace if trace is not None else Trace()

    def stage(name: str):  # type: ignore[no-untyped-def]
        if progress is not None:
            progress(name, STAGES.index(name) / len(STAGES))
        return trace.stage(name, points=len(scans))

    with stage("cleaning"):
        arranged, measured, params = clean(scans, params)
    with stage("normals"):
        normal, measured, params = estimate_normals(scans, arranged, measured, params)
    with stage("registration"):
        point, normal, aligned = register(scans, arranged, normal, measured, params)
    with stage("measure"):
        measured = measure_noise(arranged, point, normal, measured, params)
        asked, params = params.surfaces, derive(params, measured)
    with stage("grid"):
        signed = arranged.run is not None or scans.normals is not None
        grid = subdivide(point, normal, measured, params, signed)
    with stage("edges"):
        leaves, edge = find_edges(grid, params)
    with stage("regions"):
        found = grow_regions(grid, leaves, edge, measured, params)
    with stage("surfaces"):
        curved = arranged.run is None
        measured, params, found = explain_regions(
            grid, leaves, found, arranged.view, measured, params, asked, curved=curved
        )
        probe = probe_positions(scans, arranged, aligned)
        if probe is not None and params.cleaning.enabled:
            found = without_mirror_images(grid, found, arranged, probe)
    with stage("borders"):
        borders = trace_borders(scans, arranged, point, probe, grid, found, measured, params)
        if borders is not None:
            found = relabelled(grid, leaves, found, borders.label)
    with stage("patches"):
        result = assemble(
            scans, arranged, point, normal, grid, leaves, found, borders, measured, params
        )
    if aligned is not None:
        result = with_registration(result, scans, arranged, aligned)
    return replace(result, seconds=trace.seconds)


def clean(scans: Scans, params: Params) -> tuple[Arranged, Measurement, Params]:
    """Measure the spacing, mark outliers and leave them out."""
    arranged = arrange(scans)
    if arranged.run is None or arranged.start is None:
        return (
            arranged,
            Measurement(spacing_along=0, spacing_across=0, noise=0, normal_noise=0),
            params,
        )
    along, across = stripe_spacing(arranged.points, arranged.start, arranged.run, arranged.view)
    rough = stripe_roughness(arranged.points, arranged.start, arranged.run)
    measured = Measurement(
        spacing_along=along or across, spacing_across=across or along, noise=rough, normal_noise=0.0
    )
    derived = derive(params, measured)
    params = replace(
        params,
        cleaning=derived.cleaning,
        # How to filter the normals is known when their noise is.
        normals=replace(params.normals, gap=derived.normals.gap),
    )
    chosen = params.cleaning
    assert chosen.spike is not None and chosen.isolation is not None
    assert chosen.detached is not None
    if chosen.enabled:
        marked = mark_outliers(
            arranged.points,
            arranged.start,
            arranged.run,
            arranged.view,
            scans.T_world_view if scans.frame == "view" else None,
            spike=chosen.spike,
            isolation=chosen.isolation,
            detached=chosen.detached,
            along=measured.spacing_along,
            across=measured.spacing_across,
        )
        if marked.any():
            arranged = without(arranged, marked > 0, len(scans))
    return arranged, measured, params


def estimate_normals(
    scans: Scans, arranged: Arranged, measured: Measurement, params: Params
) -> tuple[np.ndarray, Measurement, Params]:
    """Return the normals of the arranged points, in the frame of the scans; filtered where noisy.

    With them come the measurement, with the noise before the filter, and the parameters.
    """
    if arranged.run is None or arranged.start is None:
        return _without_stripes(scans, arranged, params)
    if arranged.normals is not None:
        return arranged.normals, measured, _with_passes(params, 0)
    origin = scans.origin
    if origin is not None and scans.frame == "view" and scans.T_world_view is not None:
        to_view = np.linalg.inv(scans.T_world_view[: len(origin)])
        origin = np.einsum("vij,vj->vi", to_view[:, :3, :3], origin) + to_view[:, :3, 3]
    points, start, run, view = arranged.points, arranged.start, arranged.run, arranged.view
    chosen = params.normals
    assert chosen.gap is not None
    weight = chosen.weight or "unit"
    sums = edge_pair_sums(points, start, view, gap=chosen.gap, rule=chosen.rule)
    normal = oriented_normals(sums, points, start, view, weight=weight, origin=origin)
    if chosen.smooth == 0:
        return normal, measured, _with_passes(params, 0)
    noise, tilt = stripe_noise(points, normal, start, run, chosen.gap)
    measured = replace(measured, noise=noise, normal_noise=tilt)
    chosen = derive(params, measured).normals
    assert chosen.gap is not None and chosen.smooth is not None and chosen.weight is not None
    if chosen.smooth > 0:
        if chosen.weight != weight:
            how: dict[str, Any] = {"weight": chosen.weight, "origin": origin}
            normal = oriented_normals(sums, points, start, view, **how)
        lag = square_lag(measured.spacing_along, measured.spacing_across)
        normal = filter_normals(
            points,
            normal,
            start,
            run,
            view,
            passes=chosen.smooth,
            gap=chosen.gap,
            noise=tilt,
            lag=lag,
        )
    return normal, measured, replace(params, normals=chosen)


def _without_stripes(
    scans: Scans, arranged: Arranged, params: Params
) -> tuple[np.ndarray, Measurement, Params]:
    """Return the normals of unorganised points, the measurement and the parameters."""
    if scans.origin is not None:
        outward = scans.origin[arranged.view] - arranged.points
    else:
        low, high = arranged.points.min(axis=0), arranged.points.max(axis=0)
        outward = arranged.points - (low + high) / 2.0
    passes = PASSES if params.normals.smooth is None else params.normals.smooth
    if arranged.normals is not None:
        passes = 0
    normal, measured = neighbor_normals(
        arranged.points, outward, params.normals.neighbors, passes=passes
    )
    return (
        normal if arranged.normals is None else arranged.normals,
        measured,
        _with_passes(params, passes),
    )


def _with_passes(params: Params, passes: int) -> Params:
    """Return the parameters with what their noise does not tell."""
    weight = params.normals.weight or "unit"
    return replace(params, normals=replace(params.normals, smooth=passes, weight=weight))


def register(
    scans: Scans, arranged: Arranged, normal: np.ndarray, measured: Measurement, params: Params
) -> tuple[np.ndarray, np.ndarray, Registration | None]:
    """Return points and normals in the world, and how the views were aligned, where asked for."""
    if scans.frame == "world" or scans.T_world_view is None:
        point = arranged.points
    else:
        point, normal = to_world(arranged.points, normal, arranged.view, scans.T_world_view)
    if not params.registration.refine:
        return point, normal, None
    chosen = derive(params, measured).registration
    assert chosen.reach is not None
    aligned = refine_poses(
        point,
        normal,
        arranged.view,
        scans.T_world_view,
        reach=chosen.reach,
        overlap=chosen.overlap,
    )
    # What was moved goes from its recorded to its refined place; the rest keeps every bit.
    moved = (aligned.refined != aligned.recorded).any(axis=(1, 2))
    if moved.any():
        change = aligned.change()
        point, normal = to_world(point, normal, arranged.view, change)
    return point, normal, aligned


def with_registration(
    result: Segmentation, scans: Scans, arranged: Arranged, aligned: Registration
) -> Segmentation:
    """Return the result with its registration; points left out move with their views too."""
    left_out = np.ones(len(scans), bool)
    left_out[arranged.row] = False
    out = np.flatnonzero(left_out)
    if len(out) and scans.view is not None:
        change = aligned.change()[scans.view[out]]
        points = result.points
        points[out] = np.einsum("nij,nj->ni", change[:, :3, :3], points[out]) + change[:, :3, 3]
    return replace(result, registration=aligned)


def measure_noise(
    arranged: Arranged,
    point: np.ndarray,
    normal: np.ndarray,
    measured: Measurement,
    params: Params,
) -> Measurement:
    """Return the measurement with the noise along the stripes filled in."""
    if arranged.run is None or arranged.start is None:
        return measured
    assert params.normals.gap is not None
    lag = independent_lag(
        params.normals.smooth or 0, square_lag(measured.spacing_along, measured.spacing_across)
    )
    noise, tilt = stripe_noise(
        point, normal, arranged.start, arranged.run, params.normals.gap, lag=lag
    )
    if params.normals.smooth:
        # Normals that far apart differ by the shape of small faces too; no filter adds noise.
        tilt = min(tilt, measured.normal_noise)
    return replace(measured, noise=noise, normal_noise=tilt)


def subdivide(
    point: np.ndarray, normal: np.ndarray, measured: Measurement, params: Params, signed: bool
) -> Grid:
    """Build the sparse grid."""
    assert params.grid.tolerance is not None and params.grid.min_cell is not None
    literal = params.edges.rule == "levels"
    return build_grid(
        point,
        normal,
        tolerance=params.grid.tolerance,
        edge_tolerance=params.grid.edge_tolerance,
        divisions=params.grid.divisions,
        min_cell=params.grid.min_cell,
        min_points=params.grid.min_points,
        flatness=float("inf") if literal else _FLATNESS,
        noise=measured.noise,
        signed=signed,
    )


def explain_regions(
    grid: Grid,
    leaves: np.ndarray,
    found: Regions,
    view: np.ndarray,
    measured: Measurement,
    params: Params,
    asked: SurfaceParams,
    *,
    curved: bool,
) -> tuple[Measurement, Params, Regions]:
    """Find the analytic surfaces of the regions, and give the points to them.

    Where the noise was measured against planes, ``curved``, it contains curvature.
    """
    extent = grid.size * max(grid.shape)
    # Fits add up fourth powers of lengths, which beyond this leave the range of numbers.
    if not params.surfaces.enabled or not 1.0 / _LONGEST < extent < _LONGEST:
        return measured, params, found
    scatter = surface_noise(grid, leaves, found.group[leaves], view)
    if scatter is not None:
        measured = replace(measured, surface_noise=scatter[0], view_noise=scatter[1])
        if curved:
            measured = replace(measured, noise=min(measured.noise, scatter[0]))
    params = derive(replace(params, surfaces=asked), measured)
    # Distances are told in noises: what single precision cannot tell counts as one.
    rounding = 0.5 * float(np.finfo(np.float32).eps) * extent
    assert params.surfaces.noise is not None
    noise = max(params.surfaces.noise, rounding)
    params = replace(params, surfaces=replace(params.surfaces, noise=noise))
    return measured, params, fit_surfaces(grid, leaves, found, params)


def trace_borders(
    scans: Scans,
    arranged: Arranged,
    point: np.ndarray,
    probe: np.ndarray | None,
    grid: Grid,
    found: Regions,
    measured: Measurement,
    params: Params,
) -> Borders | None:
    """Find the edges between patches, and the fillets, by their surfaces."""
    if found.graph is None or found.count == 0 or params.edges.rule != "reason":
        return None
    assert found.surface is not None and found.kind is not None and found.parameters is not None
    assert params.surfaces.noise is not None
    lines = None
    if arranged.run is not None:
        order, place = runtime.download(grid.order), runtime.download(grid.place)
        lines = scan_lines(scans, arranged, point, order, place, probe)
    search = Search(
        grid.point,
        grid.normal,
        found.graph,
        found.label,
        found.surface,
        Surfaces(kind=found.kind, parameters=found.parameters),
        noise=params.surfaces.noise,
        spacing=spacing_of(measured),
        limit=params.edges.fillet_radius,
    )
    return find_borders(search, lines)


def find_edges(grid: Grid, params: Params) -> tuple[np.ndarray, np.ndarray]:
    """Return the leaves in Morton order, and the edge class of each."""
    node = runtime.download(grid.node)[: grid.count]
    leaves = np.flatnonzero(runtime.download(grid.child)[: grid.count, 0] == -2)
    leaves = leaves[np.argsort(grid.first[leaves], kind="stable")]
    level = node[leaves, LEVEL]
    if params.edges.rule == "reason":
        return leaves, edges_by_reason(node[leaves, STOP])
    if params.edges.rule == "levels":
        return leaves, edges_by_level(
            level, params.edges.smallest_levels, params.edges.fillet_levels
        )
    assert params.grid.tolerance is not None
    size = grid.edge_length[leaves]
    return leaves, edges_by_radius(size, params.grid.tolerance, params.edges.radius)
