"""Keeps the threads that run the kernels apart: one on each processor.

Taichi's threads sleep between kernels. Woken for a kernel of a few milliseconds, Linux often puts
two of them on one processor while another is idle, and the kernel has ended before it moves one
away: a scan of 92,000 points takes a quarter longer then. Where there is a thread for every
processor, which one runs where is therefore fixed. Elsewhere the system knows better.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

_TASKS = Path("/proc/self/task")


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _tasks() -> set[int]:
    """Return the identifiers of the threads of this process; none where they are not known."""
    try:
        return {int(entry.name) for entry in _TASKS.iterdir()}
    except OSError:
        return set()


@contextlib.contextmanager
def kept_apart(threads: int) -> Iterator[None]:
    """Fix the threads that start within the block to a processor each, if there are as many.

    Taichi starts those of its compiler first and those of its kernels last.

    Args:
        threads: How many of the new threads, the last ones, run kernels.
    """
    before = _tasks()
    yield
    if not hasattr(os, "sched_setaffinity") or not 1 < threads == processors():
        return
    new = sorted(_tasks() - before)
    with contextlib.suppress(OSError):  # some sandboxes forbid it, and it is faster, not needed
        for task, processor in zip(new[-threads:], sorted(os.sched_getaffinity(0)), strict=False):
            os.sched_setaffinity(task, {processor})
