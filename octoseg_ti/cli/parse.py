"""Turns arguments into the options of a verb, and a wrong argument into one clear line.

Options are frozen dataclasses: the name, type and default of a field make the option, the text
below the field its help. Parameters of the method come from `octoseg_ti.params` in the same way, so
that each is declared once; angles, which are radians inside, get degrees and a name that says so.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import inspect
import io
import math
import os
import re
import sys
import types
import typing
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from octoseg_ti.cli import UsageError, suggest

T = TypeVar("T")

_CONFIG = (tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff)
_RADIANS = re.compile(r"\[rad\]")


def parse(verb: str, options: type[T], arguments: list[str]) -> T:
    """Return the options of a verb.

    Args:
        verb: Its name, for the help.
        options: The dataclass of its options; may have a static method ``defaults(arguments)``
            that returns {field: default}, when one option decides the defaults of others.
        arguments: What follows the verb on the command line.

    Raises:
        UsageError: An argument is wrong; the message names it and the nearest known one.
        SystemExit: Help was asked for, and printed.
    """
    decide = getattr(options, "defaults", None)
    decided: dict[str, Any] = {} if decide is None else decide(arguments)
    registry = ConstructorRegistry()
    registry.struct_rule(lambda info: _dataclass_rule(info, options, decided))

    def run() -> T:
        return tyro.cli(
            options,
            prog=f"octoseg {verb}",
            description=inspect.cleandoc(options.__doc__ or ""),
            args=arguments,
            registry=registry,
            config=_CONFIG,
        )

    if any(a in ("-h", "--help") for a in arguments):
        return run()
    captured = io.StringIO()
    try:
        with _wide(), contextlib.redirect_stderr(captured):
            return run()
    except SystemExit as leaving:
        if leaving.code in (0, None):
            raise
    raise UsageError(_one_line(verb, captured.getvalue(), arguments, _names(options)))


@contextlib.contextmanager
def _wide() -> typing.Iterator[None]:
    """Keep the message of the parser on one line, however narrow the terminal is."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "2000"
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before


def _one_line(verb: str, message: str, arguments: list[str], known: list[str]) -> str:
    """Return the first paragraph of the parser's box, with a suggestion for a misspelt option."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", message)
    # A box of Unicode lines with the title in its edge, or, where the terminal knows no such lines,
    # a paragraph for the title; rules part the paragraphs.
    paragraphs: list[list[str]] = [[]]
    for line in text.splitlines():
        inside = line.strip("│|").rstrip()
        if line[:1] in "╭╰+" or not inside.strip():
            continue
        if set(inside.strip()) <= {"─", "-"}:
            paragraphs.append([])
        elif not inside.strip().startswith(("Got errors", "- <")):
            paragraphs[-1].append(inside)
    paragraphs = [lines for lines in paragraphs if lines] or [["wrong arguments"]]
    first = paragraphs[0 if text[:1] == "╭" else min(1, len(paragraphs) - 1)]
    if first[0].strip().startswith("Missing from"):
        indent = min((len(line) - len(line.lstrip()) for line in first[1:]), default=0)
        names = [line.strip() for line in first[1:] if not line[indent:].startswith(" ")]
        first = ["missing", ", ".join(re.split(r"\s{2,}", name)[0] for name in names)]
    what = " ".join(" ".join(first).split()).rstrip(".:")
    what = re.sub(
        r"Error parsing (\S+): no type matching (\w+) could be instantiated from \['(.*)'\]",
        r"\1 needs \2, not '\3'",
        what,
    )
    what = what.split(". - typing.Annotated[")[0]  # how the number is declared helps nobody
    refused = re.fullmatch(r"Error parsing (\S+): \w+: (\w+) (must .*, not) (\S+)", what)
    if refused:
        option = _option_of(refused[1], refused[2], known)
        value = refused[4]
        if option.endswith("-deg"):
            value = f"{math.degrees(float(value)):.9g}"
        what = f"{option} {refused[3]} {value}"
    given = [a.split("=")[0] for a in arguments if a.startswith("--")]
    wrong = [a for a in given if a not in known and a.replace("_", "-") not in known]
    hint = suggest(wrong[0], known) if wrong and wrong[0] in what else ""
    return f"{verb}: {what}{hint}; see octoseg {verb} --help"


def _option_of(section: str, field: str, known: list[str]) -> str:
    """Return the option that a field of a section is given by: the names of some are short."""
    dashed = field.replace("_", "-")
    full = f"--{section}.{dashed}"
    names = [name + unit for name in (full, f"--{dashed}") for unit in ("", "-deg")]
    return next((name for name in names if name in known), full)


def _names(options: type, prefix: str = "--") -> list[str]:
    """Return the long names of the options, as they are written on the command line."""
    names = []
    docs = _field_docs(options)
    for name, hint in typing.get_type_hints(options, include_extras=True).items():
        base, *marks = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
        dashed = prefix + name.replace("_", "-")
        if tyro.conf.Positional in marks:
            continue
        if dataclasses.is_dataclass(base):
            inner = prefix if tyro.conf.OmitArgPrefixes in marks else f"{dashed}."
            names += _names(typing.cast(type, base), inner)
        elif base is bool:  # which of the two there is depends on the default
            names += [dashed, f"{prefix}no-{name.replace('_', '-')}"]
        else:
            names.append(dashed + "-deg" * bool(_RADIANS.search(docs.get(name, ""))))
    return names


def _dataclass_rule(
    info: StructTypeInfo, options: type, decided: dict[str, Any]
) -> StructConstructorSpec | None:
    """Describe a dataclass of ours to the parser: fields, defaults, help, degrees for radians."""
    cls = info.type
    if not dataclasses.is_dataclass(cls) or not _ours(cls):
        return None
    docs = _field_docs(cls)
    hints = typing.get_type_hints(cls, include_extras=True)
    fields, angles, lists = [], {}, []
    for item in dataclasses.fields(cls):
        default = _default(item, info.default)
        if cls is options and item.name in decided:
            default = decided[item.name]
        doc, name = docs.get(item.name, ""), item.name
        if _RADIANS.search(doc):
            name = f"{item.name}_deg"
            doc = _RADIANS.sub("[deg]", doc)
            shown = round(math.degrees(default), 9) if isinstance(default, float) else default
            angles[name] = (item.name, shown, default)
            default = shown
        hint, is_list = _plain_type(hints[item.name])
        lists += [item.name] if is_list else []
        if not _has_option(hint) and default is not tyro.MISSING_NONPROP:
            continue
        if default is None or default is False:  # saying so would help nobody
            hint = Annotated[hint, tyro.conf.arg(help_behavior_hint="")]
        fields.append(StructFieldSpec(name=name, type=hint, default=default, helptext=doc))

    def instantiate(**values: Any) -> Any:
        for name, (field, shown, default) in angles.items():
            value = values.pop(name)
            # The default keeps its last bit: 30 degrees there and back is another number.
            values[field] = default if value == shown else math.radians(value)
        for name in lists:
            values[name] = tuple(Path(text) for text in values[name])
        return cls(**values)

    return StructConstructorSpec(instantiate=instantiate, fields=tuple(fields))


def _ours(cls: type) -> bool:
    return cls.__module__.split(".")[0] in ("octoseg_ti", "scanner_sim")


def _default(item: dataclasses.Field[Any], instance: Any) -> Any:
    """Return the default of a field: from the default of the whole, or its own."""
    if dataclasses.is_dataclass(instance) and hasattr(instance, item.name):
        return getattr(instance, item.name)
    if item.default is not dataclasses.MISSING:
        return item.default
    if item.default_factory is not dataclasses.MISSING:
        return item.default_factory()
    return tyro.MISSING_NONPROP


def _plain_type(hint: Any) -> tuple[Any, bool]:
    """Return a type that the parser can check without a slow import, and whether it lists paths.

    X | None becomes Optional[X], and a tuple of paths a list of words.
    """
    if typing.get_origin(hint) is Annotated:
        base, *marks = typing.get_args(hint)
        base, is_list = _plain_type(base)
        parts = (base, *marks)
        return Annotated[parts], is_list
    if typing.get_origin(hint) is types.UnionType:
        return typing.Union[typing.get_args(hint)], False  # noqa: UP007
    if hint == tuple[Path, ...]:
        return list, True
    return hint, False


def _has_option(hint: Any) -> bool:
    """Say whether a value of this type can be written on the command line."""
    hint = typing.get_args(hint)[0] if typing.get_origin(hint) is Annotated else hint
    if typing.get_origin(hint) is typing.Union:
        return all(_has_option(part) for part in typing.get_args(hint))
    if typing.get_origin(hint) is typing.Literal or dataclasses.is_dataclass(hint):
        return True
    return hint in (float, int, bool, str, Path, list, type(None))


def _field_docs(cls: type) -> dict[str, str]:
    """Return the text below every field of a dataclass, from its source."""
    docs: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if base is object or not dataclasses.is_dataclass(base):
            continue
        module = sys.modules[base.__module__]
        tree = ast.parse(inspect.getsource(module))
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and node.name == base.__name__:
                docs.update(_docs_of(node))
    return docs


def _docs_of(node: ast.ClassDef) -> dict[str, str]:
    docs = {}
    for field, below in zip(node.body, node.body[1:], strict=False):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(below, ast.Expr)
            and isinstance(below.value, ast.Constant)
            and isinstance(below.value.value, str)
        ):
            docs[field.target.id] = " ".join(below.value.value.replace("`", "").split())
    return docs
