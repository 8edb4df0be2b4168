"""The one owner of Taichi: its start, its arch, its threads, its cache, its arrays.

Kernel modules take ``ti`` from here (``from octoseg_ti.device.runtime import ti``), never by an
import of their own: this module silences the banner before the first import and is the only one
that may call ``ti.init``. Public functions that launch kernels call `ensure_started` first.
"""

import contextlib
import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
from octoseg_ti.device import affinity, launching, tracing

with tracing.quick_import():
    import taichi as ti

tracing.speed_up(ti.lang.kernel_impl, ti.lang.ast.ast_transformer_utils)
launching.speed_up(ti)

ARCHS = ("cpu", "cuda", "vulkan", "metal")

# A loop of fewer than 512 iterations per thread is not shared between the threads of the CPU
# backend, so coarse loops (one iteration = one chunk) are stretched by this factor.
_CPU_STRIDE = 512
# Parts into which coarse loops fall at least: more than most machines have threads.
_PARTS = 32

# Aliases, because type checkers refuse calls as annotations.
F32Array: Any = ti.types.ndarray(dtype=ti.f32, ndim=1)
F64Array: Any = ti.types.ndarray(dtype=ti.f64, ndim=1)
I32Array: Any = ti.types.ndarray(dtype=ti.i32, ndim=1)
I64Array: Any = ti.types.ndarray(dtype=ti.i64, ndim=1)
F32Rows: Any = ti.types.ndarray(dtype=ti.f32, ndim=2)
F64Rows: Any = ti.types.ndarray(dtype=ti.f64, ndim=2)
I32Rows: Any = ti.types.ndarray(dtype=ti.i32, ndim=2)
I64Rows: Any = ti.types.ndarray(dtype=ti.i64, ndim=2)

_TAICHI_DTYPE = {"float32": ti.f32, "float64": ti.f64, "int32": ti.i32, "int64": ti.i64}


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """How Taichi was started."""

    arch: str
    threads: int
    debug: bool
    profile: bool


_started: Options | None = None


def cache_folder() -> Path:
    """Return the folder of compiled kernels; the environment variable OCTOSEG_CACHE moves it."""
    base = os.environ.get("OCTOSEG_CACHE") or platformdirs.user_cache_dir(
        "octoseg", appauthor=False
    )
    return Path(base) / f"taichi-{'.'.join(map(str, ti.__version__))}"


def start(
    arch: str = "cpu", *, threads: int | None = None, debug: bool = False, profile: bool = False
) -> Options:
    """Start Taichi once, on the arch asked for or not at all.

    Args:
        arch: "cpu", "cuda", "vulkan" or "metal".
        threads: CPU threads; None takes every core.
        debug: Check indices in kernels (slow, CPU only).
        profile: Record the time of every kernel.

    Returns:
        The options in force.

    Raises:
        ValueError: Unknown arch, or a thread count below 1.
        RuntimeError: Taichi already runs with other options, or the arch is not available.
    """
    global _started
    if arch not in ARCHS:
        raise ValueError(f"arch must be one of {', '.join(ARCHS)}, not {arch!r}")
    if threads is not None and threads < 1:
        raise ValueError(f"threads must be at least 1, not {threads}")
    wanted = Options(
        arch=arch, threads=threads or affinity.processors(), debug=debug, profile=profile
    )
    if _started is not None:
        if _started != wanted:
            raise RuntimeError(f"Taichi already runs with {_started}; a process has one runtime")
        return _started
    overruled = os.environ.pop("TI_ARCH", None)  # would replace our arch without a word
    try:
        apart = affinity.kept_apart(wanted.threads if arch == "cpu" else 1)
        with contextlib.redirect_stdout(io.StringIO()), apart:
            ti.init(
                arch=getattr(ti, arch),
                enable_fallback=False,
                cpu_max_num_threads=wanted.threads,
                debug=debug,
                kernel_profiler=profile,
                default_fp=ti.f64,
                default_ip=ti.i32,
                fast_math=False,
                offline_cache=True,
                offline_cache_file_path=str(cache_folder()),
                log_level=ti.ERROR,
                random_seed=0,
            )
    except RuntimeError as error:
        raise RuntimeError(
            f"arch {arch!r} is not available on this machine: use --arch cpu"
        ) from error
    finally:
        if overruled is not None:
            os.environ["TI_ARCH"] = overruled
    running = ti.lang.impl.current_cfg().arch
    if running != getattr(ti, arch) and arch != "cpu":
        raise RuntimeError(f"arch {arch!r} is not available on this machine: use --arch cpu")
    _started = wanted
    return wanted


def restart(*, profile: bool) -> Options:
    """Start Taichi anew with the same options, but for the times of kernels.

    Kernel arrays of a device are lost; compiled kernels are loaded again from the cache.
    """
    global _started
    options = ensure_started()
    ti.reset()
    _started = None
    return start(options.arch, threads=options.threads, debug=options.debug, profile=profile)


def ensure_started() -> Options:
    """Start Taichi on the CPU unless it already runs, and return the options in force."""
    return _started if _started is not None else start()


def running() -> Options | None:
    """Return the options in force, or None while Taichi has not been started."""
    return _started


def on_cpu() -> bool:
    """Say whether kernels run on the CPU."""
    return ensure_started().arch == "cpu"


def workers() -> tuple[int, int]:
    """Return (workers, stride) for loops over coarse items.

    A kernel writes ``for u in range(workers * stride): if u % stride == 0: w = u // stride``: the
    stretched range makes the CPU backend share the items between its threads. The number of workers
    does not depend on the number of threads, so that a chunk is the same everywhere.
    """
    return (_PARTS, _CPU_STRIDE) if on_cpu() else (1024, 1)


def stride_of(items: int) -> int:
    """Return the stride for a loop over coarse items, however few.

    With many items it is small; with few the loop is as long as one over ``_PARTS`` workers.
    A kernel writes ``for u in range(items * stride): if u % stride == 0: item = u // stride``.
    """
    _, stride = workers()
    return max(_PARTS * stride // max(items, 1), 1)


def upload(array: np.ndarray) -> Any:
    """Return the array as a kernel argument: itself on the CPU, else a copy on the device."""
    array = np.ascontiguousarray(array)
    if on_cpu() or array.size == 0:
        return array
    copy = ti.ndarray(_TAICHI_DTYPE[array.dtype.name], array.shape)
    copy.from_numpy(array)
    return copy


def empty(shape: int | tuple[int, ...], dtype: type) -> Any:
    """Return an array for kernels to write; its values are undefined."""
    shape = (shape,) if isinstance(shape, int) else shape
    if on_cpu():
        return np.empty(shape, dtype)
    return ti.ndarray(_TAICHI_DTYPE[np.dtype(dtype).name], tuple(max(s, 1) for s in shape))


def zeros(shape: int | tuple[int, ...], dtype: type) -> Any:
    """Return an array of zeros for kernels."""
    shape = (shape,) if isinstance(shape, int) else shape
    if on_cpu():
        return np.zeros(shape, dtype)
    return ti.ndarray(_TAICHI_DTYPE[np.dtype(dtype).name], tuple(max(s, 1) for s in shape))


def grown(array: Any, rows: int, *, zeros: bool = False) -> Any:
    """Return a copy with more rows; the values of the new ones are undefined, or zero."""
    shape = (rows, *array.shape[1:])
    if on_cpu():
        larger = np.zeros(shape, array.dtype) if zeros else np.empty(shape, array.dtype)
        larger[: array.shape[0]] = array
        return larger
    host = np.zeros(shape, download(array).dtype)
    host[: array.shape[0]] = download(array)
    return upload(host)


def download(array: Any) -> np.ndarray:
    """Return a kernel array as NumPy: itself on the CPU, a copy elsewhere."""
    return array if isinstance(array, np.ndarray) else array.to_numpy()


def sync() -> None:
    """Wait until every launched kernel has ended."""
    if _started is not None:
        ti.sync()


def finish() -> None:
    """Save the compiled kernels and take Taichi down; the process starts it no more."""
    if _started is not None:
        ti.reset()
