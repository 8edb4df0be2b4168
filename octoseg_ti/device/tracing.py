"""Makes the translation of kernels cheaper, without changing what is translated.

Taichi 1.7 translates every kernel anew in every process, also when the compiled code comes from
the cache, and two thirds of that time goes into text: for each node of the syntax tree it renders
an excerpt of the source, wrapped and underlined, in case an error has to be reported, and it
reads, wraps and parses the source of a function again at each of its calls. Here the position is
one line, and sources are read once. For each decorated function it also searches all modules to
learn whether it stands in a class; ours never do. Names of Taichi that are not there (another
version) leave everything as it was.

Taichi also asks a server for its newest version when it starts. A tool that works on other people's
parts asks nobody: that module is replaced by one that does nothing, which also spares its imports.
"""

import ast
import contextlib
import functools
import inspect
import linecache
import sys
import textwrap
from collections.abc import Callable, Iterator
from types import FrameType, ModuleType, SimpleNamespace
from typing import Any


def _position(self: Any, node: Any) -> str:
    """Return file, line and function of a node, and the line of source."""
    line = self.src[node.lineno - 1].strip() if node.lineno <= len(self.src) else ""
    return (
        f'File "{self.file}", line {node.lineno + self.lineno_offset}, '
        f"in {self.func.func.__name__}:\n{line}\n"
    )


def _frame_info(frame: FrameType, context: int = 1) -> inspect.Traceback:
    """Return what `inspect.getframeinfo` says about a frame, without a search for its module."""
    code = frame.f_code
    line = linecache.getline(code.co_filename, frame.f_lineno)
    return inspect.Traceback(code.co_filename, frame.f_lineno, code.co_name, [line], 0)


@contextlib.contextmanager
def quick_import() -> Iterator[None]:
    """Let Taichi be imported without asking home, and without searching modules a thousand times.

    Its own library of decorated functions is read in the import; for each it looks at the source
    line where the decorator stands.
    """
    silent = ModuleType("taichi._version_check")
    silent.start_version_check_thread = lambda: None  # type: ignore[attr-defined]
    sys.modules.setdefault("taichi._version_check", silent)
    thorough = inspect.getframeinfo
    inspect.getframeinfo = _frame_info  # type: ignore[assignment]
    try:
        yield
    finally:
        inspect.getframeinfo = thorough


def _source_lines(thorough: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a faster `inspect.getsourcelines` for functions at the top of a module.

    Such a function ends before the next line that begins in the first column, apart from comments
    and from brackets that close its signature. What does not parse is left to the thorough way.
    """

    @functools.cache
    def lines_of(function: Any) -> tuple[list[str], int]:
        code: Any = getattr(function, "__code__", None)
        lines = linecache.getlines(code.co_filename) if code is not None else []
        if not lines or code.co_firstlineno > len(lines):
            return thorough(function)  # type: ignore[no-any-return]
        first = code.co_firstlineno - 1
        end = first
        while end < len(lines) and not lines[end].startswith(("def ", "async def ")):
            end += 1
        end += 1
        while end < len(lines) and (lines[end][0].isspace() or lines[end][0] in ")]}#"):
            end += 1
        block = lines[first:end]
        while block and (not block[-1].strip() or block[-1][0] == "#"):
            block.pop()
        try:
            # As Taichi puts it together, so that the tree is there when it asks for it.
            text = "\n".join(_fill(line, tabsize=4, width=9999) for line in block)
            text = textwrap.dedent(text)
            tree = ast.parse(text)
            body = tree.body
        except SyntaxError:
            body = []
        if len(body) != 1 or getattr(body[0], "name", "") != function.__name__:
            return thorough(function)  # type: ignore[no-any-return]
        _keep(text, tree)
        return block, first + 1

    return lines_of


_fill = functools.cache(textwrap.fill)


_shared: dict[str, ast.Module] = {}
_fresh: dict[str, ast.Module] = {}


def _parse(text: str) -> ast.Module:
    """Return the tree of a function's source; that of a function for kernels is parsed once.

    Such a function is translated at each of its calls. Of a kernel Taichi changes the tree, and may
    translate it again after a new start.
    """
    tree = _shared.get(text) or _fresh.pop(text, None)
    return ast.parse(text) if tree is None else tree


def _keep(text: str, tree: ast.Module) -> None:
    """Keep a tree that has just been parsed for when Taichi asks for it."""
    decorators = [d for node in tree.body for d in getattr(node, "decorator_list", [])]
    shared = any(getattr(d, "attr", getattr(d, "id", "")) == "func" for d in decorators)
    (_shared if shared else _fresh)[text] = tree


def speed_up(kernel_impl: Any, transformer: Any) -> None:
    """Replace the slow text functions in Taichi's translator.

    Args:
        kernel_impl: The module ``taichi.lang.kernel_impl``.
        transformer: The module ``taichi.lang.ast.ast_transformer_utils``.
    """
    context: Any = getattr(transformer, "ASTTransformerContext", None)
    if hasattr(context, "get_pos_info"):
        context.get_pos_info = _position
    if hasattr(kernel_impl, "getsourcelines"):
        kernel_impl.getsourcelines = _source_lines(kernel_impl.getsourcelines)
    if hasattr(kernel_impl, "getsourcefile"):
        kernel_impl.getsourcefile = functools.cache(kernel_impl.getsourcefile)
    if hasattr(kernel_impl, "_inside_class"):
        kernel_impl._inside_class = lambda level_of_class_stackframe: False
    if hasattr(kernel_impl, "ast"):
        # A tree may be walked again: unrolled loops do that with their bodies.
        parser = ModuleType("ast")
        parser.__dict__.update(vars(ast))
        parser.parse = _parse  # type: ignore[attr-defined]
        kernel_impl.ast = parser
    if hasattr(kernel_impl, "textwrap"):
        kernel_impl.textwrap = SimpleNamespace(fill=_fill, dedent=functools.cache(textwrap.dedent))
