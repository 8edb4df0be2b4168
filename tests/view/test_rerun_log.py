"""Rerun files read back: entities, rows, positions, colours, and what must not be written."""

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest

from octoseg_ti import DataError
from octoseg_ti.view import entities, rerun_log, scene
from octoseg_ti.view.blueprint import TABS

rr = pytest.importorskip("rerun")
chunk = pytest.importorskip("rerun.chunk")


@pytest.fixture(autouse=True)
def strict():
    """Let a wrong call to Rerun fail instead of warn."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


class Recording:
    """The chunks of a file, by entity."""

    def __init__(self, path):
        self.chunks = {}
        for c in chunk.RrdReader(path).stream().to_chunks():
            self.chunks.setdefault(c.entity_path, []).append(c)

    def rows(self, entity, *, static):
        return sum(c.num_rows for c in self.chunks.get(entity, []) if c.is_static == static)

    def column(self, entity, name, *, static):
        """Return the values of a component, row after row, in the order of time."""
        rows = []
        for c in self.chunks[entity]:
            batch = c.to_record_batch()
            if c.is_static == static and name in batch.schema.names:
                time = batch.column("scan_line").to_pylist() if not static else [0] * len(batch)
                rows += list(zip(time, batch.column(name).to_pylist(), strict=True))
        return [value for _, value in sorted(rows, key=lambda row: row[0])]

    def positions(self, entity, *, static):
        rows = self.column(entity, "Points3D:positions", static=static)
        return [np.array(row, np.float32).reshape(-1, 3) for row in rows]


@pytest.fixture(scope="module")
def saved(made, tmp_path_factory):
    """Return the recording of everything there is."""
    scans, truth, result = made
    path = tmp_path_factory.mktemp("rrd") / "all.rrd"
    rerun_log.save_rrd(path, scans=scans, segmentation=result, truth=truth)
    assert not path.with_name("all.rrd.part").exists()
    return Recording(path)


def test_the_entity_tree(saved, made):
    result = made[2]
    wanted = {
        "/world", "/world/scanner", "/world/scan/lines", "/world/normals/points",
        "/world/normals/arrows", "/world/octree/initial/level_0", "/world/edges/points",
        "/world/edges/removed", "/world/segments/points", "/world/truth/points",
        "/world/errors/points", "/metrics/segment_sizes", "/report", "/params",
        *(f"/world/octree/final/level_{k}" for k in range(4)),
        *(f"/world/surfaces/{k}" for k in range(4)),
        *(f"/metrics/seconds/{name}" for name in result.seconds),
    }  # fmt: skip
    assert wanted <= set(saved.chunks)
    # Every tab has something to show.
    for contents in TABS.values():
        for query in contents:
            assert any(e.startswith(query.removesuffix("/**")) for e in saved.chunks), query


def test_stripes_arrive_one_by_one_with_their_points(saved, made):
    scans = made[0]
    rows = saved.positions("/world/scan/lines", static=False)
    bounds = scene.stripe_bounds(scans.stripe)
    assert len(rows) == len(bounds) - 1 == 120
    assert (np.concatenate(rows) == scans.points.astype(np.float32)).all()
    assert [len(row) for row in rows] == np.diff(bounds).tolist()
    column = saved.column("/world/scan/lines", "octoseg.Scan:column", static=False)
    assert np.concatenate(column).tolist() == scans.column.tolist()
    # Two views, two colours, one for every stripe.
    colors = saved.column("/world/scan/lines", "Points3D:colors", static=False)
    assert {len(c) for c in colors} == {1}
    assert len({c[0] for c in colors}) == 2
    (index,) = (c for c in saved.chunks["/world/scan/lines"] if not c.is_static)
    assert set(index.timeline_names) >= {"scan_line", "scan_time"}


def test_the_probe_moves(saved, made):
    places = saved.column("/world/scanner", "Transform3D:translation", static=False)
    assert np.allclose(np.array(places).reshape(-1, 3), made[0].stripe_origin)


def test_results_are_static_and_whole(saved, made):
    result = made[2]
    (positions,) = saved.positions("/world/segments/points", static=True)
    assert (positions == result.points.astype(np.float32)).all()
    (ids,) = saved.column("/world/segments/points", "Points3D:class_ids", static=True)
    assert np.array(ids).tolist() == (result.labels + 1).tolist()
    (edge,) = saved.positions("/world/edges/points", static=True)
    assert len(edge) == np.count_nonzero(result.edge)
    (rest,) = saved.positions("/world/edges/removed", static=True)
    assert len(rest) == np.sum((result.edge == 0) & (result.outlier == 0))
    (boxes,) = saved.column("/world/octree/final/level_0", "Boxes3D:centers", static=True)
    assert len(boxes) == np.sum(result.cells.level == 0)


def test_the_report_is_inside_with_the_scores(saved):
    (text,) = saved.column("/report", "TextDocument:text", static=True)
    assert "Measured on the data" in text[0] and "adjusted Rand index" in text[0]


def test_the_unit_is_written_down(saved):
    (unit,) = saved.column("/__properties/octoseg", "length_unit", static=True)
    assert unit == ["mm"]


def test_the_file_has_a_layout(made, tmp_path):
    rerun_log.save_rrd(tmp_path / "a.rrd", scans=made[0])
    reader = chunk.RrdReader(tmp_path / "a.rrd")
    assert len(reader.recordings()) == 1
    assert len(reader.blueprints()) == 1


def test_many_cells_are_spread_over_entities(made, tmp_path, monkeypatch):
    monkeypatch.setattr(entities, "BOXES", 100)
    result = made[2]
    rerun_log.save_rrd(tmp_path / "a.rrd", segmentation=result)
    recording = Recording(tmp_path / "a.rrd")
    counts = [
        len(recording.column(entity, "Boxes3D:centers", static=True)[0])
        for entity in recording.chunks
        if entity.startswith("/world/octree/final/level_3")
    ]
    assert max(counts) == 100 and len(counts) > 1
    assert sum(counts) == np.sum(result.cells.level == 3)


def test_far_parts_keep_their_precision(made, tmp_path):
    scans, truth, result = made
    far = np.array([1e6, -2e6, 5e5])
    scans = dataclasses.replace(scans, points=scans.points + far)
    cells = dataclasses.replace(result.cells, corner=result.cells.corner + far)
    result = dataclasses.replace(result, points=result.points + far, cells=cells)
    rerun_log.save_rrd(tmp_path / "far.rrd", scans=scans, segmentation=result, truth=truth)
    recording = Recording(tmp_path / "far.rrd")
    (moved,) = recording.column("/world", "Transform3D:translation", static=True)
    for rows in (
        recording.positions("/world/scan/lines", static=False),
        recording.positions("/world/segments/points", static=True),
        recording.positions("/world/truth/points", static=True),
    ):
        world = np.concatenate(rows).astype(float) + np.array(moved).reshape(3)
        assert np.abs(world - scans.points).max() < 1e-5
    (boxes,) = recording.column("/world/octree/final/level_0", "Boxes3D:centers", static=True)
    assert np.abs(np.array(boxes)).max() < 100


def test_odd_input(made, tmp_path):
    scans, _, result = made
    bare = dataclasses.replace(scans, stripe=None, column=None, view=None, time_ns=None)
    rerun_log.save_rrd(tmp_path / "bare.rrd", scans=bare)
    (positions,) = Recording(tmp_path / "bare.rrd").positions("/world/scan/lines", static=True)
    assert len(positions) == len(scans)

    points = result.points.copy()
    points[::7] = np.nan
    holed = dataclasses.replace(result, points=points, labels=np.full(len(result), -1, np.int32))
    rerun_log.save_rrd(tmp_path / "holed.rrd", segmentation=holed)
    (positions,) = Recording(tmp_path / "holed.rrd").positions(
        "/world/segments/points", static=True
    )
    assert len(positions) == np.isfinite(points).all(axis=1).sum()


def test_what_is_refused(made, tmp_path):
    scans, truth, result = made
    short = dataclasses.replace(truth, patch=truth.patch[:-1])
    target = tmp_path / "a.rrd"
    target.write_bytes(b"old")
    for arguments, word in (
        ({}, "neither"),
        ({"scans": scans, "truth": short}, "truth has"),
        ({"segmentation": result, "truth": short}, "truth has"),
    ):
        with pytest.raises(DataError, match=word):
            rerun_log.save_rrd(target, **arguments)
    with pytest.raises(DataError, match="does not exist"):
        rerun_log.save_rrd(tmp_path / "no" / "a.rrd", scans=scans)
    with pytest.raises(DataError, match="is a folder"):
        rerun_log.save_rrd(tmp_path, scans=scans)
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.rrd"]


def test_importing_the_views_loads_neither_rerun_nor_taichi():
    code = (
        "import sys, octoseg_ti.view.rerun_log, octoseg_ti.view.report, octoseg_ti.view.figures;"
        "print([m for m in ('rerun', 'taichi', 'PIL', 'scipy', 'mcap') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
