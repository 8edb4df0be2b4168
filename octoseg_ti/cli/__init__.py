"""The command line: octoseg VERB ...

`main` finds the verb and turns every outcome into an exit code: 0 done, 1 the data or the work
failed, 2 wrong usage, 130 interrupted. The module of a verb is imported only when it is called.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import traceback
import warnings
from collections.abc import Iterable, Sequence
from importlib import import_module

VERBS = {
    "demo": ("demo", "the whole road once: simulate a test block, segment it, score it, show it"),
    "simulate": ("simulate", "make a recording of a simulated stripe scanner, with truth"),
    "segment": ("segment", "points or stripes to labelled patches"),
    "play": ("play", "replay a recording stripe by stripe in Rerun"),
    "evaluate": ("evaluate", "score results against the recorded truth"),
    "profile": ("profile", "time per stage and per kernel, compilation apart"),
    "info": ("inspect", "say what is in a file"),
    "check": ("inspect", "verify a file"),
    "convert": ("convert", "translate a file into another format"),
    "acceptance": ("acceptance", "measure a simulated scanner on a ball, a plane and a step"),
    "paper": ("paper", "redo the examples of the paper that the method comes from"),
}
"""Verb -> (module in this package, one line of help). A module has OPTIONS and run_<verb>."""

_COLLECT_AFTER = 200_000  # new objects between two runs of the garbage collector

DONE, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130


class UsageError(Exception):
    """The command line itself is wrong; the message is one line for the user."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb.

    Args:
        argv: Arguments after the program's name; None takes those of the process.

    Returns:
        The exit code: 0, 1, 2 or 130.
    """
    if argv is None and not sys.warnoptions:
        warnings.simplefilter("ignore")  # addressed to programmers; python -W default shows them
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _dispatch(arguments)
        _flush()
        return code
    except UsageError as error:
        _complain(str(error))
        return USAGE
    except KeyboardInterrupt:
        _complain("interrupted")
        return INTERRUPTED
    except SystemExit as leaving:  # --help of a verb
        _flush()
        return leaving.code if isinstance(leaving.code, int) else DONE
    except BrokenPipeError:
        drop_stdout()
        return DONE
    except Exception as error:
        _complain(_explain(error))
        return FAILED


def program() -> None:
    """Run one verb and end the process: what the command ``octoseg`` calls.

    Taking Taichi down object by object at the end takes a quarter of a second, a tenth of a short
    run. Its kernels are saved and the process left at once, unless the viewer is loaded too, which
    has work of its own to finish. Translating kernels makes a hundred thousand small objects that
    stay: the collector would walk over them again and again. And the matrices here are small: a
    second thread for them is only there to wait.
    """
    gc.set_threshold(_COLLECT_AFTER)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    code = main()
    if "rerun" in sys.modules:
        sys.exit(code)
    runtime = sys.modules.get("octoseg_ti.device.runtime")
    if runtime is not None:
        runtime.finish()
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.flush()
    os._exit(code)


def _dispatch(arguments: list[str]) -> int:
    """Find the verb and run it."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help())
        return DONE if arguments else USAGE
    verb, rest = arguments[0], arguments[1:]
    if verb in ("-V", "--version"):
        from octoseg_ti import __version__

        print(f"octoseg {__version__}")
        return DONE
    if verb not in VERBS:
        raise UsageError(f"no verb {verb!r}{suggest(verb, VERBS)}; see octoseg --help")
    module = import_module(f"octoseg_ti.cli.{VERBS[verb][0]}")
    from octoseg_ti.cli.parse import parse

    options = parse(verb, module.OPTIONS[verb], rest)
    return int(getattr(module, f"run_{verb}")(options))


def _help() -> str:
    width = max(map(len, VERBS))
    lines = [
        "usage: octoseg VERB [OPTIONS]",
        "",
        "Stripe laser scans to surface patches, edges and surfaces.",
        "",
        "verbs:",
        *(f"  {verb:<{width}}  {line}" for verb, (_, line) in VERBS.items()),
        "",
        "octoseg VERB --help explains a verb; octoseg --version prints the version.",
        "Start with: octoseg demo",
        "Exit codes: 0 done, 1 the data or the work failed, 2 wrong usage, 130 interrupted.",
    ]
    return "\n".join(lines)


def suggest(word: str, known: Iterable[str]) -> str:
    """Return " (did you mean 'x'?)" for the known word that is nearest, or ""."""
    import difflib

    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.55)
    return f" (did you mean {near[0]!r}?)" if near else ""


def _explain(error: Exception) -> str:
    """Say in one line what went wrong, for the person at the terminal."""
    from octoseg_ti.errors import DataError, MissingPackageError

    if os.environ.get("OCTOSEG_TRACEBACK"):
        traceback.print_exc()
    if isinstance(error, DataError | MissingPackageError):
        return str(error)
    if isinstance(error, MemoryError):
        return "not enough memory; use fewer points, or a machine with more memory"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}"
    if isinstance(error, ValueError | Failure):
        return str(error)
    name = type(error).__name__
    return f"{name}: {error}; this is a bug in octoseg, OCTOSEG_TRACEBACK=1 shows where"


class Failure(Exception):
    """The work cannot be done; the message is one line for the user."""


def _complain(line: str) -> None:
    """Write one line to stderr, whatever the message holds."""
    try:
        sys.stderr.write(f"octoseg: {' '.join(line.split())}\n")
        sys.stderr.flush()
    except OSError:
        pass


def _flush() -> None:
    """Write what is still buffered; a reader that went away is no error."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        drop_stdout()


def drop_stdout() -> None:
    """Point stdout at nothing: nobody writes into the closed pipe again, not even at exit."""
    try:
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, sys.stdout.fileno())
        os.close(nothing)
    except (OSError, ValueError):
        pass
