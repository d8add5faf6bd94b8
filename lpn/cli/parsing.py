"""Parsing of a command's options, and its help: `--help` lists fifteen options at most, and `--help-all` all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, field, fields, is_dataclass, make_dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from lpn.core.errors import InputError
from lpn.core.texts import counted
from lpn.sources.options import ADVANCED

_Number = TypeVar("_Number", int, float)

HELP, HELP_ALL = "--help", "--help-all"
# tyro's mark of an option that help omits.
_SUPPRESSED = get_args(tyro.conf.Suppress[int])[1:]
# Within this context, `tyro.cli` lists the words of `Literal[...] | None` in their order, and without None.
_IN_ORDER = ConstructorRegistry()


@_IN_ORDER.primitive_rule
def _words_or_none(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    if info.type_origin not in (Union, UnionType):
        return None
    members = [member for member in get_args(info.type) if member is not NoneType]
    words = tuple(word for member in members for word in get_args(member))
    if not all(get_origin(member) is Literal for member in members) or not all(isinstance(w, str) for w in words):
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(words)}}}",
        instance_from_str=lambda given: given[0],
        is_instance=lambda value: value is None or value in words,
        str_from_instance=lambda value: [str(value)],
        choices=words,
    )


def parse(command: type[Any], arguments: Sequence[str], program: str, default: Any = None) -> Any:
    """Parse the options of a command.

    Args:
        command: a dataclass. An option in its `MODES`, if it has any, selects another dataclass in its place.
        default: the options for which there is no argument; by default the dataclass's defaults.
    """
    given = {argument.partition("=")[0] for argument in arguments}
    for option, mode in modes(command).items():
        if option in given:
            command, program = mode, f"{program} {option}"
    description = command.__doc__ or ""
    if HELP_ALL in given:
        arguments = [HELP]
    elif given & {"-h", HELP}:
        arguments, brief = [HELP], _brief(command)
        if hidden := len(set(options(command))) - len(set(options(brief))):
            description += f"\n\n{program} {HELP_ALL} shows {counted(hidden, 'more option')}."
        if default is not None:
            default = brief(**{one.name: getattr(default, one.name) for one in fields(default)})
        command = brief
    with _IN_ORDER:
        return tyro.cli(
            command,
            args=arguments,
            prog=program,
            description=description,
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone),
            **({} if default is None else {"default": default}),
        )


def part_values(text: str | None) -> list[float] | None:
    """Parse part weights such as "1,1,0,1"; InputError if they are not numbers."""
    return numbers(text, float, "weights", "a number for each part, such as 1,1,0,1")


def numbers(text: str | None, kind: Callable[[str], _Number], noun: str, expected: str) -> list[_Number] | None:
    """Parse numbers separated by commas; None for None."""
    try:
        return None if text is None else [kind(item) for item in text.split(",")]
    except ValueError as error:
        raise InputError(f"The {noun} are {text!r}; expected {expected}.") from error


def modes(command: type[Any]) -> dict[str, type[Any]]:
    """Return the commands that replace this one, by the option that selects each."""
    return getattr(command, "MODES", {})


def options(command: type[Any]) -> Iterator[str]:
    """Yield the options of a command and of its groups as users write them, such as "--data"."""
    for name, marks, kind in _fields(command):
        if tyro.conf.Suppress in marks or tyro.conf.Positional in marks:
            continue
        if isinstance(kind, type) and is_dataclass(kind):
            yield from options(kind)
        else:
            yield f"--{name.replace('_', '-')}"


def _fields(command: type[Any]) -> Iterator[tuple[str, tuple[Any, ...], Any]]:
    """Yield the name, the annotations, and the type of each field."""
    hints = get_type_hints(command, include_extras=True)
    for one in fields(command):
        marks: tuple[Any, ...] = getattr(hints[one.name], "__metadata__", ())
        yield one.name, marks, get_args(hints[one.name])[0] if marks else hints[one.name]


def _brief(command: type[Any]) -> type[Any]:
    """Return a command without its advanced options."""
    hints, defaults = get_type_hints(command, include_extras=True), {one.name: one for one in fields(command)}
    hidden = [
        (
            name,
            Annotated[hints[name], *_SUPPRESSED],
            field(default=one.default)
            if (one := defaults[name]).default_factory is MISSING
            else field(default_factory=one.default_factory),
        )
        for name, marks, _ in _fields(command)
        if ADVANCED in marks
    ]
    return make_dataclass(command.__name__, hidden, bases=(command,), kw_only=True)
