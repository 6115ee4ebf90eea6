"""Builds command lines from dataclasses: one option per field, with help from the docstring."""

import argparse
import dataclasses
import inspect
import re
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from trap_tube_jax.checks import did_you_mean
from trap_tube_jax.command_line import path_argument
from trap_tube_jax.imports import import_modules

Options = TypeVar("Options")


def option(default: Any, group: str | None = None, **metadata: Any) -> Any:
    """Declares a field of options.

    Args:
      default: its default.
      group: title under which help lists it.
      metadata: `append=True` collects the values of a repeated option in a tuple; `flags`
        lists alternative spellings; `may_be_empty=True` allows a tuple of no values.
    """
    return dataclasses.field(default=default, metadata={"group": group, **metadata})


class _Help(argparse.HelpFormatter):
    """Breaks the lines of a description to the terminal's width, and keeps its paragraphs."""

    def __init__(self, prog: str, **options: Any):
        super().__init__(prog, max_help_position=32, **options)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        fill = super()._fill_text
        return "\n\n".join(fill(part, width, indent) for part in text.split("\n\n"))


def parse(cls: type[Options], arguments: Sequence[str] | None, prog: str) -> Options:
    """Reads a command line into one dataclass; see `parse_all`."""
    return parse_all([cls], arguments, prog)[0]


def parse_all(declared: Sequence[Any], arguments: Sequence[str] | None, prog: str) -> list[Any]:
    """Reads a command line into several dataclasses; first imports the modules of `--import`.

    Arguments as in `read`.

    Raises:
      SystemExit: the command line is invalid, or asks for help.
      ValueError: a value is not allowed.
    """
    values = read(declared, arguments, prog)
    import_modules(values.get("imports", ()))  # they register names that the classes check
    return [build(options, values) for options in declared]


def read(declared: Sequence[Any], arguments: Sequence[str] | None, prog: str) -> dict[str, Any]:
    """Reads a command line; returns the values that it gives by the names of their fields.

    Fields without a default are positional.

    Args:
      declared: dataclasses, or instances whose values are the defaults. The docstring of the first
        describes the command.
      arguments: the command line after the program, by default the arguments of the process.
      prog: the command.

    Raises:
      SystemExit: the command line is invalid, or asks for help.
    """
    positional = [f.name for cls in declared for f in dataclasses.fields(cls) if _is_required(f)]
    parser = argparse.ArgumentParser(
        prog=prog,
        usage=" ".join([prog, *map(str.upper, positional), "[options]"]),
        description=(inspect.getdoc(declared[0]) or "").partition("\n\nAttributes:")[0],
        formatter_class=_Help,
        allow_abbrev=False,
    )
    groups: dict[Any, Any] = {None: parser}
    for options in declared:
        documents = _documents(_class(options))
        kinds = get_type_hints(_class(options))
        for field in dataclasses.fields(options):
            group = field.metadata.get("group")
            if group not in groups:
                groups[group] = parser.add_argument_group(group)
            text = documents[field.name].replace("%", "%%")
            _add(groups[group], field, getattr(options, field.name, None), text, kinds[field.name])
    known, unknown = parser.parse_known_args(arguments)
    if unknown:
        options = [name for action in parser._actions for name in action.option_strings]
        near = did_you_mean(unknown[0], options) if unknown[0].startswith("-") else ""
        parser.error(f"unknown arguments: {' '.join(unknown)}{near}")
    found = vars(known)
    for field in (field for options in declared for field in dataclasses.fields(options)):
        if found.get(field.name) == [] and not field.metadata.get("may_be_empty"):
            parser.error(f"argument {_flag(field.name)}: expected at least one argument")
    return {name: tuple(x) if isinstance(x, list) else x for name, x in found.items()}


def build(declared: Any, values: dict[str, Any]) -> Any:
    """Returns an instance of a dataclass, or a changed copy, with its fields among the values.

    Raises:
      ValueError: a value is not allowed.
    """
    given = {f.name: values[f.name] for f in dataclasses.fields(declared) if f.name in values}
    is_class = isinstance(declared, type)
    return declared(**given) if is_class else dataclasses.replace(declared, **given)


def _class(declared: Any) -> type:
    return declared if isinstance(declared, type) else type(declared)


def _is_required(field: dataclasses.Field) -> bool:
    return field.default is dataclasses.MISSING


def _add(group: Any, field: dataclasses.Field, default: Any, text: str, kind: Any) -> None:
    if _is_required(field):
        options = {**_values(kind), "metavar": field.name.upper()}
        many = {"nargs": "+"} if "nargs" in options else {}
        group.add_argument(field.name, help=text, **options | many)
        return
    options = _values(kind)
    if field.metadata.get("append"):
        options = {"action": "append", "metavar": "NAME"}
    elif options.get("nargs") == "*":
        options["action"] = "extend"  # given twice, the option holds the values of both
    shown = "on" if default is True else default
    if isinstance(default, list | tuple):
        shown = " ".join(map(str, default))
    group.add_argument(
        _flag(field.name),
        *field.metadata.get("flags", ()),
        dest=field.name,
        default=argparse.SUPPRESS,  # the class has them
        help=text if shown is None or shown is False or shown == "" else f"{text} [{shown}]",
        **options,
    )


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _values(kind: Any) -> dict[str, Any]:
    """Returns the `add_argument` options for values of an annotated type."""
    if get_origin(kind) in (Union, types.UnionType):
        inner = next(part for part in get_args(kind) if part is not types.NoneType)
        options = _values(inner)
        return {**options, "type": _or_none(inner)} if inner in (int, float) else options
    if get_origin(kind) is Literal:
        return {"choices": get_args(kind)}
    if get_origin(kind) is tuple:
        inner, *rest = get_args(kind)
        return {**_values(inner), "nargs": "*" if rest == [...] else 1 + len(rest)}
    if kind is bool:
        return {"action": argparse.BooleanOptionalAction}
    if kind is Path:
        return {"type": path_argument, "metavar": "PATH"}
    return {"type": kind, "metavar": {int: "N", float: "X", str: "NAME"}[kind]}


def _or_none(kind: type) -> Callable[[str], Any]:
    """Returns a reader of numbers that takes "None", too: settings of a stored run may be reset."""

    def read(text: str) -> Any:
        return None if text == "None" else kind(text)

    read.__name__ = kind.__name__  # for messages
    return read


def _documents(cls: type) -> dict[str, str]:
    """Returns the first sentence about every attribute in the docstrings of `cls` and its bases."""
    text = "\n".join(inspect.getdoc(base) or "" for base in reversed(cls.__mro__[:-1]))
    entries = re.findall(r"^ {2}(\w+): (.+(?:\n {4}.+)*)", text, re.M)
    sentences = {name: re.sub(r"\s+", " ", entry) for name, entry in entries}
    return {
        name: re.split(r"(?<=[\w`)\]])[.:;] ", entry)[0].rstrip(".")
        for name, entry in sentences.items()
    }
