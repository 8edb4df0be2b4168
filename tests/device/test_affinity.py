"""The threads that run kernels keep to a processor each where there is one for every thread."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from octoseg_ti.device.affinity import processors

ROOT = Path(__file__).resolve().parents[2]

# Runs a kernel for long enough to be seen, and prints for every thread the ticks that it ran and
# the processors that it may use.
CODE = """
import json, os, sys, time
from octoseg_ti.device import runtime
runtime.start('cpu', threads=int(sys.argv[1]))
import numpy as np
from octoseg_ti.stages.registration import to_world
n = 200_000
points, view = np.ones((n, 3)), np.zeros(n, np.int32)
end = time.monotonic() + 3.0
while time.monotonic() < end:
    to_world(points, points, view, np.eye(4)[None])
def ticks(task):
    fields = open(f'/proc/self/task/{task}/stat').read().rsplit(')', 1)[1].split()
    return int(fields[11]) + int(fields[12])
tasks = [int(t) for t in os.listdir('/proc/self/task') if int(t) != os.getpid()]
print(json.dumps([[ticks(t), sorted(os.sched_getaffinity(t))] for t in tasks]))
"""


def threads_of(count: int) -> list[tuple[int, list[int]]]:
    """Return ticks and processors of the threads of a process beside the main one."""
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(count)],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [(ticks, allowed) for ticks, allowed in json.loads(done.stdout)]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux alone lets threads be kept")
def test_a_thread_for_every_processor_stays_on_its_own() -> None:
    count = processors()
    if count == 1:
        pytest.skip("there is one processor")
    threads = threads_of(count)
    kept = [allowed[0] for _, allowed in threads if len(allowed) == 1]
    assert sorted(kept) == sorted(os.sched_getaffinity(0))
    # They are those that run the kernels; whatever else there is has hardly run.
    most = sorted(threads, reverse=True)[:count]
    assert all(len(allowed) == 1 for _, allowed in most)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux alone lets threads be kept")
@pytest.mark.parametrize("count", {1, processors() + 1})
def test_fewer_or_more_threads_are_free(count: int) -> None:
    everywhere = sorted(os.sched_getaffinity(0))
    assert all(allowed == everywhere for _, allowed in threads_of(count))


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="there is no such limit")
def test_processors_that_are_not_ours_do_not_count() -> None:
    code = (
        "import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from octoseg_ti.device import runtime\nprint(runtime.start('cpu').threads)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=120,
    )  # fmt: skip
    assert done.stdout.strip() == "1", done.stderr
