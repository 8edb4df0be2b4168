"""What belongs together in a mesh, on solids whose faces are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference.shapes import ball, cube, lathe, rod

from octoseg_ti.types import EdgeClass, SurfaceKind
from scanner_sim.mesh_forms import kinds_of
from scanner_sim.solids import mesh_part
from scanner_sim.topology import (
    Mesh,
    angles_between,
    corner_normals,
    crease_angle,
    facet_normals,
    link,
    orient,
    smooth_groups,
    weld,
)


def _volume(mesh: Mesh) -> float:
    a, b, c = mesh.corners().transpose(1, 0, 2)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_equal_corners_are_one_vertex_and_flat_triangles_are_dropped() -> None:
    corners = cube(10.0)
    noisy = corners + np.random.default_rng(0).uniform(-1e-9, 1e-9, corners.shape)
    twice, line = corners[0][[0, 0, 1]], np.array([[0, 0, 0], [1, 1, 1], [3, 3, 3]], float)
    mesh, kept = weld(np.concatenate([noisy, [twice, line]]), 1e-6)
    assert len(mesh.vertices) == 8 and len(mesh.triangles) == 12
    np.testing.assert_array_equal(np.flatnonzero(~kept), [12, 13])
    np.testing.assert_allclose(mesh.corners(), corners, atol=2e-9)


def test_every_edge_of_a_closed_mesh_has_two_triangles() -> None:
    mesh, _ = weld(ball(), 1e-9)
    links = link(mesh)
    assert len(links.border) == 0 and not links.aligned.any()
    assert len(links.first) == links.clear == 3 * len(mesh.triangles) // 2
    shared = [
        len(set(mesh.triangles[i]) & set(mesh.triangles[j]))
        for i, j in zip(links.first, links.second, strict=True)
    ]
    assert set(shared) == {2}
    opened = Mesh(mesh.vertices, mesh.triangles[5:])
    assert len(link(opened).border) > 0


def test_more_than_two_triangles_at_an_edge_are_told() -> None:
    mesh, _ = weld(np.concatenate([cube(1.0), cube(1.0, (1, 1, 0))]), 1e-9)
    links = link(mesh)
    assert len(links.first) - links.clear == 3  # four triangles at one edge: three pairs
    assert _volume(orient(mesh, links)) == pytest.approx(2.0)


@pytest.mark.parametrize("make", [ball, cube, rod])
def test_turned_triangles_are_turned_back(make) -> None:
    mesh, _ = weld(make(), 1e-9)
    rng = np.random.default_rng(1)
    flip = rng.random(len(mesh.triangles)) < 0.4
    mixed = mesh.triangles.copy()
    mixed[flip] = mixed[flip][:, ::-1]
    for triangles in (mixed, mesh.triangles[:, ::-1].copy()):
        again = orient(Mesh(mesh.vertices, triangles), link(Mesh(mesh.vertices, triangles)))
        assert not link(again).aligned.any()
        assert _volume(again) == pytest.approx(_volume(mesh))


def test_a_needle_takes_the_normal_of_its_neighbour() -> None:
    square = np.array([[[0, 0, 0], [4, 0, 0], [4, 4, 0]], [[0, 0, 0], [4, 4, 0], [0, 4, 0]]], float)
    # A seam so low that its normal is rounding error, and that error points sideways.
    low = np.array([[0, 0, 0], [2, 1e-7, 1e-6], [4, 0, 0]])
    mesh, _ = weld(np.concatenate([square, [low]]), 0.0)
    normals = facet_normals(mesh, link(mesh))
    np.testing.assert_allclose(normals, np.tile([0, 0, 1.0], (3, 1)), atol=1e-6)


def test_angles_and_the_limit_between_smooth_and_sharp() -> None:
    mesh, _ = weld(rod(turns=48), 1e-9)
    links = link(mesh)
    angles = np.degrees(angles_between(facet_normals(mesh, links), links))
    np.testing.assert_allclose(np.unique(angles.round(6)), [0.0, 7.5, 90.0])
    assert crease_angle(np.radians([0, 0, 90])) == pytest.approx(math.radians(35))
    assert crease_angle(np.radians([12, 20, 45, 58])) == pytest.approx(math.radians(32.5))
    crowd = np.radians(np.arange(0.0, 90.0, 2.0))
    assert crease_angle(crowd) == pytest.approx(math.radians(30))


def test_smooth_groups_are_the_faces() -> None:
    mesh, _ = weld(rod(), 1e-9)
    links = link(mesh)
    normals = facet_normals(mesh, links)
    group = smooth_groups(len(normals), links, angles_between(normals, links) < 0.6)
    assert group.max() == 2
    caps = np.abs(normals[:, 2]) > 0.5
    assert len(set(group[caps])) == 2 and len(set(group[~caps])) == 1


def test_corner_normals_are_radial_on_a_ball_and_stop_at_creases() -> None:
    mesh, _ = weld(ball(10.0, turns=96), 1e-9)
    normals = facet_normals(mesh, link(mesh))
    smooth = corner_normals(mesh, normals, np.zeros(len(normals), int))
    radial = mesh.corners() / 10.0
    assert np.degrees(np.arccos(np.clip((smooth * radial).sum(axis=2), -1, 1))).max() < 0.2
    box, _ = weld(cube(), 1e-9)
    flat = facet_normals(box, link(box))
    own = corner_normals(box, flat, np.arange(12) // 2)
    np.testing.assert_allclose(own, np.repeat(flat[:, None], 3, axis=1), atol=1e-12)


def test_kinds_only_where_they_are_certain() -> None:
    radii, heights = np.array([0, 9, 4, 0.0]), np.array([0, 0, 12, 12.0])
    for corners, expected in (
        (rod(), {SurfaceKind.PLANE: 2, SurfaceKind.CYLINDER: 1}),
        (ball(), {SurfaceKind.SPHERE: 1}),
        (lathe(radii, heights, 60), {SurfaceKind.PLANE: 2, SurfaceKind.CONE: 1}),
        (cube(), {SurfaceKind.PLANE: 6}),
        (ball() * [1, 1, 1.3], {SurfaceKind.FREE_FORM: 1}),
    ):
        part = mesh_part(corners)
        kinds, counts = np.unique(part.surfaces.kind, return_counts=True)
        assert dict(zip(map(SurfaceKind, kinds), counts, strict=True)) == expected
    # Three rulings fit a circle, but prove none.
    strip = np.array([[[0, 0, 0], [1, 0.1, 0], [1, 0.1, 5]], [[0, 0, 0], [1, 0.1, 5], [0, 0, 5]],
                      [[1, 0.1, 0], [2, 0, 0], [2, 0, 5]], [[1, 0.1, 0], [2, 0, 5], [1, 0.1, 5]]],
                     float)  # fmt: skip
    mesh, _ = weld(strip, 1e-9)
    normals = facet_normals(mesh, link(mesh))
    assert kinds_of(mesh, normals, np.zeros(4, int), 1e-6)[0] == SurfaceKind.FREE_FORM


def test_edge_curves_of_a_rod_and_of_an_open_sheet() -> None:
    part = mesh_part(rod(5.0, 12.0, turns=48))
    middle = 0.5 * (part.edges.start + part.edges.end)
    assert len(middle) == 96 and (part.edges.kind == EdgeClass.SHARP).all()
    assert set(np.round(middle[:, 2], 9)) == {0.0, 12.0}
    np.testing.assert_allclose(np.linalg.norm(part.edges.start[:, :2], axis=1), 5.0)
    sheet = mesh_part(cube()[:2])
    assert len(sheet.edges.kind) == 4 and (sheet.edges.kind == EdgeClass.SHARP).all()
    assert sheet.info["open_edges"] == "4"


def test_labels_meet_smoothly_where_the_surface_does() -> None:
    corners = ball(10.0)
    part = mesh_part(corners, label=(corners[:, :, 2].mean(axis=1) > 0).astype(int))
    assert len(part.surfaces.kind) == 2
    assert (part.edges.kind == EdgeClass.SMOOTH).all()
    np.testing.assert_allclose(part.edges.start[:, 2], 0.0, atol=1e-9)
