"""Command lines from dataclasses: one option a field, documented by the class's docstring."""

import argparse
import dataclasses
import inspect
import re
import types
from collections.abc import Sequence
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

Options = TypeVar("Options")


def option(default: Any, group: str | None = None, **metadata: Any) -> Any:
    """Declares a field of options.

    Args:
      default: its default.
      group: title under which help lists it.
      metadata: `append=True`: a tuple that grows by one value each time the option is given;
        `flags`: further spellings.
    """
    return dataclasses.field(default=default, metadata={"group": group, **metadata})


def parse(cls: type[Options], arguments: Sequence[str] | None, prog: str) -> Options:
    """Reads a command line into a dataclass; fields without a default are positional.

    Raises:
      SystemExit: the command line is invalid, or asks for help.
    """
    parser = make_parser(cls, prog)
    add_options(parser, cls)
    return build(cls, parser.parse_args(arguments))


def make_parser(cls: type, prog: str) -> argparse.ArgumentParser:
    """Returns a parser without options, described by the docstring of `cls`."""
    return argparse.ArgumentParser(
        prog=prog,
        usage=f"{prog} [options]",
        description=(inspect.getdoc(cls) or "").partition("\n\nAttributes:")[0],
        formatter_class=_Formatter,
        allow_abbrev=False,
    )


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str):
        super().__init__(prog, max_help_position=32)


def add_options(
    parser: argparse.ArgumentParser, cls: type, defaults: Any = None, skip: Sequence[str] = ()
) -> None:
    """Adds an option for each field of a dataclass.

    Args:
      parser: the parser.
      cls: the dataclass.
      defaults: an instance with other defaults than the fields have.
      skip: fields without an option.
    """
    documents, kinds = _documents(cls), get_type_hints(cls)
    groups = {group.title: group for group in parser._action_groups}
    for field in dataclasses.fields(cls):
        if field.name in skip:
            continue
        title = field.metadata.get("group")
        if title is not None and title not in groups:
            groups[title] = parser.add_argument_group(title)
        target = parser if title is None else groups[title]
        text = documents.get(field.name, "").replace("%", "%%")
        if field.default is dataclasses.MISSING:
            target.add_argument(field.name, help=text, **_values(kinds[field.name]))
            continue
        default = field.default if defaults is None else getattr(defaults, field.name)
        shown = _text(default)
        target.add_argument(
            f"--{field.name.replace('_', '-')}",
            *field.metadata.get("flags", ()),
            dest=field.name,
            default=list(default) if field.metadata.get("append") else default,
            help=f"{text} [{shown}]" if shown else text,
            **_action(field, kinds[field.name]),
        )


def build(cls: type[Options], namespace: argparse.Namespace, **given: Any) -> Options:
    """Builds a dataclass from parsed options, and from `given` values for skipped fields.

    Raises:
      ValueError: a value is not allowed.
    """
    names = [field.name for field in dataclasses.fields(cls) if field.name not in given]  # pyright: ignore[reportArgumentType]
    values = {name: getattr(namespace, name) for name in names}
    as_tuples = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return cls(**as_tuples, **given)


def _documents(cls: type) -> dict[str, str]:
    """Returns the first sentence about each attribute in the docstrings of `cls` and its bases."""
    text = "\n".join(inspect.getdoc(each) or "" for each in reversed(cls.__mro__[:-1]))
    entries = re.findall(r"^ {2}(\w+): (.+(?:\n {4}.+)*)", text, re.M)
    sentences = {name: re.sub(r"\s+", " ", entry) for name, entry in entries}
    return {
        name: re.split(r"(?<=\w)[.:;] ", entry)[0].rstrip(".") for name, entry in sentences.items()
    }


def _action(field: dataclasses.Field, kind: Any) -> dict[str, Any]:
    if kind is bool:
        return {"action": argparse.BooleanOptionalAction}
    if field.metadata.get("append"):
        return {"action": "append", "metavar": "NAME"}
    return _values(kind)


def _values(kind: Any) -> dict[str, Any]:
    """Returns how argparse reads values of an annotated type."""
    if get_origin(kind) in (Union, types.UnionType):
        return _values(next(each for each in get_args(kind) if each is not types.NoneType))
    if get_origin(kind) is Literal:
        return {"choices": get_args(kind)}
    if get_origin(kind) is tuple:
        inner, *rest = get_args(kind)
        return {**_values(inner), "nargs": "*" if rest == [...] else 1 + len(rest)}
    return {"type": kind, "metavar": {int: "N", float: "X", str: "NAME"}.get(kind, "PATH")}


def _text(default: Any) -> str:
    if default is None or default == () or isinstance(default, bool):
        return "on" if default is True else ""
    return " ".join(map(str, default)) if isinstance(default, tuple) else str(default)
