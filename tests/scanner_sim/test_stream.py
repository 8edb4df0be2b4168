"""Scans given view by view are the scans of `simulate`, and reach a file as they come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from files.compare import as_stored, assert_equal

from octoseg_ti import files
from octoseg_ti.errors import DataError
from octoseg_ti.files.inspect import check
from octoseg_ti.files.recording_write import RecordingWriter
from octoseg_ti.types import Scans
from scanner_sim import Part, StripeScanner, View, box, scan_views, simulate, sphere
from scanner_sim.part import union
from scanner_sim.simulate import joined

PART: Part = union(box((-8, -6, 0), (8, 6, 5)), sphere((-4, 0, 4), 2.5))
VIEWS = (View(), View(tilt=0.6, azimuth=0.3), View(tilt=0.6, azimuth=2.4))
PITCH = StripeScanner(stripe_pitch=0.5, views=VIEWS, pose_noise=0.02)


@pytest.mark.parametrize("scanner", [PITCH, replace(PITCH, stripe_pitch=None, points=3000)])
def test_the_views_together_are_the_scan(scanner: StripeScanner) -> None:
    scans, truth = simulate(PART, scanner, seed=5)
    stream = scan_views(PART, scanner, seed=5)
    assert stream.at_once == (scanner.points is None) and stream.truth is None
    pieces = list(stream)
    assert stream.truth is not None and len(pieces) == 3
    assert_equal(joined(pieces), scans)
    assert_equal(stream.truth, truth)
    for v, piece in enumerate(pieces):
        assert isinstance(piece, Scans) and piece.view is not None and piece.stripe is not None
        assert (piece.view == v).all()
        assert piece.T_world_view is not None and len(piece.T_world_view) == v + 1
        assert piece.stripe_origin is not None and len(piece.stripe_origin) > piece.stripe.max()
    bare = scan_views(PART, scanner, seed=5, truth=False)
    assert_equal(joined(list(bare)), scans)
    assert bare.truth is None


def test_a_view_is_given_before_the_next_is_scanned() -> None:
    done: list[float] = []
    stream = scan_views(PART, PITCH, progress=lambda name, share: done.append(share), truth=False)
    seen = [(len(piece), max(done)) for piece in stream]
    assert [share for _, share in seen] == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert all(count > 100 for count, _ in seen)


def test_a_stream_that_sees_nothing_says_so_at_its_end() -> None:
    stream = scan_views(PART, replace(PITCH, depth_of_field=1e-6, views=(View(),)))
    with pytest.raises(DataError, match="sees nothing"):
        list(stream)


def test_a_recording_written_in_parts_holds_the_same(tmp_path) -> None:
    scans, truth = simulate(PART, PITCH, seed=5)
    stream = scan_views(PART, PITCH, seed=5)
    path = tmp_path / "parts.mcap"
    with RecordingWriter(path, name=scans.name, truth_follows=True) as writer:
        for number, piece in enumerate(stream):
            writer.add(piece)
            assert not path.exists()
            assert number == 0 or writer.time_ns > 0
        assert stream.truth is not None
        writer.add_truth(stream.truth)
    assert check(path) == []
    files.write(tmp_path / "whole.mcap", scans, truth=truth)
    assert_equal(files.read(path), files.read(tmp_path / "whole.mcap"), but=("name",))
    there, known = files.read_truth(path), files.read_truth(tmp_path / "whole.mcap")
    assert_equal(there, known)
    assert there is not None
    np.testing.assert_array_equal(there.position, truth.position)
    world = files.read(path).points
    np.testing.assert_array_equal(world, as_stored(world))


def test_truth_that_was_not_announced_or_does_not_fit_is_refused(tmp_path) -> None:
    _, truth = simulate(PART, PITCH, seed=5)
    for follows in (False, True):
        with pytest.raises(ValueError, match="truth of"):
            with RecordingWriter(tmp_path / "a.mcap", truth_follows=follows) as writer:
                writer.add(next(iter(scan_views(PART, PITCH, seed=5))))
                writer.add_truth(truth)
        assert list(tmp_path.iterdir()) == []  # nothing half-written stays
