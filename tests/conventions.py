"""Reads a source file and lists where it breaks the conventions of this project.

The rules for kernels come from what Taichi 1.7 accepts and from what keeps results the same on
every run; each finding is one line "file:line: what is wrong".
"""

import ast
import re
from pathlib import Path

MAX_LINES = 450
MAX_PARAMETERS = 12
MAX_KERNEL_LINES = 60
RUNTIME = "octoseg_ti/device/runtime.py"
EMPTY_NAMES = {"utils.py", "util.py", "common.py", "helpers.py", "misc.py"}
OPTIONAL_PACKAGES = {"laspy", "pye57", "OCP"}

_ARRAY = re.compile(r"^[FIU](8|16|32|64)[A-Z]\w*$")  # F64Rows, I32Array ...
_SUFFIX = ("_in", "_out", "_inout")


def findings(source: str, path: str) -> list[str]:
    """Return every breach in the text of a file; `path` is relative to the repository."""
    tree = ast.parse(source)
    lines = source.splitlines()
    found = _file_rules(tree, lines, path) + _taichi_rules(tree, path)
    kernels = _decorated(tree, "kernel")
    if kernels or _decorated(tree, "func"):
        found += _kernel_file_rules(tree, path)
    for kernel in kernels:
        found += _kernel_rules(kernel, tree, lines, path)
    return found + _host_rules(tree, {k.name for k in kernels}, path)


def _at(path: str, node: ast.AST | int, what: str) -> str:
    line = node if isinstance(node, int) else getattr(node, "lineno", 1)
    return f"{path}:{line}: {what}"


def _name(node: ast.AST | None) -> str:
    """Return a dotted name, or "" for any other expression."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        base = _name(node.value)
        return f"{base}.{node.attr}" if base else ""
    return ""


def _decorated(tree: ast.AST, kind: str) -> list[ast.FunctionDef]:
    """Return the functions that carry @ti.kernel or @ti.func, wherever they are."""

    def carries(function: ast.FunctionDef) -> bool:
        for decorator in function.decorator_list:
            target = decorator.func if isinstance(decorator, ast.Call) else decorator
            if _name(target) in (f"ti.{kind}", f"runtime.ti.{kind}", f"taichi.{kind}"):
                return True
        return False

    return [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and carries(n)]


def _file_rules(tree: ast.Module, lines: list[str], path: str) -> list[str]:
    found = []
    if len(lines) > MAX_LINES:
        found.append(_at(path, len(lines), f"more than {MAX_LINES} lines: split the file"))
    if Path(path).name in EMPTY_NAMES:
        found.append(_at(path, 1, "the name of the file says nothing of its concern"))
    if not ast.get_docstring(tree) and tree.body:
        found.append(_at(path, 1, "no module docstring"))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and any(a.name == "*" for a in node.names):
            found.append(_at(path, node, "star import"))
        if (
            isinstance(node, ast.Call)
            and _name(node.func) in ("print", "sys.exit", "exit", "breakpoint")
            and not path.startswith("octoseg_ti/cli/")
            and path != "octoseg_ti/__main__.py"
        ):
            found.append(_at(path, node, f"{_name(node.func)}() outside the command line"))
    for node in tree.body:
        for module in _imported(node):
            if module.split(".")[0] in OPTIONAL_PACKAGES:
                found.append(_at(path, node, f"optional package {module} at module level"))
    return found


def _imported(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [a.name for a in node.names]
    if isinstance(node, ast.ImportFrom) and node.level == 0:
        return [node.module or ""]
    return []


def _taichi_rules(tree: ast.Module, path: str) -> list[str]:
    found = []
    for node in ast.walk(tree):
        if path != RUNTIME and any(m.split(".")[0] == "taichi" for m in _imported(node)):
            found.append(_at(path, node, "imports taichi: take ti from octoseg_ti.device.runtime"))
        if isinstance(node, ast.Call) and _name(node.func) in ("ti.init", "ti.reset"):
            if path != RUNTIME:
                found.append(_at(path, node, f"{_name(node.func)} belongs to the runtime"))
        if isinstance(node, ast.Call) and _name(node.func) == "ti.field":
            found.append(_at(path, node, "ti.field: data are arrays, sized by the input"))
    return found


def _kernel_file_rules(tree: ast.Module, path: str) -> list[str]:
    found = []
    sources = [n.module for n in tree.body if isinstance(n, ast.ImportFrom) and n.module]
    if "__future__" in sources:
        found.append(_at(path, 1, "imports __future__: Taichi reads annotations as objects"))
    takes_ti = any(
        isinstance(n, ast.ImportFrom)
        and n.module == "octoseg_ti.device.runtime"
        and any(a.name == "ti" for a in n.names)
        for n in tree.body
    )
    if not takes_ti and path != RUNTIME:
        found.append(_at(path, 1, "kernels without: from octoseg_ti.device.runtime import ti"))
    for function in _decorated(tree, "func"):
        if not ast.get_docstring(function):
            found.append(_at(path, function, f"@ti.func {function.name} has no docstring"))
    return found


def _kernel_rules(
    kernel: ast.FunctionDef, tree: ast.Module, lines: list[str], path: str
) -> list[str]:
    found = []

    def wrong(what: str, node: ast.AST = kernel) -> None:
        found.append(_at(path, node, f"kernel {kernel.name}: {what}"))

    if kernel not in tree.body:
        wrong("is not at module level")
    if not kernel.name.startswith("_"):
        wrong("its name starts with _: the host function is the public one")
    if not ast.get_docstring(kernel):
        wrong("no docstring")
    arguments = kernel.args
    parameters = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    if arguments.vararg or arguments.kwarg or arguments.defaults or arguments.kw_defaults:
        wrong("no *args, **kwargs or defaults")
    if len(parameters) > MAX_PARAMETERS:
        wrong(f"{len(parameters)} parameters; at most {MAX_PARAMETERS}")
    length = (kernel.end_lineno or kernel.lineno) - kernel.lineno + 1
    if length > MAX_KERNEL_LINES:
        wrong(f"{length} lines; at most {MAX_KERNEL_LINES}")
    found += _signature_rules(kernel, parameters, lines, path)
    found += _atomic_rules(kernel, parameters, path)
    return found


def _signature_rules(
    kernel: ast.FunctionDef, parameters: list[ast.arg], lines: list[str], path: str
) -> list[str]:
    found = []
    inputs, outputs = [], []
    for parameter in parameters:
        where = f"kernel {kernel.name}: parameter {parameter.arg}"
        if parameter.annotation is None:
            found.append(_at(path, parameter, f"{where} has no annotation"))
            continue
        annotation = _name(parameter.annotation)
        if isinstance(parameter.annotation, ast.Call) and "ndarray" in _name(
            parameter.annotation.func
        ):
            found.append(_at(path, parameter, f"{where}: use an alias of the runtime as type"))
        if _ARRAY.match(annotation.split(".")[-1]):
            if not parameter.arg.endswith(_SUFFIX):
                found.append(_at(path, parameter, f"{where}: an array ends in _in, _out or _inout"))
            (outputs if parameter.arg.endswith(("_out", "_inout")) else inputs).append(parameter)
        elif parameter.arg.endswith(_SUFFIX):
            found.append(_at(path, parameter, f"{where}: the suffix is for arrays"))
    groups = _groups(kernel, lines)
    for group, members in (("# In:", inputs), ("# Out:", outputs)):
        if members and group not in groups:
            found.append(_at(path, kernel, f"kernel {kernel.name}: no group {group}"))
    for parameter in outputs:
        if "# Out:" in groups and parameter.lineno < groups["# Out:"]:
            found.append(_at(path, parameter, f"{parameter.arg} stands outside the group # Out:"))
    for parameter in parameters:
        if parameter not in outputs and parameter.lineno > groups.get("# Out:", 10**9):
            found.append(_at(path, parameter, f"{parameter.arg} stands after # Out:"))
    return found


def _groups(kernel: ast.FunctionDef, lines: list[str]) -> dict[str, int]:
    """Return the lines of the group comments in the signature."""
    first, last = kernel.lineno, kernel.body[0].lineno
    stripped = {number: lines[number - 1].strip() for number in range(first, last)}
    return {text: number for number, text in stripped.items() if text in ("# In:", "# Out:")}


def _atomic_rules(kernel: ast.FunctionDef, parameters: list[ast.arg], path: str) -> list[str]:
    """Find sums of floats whose order the threads decide."""
    floats = {p.arg for p in parameters if _name(p.annotation).split(".")[-1].startswith("F")}
    found = []
    for node in ast.walk(kernel):
        target: ast.AST | None = None
        if isinstance(node, ast.AugAssign):
            target = node.target
        elif isinstance(node, ast.Call) and _name(node.func) in ("ti.atomic_add", "ti.atomic_sub"):
            target = node.args[0] if node.args else None
        if isinstance(target, ast.Subscript) and _name(target.value) in floats:
            what = f"kernel {kernel.name}: atomic sum of floats in {_name(target.value)}"
            found.append(_at(path, node, f"{what}: write a[i] = a[i] + x, or use integers"))
    return found


def _host_rules(tree: ast.Module, kernels: set[str], path: str) -> list[str]:
    """Find public functions that launch a kernel before anybody has started Taichi."""
    found = []
    for function in tree.body:
        if not isinstance(function, ast.FunctionDef) or function.name.startswith("_"):
            continue
        calls = [_name(n.func) for n in ast.walk(function) if isinstance(n, ast.Call)]
        started = any(c.split(".")[-1] == "ensure_started" for c in calls)
        if kernels.intersection(calls) and not started:
            found.append(_at(path, function, f"{function.name} launches kernels: ensure_started()"))
    return found
