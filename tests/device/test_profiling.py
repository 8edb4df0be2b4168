"""Stages nest and add up; kernels are named, counted and laid out; compile is apart from run."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from octoseg_ti.device.profiling import (
    Launch,
    Trace,
    chrome_trace,
    join_parts,
    measure,
    stage_table,
)


def nested():
    trace = Trace()
    with trace.stage("grid", points=7):
        with trace.stage("sort"):
            time.sleep(0.01)
        for _ in range(2):
            with trace.stage("split"):
                time.sleep(0.005)
    with trace.stage("edges"):
        pass
    return trace


def test_stages_nest_in_order_and_add_up():
    trace = nested()
    assert list(trace.seconds) == ["grid", "grid.sort", "grid.split", "edges"]
    s = trace.seconds
    assert s["grid.sort"] >= 0.01 and s["grid.split"] >= 0.01
    assert s["grid"] >= s["grid.sort"] + s["grid.split"]
    assert trace.total == pytest.approx(s["grid"] + s["edges"])


def test_a_stage_that_raises_is_kept_and_closed():
    trace = Trace()
    with pytest.raises(KeyError), trace.stage("a"), trace.stage("b"):
        raise KeyError
    with trace.stage("c"):
        pass
    assert list(trace.seconds) == ["a", "a.b", "c"]


def test_a_stage_costs_next_to_nothing():
    times = []
    for _ in range(5):
        trace = Trace()
        start = time.perf_counter()
        for _ in range(200):
            with trace.stage("x"):
                pass
        times.append((time.perf_counter() - start) / 200)
    assert min(times) < 100e-6


def test_chrome_trace_has_both_tracks():
    trace = nested()
    trace.launches += [
        Launch(name="scatter", ms=2.0, stage="grid.sort"),
        Launch(name="scatter", ms=1.0, stage="grid.sort"),
    ]
    values = json.loads(json.dumps(chrome_trace(trace)))
    complete = [e for e in values["traceEvents"] if e["ph"] == "X"]
    stages = [e for e in complete if e["tid"] == 1]
    assert [e["name"] for e in stages] == ["grid", "grid.sort", "grid.split", "grid.split", "edges"]
    assert stages[0]["ts"] == 0 and stages[0]["args"] == {"points": 7}
    outer, inner = stages[0], stages[1]
    assert outer["ts"] <= inner["ts"]
    assert inner["ts"] + inner["dur"] <= outer["ts"] + outer["dur"]
    kernels = [e for e in complete if e["tid"] == 2]
    assert [e["dur"] for e in kernels] == [2000.0, 1000.0]
    assert kernels[0]["ts"] == inner["ts"]
    assert kernels[1]["ts"] == pytest.approx(inner["ts"] + 2000)
    assert chrome_trace(Trace())["traceEvents"]


def test_parts_of_a_launch_are_joined():
    records = [
        ("_fill_c80_0_kernel_0_serial", 1.0),
        ("_fill_c80_0_kernel_1_range_for", 2.0),
        ("_fill_c80_0_kernel_0_serial", 4.0),
        ("_fill_c80_0_kernel_1_range_for", 8.0),
        ("_sort_keys_c9_1_kernel_0_range_for", 16.0),
        ("_sort_keys_c9_1_kernel_0_range_for", 32.0),
        ("memcpy", 64.0),
    ]
    assert join_parts(records) == [
        ("fill", 3.0), ("fill", 12.0), ("sort_keys", 16.0), ("sort_keys", 32.0), ("memcpy", 64.0),
    ]  # fmt: skip
    assert join_parts([]) == []


def test_profile_keeps_the_first_run_apart():
    calls = []

    def work(trace):
        calls.append(len(calls))
        with trace.stage("slow"):
            time.sleep(0.05 if len(calls) == 1 else 0.01)
        with trace.stage("fast"):
            pass

    shares = []
    profile = measure(
        work, points=1000, repeat=3, bytes_per_point={"slow": 24}, progress=shares.append
    )
    assert len(calls) == 4 and len(profile.runs) == 3
    assert shares == [0.25, 0.5, 0.75, 1.0]
    slow, fast, total = profile.stages
    assert (slow["stage"], fast["stage"], total["stage"]) == ("slow", "fast", "total")
    assert slow["cold_ms"] >= 50 and 10 <= slow["ms"] < slow["cold_ms"]
    assert slow["compile_ms"] == pytest.approx(slow["cold_ms"] - slow["ms"])
    assert slow["mpoints_per_s"] == pytest.approx(1 / slow["ms"])
    assert (slow["bytes_per_point"], fast["bytes_per_point"]) == (24, None)
    assert total["percent"] == pytest.approx(100)
    assert slow["percent"] > 90
    json.dumps(profile.to_dict())
    with pytest.raises(ValueError):
        measure(work, points=1, repeat=0)


def test_median_of_the_runs():
    traces = []
    for ns in (9, 1, 2, 50):
        trace = nested()
        trace.spans[:] = [s for s in trace.spans if s.name == "edges"]
        object.__setattr__(trace.spans[0], "duration_ns", ns * 1_000_000)
        traces.append(trace)
    row = next(r for r in stage_table(traces[0], traces[1:], points=10) if r["stage"] == "edges")
    assert (row["cold_ms"], row["ms"], row["min_ms"]) == pytest.approx((9, 2, 1))


KERNELS = '''
import json, sys
import numpy as np
from octoseg_ti.device import profiling, runtime
from octoseg_ti.device.runtime import F64Array, ti

@ti.kernel
def _fill(n: ti.i32, x_out: F64Array):
    """Write a ramp, twice."""
    for i in range(n):
        x_out[i] = i
    for i in range(n):
        x_out[i] = 2.0 * x_out[i]

runtime.start(profile=sys.argv[1] == "yes")
x = np.zeros(200_000)

def work(trace):
    with trace.stage("outer"):
        with trace.stage("ramp"):
            _fill(len(x), x)
            _fill(len(x), x)

profile = profiling.measure(work, points=len(x), repeat=5)
trace = profiling.chrome_trace(profile.runs[0])
print(json.dumps([profile.to_dict(), trace, x[-1]]))
'''


@pytest.mark.parametrize("on", ["yes", "no"])
def test_kernels_of_a_real_run(tmp_path, on):
    script = tmp_path / "kernels.py"  # kernels need their source in a file
    script.write_text(KERNELS)
    root = str(Path(__file__).resolve().parents[2])
    done = subprocess.run(
        [sys.executable, script, on], capture_output=True, text=True, cwd=root,
        env={**os.environ, "PYTHONPATH": root},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    profile, trace, last = json.loads(done.stdout)
    assert last == 2 * 199_999
    rows = {row["stage"]: row for row in profile["stages"]}
    assert rows["outer.ramp"]["cold_ms"] > 5 * rows["outer.ramp"]["min_ms"]
    kernels = [e for e in trace["traceEvents"] if e.get("cat") == "kernel"]
    if on == "no":
        assert profile["kernels"] == [] and kernels == []
        return
    (row,) = profile["kernels"]
    assert (row["kernel"], row["count"]) == ("fill", 10)
    assert 0 < row["min_ms"] <= row["mean_ms"] <= row["max_ms"]
    assert row["total_ms"] == pytest.approx(10 * row["mean_ms"])
    # The kernels of five runs fit into the wall time of the stage that launched them.
    assert row["total_ms"] / 5 < 3 * rows["outer.ramp"]["ms"]
    assert [e["args"]["stage"] for e in kernels] == ["outer.ramp"] * 2
