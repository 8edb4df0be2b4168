"""From cells to the answer: regions grown and judged, points handed out, all in the input order."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from octoseg_ti.arrange import Arranged
from octoseg_ti.borders.tracing import Borders
from octoseg_ti.defaults import BACK_GAPS, spacing_of
from octoseg_ti.device import runtime
from octoseg_ti.device.surfaces import distances_to_surfaces
from octoseg_ti.params import Params
from octoseg_ti.readmission import readmit
from octoseg_ti.stages.adjacency import Adjacency, find_touching
from octoseg_ti.stages.assignment import (
    assign_points,
    claimed_share,
    in_rows,
    places_of_rows,
    points_of_leaves,
)
from octoseg_ti.stages.bends import split_at_bends
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.labelling import common_label
from octoseg_ti.stages.leaves import Leaves, sizes_of
from octoseg_ti.stages.moments import LEVEL, NORMAL, SIGMA, STOP, X, Z
from octoseg_ti.stages.planes import fit_planes
from octoseg_ti.stages.regions import flood_fill, number_groups, strips
from octoseg_ti.types import (
    NONE,
    Cells,
    EdgeClass,
    Fillets,
    Measurement,
    Scans,
    Segmentation,
    SurfaceKind,
)

# The line through two cells may leave the surface by half a tolerance.
_CHORD = 0.5
# An edge point joins a patch whose plane is this near: in smallest cells, plus three noises.
_JOIN_CELLS = 0.25
# A group is no patch when larger ones explain this share of its points.
_CLAIMED = 0.5
# A point of a bend lies on a plane when it is this near.
_LIE_CELLS = 0.05
# A cell on a bend joins a face whose normal is this many tolerances away at most.
_BEND_TOLERANCES = 2.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regions:
    """Regions of cells, and the points that belong to them."""

    touching: Adjacency
    """The touching pairs of leaves."""
    edge: np.ndarray
    """`EdgeClass` of every leaf, shape (C,), u8."""
    group: np.ndarray
    """Group of every node that the flood fill reached, -1 = none, shape (M,), i32."""
    cut: np.ndarray
    """The same with groups of flat faces cut apart at the bends between them, shape (M,), i32."""
    cell_label: np.ndarray
    """Region of every node, 0..K-1, -1 = none, shape (M,), i32."""
    label: np.ndarray
    """Region of every sorted point, 0..K-1, -1 = none, shape (n,), i32."""
    count: int
    """Number of regions K."""
    surface: np.ndarray | None = None
    """Analytic surface of every region, -1 = none, shape (K,), i32; None = not looked for."""
    kind: np.ndarray | None = None
    """`SurfaceKind` of every such surface."""
    parameters: np.ndarray | None = None
    """Parameters of every such surface, relative to the corner of the grid."""
    covariance: np.ndarray | None = None
    """Covariance of these; where the grid begins makes no difference to it."""
    graph: Leaves | None = None
    """The leaves as a graph, when surfaces were looked for."""
    mirrored: np.ndarray | None = None
    """Whether a sorted point is of a mirror image, shape (n,), bool; None = none is."""


def grow_regions(
    grid: Grid, leaves: np.ndarray, edge: np.ndarray, measured: Measurement, params: Params
) -> Regions:
    """Grow regions over the leaves, judge them, and hand out the points.

    Args:
        grid: The sparse grid.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        edge: `EdgeClass` of every leaf, shape (C,), u8.
        measured: Spacing and noise.
        params: Parameters, all filled in.

    Returns:
        The regions; the edge class knows of the strips along edges (sharp) and of the bends
        (fillet) that were found on the way.
    """
    assert params.regions.homogeneity is not None and params.regions.min_points is not None
    assert params.grid.edge_tolerance is not None
    literal = params.edges.rule == "levels"
    rule: dict[str, Any] = {
        "homogeneity": params.regions.homogeneity,
        "chord": float("inf") if literal else _CHORD * params.grid.edge_tolerance,
        "slack": 3.0 * measured.noise,
    }
    takes_part = np.zeros(grid.count, bool)
    takes_part[leaves[edge == int(EdgeClass.NONE)]] = True
    touching = find_touching(grid)
    group = flood_fill(grid, touching, takes_part, **rule)
    min_points = params.regions.min_points
    if literal or not params.regions.assign_edges:
        cell_label = number_groups(grid, group, min_points)
        label = points_of_leaves(grid, leaves, cell_label[leaves])
        return _regions(touching, edge, group, group, cell_label, label)
    whole = group
    group = split_at_bends(
        grid,
        touching,
        whole,
        min_points=min_points,
        flat=params.grid.edge_tolerance,
        noise=measured.normal_noise,
        **rule,
    )
    bend = (group < 0) & (whole >= 0)
    finest = grid.size / 2.0**grid.depth
    fit: dict[str, Any] = {
        "limit": _JOIN_CELLS * finest + 3.0 * measured.noise,
        "tight": _LIE_CELLS * finest + 3.0 * measured.noise,
        "angle": _BEND_TOLERANCES * params.grid.edge_tolerance,
    }
    # Groups that larger ones explain are no patches: strips along an edge, and bends that are as
    # flat as the face beside them. What is left of them stands for itself.
    group[bend] = flood_fill(grid, touching, bend, **rule)[bend]
    cut = group.copy()
    number = number_groups(grid, group, min_points)
    doubtful = (strips(grid, touching, group) | bend) & (number >= 0)
    cell_label = np.where(doubtful, NONE, number)
    if doubtful.any():
        judged = assign_points(
            grid, leaves, cell_label, bend=bend, only=doubtful | bend, rounds=1, **fit
        )
        asked = np.flatnonzero(doubtful)
        claimed = claimed_share(grid, leaves, judged, np.where(doubtful, number, NONE))
        explained = asked[claimed[number[asked]] > _CLAIMED]
        group[explained] = NONE
        bends = np.flatnonzero(bend & (group >= 0))
        cells = np.full(grid.count, NONE, np.int32)
        cells[bends] = np.arange(len(bends), dtype=np.int32)
        flush = bends[claimed_share(grid, leaves, judged, cells) > _CLAIMED]
        group[flush] = NONE
        found = np.zeros(grid.count, np.uint8)
        found[bend & (group >= 0)] = int(EdgeClass.FILLET)
        found[explained] = int(EdgeClass.SHARP)
        edge = np.where(edge == int(EdgeClass.NONE), found[leaves], edge)
        cell_label = number_groups(grid, group, min_points)
    label = assign_points(grid, leaves, cell_label, bend=bend, **fit)
    return _regions(touching, edge, whole, cut, cell_label, label)


def _regions(
    touching: Adjacency,
    edge: np.ndarray,
    group: np.ndarray,
    cut: np.ndarray,
    cell_label: np.ndarray,
    label: np.ndarray,
) -> Regions:
    count = int(cell_label.max(initial=NONE)) + 1
    return Regions(
        touching=touching, edge=edge, group=group, cut=cut, cell_label=cell_label, label=label,
        count=count,
    )  # fmt: skip


def assemble(
    scans: Scans,
    arranged: Arranged,
    point: np.ndarray,
    normal: np.ndarray,
    grid: Grid,
    leaves: np.ndarray,
    found: Regions,
    borders: Borders | None,
    measured: Measurement,
    params: Params,
) -> Segmentation:
    """Number the patches by size, describe their surfaces, and bring all into the input order."""
    patches, n = found.count, len(scans)
    place = places_of_rows(grid, None if arranged.whole else arranged.row, n)
    outlier = (place < 0).astype(np.uint8)
    left_out = np.flatnonzero(outlier)
    outside = scans_in_world(scans, left_out)
    back = _come_back(outside, grid, found, params)
    size = sizes_of(found.label, patches)
    kind, parameters, covariance, residual, surface = _describe(grid, leaves, found, size, measured)
    rank = np.argsort(-(size + np.bincount(back[back >= 0], minlength=patches)), kind="stable")
    name = np.full(patches + 1, NONE, np.int32)
    name[rank] = np.arange(patches, dtype=np.int32)
    normals = normal.astype(np.float32)
    if arranged.whole:
        points = point.copy()
    else:
        given = np.full(n, NONE, np.intp)
        given[arranged.row] = np.arange(len(point))
        points, normals = point.take(given, axis=0), normals.take(given, axis=0)
        points[left_out], normals[left_out] = outside, 0.0
    labels = in_rows(name.take(found.label), place, NONE)
    labels[left_out] = name[back]
    outlier[left_out[back >= 0]] = 0
    node, side = runtime.download(grid.node).take(leaves, axis=0), grid.edge_length[leaves]
    mean = runtime.download(grid.mean).take(leaves, axis=0)
    level = node[:, LEVEL].astype(np.int8)
    cells = Cells(
        corner=grid.corner + node[:, X : Z + 1] * side[:, None],
        size=side,
        level=level,
        count=grid.holds[leaves],
        normal=mean[:, NORMAL : NORMAL + 3].astype(np.float32),
        sigma=mean[:, SIGMA].astype(np.float32),
        stop=node[:, STOP].astype(np.uint8),
        edge=found.edge,
        label=name[found.cell_label[leaves]],
        initial_size=grid.size,
    )
    if borders is not None:
        edge, fillets = borders.edge, _fillets(borders, place, name, rank)
    else:
        edge, fillets = points_of_leaves(grid, leaves, found.edge), None
    if found.mirrored is not None:
        outlier[in_rows(found.mirrored, place, False)] = 1
    return Segmentation(
        points=points, normals=normals, labels=labels, edge=in_rows(edge, place, 0),
        fillets=fillets, level=in_rows(points_of_leaves(grid, leaves, level), place, NONE),
        outlier=outlier, kind=kind[rank],
        surface=_renumbered(surface[rank]), parameters=parameters[rank],
        covariance=covariance[rank], residual=residual[rank],
        cells=cells, stripe=scans.stripe, view=scans.view, params=params, measured=measured,
        passes=grid.passes, name=scans.name,
    )  # fmt: skip


def relabelled(grid: Grid, leaves: np.ndarray, found: Regions, label: np.ndarray) -> Regions:
    """Return the regions with other labels of the points; a cell has the one that all of its have.

    Args:
        grid: The sparse grid.
        leaves: The nodes that are leaves, in Morton order, shape (C,).
        found: The regions, with the leaves as a graph.
        label: Region of every sorted point, -1 = none, shape (n,), i32.
    """
    assert found.graph is not None
    held = np.full(grid.count, NONE, np.int32)
    held[leaves] = common_label(found.graph, label)
    cell_label = np.where(found.cell_label >= 0, held, NONE).astype(np.int32)
    return replace(found, label=label, cell_label=cell_label)


def _come_back(outside: np.ndarray, grid: Grid, found: Regions, params: Params) -> np.ndarray:
    """Return the region of every point that cleaning left out, -1 = it stays out, i32."""
    noise, gap = params.surfaces.noise, params.normals.gap
    if not len(outside) or found.surface is None or noise is None or gap is None:
        return np.full(len(outside), NONE, np.int32)
    assert found.kind is not None and found.parameters is not None
    return readmit(
        outside - grid.corner, runtime.download(grid.point), found.label, found.surface,
        found.kind, found.parameters, noise=noise, gap=BACK_GAPS * gap,
    )  # fmt: skip


def _fillets(borders: Borders, place: np.ndarray, name: np.ndarray, rank: np.ndarray) -> Fillets:
    """Return the fillets by the number of their points.

    Args:
        borders: The edges of the sorted points.
        place: Sorted point of every row, -1 = none, shape (N,).
        name: Patch of every region, shape (K + 1,).
        rank: Region of every patch, shape (K,).
    """
    size = sizes_of(borders.fillet, len(borders.radius))
    order = np.argsort(-size, kind="stable")
    number = np.full(len(size) + 1, NONE, np.int32)
    number[order] = np.arange(len(size), dtype=np.int32)
    return Fillets(
        patches=np.sort(name[borders.sides[order]], axis=1),
        radius=np.abs(borders.radius[order]),
        deviation=borders.deviation[order],
        concave=(borders.radius[order] > 0.0).astype(np.uint8),
        points=size[order].astype(np.int32),
        strip=number[borders.strip[rank]],
        point=in_rows(number.take(borders.fillet), place, NONE),
    )


def _describe(
    grid: Grid, leaves: np.ndarray, found: Regions, size: np.ndarray, measured: Measurement
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return kind, parameters, their covariance, residual and surface of every region."""
    patches = found.count
    flat = 2.0 * measured.noise + 0.02 * spacing_of(measured)
    cell_label = found.cell_label[leaves]
    if found.surface is not None:  # what has a surface needs no plane
        cell_label[np.append(found.surface, NONE)[cell_label] >= 0] = NONE
    kind, parameters, covariance, residual = fit_planes(
        grid, leaves, cell_label, patches, limit=flat
    )
    surface = np.arange(patches, dtype=np.int32)
    if found.surface is None or found.kind is None or found.parameters is None:
        return kind, parameters, covariance, residual, surface
    assert found.covariance is not None
    kind[kind == int(SurfaceKind.NONE)] = int(SurfaceKind.FREE_FORM)
    on = np.flatnonzero(found.surface >= 0)
    if len(on) == 0:
        return kind, parameters, covariance, residual, surface
    which = found.surface[on]
    kind[on], parameters[on] = found.kind[which], found.parameters[which]
    parameters[on, :3] += grid.corner
    covariance[on] = found.covariance[which]
    surface[on] = which
    surface[found.surface < 0] = len(found.kind) + np.arange(patches - len(on))
    # By region, also of those without a surface: what is the distance there does not matter.
    far = distances_to_surfaces(
        grid.point, found.label, found.kind[found.surface], found.parameters[found.surface]
    )
    # What has no patch comes first.
    square = np.bincount(found.label + 1, np.square(far, out=far), patches + 1)[1:]
    residual[on] = np.sqrt(square / np.maximum(size, 1))[on]
    return kind, parameters, covariance, residual, surface


def _renumbered(surface: np.ndarray) -> np.ndarray:
    """Number surfaces in the order in which they come up, shape (K,), i32."""
    _, first, index = np.unique(surface, return_index=True, return_inverse=True)
    order = np.empty(len(first), np.int32)
    order[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    return order[index]


def scans_in_world(scans: Scans, rows: np.ndarray) -> np.ndarray:
    """Return the world positions of some rows [mm], shape (len(rows), 3)."""
    points = scans.points[rows]
    if scans.frame == "world" or scans.T_world_view is None:
        return points
    view = np.zeros(len(rows), np.int32) if scans.view is None else scans.view[rows]
    pose = scans.T_world_view[view]
    return np.einsum("nij,nj->ni", pose[:, :3, :3], points) + pose[:, :3, 3]
