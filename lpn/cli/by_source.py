"""Commands that take a task from any source: the word behind the command names the source, and each source has its own options.

lpn evaluate --data ROOT --model city-lpn             a data set is the source if none is named
lpn evaluate index --index tiles --model city-lpn --data ROOT
"""

from __future__ import annotations

import types
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass, make_dataclass
from typing import Any, Union, get_args, get_origin, get_type_hints

import tyro

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.texts import listed
from lpn.sources import TaskSource


def of_sources(command: type[Any], *sources: type[TaskSource]) -> dict[str, type[Any]]:
    """Return a command for each of some sources, by the source's word.

    Args:
        command: a dataclass with a field `source`, which becomes the options of one source.
    """
    return {
        source.WORD: make_dataclass(
            f"{command.__name__}{source.__name__}",
            [("source", source)],
            bases=(command,),
            kw_only=True,
            namespace={"__doc__": command.__doc__},
        )
        for source in sources
    }


def parse(command: type[Any], arguments: Sequence[str], program: str) -> Any:
    """Parse the options of a command.

    Args:
        command: a dataclass. Its `SOURCES`, if it has any, are the dataclasses of its other sources by their words.

    Raises:
        InputError: if an option is one of another source.
    """
    sources: dict[str, type[Any]] = getattr(command, "SOURCES", {})
    if arguments and (chosen := sources.get(arguments[0])) is not None:
        return _cli(chosen, arguments[1:], f"{program} {arguments[0]}")
    own = arguments[1:] if sources and arguments[:1] == ["data"] else arguments
    if sources and own and not own[0].startswith("-") and not _takes_words(command):
        raise InputError(f"{program} has no source {printable(own[0])}; it has data, {', '.join(sources)}.")
    _check_options(command, sources, own, program)
    others = ", ".join(f"{program} {word}" for word in sources)
    return _cli(command, own, program, f"Other sources, each with its own --help: {others}." if others else "")


def _cli(command: type[Any], arguments: Sequence[str], program: str, more: str = "") -> Any:
    """Parse the options of a command; its help ends with `more`."""
    description = f"{command.__doc__ or ''}\n\n{more}".strip()
    return tyro.cli(command, args=arguments, prog=program, description=description, config=(tyro.conf.OmitArgPrefixes,))


def options(command: type[Any]) -> Iterator[str]:
    """Yield the options of a command as they are written, such as "--data"; those of its groups, too."""
    for name, marks in _leaves(command):
        if tyro.conf.Positional not in marks:
            yield f"--{name.replace('_', '-')}"


def _takes_words(command: type[Any]) -> bool:
    """Return True if a command takes arguments without a name."""
    return any(tyro.conf.Positional in annotations for _, annotations in _leaves(command))


def _leaves(command: type[Any]) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Yield the name and the annotations of each field of a command and of its groups."""
    hints = get_type_hints(command, include_extras=True)
    for one in fields(command):
        kind = hints[one.name]
        annotations: tuple[Any, ...] = getattr(kind, "__metadata__", ())
        kind = get_args(kind)[0] if annotations else kind
        members = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
        groups = [member for member in members if isinstance(member, type) and is_dataclass(member)]
        for group in groups:
            yield from _leaves(group)
        if not groups:
            yield one.name, annotations


def _check_options(command: type[Any], sources: dict[str, type[Any]], arguments: Sequence[str], program: str) -> None:
    """Refuse an option that only another source has, and name that source."""
    own = set(options(command)) if sources else set()
    for argument in arguments:
        written = argument.partition("=")[0].replace("_", "-")
        names = {written, written.replace("--no-", "--", 1)}
        if not sources or not written.startswith("--") or names & own:
            continue
        words = [word for word, other in sources.items() if names & set(options(other))]
        if words:
            raise InputError(
                f"{program} has no {written} for a data set, which is the source if none is named (see {program} --help); "
                f"{listed([f'{program} {word}' for word in words])} {'has' if len(words) == 1 else 'have'} it."
            )
