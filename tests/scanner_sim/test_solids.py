"""Meshes under the scanner: as CSG where both describe one solid, and errors of their files."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from reference.shapes import (
    ball,
    cube,
    rod,
    write_ascii_stl,
    write_obj,
    write_ply,
    write_stl,
)  # fmt: skip
from reference.triangles import first_hits, segment_distance

from octoseg_ti.errors import DataError
from octoseg_ti.types import EdgeClass, SurfaceKind
from scanner_sim import SolidOptions, StripeScanner, View, box, read_part, simulate
from scanner_sim.solids import mesh_part

_CLEAN: dict[str, float] = {"range_noise": 0.0, "dropout": 0.0, "lost_ends": 0.0}


def _two_steps() -> np.ndarray:
    """A plate with a block on it: a stepped solid whose triangles overlap nowhere."""
    low, high = cube(20.0) * [1, 1, 0.25], cube(8.0, (6, 6, 5)) * [1, 1, 1]
    return np.concatenate([low, high])


def test_a_cube_of_triangles_scans_like_one_of_half_spaces() -> None:
    scanner = StripeScanner(stripe_pitch=0.5, point_pitch=0.4, **_CLEAN)  # type: ignore[arg-type]
    scans, truth = simulate(mesh_part(cube(20.0)), scanner, seed=3)
    same, true = simulate(box((0, 0, 0), (20, 20, 20)), scanner, seed=3)
    assert len(scans) == len(same) > 5000
    np.testing.assert_allclose(scans.points, same.points, atol=1e-10)
    np.testing.assert_array_equal(scans.stripe, same.stripe)
    np.testing.assert_allclose(truth.normal, true.normal, atol=1e-12)
    np.testing.assert_allclose(truth.edge_distance, true.edge_distance, atol=3e-3)
    np.testing.assert_array_equal(truth.edge_class, true.edge_class)
    assert truth.patch_count == true.patch_count == 5
    pairs = np.unique(np.stack([truth.patch, true.patch], axis=1), axis=0)
    assert len(pairs) == 5  # the same patches, by whatever number
    assert truth.info["format"] if "format" in truth.info else truth.info["triangles"] == "12"


def test_both_shadows_against_every_triangle_one_by_one() -> None:
    corners = _two_steps()
    part = mesh_part(corners)
    rng = np.random.default_rng(0)
    origins = np.column_stack([rng.uniform(-2, 22, (300, 2)), np.full(300, 60.0)])
    directions = rng.normal(size=(300, 3)) * [0.08, 0.08, 0.0] + [0, 0, -1.0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = part.trace(origins, directions, np.full(300, math.inf))
    far, triangle = first_hits(corners, origins, directions)
    np.testing.assert_allclose(hits.distance, far, rtol=1e-12)
    found = np.flatnonzero(triangle >= 0)
    assert 150 < len(found)
    position = origins[found] + far[found, None] * directions[found]
    camera = np.array([60.0, 10.0, 40.0])
    way = camera - position
    reach = np.linalg.norm(way, axis=1)
    way /= reach[:, None]
    hidden = part.hidden(position, hits.normal[found], way, reach)
    start = position + 1e-6 * hits.normal[found]
    expected = first_hits(corners, start, way)[0] < reach
    np.testing.assert_array_equal(hidden, expected)
    assert 20 < expected.sum() < len(found) - 20


def test_truth_of_a_ball_and_a_rod() -> None:
    _, truth = simulate(mesh_part(ball(10.0, turns=160)), StripeScanner(points=8000))
    assert truth.patch_count == 1 and set(truth.kind) == {SurfaceKind.SPHERE}  # type: ignore[arg-type]
    assert truth.position is not None and truth.normal is not None
    length = np.linalg.norm(truth.position, axis=1, keepdims=True)
    assert 10.0 - length.min() < 10.0 * (1 - math.cos(math.pi / 160)) * 2.1
    cosine = (truth.normal * truth.position / length).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.3
    part = mesh_part(rod(5.0, 12.0))
    _, truth = simulate(part, StripeScanner(points=8000))
    assert sorted(np.unique(truth.kind)) == [SurfaceKind.PLANE, SurfaceKind.CYLINDER]
    assert truth.patch_count == 2 and (truth.edge_class == EdgeClass.SHARP).all()
    some = slice(None, None, 40)
    assert truth.position is not None and truth.edge_distance is not None
    brute = segment_distance(part.edges.start, part.edges.end, truth.position[some])
    np.testing.assert_allclose(truth.edge_distance[some], brute, atol=1e-5)


def test_a_groove_parts_a_face_of_a_mesh_and_a_lost_point_does_not() -> None:
    left, right = cube(10.0) * [1, 1, 0.2], cube(10.0, (10.4, 0, 0)) * [1, 1, 0.2]
    floor = cube(1.0, (10, 0, 0)) * [1, 10, 0.5] * [1, 1, 1]
    floor[:, :, 0] = 10.0 + (floor[:, :, 0] - 10.0) * 0.4
    corners = np.concatenate([left, right, floor])
    label = np.concatenate([np.arange(24) // 2 % 6, 6 + np.arange(12) // 2])
    scanner = StripeScanner(stripe_pitch=0.25, dropout=0.2, views=(View(),))
    _, truth = simulate(mesh_part(corners, label=label), scanner)
    top = [k for k in range(truth.patch_count) if (truth.patch == k).sum() > 500]
    assert len(top) == 2
    assert truth.surface is not None
    assert len(np.unique(truth.surface[np.isin(truth.patch, top)])) == 1
    whole = mesh_part(cube(20.0) * [1, 1, 0.1])
    assert simulate(whole, scanner)[1].patch_count == 1


def test_a_curved_free_form_face_is_one_patch() -> None:
    part = mesh_part(ball(10.0, turns=64) * [1, 1.2, 0.7])
    _, truth = simulate(part, StripeScanner(points=6000))
    assert set(part.surfaces.kind) == {SurfaceKind.FREE_FORM}
    assert truth.patch_count == 1 and (truth.patch == 0).all()
    assert truth.edge_distance is not None and np.isinf(truth.edge_distance).all()


@pytest.mark.parametrize("suffix", ["stl", "ascii.stl", "obj", "ply"])
def test_every_format_gives_the_same_solid(tmp_path: Path, suffix: str) -> None:
    corners = rod(5.0, 12.0)
    path = tmp_path / f"rod.{suffix}"
    write = {"stl": write_stl, "ascii.stl": write_ascii_stl, "obj": write_obj, "ply": write_ply}
    write[suffix](path, corners)
    part = read_part(path)
    assert part.name == path.name and part.info["format"] == suffix.split(".")[-1]
    assert part.info["open_edges"] == "0" and part.info["dropped_triangles"] == "0"
    np.testing.assert_allclose(part.mesh.corners(), corners, atol=1e-6)
    assert sorted(part.surfaces.kind) == [SurfaceKind.PLANE, SurfaceKind.PLANE,
                                          SurfaceKind.CYLINDER]  # fmt: skip
    metres = read_part(path, SolidOptions(unit="m"))
    np.testing.assert_allclose(metres.box, 1000.0 * part.box, rtol=1e-6)


def test_groups_and_labels_are_the_faces(tmp_path: Path) -> None:
    corners = rod(5.0, 12.0)
    half = (corners[:, :, 0].mean(axis=1) > 0).astype(int)
    for path in (write_obj(tmp_path / "a.obj", corners, half),
                 write_ply(tmp_path / "a.ply", corners, 7 * half)):  # fmt: skip
        part = read_part(path)
        assert len(part.surfaces.kind) == 2 and part.info["faces"] == "labels of the file"
        assert (part.surfaces.kind == SurfaceKind.FREE_FORM).all()
        unnamed = read_part(path, SolidOptions(face_labels=False))
        assert len(unnamed.surfaces.kind) == 3 and unnamed.info["faces"] == "smooth groups"
    facets = read_part(path, SolidOptions(face_labels=False, smooth_angle=math.radians(3)))
    assert len(facets.surfaces.kind) == 50


def test_polygons_with_more_corners_and_counting_from_the_end(tmp_path: Path) -> None:
    path = tmp_path / "quads.obj"
    path.write_text(
        "v 0 0 0\nv 4 0 0\nv 4 4 0\nv 0 4 0\nvn 0 0 1\nf -4//1 -3//1 \\\n -2//1 -1//1\n"
    )
    part = read_part(path)
    assert len(part.surface) == 2 and part.surfaces.kind.tolist() == [SurfaceKind.PLANE]
    ply = tmp_path / "quads.ply"
    ply.write_text(
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_index\nend_header\n"
        "0 0 0\n4 0 0\n4 4 0\n0 4 0\n2 6 0\n4 0 1 2 3\n3 3 2 4\n"
    )
    assert len(read_part(ply).surface) == 3


def test_an_open_mesh_is_seen_from_both_sides() -> None:
    sheet = mesh_part(cube(20.0)[:2])  # in the plane x = 0
    directions = np.array([[1.0, 0, 0], [-1.0, 0, 0]])
    hits = sheet.trace(-50.0 * directions + [0, 9.0, 11.0], directions, np.full(2, math.inf))
    np.testing.assert_allclose(hits.distance, 50.0)
    np.testing.assert_allclose(hits.normal, -directions)


@pytest.mark.parametrize("size", [0.1, 10_000.0])
def test_tiny_and_huge_parts_are_scanned(size: float) -> None:
    part = mesh_part(cube(size))
    scans, truth = simulate(part, StripeScanner(points=5000, range_noise=0.0))
    assert len(scans) == 5000 and truth.patch_count == 5
    assert truth.position is not None and truth.edge_distance is not None
    assert 0.4 * size < truth.edge_distance.max() <= 0.5 * size
    outside = np.abs(truth.position / size - 0.5).max(axis=1)
    np.testing.assert_allclose(outside, 0.5, atol=1e-9)
    with pytest.raises(DataError, match="stand_off"):
        simulate(mesh_part(cube(1000.0)), StripeScanner(points=5000, stand_off=299.0))


def test_degenerate_triangles_are_dropped_and_counted() -> None:
    corners = np.concatenate([cube(), cube()[:3][:, [0, 0, 1]]])
    part = mesh_part(corners)
    assert part.info["dropped_triangles"] == "3" and part.info["open_edges"] == "0"
    assert len(part.surface) == 12


def _refused(path: Path, *wanted: str, options: SolidOptions | None = None) -> None:
    with pytest.raises(DataError) as caught:
        read_part(path, options)
    message = str(caught.value)
    assert path.name in message and "\n" not in message
    for text in wanted:
        assert text in message


def test_what_is_no_mesh_is_refused(tmp_path: Path) -> None:
    whole = write_stl(tmp_path / "whole.stl", cube()).read_bytes()
    text = write_ascii_stl(tmp_path / "text.stl", cube()).read_bytes()
    listing = write_ply(tmp_path / "whole.ply", cube()).read_bytes()
    for name, content, wanted in (
        ("empty.stl", b"", "empty"), ("cut.stl", whole[:-30], "cut off"),
        ("none.stl", whole[:80] + bytes(4), "no triangles"), ("junk.stl", b"junk" * 99, "STL"),
        ("cut text.stl", text[: len(text) // 2], "damaged"),
        ("word.stl", text.replace(b"vertex 0 ", b"vertex x ", 1), "damaged"),
        ("nan.stl", text.replace(b"vertex 0 ", b"vertex nan ", 1), "not finite"),
        ("solid.stl", b"solid\nendsolid\n", "no triangles"),
        ("far.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 3\n", "line 3"), ("junk.obj", b"v 1 2\n", "line 1"),
        ("points.obj", b"v 0 0 0\n", "no triangles"), ("junk.ply", b"junk", "PLY"),
        ("cut.ply", listing[: len(listing) // 2], "PLY"),
        ("points.ply", listing[: listing.index(b"element face")] + b"end_header" + b"\n0 0 0" * 36,
         "no faces"),
        ("line.obj", b"v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\n", "none of the 1 triangles"),
        ("part.iges", b"x", "unknown suffix"),
    ):  # fmt: skip
        path = tmp_path / name
        path.write_bytes(content)
        _refused(path, wanted)
    _refused(tmp_path / "absent.stl", "no such file")
    (tmp_path / "folder.stl").mkdir()
    _refused(tmp_path / "folder.stl", "folder")


@pytest.mark.parametrize(
    "values", [{"smooth_angle": 0.0}, {"deflection": -1.0}, {"angular_deflection": 4.0},
               {"fillet_radius": -0.1}, {"unit": "yard"}],
)  # fmt: skip
def test_impossible_options_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(DataError, match=f"SolidOptions: {next(iter(values))}"):
        SolidOptions(**values)  # type: ignore[arg-type]


def test_faces_keep_their_kind_far_from_the_origin(tmp_path: Path) -> None:
    path = write_stl(tmp_path / "far.stl", rod(5.0, 12.0) + np.array([2000.0, -3000.0, 500.0]))
    kinds = sorted(read_part(path).surfaces.kind)
    assert kinds == [SurfaceKind.PLANE, SurfaceKind.PLANE, SurfaceKind.CYLINDER]


_RUN = """
import hashlib, json, sys
from octoseg_ti.device import runtime
runtime.start(threads=int(sys.argv[1]))
from scanner_sim import StripeScanner, read_part, simulate
scans, truth = simulate(read_part(sys.argv[2]), StripeScanner(points=3000), seed=5)
arrays = [scans.points, scans.stripe, truth.patch, truth.edge_distance, truth.normal]
print(json.dumps([hashlib.sha256(a.tobytes()).hexdigest() for a in arrays]))
"""


def test_same_mesh_same_arrays_for_any_number_of_threads(tmp_path: Path) -> None:
    path = str(write_stl(tmp_path / "rod.stl", rod()))
    runs = [
        json.loads(subprocess.run([sys.executable, "-c", _RUN, str(n), path], check=True,
                                  capture_output=True, text=True).stdout)
        for n in (1, 2)
    ]  # fmt: skip
    assert runs[0] == runs[1]
