"""Makes the translation of kernels cheaper, without changing what is translated.

Taichi 1.7 translates every kernel anew in every process, also when the compiled code comes from
the cache, and two thirds of that time goes into text: for each node of the syntax tree it renders
an excerpt of the source, wrapped and underlined, in case an error has to be reported, and it
reads, wraps and parses the source of a function again at each of its calls. Here the position is
one line, and sources are read once. For each decorated function it also searches all modules to
learn whether it stands in a class; ours never do. Names of Taichi that are not there (another
version) leave everything as it was.
"""

import ast
import functools
import textwrap
from types import ModuleType, SimpleNamespace
from typing import Any


def _position(self: Any, node: Any) -> str:
    """Return file, line and function of a node, and the line of source."""
    line = self.src[node.lineno - 1].strip() if node.lineno <= len(self.src) else ""
    return (
        f'File "{self.file}", line {node.lineno + self.lineno_offset}, '
        f"in {self.func.func.__name__}:\n{line}\n"
    )


def speed_up(kernel_impl: Any, transformer: Any) -> None:
    """Replace the slow text functions in Taichi's translator.

    Args:
        kernel_impl: The module ``taichi.lang.kernel_impl``.
        transformer: The module ``taichi.lang.ast.ast_transformer_utils``.
    """
    context: Any = getattr(transformer, "ASTTransformerContext", None)
    if hasattr(context, "get_pos_info"):
        context.get_pos_info = _position
    for name in ("getsourcelines", "getsourcefile"):
        read = getattr(kernel_impl, name, None)
        if read is not None:
            setattr(kernel_impl, name, functools.cache(read))
    if hasattr(kernel_impl, "_inside_class"):
        kernel_impl._inside_class = lambda level_of_class_stackframe: False
    if hasattr(kernel_impl, "ast"):
        # A tree may be walked again: unrolled loops do that with their bodies.
        parser = ModuleType("ast")
        parser.__dict__.update(vars(ast))
        parser.parse = functools.cache(ast.parse)  # type: ignore[attr-defined]
        kernel_impl.ast = parser
    if hasattr(kernel_impl, "textwrap"):
        kernel_impl.textwrap = SimpleNamespace(
            fill=functools.cache(textwrap.fill), dedent=functools.cache(textwrap.dedent)
        )
