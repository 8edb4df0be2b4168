"""Playing: pace, choice of stripes, and that nothing is dropped."""

import dataclasses

import numpy as np
import pytest

from octoseg_ti import DataError
from octoseg_ti.view import scene
from octoseg_ti.view.player import play

chunk = pytest.importorskip("rerun.chunk")


class Clock:
    """A clock that only goes on when someone sleeps, or by a fixed cost of every look at it."""

    def __init__(self, cost=0.0):
        self.now, self.cost, self.sleeps = 100.0, cost, []

    def __call__(self):
        self.now += self.cost
        return self.now

    def sleep(self, seconds):
        self.sleeps.append(seconds)
        self.now += seconds


def lines(path):
    """Return the played stripe numbers and their points."""
    rows = []
    for c in chunk.RrdReader(path).stream().filter(content="/world/scan/lines").to_chunks():
        batch = c.to_record_batch()
        if not c.is_static:
            position = batch.column("Points3D:positions").to_pylist()
            rows += list(zip(batch.column("scan_line").to_pylist(), position, strict=True))
    rows.sort(key=lambda row: row[0])
    points = [np.array(p, np.float32).reshape(-1, 3) for _, p in rows]
    return [line for line, _ in rows], points


def test_as_fast_as_possible(made, tmp_path):
    scans = made[0]
    clock = Clock()
    shares = []
    played = play(scans, save=tmp_path / "p.rrd", clock=clock, sleep=clock.sleep,
                  progress=shares.append)  # fmt: skip
    assert clock.sleeps == []
    assert (played.stripes, played.points) == (120, len(scans))
    assert (played.lag, played.segmentations) == (0.0, 0)
    assert len(shares) == 120 and shares[-1] == 1.0
    numbers, points = lines(tmp_path / "p.rrd")
    assert numbers == sorted(set(scans.stripe.tolist()))
    assert (np.concatenate(points) == scans.points.astype(np.float32)).all()


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_the_pace_is_that_of_the_recording_times_the_rate(made, tmp_path, rate):
    clock = Clock()
    play(made[0], rate=rate, save=tmp_path / "p.rrd", clock=clock, sleep=clock.sleep)
    # 120 stripes, 1 ms apart.
    assert sum(clock.sleeps) == pytest.approx(0.119 / rate)
    assert np.allclose(clock.sleeps, 0.001 / rate)


def test_a_slow_receiver_is_reported_and_loses_nothing(made, tmp_path):
    clock = Clock(cost=0.002)  # twice as long as there is for a stripe
    played = play(made[0], rate=1.0, save=tmp_path / "p.rrd", clock=clock, sleep=clock.sleep)
    assert played.stripes == 120
    assert played.lag == pytest.approx(0.119 + 0.002, abs=0.004)
    assert lines(tmp_path / "p.rrd")[0] == list(range(120))


def test_lines_and_every(made, tmp_path):
    played = play(made[0], lines=(10, 31), every=5, save=tmp_path / "p.rrd")
    numbers, points = lines(tmp_path / "p.rrd")
    assert numbers == [10, 15, 20, 25, 30]
    assert played.stripes == 5
    on = np.isin(made[0].stripe, numbers)
    assert (np.concatenate(points) == made[0].points[on].astype(np.float32)).all()


def test_segmenting_on_the_way(made, tmp_path):
    scans, _, result = made
    seen = []

    def segment(part):
        seen.append((len(part), len(scene.stripe_bounds(part.stripe)) - 1))
        names = ("points", "normals", "labels", "edge", "level", "outlier")
        per_point = {name: getattr(result, name)[: len(part)] for name in names}
        return dataclasses.replace(result, **per_point)

    played = play(scans, save=tmp_path / "p.rrd", segment=segment, segment_every=50)
    assert [count for _, count in seen] == [50, 100, 120]
    assert seen[-1][0] == len(scans)
    assert played.segmentations == 3
    sizes = []
    for c in chunk.RrdReader(tmp_path / "p.rrd").stream().to_chunks():
        if c.entity_path == "/world/segments/points":
            batch = c.to_record_batch()
            clouds = batch.column("Points3D:positions").to_pylist()
            sizes += list(zip(batch.column("scan_line").to_pylist(), map(len, clouds), strict=True))
    assert sorted(sizes) == [(49, seen[0][0]), (99, seen[1][0]), (119, seen[2][0])]


def test_a_clock_set_back_between_views_stands_still(made, tmp_path):
    scans = made[0]
    back = dataclasses.replace(scans, time_ns=scans.time_ns % 60_000_000)
    clock = Clock()
    play(back, rate=1.0, save=tmp_path / "p.rrd", clock=clock, sleep=clock.sleep)
    assert sum(clock.sleeps) == pytest.approx(0.118)


def test_interruption_leaves_no_file(made, tmp_path):
    def stop(share):
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        play(made[0], save=tmp_path / "p.rrd", progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "options", "word"),
    [
        ({"stripe": None}, {}, "no stripes"),
        ({"time_ns": None}, {"rate": 1.0}, "no times"),
        ({}, {"rate": -1.0}, "rate"),
        ({}, {"rate": float("nan")}, "rate"),
        ({}, {"every": 0}, "every"),
        ({}, {"lines": (500, 600)}, "no stripe is chosen of the 120"),
        ({}, {"loop": 2}, "one loop"),
    ],
)
def test_what_cannot_be_played(made, tmp_path, change, options, word):
    scans = dataclasses.replace(made[0], **change)
    with pytest.raises(DataError, match=word):
        play(scans, save=tmp_path / "p.rrd", **options)
    assert list(tmp_path.iterdir()) == []


def test_it_must_go_somewhere(made):
    with pytest.raises(ValueError, match="goes to"):
        play(made[0])
