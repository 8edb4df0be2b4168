"""Damaged, foreign and wrong files give one clear line, whatever the damage."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from octoseg_ti.errors import DataError
from octoseg_ti.files import read, read_segmentation, read_truth, write

from .compare import as_stored
from .factory import make, make_result

ANY_CASE = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Give the bytes of a recording with scans, truth and result, and a place for broken ones."""
    folder = tmp_path_factory.mktemp("damage")
    scans, truth = make(6, 20)
    path = folder / "whole.mcap"
    write(path, make_result(scans, truth, cells=20), scans=scans, truth=truth)
    return path.read_bytes(), folder / "broken.mcap"


def assert_refused(path, *needles):
    """Assert that every reader gives one line that names the file, the fault and a remedy."""
    for reader in (read, read_truth, read_segmentation):
        with pytest.raises(DataError) as caught:
            reader(path)
        text = str(caught.value)
        assert text.startswith(f"{path}: ") and "\n" not in text and caught.value.hint
        for needle in needles:
            assert needle in text


def test_every_truncation_is_refused(whole):
    data, path = whole
    cuts = {1, 4, 8, 9, 20, *range(60, len(data), max(len(data) // 60, 1)), len(data) - 1}
    for cut in sorted(cuts | {len(data) - k for k in (2, 4, 8, 9, 12, 20, 36, 37)}):
        path.write_bytes(data[:cut])
        assert_refused(path, "cut off")


def test_truncation_tells_how_much_is_left(whole):
    data, path = whole
    path.write_bytes(data[:-20])
    assert_refused(path, "6 stripes can still be read", "recover")


@ANY_CASE
@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_every_flipped_bit_is_refused(whole, place, bit):
    data, path = whole
    broken = bytearray(data)
    broken[int(place * len(data))] ^= 1 << bit
    path.write_bytes(broken)
    assert_refused(path)


def test_flipped_bits_at_both_ends_are_refused(whole):
    data, path = whole
    for at in (*range(40), *range(len(data) - 60, len(data))):
        broken = bytearray(data)
        broken[at] ^= 1 << (at % 8)
        path.write_bytes(broken)
        assert_refused(path)


@ANY_CASE
@given(junk=st.binary(min_size=1, max_size=300), end=st.booleans())
def test_junk_is_refused(whole, junk, end):
    _, path = whole
    magic = b"\x89MCAP0\r\n"
    path.write_bytes(magic + junk + magic if end else junk)
    assert_refused(path)


@pytest.mark.parametrize(
    "suffix", [".mcap", ".npz", ".ply", ".ply.gz", ".pcd", ".xyz", ".las", ".e57"]
)
@pytest.mark.parametrize(
    "content", [b"", b"hello", b"\x00" * 200, b"ply\n", b"\x1f\x8b\x08", b"LASF"]
)
def test_wrong_content_is_refused(tmp_path, suffix, content):
    path = tmp_path / f"wrong{suffix}"
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".npz", ".ply", ".pcd"])
def test_truncated_tables_are_refused(tmp_path, suffix):
    scans, _ = make(6, 20)
    path = tmp_path / f"t{suffix}"
    write(path, scans)
    data = path.read_bytes()
    for cut in range(1, len(data), max(len(data) // 40, 1)):
        path.write_bytes(data[:cut])
        with pytest.raises(DataError):
            read(path)


def test_missing_file_folder_and_unknown_suffix(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read(tmp_path / "nothing.mcap")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(DataError, match="folder"):
        read(tmp_path / "folder.npz")
    for name in ("x.stl", "x", "x.rrd"):
        with pytest.raises(DataError, match=r"known: \.mcap"):
            read(tmp_path / name)
    with pytest.raises(DataError, match=r"known: \.mcap"):
        write(tmp_path / "x.las", make()[0])


def record(path, topics):
    """Write a foreign recording of (topic, schema, encoding, messages) by the plain writer."""
    from mcap.writer import Writer
    from mcap_protobuf.schema import build_file_descriptor_set

    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, schema, encoding, messages in topics:
            name, kind, data = "", "", b""
            if isinstance(schema, str):
                name, kind = schema, encoding
            elif schema is not None:
                name, kind = schema.DESCRIPTOR.full_name, "protobuf"
                data = build_file_descriptor_set(schema).SerializeToString()
            identity = writer.register_schema(name, kind, data) if name else 0
            channel = writer.register_channel(topic, encoding, identity)
            for time, message in enumerate(messages):
                writer.add_message(channel, 10 * time, message, 10 * time)
        writer.finish()


def cloud(points, dtype="<f4", frame="base", pose=None):
    """Return a serialised foreign PointCloud in metres, with an extra field before x."""
    from octoseg_ti.files.messages import CloudLayout, PointCloud

    layout = np.dtype([("ring", "u1"), ("x", dtype), ("y", dtype), ("z", dtype)])
    rows = np.zeros(len(points), layout)
    for i, axis in enumerate("xyz"):
        rows[axis] = points[:, i]
    message = PointCloud.FromString(CloudLayout(layout, frame).pack(rows, 5))
    if pose is not None:
        message.pose.position.x = pose
    return message.SerializeToString()


@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
def test_foreign_clouds_are_stripes_in_the_root_frame(tmp_path, dtype):
    from octoseg_ti.files import messages

    path = tmp_path / "foreign.mcap"
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3)).astype(np.float32)
    shift = np.eye(4)
    shift[:3, 3] = 1000.0, 0.0, 0.0
    tf = messages.transform_message([("map", "base", shift)], 0).SerializeToString()
    transforms = ("/tf", messages.FrameTransforms, "protobuf", [tf])
    clouds = [cloud(points, dtype), cloud(points + 1, dtype, pose=0.5)]
    record(path, [transforms, ("/lidar", messages.PointCloud, "protobuf", clouds)])
    scans = read(path)
    expected = points.astype(np.float64) * 1000.0 + [1000.0, 0.0, 0.0]
    np.testing.assert_allclose(scans.points[:5], expected, rtol=1e-12)
    moved = (points + 1).astype(np.float64) * 1000.0 + [1500.0, 0.0, 0.0]
    np.testing.assert_allclose(scans.points[5:], moved, rtol=1e-12)
    assert scans.stripe.tolist() == [0] * 5 + [1] * 5
    assert scans.time_ns.tolist() == [0] * 5 + [10] * 5
    assert read_truth(path) is None


def test_foreign_topics_must_be_chosen(tmp_path):
    from octoseg_ti.files.messages import PointCloud

    path = tmp_path / "two.mcap"
    points = np.ones((4, 3))
    record(path, [(f"/{n}", PointCloud, "protobuf", [cloud(points * n)]) for n in (1, 2)])
    with pytest.raises(DataError, match="/1, /2"):
        read(path)
    scans = read(path, topic="/2")
    np.testing.assert_array_equal(scans.points, as_stored(points * 2000.0))
    assert scans.stripe is None
    with pytest.raises(DataError, match="no topic /3"):
        read(path, topic="/3")


def test_recordings_that_cannot_be_used_say_why(tmp_path):
    from octoseg_ti.files.messages import Log, PointCloud, log_message

    path = tmp_path / "f.mcap"
    log = ("/log", Log, "protobuf", [log_message("hi", 0).SerializeToString()])
    cases = {
        "no foxglove.PointCloud topic": [log],
        "foxglove.PointCloud in json": [("/a", "foxglove.PointCloud", "json", [b"{}"])],
        "has no messages": [("/a", PointCloud, "protobuf", [])],
        "not a readable MCAP": [("/a", PointCloud, "protobuf", [b"\xff\xff\xff"])],
        "there are no points": [("/a", PointCloud, "protobuf", [cloud(np.zeros((0, 3)))])],
    }
    for reason, topics in cases.items():
        record(path, topics)
        with pytest.raises(DataError, match=reason):
            read(path)
    with pytest.raises(DataError, match="without schema"):
        record(path, [("/a", None, "json", [b"{}"])])
        read(path, topic="/a")


def test_pickled_objects_are_never_loaded(tmp_path):
    path = tmp_path / "p.npz"
    np.savez(path, points=np.array([{"a": 1}], dtype=object))
    with pytest.raises(DataError, match="NPZ"):
        read(path)


def test_archive_that_lies_about_its_size_is_refused(tmp_path):
    import zipfile

    header = io.BytesIO()
    shape = {"descr": "<f8", "fortran_order": False, "shape": (10**15, 3)}
    np.lib.format.write_array_header_1_0(header, shape)
    path = tmp_path / "huge.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("points.npy", header.getvalue())
    with pytest.raises(DataError, match="NPZ"):
        read(path)
