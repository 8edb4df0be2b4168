"""Where the time goes: stages of the host, kernels of the device, compile apart from run.

Kernels are seen only when the runtime was started with ``profile=True``. Taichi records how long
each launch took and in what order, not when it began.
"""

import re
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import Any

# Taichi calls part 2 of the kernel `_fill` "_fill_c80_0_kernel_2_range_for".
_PART = re.compile(r"^_*(?P<name>.*?)_c\d+_\d+_kernel_(?P<part>\d+)_\w*$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """One pass through a stage."""

    name: str
    """Names of the stages around it and its own, joined by dots."""
    depth: int
    """Number of stages around it."""
    start_ns: int
    """Start on the monotonic clock [ns]."""
    duration_ns: int
    """Wall time [ns]."""
    args: Mapping[str, Any]
    """What the caller noted about it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Launch:
    """One launch of a kernel."""

    name: str
    """Name of the kernel."""
    ms: float
    """Time on the device, all parts together [ms]."""
    stage: str
    """Innermost stage it was launched in; "" = outside."""


# What was taken out of Taichi's own list, which would grow for ever (taichi issue 5527).
_launches: list[Launch] = []


class Trace:
    """Wall time of stages.

    Stages nest: ``grid`` and, inside it, ``grid.split``. Taichi is waited for at both ends of a
    stage, so that a stage is charged with all it launched and nothing else.
    """

    def __init__(self) -> None:
        """Start with no stages."""
        self._open: list[str] = []
        self._order: dict[str, None] = {}
        self.spans: list[Span] = []
        """Stages passed through, in the order in which they ended."""
        self.launches: list[Launch] = []
        """Launches inside the stages, in order; empty unless Taichi profiles."""

    @contextmanager
    def stage(self, name: str, **args: Any) -> Iterator[None]:
        """Measure the body of the ``with`` statement, also when it raises.

        Args:
            name: Name of the stage.
            **args: What the trace file shall say about it, such as ``points=1000``.
        """
        _sync()
        self._collect()
        self._open.append(name)
        path = ".".join(self._open)
        self._order.setdefault(path)
        start = perf_counter_ns()
        try:
            yield
        finally:
            try:
                _sync()
            finally:
                duration = perf_counter_ns() - start
                self._collect()
                self._open.pop()
                self.spans.append(
                    Span(
                        name=path,
                        depth=len(self._open),
                        start_ns=start,
                        duration_ns=duration,
                        args=args,
                    )
                )

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time of every stage [s], in the order of their starts; repeated ones add up."""
        total = dict.fromkeys(self._order, 0)
        for span in self.spans:
            total[span.name] += span.duration_ns
        return {name: 1e-9 * ns for name, ns in total.items()}

    @property
    def total(self) -> float:
        """Wall time of the outermost stages [s]."""
        return 1e-9 * sum(span.duration_ns for span in self.spans if span.depth == 0)

    def _collect(self) -> None:
        self.launches += _drain(".".join(self._open))


@dataclass(frozen=True, slots=True, kw_only=True)
class Profile:
    """The times of one cold run, which compiles, and of the runs after it."""

    points: int
    """Points that every run worked on."""
    cold: Trace
    """The first run."""
    runs: tuple[Trace, ...]
    """The runs after it."""
    stages: list[dict[str, Any]]
    """Rows of `stage_table`."""
    kernels: list[dict[str, Any]]
    """Rows of `kernel_table` over the runs whose kernels were timed."""
    watched: tuple[Trace, ...] = ()
    """Runs of their own whose kernels were timed, where that was asked for."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "points": self.points,
            "runs": len(self.runs),
            "stages": self.stages,
            "kernels": self.kernels,
        }


def measure(
    work: Callable[[Trace], Any],
    *,
    points: int,
    repeat: int = 20,
    bytes_per_point: Mapping[str, float] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Profile:
    """Run some work once cold and then repeatedly, and sum up where the time went.

    Args:
        work: Does the work, in stages of the trace that it is given.
        points: Points that the work handles.
        repeat: Runs after the first, at least 1.
        bytes_per_point: Memory that a stage reads and writes for every point, where known.
        progress: Told the share of the runs done, 0..1.

    Raises:
        ValueError: ``repeat`` is below 1.
    """
    if repeat < 1:
        raise ValueError(f"repeat must be at least 1, not {repeat}")
    traces = []
    for k in range(repeat + 1):
        traces.append(Trace())
        work(traces[-1])
        _sync()
        if k == 0:
            clear_kernels()
        if progress is not None:
            progress((k + 1) / (repeat + 1))
    cold, runs = traces[0], tuple(traces[1:])
    return Profile(
        points=points,
        cold=cold,
        runs=runs,
        stages=stage_table(cold, runs, points=points, bytes_per_point=bytes_per_point),
        kernels=kernel_table(),
    )


def measure_apart(work: Callable[[Trace], Any], **options: Any) -> Profile:
    """Measure stages first, then kernels in runs of their own.

    Taichi's clock around every kernel costs a third of a short run. So the stages are timed without
    it, and Taichi is started anew to time the kernels.

    Args:
        work: As for `measure`.
        **options: The other arguments of `measure`; the progress covers both halves.
    """
    from octoseg_ti.device import runtime

    progress = options.pop("progress", None)

    def half(offset: float) -> Callable[[float], None] | None:
        return None if progress is None else lambda share: progress(offset + share / 2)

    profile = measure(work, **options, progress=half(0.0))
    runtime.restart(profile=True)
    try:
        watched = measure(work, **options, progress=half(0.5))
    finally:
        runtime.restart(profile=False)
    return replace(profile, kernels=watched.kernels, watched=watched.runs)


def stage_table(
    cold: Trace,
    runs: Sequence[Trace],
    *,
    points: int,
    bytes_per_point: Mapping[str, float] | None = None,
) -> list[dict[str, Any]]:
    """Return a row for every stage and a last one, "total".

    A row has ``stage``, ``depth``, ``cold_ms`` (first run), ``ms`` (median of the runs),
    ``min_ms``, ``compile_ms`` (``cold_ms`` less ``ms``, not below 0: loading and compiling of
    kernels, and cold caches), ``mpoints_per_s``, ``bytes_per_point`` (None = not known) and
    ``percent`` of the total.

    Args:
        cold: Trace of the first run.
        runs: Traces of the runs after it.
        points: Points that every run worked on.
        bytes_per_point: Memory that a stage reads and writes for every point, where known.
    """
    known = bytes_per_point or {}
    names: dict[str, None] = {}
    for trace in (*runs, cold):
        names.update(dict.fromkeys(trace.seconds))
    total = statistics.median(trace.total for trace in runs)
    rows = []
    for name in names:
        times = [trace.seconds[name] for trace in runs if name in trace.seconds]
        first = cold.seconds.get(name, 0.0)
        rows.append(_row(name, first, times, total, points, known.get(name)))
    rows.append(
        _row("total", cold.total, [t.total for t in runs], total, points, known.get("total"))
    )
    return rows


def _row(
    name: str, cold: float, times: list[float], total: float, points: int, size: float | None
) -> dict[str, Any]:
    median = statistics.median(times) if times else 0.0
    return {
        "stage": name,
        "depth": name.count("."),
        "cold_ms": 1e3 * cold,
        "ms": 1e3 * median,
        "min_ms": 1e3 * min(times, default=0.0),
        "compile_ms": 1e3 * max(cold - median, 0.0),
        "mpoints_per_s": 1e-6 * points / median if median else None,
        "bytes_per_point": size,
        "percent": 100 * median / total if total else 0.0,
    }


def kernel_table() -> list[dict[str, Any]]:
    """Return a row for every kernel launched since `clear_kernels`, the costliest first.

    A row has ``kernel``, ``count`` (launches), ``min_ms``, ``mean_ms``, ``max_ms``, ``total_ms``
    and ``percent`` of the time of all kernels. Empty unless Taichi was started with
    ``profile=True``.
    """
    _sync()
    _drain("")
    times: dict[str, list[float]] = {}
    for launch in _launches:
        times.setdefault(launch.name, []).append(launch.ms)
    total = sum(map(sum, times.values()))
    rows = [
        {
            "kernel": name,
            "count": len(ms),
            "min_ms": min(ms),
            "mean_ms": sum(ms) / len(ms),
            "max_ms": max(ms),
            "total_ms": sum(ms),
            "percent": 100 * sum(ms) / total if total else 0.0,
        }
        for name, ms in times.items()
    ]
    return sorted(rows, key=lambda row: (-row["total_ms"], row["kernel"]))


def clear_kernels() -> None:
    """Forget the launches recorded so far."""
    _drain("")
    _launches.clear()


def chrome_trace(trace: Trace) -> dict[str, Any]:
    """Return the trace in the Chrome trace event format, for ui.perfetto.dev or speedscope.

    Stages are on one track. Kernels are on a second one: their durations and order are measured;
    each is drawn right after the one before it, from the start of its stage.

    Args:
        trace: Trace of one run.
    """
    spans = sorted(trace.spans, key=lambda span: (span.start_ns, span.depth))
    origin = spans[0].start_ns if spans else 0
    events: list[dict[str, Any]] = [
        {"ph": "M", "pid": 1, "tid": 0, "name": "process_name", "args": {"name": "octoseg"}},
        {"ph": "M", "pid": 1, "tid": 1, "name": "thread_name", "args": {"name": "stages"}},
    ]
    for span in spans:
        events.append(
            {
                "ph": "X",
                "pid": 1,
                "tid": 1,
                "cat": "stage",
                "name": span.name,
                "ts": (span.start_ns - origin) / 1e3,
                "dur": span.duration_ns / 1e3,
                "args": dict(span.args),
            }
        )
    if trace.launches:
        name = {"name": "kernels (start times estimated)"}
        events.append({"ph": "M", "pid": 1, "tid": 2, "name": "thread_name", "args": name})
    start_us = {span.name: (span.start_ns - origin) / 1e3 for span in reversed(spans)}
    now = 0.0
    for launch in trace.launches:
        now = max(now, start_us.get(launch.stage, now))
        events.append(
            {
                "ph": "X",
                "pid": 1,
                "tid": 2,
                "cat": "kernel",
                "name": launch.name,
                "ts": now,
                "dur": 1e3 * launch.ms,
                "args": {"stage": launch.stage},
            }
        )
        now += 1e3 * launch.ms
    return {"traceEvents": events, "displayTimeUnit": "ms"}


def _runtime() -> Any:
    # A runtime that was never imported has launched nothing; importing it would cost a third of a
    # second here.
    return sys.modules.get("octoseg_ti.device.runtime")


def _sync() -> None:
    runtime = _runtime()
    if runtime is not None:
        runtime.sync()


def _drain(stage: str) -> list[Launch]:
    """Take the records of kernels from Taichi and file them under a stage."""
    runtime = _runtime()
    options = None if runtime is None else runtime.running()
    if options is None or not options.profile:
        return []
    ti = runtime.ti
    try:
        profiler = ti.profiler.kernel_profiler.get_default_kernel_profiler()
        profiler._update_records()
        records = [(record.name, record.kernel_time) for record in profiler._traced_records]
    except AttributeError as error:  # these are private to Taichi
        raise RuntimeError(f"Taichi {ti.__version__} hides its kernel records") from error
    if not records:
        return []
    ti.profiler.clear_kernel_profiler_info()
    launches = [Launch(name=name, ms=ms, stage=stage) for name, ms in join_parts(records)]
    _launches.extend(launches)
    return launches


def join_parts(records: Sequence[tuple[str, float]]) -> list[tuple[str, float]]:
    """Join the parts of every launch.

    Taichi records each loop of a kernel, and the code between loops, as a part of its own; parts
    of one launch are numbered upwards.

    Args:
        records: Taichi's name and time [ms] of every part, in order.

    Returns:
        Name of the kernel without leading underscores, and time [ms], of every launch.
    """
    joined: list[tuple[str, float]] = []
    last = ("", 0)
    for raw, ms in records:
        match = _PART.match(raw)
        name, part = (match["name"], int(match["part"])) if match else (raw, 0)
        if joined and last[0] == name and part > last[1]:
            joined[-1] = (name, joined[-1][1] + ms)
        else:
            joined.append((name, ms))
        last = (name, part)
    return joined
