"""Every table format brings its points back; foreign files of each are understood."""

from __future__ import annotations

import dataclasses
import gzip
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from octoseg_ti.errors import DataError, MissingPackageError
from octoseg_ti.files import read, read_segmentation, read_truth, write
from octoseg_ti.files.lzf import decompress
from octoseg_ti.palette import colors
from octoseg_ti.types import Scans, SurfaceKind

from .compare import assert_equal
from .factory import make, make_result

SHARED = Path(os.environ.get("OCTOSEG_SHARED") or Path(__file__).parents[3] / "shared") / "data"
TABLES = (".ply", ".pcd", ".xyz")
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="no shared data")


def test_npz_brings_everything_back(tmp_path):
    scans, truth = make(views=2)
    scans = dataclasses.replace(scans, normals=truth.normal)
    result = make_result(scans, truth)
    write(tmp_path / "s.npz", scans, truth=truth)
    assert_equal(read(tmp_path / "s.npz"), scans)
    assert_equal(read_truth(tmp_path / "s.npz"), truth)
    write(tmp_path / "r.npz", result, truth=truth)
    assert_equal(read_segmentation(tmp_path / "r.npz"), result)
    assert_equal(read_truth(tmp_path / "r.npz"), truth)
    back = read(tmp_path / "r.npz")
    assert back.normals is None
    np.testing.assert_array_equal(back.stripe, scans.stripe)
    with np.load(tmp_path / "r.npz") as archive:  # the contract of the NPZ output
        kinds = {name: (archive[name].dtype.name, archive[name].ndim) for name in archive.files}
    wanted = {"normals": ("float32", 2), "labels": ("int32", 1), "edge": ("uint8", 1)}
    wanted |= {"level": ("int8", 1), "outlier": ("uint8", 1), "kind": ("int8", 1)}
    wanted |= {"points": ("float64", 2), "surface": ("int32", 1), "parameters": ("float64", 2)}
    wanted["covariance"] = ("float64", 3)
    assert wanted.items() <= kinds.items()


@settings(max_examples=20, deadline=None)
@given(
    hnp.arrays(
        np.float64, (4, 8, 8), elements=st.floats(allow_nan=True, allow_infinity=True, width=64)
    ),
    st.sampled_from([".npz", ".mcap"]),
)
def test_any_covariance_comes_back(tmp_path_factory, covariance, suffix):
    scans, truth = make(4, 9)
    result = make_result(scans, dataclasses.replace(truth, patch=truth.patch % 4), cells=5)
    path = tmp_path_factory.mktemp("covariance") / f"r{suffix}"
    write(path, dataclasses.replace(result, covariance=covariance), scans=scans)
    np.testing.assert_array_equal(read_segmentation(path).covariance, covariance)


def test_results_of_earlier_versions_have_no_covariance(tmp_path):
    result = make_result(*make())
    write(tmp_path / "r.npz", result)
    with np.load(tmp_path / "r.npz") as archive:
        arrays = {name: archive[name] for name in archive.files if name != "covariance"}
    np.savez(tmp_path / "old.npz", **arrays)
    back = read_segmentation(tmp_path / "old.npz")
    assert_equal(back, result, but=("covariance",))
    assert back.covariance.shape == (result.patch_count, 8, 8) and np.isnan(back.covariance).all()
    for wrong in (result.covariance[:, :7], result.covariance[1:]):
        np.savez(tmp_path / "wrong.npz", covariance=wrong, **arrays)
        with pytest.raises(DataError, match="covariance has"):
            read_segmentation(tmp_path / "wrong.npz")


def test_npz_without_truth_has_none(tmp_path):
    scans, truth = make(2, 5)
    write(tmp_path / "s.npz", scans)
    write(tmp_path / "r.npz", make_result(scans, truth))
    assert read_truth(tmp_path / "s.npz") is None
    assert read_truth(tmp_path / "r.npz") is None
    with pytest.raises(DataError, match="no result"):
        read_segmentation(tmp_path / "s.npz")


def test_labels_of_a_foreign_npz_are_truth(tmp_path):
    labels = np.array([4, 0, -1, 1])
    kinds = np.array(["plane", "cone", "helix", "x", "sphere"])
    np.savez(tmp_path / "f.npz", points=np.zeros((4, 3)), labels=labels, kinds=kinds)
    truth = read_truth(tmp_path / "f.npz")
    assert truth.patch.tolist() == labels.tolist()
    expected = [SurfaceKind.SPHERE, SurfaceKind.PLANE, SurfaceKind.NONE, SurfaceKind.CONE]
    assert truth.kind.tolist() == expected
    np.savez(tmp_path / "n.npz", normals=np.zeros((4, 3)))
    with pytest.raises(DataError, match="no array `points`"):
        read(tmp_path / "n.npz")


@pytest.mark.parametrize("suffix", TABLES)
def test_tables_bring_scans_back(tmp_path, suffix):
    scans, truth = make()
    scans = dataclasses.replace(scans, normals=truth.normal)
    path = tmp_path / f"t{suffix}"
    write(path, scans, truth=truth)
    lost = ("time_ns", "T_world_view", "origin", "stripe_origin", "name")
    assert_equal(read(path), scans, but=lost)
    assert read_truth(path) is None
    with pytest.raises(DataError, match="does not keep a whole result"):
        read_segmentation(path)


@pytest.mark.parametrize("suffix", TABLES)
def test_tables_of_results_bring_points_and_stripes_back(tmp_path, suffix):
    scans, truth = make(views=2)
    path = tmp_path / f"t{suffix}"
    write(path, make_result(scans, truth))
    back = read(path)
    assert back.normals is None
    for name in ("points", "stripe", "view"):
        np.testing.assert_array_equal(getattr(back, name), getattr(scans, name))


@pytest.mark.parametrize("suffix", TABLES)
def test_tables_refuse_the_view_frame(tmp_path, suffix):
    scans = dataclasses.replace(make()[0], frame="view")
    with pytest.raises(DataError, match="poses"):
        write(tmp_path / f"t{suffix}", scans)
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=30, deadline=None)
@given(
    points=hnp.arrays(
        np.float64,
        hnp.array_shapes(min_dims=2, max_dims=2, min_side=3, max_side=3).map(
            lambda s: (s[0] * 2, 3)
        ),
        # No subnormal numbers: the compiler of the kernels makes the process treat them as zero.
        elements=st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=False, width=64),
    )
)
@pytest.mark.parametrize("suffix", [".npz", *TABLES])
def test_any_number_comes_back(tmp_path_factory, suffix, points):
    path = tmp_path_factory.mktemp("any") / f"p{suffix}"
    write(path, Scans(points=points))
    np.testing.assert_array_equal(read(path).points, points)


@pytest.mark.parametrize("suffix", TABLES)
def test_unit_scales(tmp_path, suffix):
    scans, _ = make(2, 5)
    write(tmp_path / f"t{suffix}", scans)
    back = read(tmp_path / f"t{suffix}", unit="m")
    np.testing.assert_allclose(back.points, scans.points * 1000.0, rtol=1e-15)
    with pytest.raises(DataError, match="unknown unit"):
        read(tmp_path / f"t{suffix}", unit="inch")
    write(tmp_path / "t.npz", scans)
    with pytest.raises(DataError, match="fixed unit"):
        read(tmp_path / "t.npz", unit="m")


def test_ply_output_has_colours_by_label_and_patches(tmp_path):
    from plyfile import PlyData

    scans, truth = make()
    result = make_result(scans, truth)
    write(tmp_path / "r.ply", result)
    content = PlyData.read(str(tmp_path / "r.ply"))
    vertex = content["vertex"]
    shades = np.stack([vertex["red"], vertex["green"], vertex["blue"]], axis=1)
    np.testing.assert_array_equal(shades, colors(result.labels)[:, :3])
    for name in ("label", "edge", "level", "outlier"):
        expected = result.labels if name == "label" else getattr(result, name)
        np.testing.assert_array_equal(vertex[name], expected)
    patch = content["patch"]
    np.testing.assert_array_equal(patch["a"], result.parameters[:, 6])
    np.testing.assert_array_equal(patch["cov_px_py"], result.covariance[:, 0, 1])
    np.testing.assert_array_equal(patch["cov_az_a"], result.covariance[:, 5, 6])
    assert sum(name.startswith("cov_") for name in patch.data.dtype.names) == 36


@pytest.mark.parametrize("text", [True, False])
def test_ply_meshes_are_point_clouds(tmp_path, text):
    from plyfile import PlyData, PlyElement

    points = np.random.default_rng(0).random((6, 3))
    vertex = np.array([tuple(p) for p in points], [("x", "f8"), ("y", "f8"), ("z", "f8")])
    for corners in (3, 4):
        faces = np.empty(2, [("vertex_indices", "i4", (corners,))])
        faces["vertex_indices"] = np.arange(2 * corners).reshape(2, corners) % 6
        elements = [PlyElement.describe(vertex, "vertex"), PlyElement.describe(faces, "face")]
        PlyData(elements, text=text).write(str(tmp_path / "m.ply"))
        np.testing.assert_allclose(read(tmp_path / "m.ply").points, points, rtol=1e-12)


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("packed", [True, False])
def test_range_grid_columns_are_stripes(tmp_path, text, packed):
    from plyfile import PlyData, PlyElement

    rows, cols = 3, 4
    vertex = np.array([(c * 0.5, r * 0.1, 1.0) for r in range(rows) for c in range(cols)])
    there = [k for k in range(rows * cols) if k not in (1, 5, 9, 10)]  # column 1 is empty
    table = np.array([tuple(vertex[k]) for k in there], [("x", "f8"), ("y", "f8"), ("z", "f8")])
    grid = np.empty(rows * cols, [("vertex_indices", object)])
    for k in range(rows * cols):
        entry = [there.index(k)] if k in there else []
        grid[k] = (np.array(entry, np.int32),)
    kinds = {"vertex_indices": "i4"}
    elements = [
        PlyElement.describe(table, "vertex"),
        PlyElement.describe(
            grid, "range_grid", len_types={"vertex_indices": "u1"}, val_types=kinds
        ),
    ]
    info = [f"num_cols {cols}", f"num_rows {rows}"]
    for cyberware, scale in ((0, 1.0), (1, 1000.0)):
        path = tmp_path / ("g.ply.gz" if packed else "g.ply")
        flag = [f"is_cyberware_data {cyberware}"]
        plain = tmp_path / "plain.ply"
        PlyData(elements, text=text, byte_order="<", obj_info=info + flag).write(str(plain))
        path.write_bytes(gzip.compress(plain.read_bytes()) if packed else plain.read_bytes())
        scans = read(path)
        assert scans.stripe.tolist() == [0, 0, 0, 2, 2, 3, 3, 3]
        assert scans.column.tolist() == [0, 1, 2, 0, 1, 0, 1, 2]
        np.testing.assert_allclose(scans.points[:, 0], scans.stripe * 0.5 * scale)
        np.testing.assert_allclose(scans.points[:, 1], scans.column * 0.1 * scale)


@needs_shared
def test_stanford_bunny_is_in_millimetres_and_columns():
    scans = read(SHARED / "stanford_bunny" / "bun000.ply.gz")
    assert len(scans) == 40256
    size = np.ptp(scans.points, axis=0)
    assert (size > 100).all() and (size < 200).all()
    offset = scans.points[:, 0] - 0.5 * scans.stripe
    even = scans.column % 2 == 0
    assert np.ptp(offset[even]) < 0.01 and np.ptp(offset[~even]) < 0.01
    assert len(read(SHARED / "proper_test.npz")) == 37326
    assert read_truth(SHARED / "proper_test.npz").patch_count == 3


@pytest.mark.parametrize(
    "text",
    [
        "0 1 2\n3 4 5\n",
        "# made by hand\n0,1,2\n3,4,5\n",
        "// x y z\n0\t1\t2\n\n3\t4\t5",
        "2\n0 1 2 17\n3 4 5 18\n",
        "X;Y;Z\n0;1;2\n3;4;5\n",
        '"z","x","y"\n2,0,1\n5,3,4\n',
        "\ufeff0 1 2 255 0 0\n3 4 5 0 255 0\n",
    ],
)
def test_xyz_dialects(tmp_path, text):
    path = tmp_path / "p.txt"
    path.write_text(text, encoding="utf-8")
    scans = read(path)
    np.testing.assert_array_equal(scans.points, [[0, 1, 2], [3, 4, 5]])
    assert scans.normals is None and scans.stripe is None


def test_xyz_normals_are_taken_when_they_are_unit(tmp_path):
    path = tmp_path / "p.xyz"
    path.write_text("0 1 2 0 0 1\n3 4 5 0 0.6 0.8\n")
    np.testing.assert_array_equal(read(path).normals, [[0, 0, 1], [0, 0.6, 0.8]])


@pytest.mark.parametrize("text", ["0 1\n2 3\n", "a b c\n", "0 1 2\n3 4\n", "0 1 2\nx y z\n"])
def test_xyz_faults(tmp_path, text):
    path = tmp_path / "p.xyz"
    path.write_text(text)
    with pytest.raises(DataError):
        read(path)


def pcd(form, body, view="0 0 0 1 0 0 0", fields="x y z", count=3):
    """Return a PCD file of three points with one extra field of two numbers."""
    head = f"# .PCD v.7\nVERSION .7\nFIELDS {fields} pair\nSIZE 4 4 4 2\nTYPE F F F I\n"
    head += (
        f"COUNT 1 1 1 2\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT {view}\nPOINTS {count}\nDATA {form}\n"
    )
    return head.encode() + body


PCD_ROWS = np.array(
    [(0, 1, 2, (7, 8)), (3, 4, 5, (9, 9)), (np.nan, 6, 7, (1, 2))],
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("pair", "<i2", (2,))],
)


def literal_lzf(data):
    """Return LZF data that only copies, and one repeat of the last byte where possible."""
    out = b""
    for at in range(0, len(data), 32):
        out += bytes([len(data[at : at + 32]) - 1]) + data[at : at + 32]
    return out


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_pcd_forms(tmp_path, form):
    text = b"0 1 2 7 8\n3 4 5 9 9\nnan 6 7 1 2\n"
    planes = b"".join(np.ascontiguousarray(PCD_ROWS[n]).tobytes() for n in PCD_ROWS.dtype.names)
    packed = literal_lzf(planes)
    sizes = np.array([len(packed), len(planes)], "<u4").tobytes()
    bodies = {"ascii": text, "binary": PCD_ROWS.tobytes(), "binary_compressed": sizes + packed}
    path = tmp_path / "p.pcd"
    path.write_bytes(pcd(form, bodies[form]))
    np.testing.assert_array_equal(read(path).points, [[0, 1, 2], [3, 4, 5], [np.nan, 6, 7]])
    path.write_bytes(pcd(form, bodies[form], view="1 0 0 0 0 0 1"))  # half a turn about z
    moved = read(path)
    np.testing.assert_allclose(moved.points[:2], [[1, -1, 2], [-2, -4, 5]], atol=1e-12)
    np.testing.assert_array_equal(moved.origin, [[1, 0, 0]])
    path.write_bytes(pcd(form, bodies[form], count=4))
    with pytest.raises(DataError):
        read(path)


@pytest.mark.parametrize(
    ("data", "plain"),
    [
        (b"\x02abc", b"abc"),
        (b"\x00a\x20\x00", b"aaaa"),  # one byte, repeated three times
        (b"\x02abc\x80\x02", b"abcabcabc"),
        (b"\x00x\xe0\xff\x00", b"x" * (1 + 7 + 255 + 2)),
    ],
)
def test_lzf_known_answers(data, plain):
    assert decompress(data, len(plain)) == plain
    for broken in (data[:-1], data + b"\x00", b"\x20\xff" + data):
        with pytest.raises(ValueError, match=r"bytes|data|reference|beginning"):
            decompress(broken, len(plain))


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_is_in_metres(tmp_path, suffix):
    laspy = pytest.importorskip("laspy")
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3)).round(6)
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = [1e-6] * 3
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.write(str(tmp_path / f"p{suffix}"))
    np.testing.assert_allclose(read(tmp_path / f"p{suffix}").points, points * 1000.0, atol=1e-6)
    in_mm = read(tmp_path / f"p{suffix}", unit="mm")
    np.testing.assert_allclose(in_mm.points, points, atol=1e-9)


def test_e57_scans_are_views(tmp_path):
    pye57 = pytest.importorskip("pye57")
    rng = np.random.default_rng(0)
    path = tmp_path / "p.e57"
    pieces = [rng.uniform(-1, 1, (20, 3)) for _ in range(2)]
    file = pye57.E57(str(path), mode="w")
    for k, piece in enumerate(pieces):
        data = {f"cartesian{axis}": piece[:, i] for i, axis in enumerate("XYZ")}
        data["rowIndex"] = np.tile(np.arange(4, dtype=np.int64), 5)
        data["columnIndex"] = np.repeat(np.arange(5, dtype=np.int64), 4)
        turn = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # a quarter turn about z
        file.write_scan_raw(data, rotation=turn, translation=np.array([k, 0.0, 2.0]))
    file.close()
    scans = read(path)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    expected = [1000.0 * (p @ quarter.T + [k, 0.0, 2.0]) for k, p in enumerate(pieces)]
    np.testing.assert_allclose(scans.points, np.concatenate(expected), atol=1e-3)  # single
    assert scans.view.tolist() == [0] * 20 + [1] * 20
    np.testing.assert_allclose(scans.origin, [[0, 0, 2000], [1000, 0, 2000]], atol=1e-9)
    np.testing.assert_allclose(scans.T_world_view[1, :3, :3], quarter, atol=1e-12)
    assert len(np.unique(scans.stripe)) == 10


@pytest.mark.parametrize(("name", "package"), [("p.las", "laspy"), ("p.e57", "pye57")])
def test_missing_package_says_how_to_install_it(tmp_path, monkeypatch, name, package):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_bytes(b"x" * 300)
    with pytest.raises(MissingPackageError, match=r"pip install 'octoseg\["):
        read(tmp_path / name)


def test_importing_the_package_loads_no_format():
    code = (
        "import sys, octoseg_ti.files, octoseg_ti.palette\n"
        "heavy = {'mcap', 'google', 'plyfile', 'laspy', 'pye57', 'rerun', 'taichi', 'scipy'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
