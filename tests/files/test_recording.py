"""Recordings come back as they were written, and Rerun reads them too."""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from octoseg_ti.errors import DataError
from octoseg_ti.files import read, read_segmentation, read_truth, write
from octoseg_ti.files.recording_result import initial_cells
from octoseg_ti.files.recording_write import RecordingWriter
from octoseg_ti.types import Scans, Truth

from .compare import as_stored, assert_equal
from .factory import make, make_result

RERUN = Path(sys.executable).with_name("rerun")


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    """Give scans, truth, result of two views, and the recording of all three."""
    scans, truth = make(views=2)
    result = make_result(scans, truth)
    path = tmp_path_factory.mktemp("recording") / "all.mcap"
    write(path, result, scans=scans, truth=truth, report="# report", scores={"ari": 0.99})
    return scans, truth, result, path


def test_scans_come_back(everything):
    scans, _, _, path = everything
    back = read(path)
    assert_equal(back, scans, but=("points",))
    np.testing.assert_array_equal(back.points, as_stored(scans.points))


def test_truth_comes_back_bit_for_bit(everything):
    _, truth, _, path = everything
    assert_equal(read_truth(path), truth)


def test_result_comes_back(everything):
    _, _, result, path = everything
    back = read_segmentation(path)
    assert_equal(back, result, but=("points",))
    np.testing.assert_array_equal(back.points, as_stored(result.points))


def test_reading_and_writing_again_gives_the_same_bytes(everything, tmp_path):
    scans, truth, _, _ = everything
    write(tmp_path / "a.mcap", scans, truth=truth)
    write(tmp_path / "b.mcap", read(tmp_path / "a.mcap"), truth=read_truth(tmp_path / "a.mcap"))
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_points_in_the_view_frame_are_written_in_the_world_frame(tmp_path):
    scans, truth = make(views=2)
    inverse = np.linalg.inv(scans.T_world_view)[scans.view]
    local = np.einsum("nij,nj->ni", inverse[:, :3, :3], scans.points) + inverse[:, :3, 3]
    normals = np.einsum("nij,nj->ni", inverse[:, :3, :3], truth.normal)
    seen = dataclasses.replace(scans, points=local, normals=normals, frame="view")
    write(tmp_path / "v.mcap", seen)
    back = read(tmp_path / "v.mcap")
    assert back.frame == "world"
    np.testing.assert_allclose(back.points, scans.points, atol=2e-5)
    np.testing.assert_allclose(back.normals, truth.normal, atol=1e-6)


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_large_coordinates_keep_a_micrometre(tmp_path, offset):
    scans, truth = make(offset=offset)
    write(tmp_path / "o.mcap", scans, truth=truth)
    assert np.abs(read(tmp_path / "o.mcap").points - scans.points).max() < 1e-3
    assert_equal(read_truth(tmp_path / "o.mcap"), truth)


def test_rows_that_are_not_finite_keep_their_places(tmp_path):
    scans, truth = make()
    points = scans.points.copy()
    points[3], points[7, 1], points[-1, 2] = np.nan, np.inf, -np.inf
    write(tmp_path / "n.mcap", dataclasses.replace(scans, points=points), truth=truth)
    np.testing.assert_array_equal(read(tmp_path / "n.mcap").points, as_stored(points))
    assert_equal(read_truth(tmp_path / "n.mcap"), truth)


def test_unorganised_points_stay_unorganised(tmp_path):
    points = np.random.default_rng(1).uniform(-50, 50, (120_000, 3))
    write(tmp_path / "u.mcap", Scans(points=points))
    back = read(tmp_path / "u.mcap")
    assert back.stripe is None and back.view is None and back.time_ns is None
    assert back.T_world_view is None
    np.testing.assert_array_equal(back.points, as_stored(points))


def test_missing_stripes_and_times_within_a_stripe_come_back(tmp_path):
    scans, _ = make()
    stripe = scans.stripe * 3 + 5
    time_ns = np.arange(len(scans), dtype=np.int64) * 1234
    origin = np.arange(3.0 * (stripe.max() + 1)).reshape(-1, 3)
    odd = dataclasses.replace(scans, stripe=stripe, time_ns=time_ns, stripe_origin=origin)
    write(tmp_path / "m.mcap", odd)
    assert_equal(read(tmp_path / "m.mcap"), odd, but=("points",))


def test_result_without_scans_is_a_recording_of_its_own(everything, tmp_path):
    _, truth, result, _ = everything
    write(tmp_path / "r.mcap", result)
    assert_equal(read_segmentation(tmp_path / "r.mcap"), result, but=("points",))
    assert read_truth(tmp_path / "r.mcap") is None
    back = read(tmp_path / "r.mcap")
    np.testing.assert_array_equal(back.points, as_stored(result.points))
    np.testing.assert_array_equal(back.stripe, result.stripe)
    np.testing.assert_array_equal(back.view, result.view)
    assert back.normals is None
    write(tmp_path / "rt.mcap", result, truth=truth)
    assert_equal(read_truth(tmp_path / "rt.mcap"), truth)


def test_file_without_result_says_so(tmp_path):
    scans, _ = make()
    write(tmp_path / "s.mcap", scans)
    with pytest.raises(DataError, match="holds no result"):
        read_segmentation(tmp_path / "s.mcap")


def test_partial_truth_comes_back(tmp_path):
    scans, truth = make()
    part = Truth(patch=truth.patch, edge_distance=truth.edge_distance)
    write(tmp_path / "p.mcap", scans, truth=part)
    assert_equal(read_truth(tmp_path / "p.mcap"), part)


def test_streamed_stripes_equal_the_batch(everything, tmp_path):
    scans, truth, _, _ = everything
    bounds = np.append(np.flatnonzero(np.diff(scans.stripe, prepend=-1)), len(scans))
    with RecordingWriter(tmp_path / "s.mcap", name=scans.name) as writer:
        for a, b in itertools.pairwise(bounds.tolist()):
            piece = {
                f.name: getattr(truth, f.name)[a:b]
                for f in dataclasses.fields(truth)
                if f.name not in ("info", "T_world_view")
            }
            writer.add_stripe(
                scans.points[a:b],
                stripe=int(scans.stripe[a]),
                view=int(scans.view[a]),
                column=scans.column[a:b],
                time_ns=int(scans.time_ns[a]),
                origin=scans.stripe_origin[scans.stripe[a]],
                truth=Truth(info=truth.info, **piece),
            )
    back = read(tmp_path / "s.mcap")
    assert_equal(back, scans, but=("points", "T_world_view", "origin"))
    np.testing.assert_array_equal(back.points, as_stored(scans.points))
    assert_equal(read_truth(tmp_path / "s.mcap"), truth)


def test_writer_that_fails_leaves_nothing(tmp_path):
    path = tmp_path / "x.mcap"
    with pytest.raises(KeyboardInterrupt), RecordingWriter(path) as writer:
        writer.add_stripe(np.zeros((3, 3)), stripe=0)
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_writer_refuses_a_piece_that_needs_more_precision(tmp_path):
    with pytest.raises(DataError, match="precise=True"), RecordingWriter(tmp_path / "x") as writer:
        writer.add_stripe(np.zeros((3, 3)), stripe=0)
        writer.add_stripe(np.full((3, 3), 1234567.891), stripe=1)


def test_initial_cells_hold_every_leaf(everything):
    cells = everything[2].cells
    corner, guessed = initial_cells(cells)
    assert guessed == 0
    low, high = corner[:, None], corner[:, None] + cells.initial_size
    inside = (low <= cells.corner + 1e-9) & (cells.corner + cells.size[:, None] <= high + 1e-9)
    assert inside.all(axis=2).any(axis=0).all()
    assert inside.all(axis=2).any(axis=1).all()


def test_topics_follow_the_table(everything):
    from octoseg_ti.files import messages
    from octoseg_ti.files.recording_read import collect

    scans, _, result, path = everything
    contents = collect(path, None)
    by_topic = {
        channel.topic: [m for m in contents.messages if m.channel_id == channel.id]
        for channel in contents.channels.values()
    }
    assert contents.messages == sorted(contents.messages, key=lambda m: m.log_time)
    stripes = np.unique(scans.stripe)
    assert [m.sequence for m in by_topic["/scan/lines"]] == stripes.tolist()
    assert [m.sequence for m in by_topic["/truth/lines"]] == stripes.tolist()
    cloud = messages.PointCloud.FromString(by_topic["/scan/lines"][0].data)
    assert cloud.frame_id == "world" and cloud.pose.orientation.w == 1.0
    assert [f.name for f in cloud.fields][-4:] == ["red", "green", "blue", "alpha"]
    first = messages.FrameTransforms.FromString(by_topic["/tf"][0].data)
    assert [t.child_frame_id for t in first.transforms] == ["view_0", "scanner"]
    place = first.transforms[1].translation
    np.testing.assert_allclose(
        [place.x, place.y, place.z], scans.stripe_origin[0] / 1000.0, rtol=1e-14
    )
    cubes = messages.SceneUpdate.FromString(by_topic["/octree/final"][0].data).entities[0].cubes
    centers = np.array([(c.pose.position.x, c.pose.position.y, c.pose.position.z) for c in cubes])
    cells = result.cells
    np.testing.assert_array_equal(centers, (cells.corner + 0.5 * cells.size[:, None]) / 1000.0)
    assert {c.pose.orientation.w for c in cubes} == {1.0}
    np.testing.assert_array_equal([c.size.y for c in cubes], cells.size / 1000.0)
    stages = [messages.Stage.FromString(m.data) for m in by_topic["/profile/stages"]]
    assert [s.name for s in stages] == list(result.seconds)
    metrics = messages.Metrics.FromString(by_topic["/metrics"][0].data)
    assert (metrics.points, metrics.patches) == (len(result), result.patch_count)
    params = messages.Params.FromString(by_topic["/params"][0].data)
    assert params.normals_rule == result.params.normals.rule
    assert set(contents.attachments) >= {"config.json", "ground_truth.npz", "report.md"}
    assert contents.metadata["octoseg.scores"] == {"ari": "0.99"}


def test_every_parameter_has_a_field():
    from octoseg_ti.files.messages import PARAMS_FIELDS
    from octoseg_ti.params import Params

    wanted = {f"{s}_{key}" for s, section in Params().to_dict().items() for key in section}
    assert {name for name, _ in PARAMS_FIELDS} == wanted | {"preset"}


@pytest.mark.skipif(not RERUN.exists(), reason="rerun is not installed")
def test_rerun_finds_no_fault(everything, tmp_path):
    scans, truth, result, path = everything
    files = {"s": (scans, truth), "r": (result, None)}
    paths = [path]
    for name, (what, with_truth) in files.items():
        paths.append(tmp_path / f"{name}.mcap")
        write(paths[-1], what, truth=with_truth)
    for file in paths:
        command = [str(RERUN), "mcap", "check", "--full", str(file)]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        table = done.stdout.split("─\n")[-1]
        states = [line.split()[0] for line in table.splitlines() if line.strip()]
        assert len(states) >= 2 and set(states) == {"ok"}, done.stdout


def test_rerun_reads_positions_colours_and_transforms(everything):
    chunk = pytest.importorskip("rerun.chunk")
    scans, _, result, path = everything
    columns: dict[str, dict[str, list]] = {}
    for piece in chunk.McapReader(str(path)).stream().to_chunks():
        batch = piece.to_record_batch()
        entity = columns.setdefault(piece.entity_path, {})
        for name in batch.schema.names:
            entity.setdefault(name, []).extend(batch.column(name).to_pylist())
    for entity, count, points in (
        ("/scan/lines", len(np.unique(scans.stripe)), scans.points),
        ("/truth/lines", len(np.unique(scans.stripe)), scans.points),
        ("/segments/points", 1, result.points),
    ):
        rows = [row for row in columns[entity]["Points3D:positions"] if row]
        assert len(rows) == count
        found = np.concatenate([np.array(row) for row in rows])
        np.testing.assert_array_equal(found.astype(np.float32), (points / 1000).astype(np.float32))
        colors = np.concatenate([row for row in columns[entity]["Points3D:colors"] if row])
        assert len(colors) == len(points)
    assert len(set(colors.tolist())) == result.patch_count + 1
    children = [row for row in columns["/tf"]["Transform3D:child_frame"] if row]
    assert sum(row == ["scanner"] for row in children) == len(np.unique(scans.stripe))
    assert ["view_1"] in children
