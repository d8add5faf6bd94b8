"""Recognition of a source's kind by its files, and its opening."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import fields
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from inspect import isabstract
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, ClassVar

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.texts import listed
from lpn.sources import kinds
from lpn.sources.opened import OpenedSource
from lpn.sources.options import SourceOptions

if TYPE_CHECKING:
    from lpn.tasks.task import Task

# The group of the entry points for other packages' kinds of source.
GROUP = "lpn.sources"
# Options that need a network; kinds of source with a network take them.
NETWORK = frozenset(("model", "kind", "pooling", "provider", "rotate"))


class TaskSource(ABC):
    """A source of tasks of one kind; `open` opens them.

    Attributes:
        noun: the kind in a sentence, such as "a data set".
        takes: names of its options.
        priority: kinds of higher priority are tried first.
    """

    noun: ClassVar[str]
    takes: ClassVar[frozenset[str]]
    priority: ClassVar[int] = 0

    def __init__(self, options: SourceOptions) -> None:
        self.options = options

    @classmethod
    @abstractmethod
    def recognises(cls, options: SourceOptions) -> bool:
        """Return whether a source is of this kind."""

    @property
    def title(self) -> str:
        """The displayed names of its files."""
        return file_names(self.options.path)

    @abstractmethod
    def open(self, names: Sequence[str] = (), weights: Sequence[float] | None = None) -> OpenedSource:
        """Open the source.

        Args:
            names: required names of queries of the first task; they are checked before pictures are described.
            weights: part weights of the task, checked likewise; equal by default.

        Raises:
            LPNError: if a file cannot be used, or there is no such query.
        """

    def to_measure(self) -> list[Task]:
        """Open the tasks to measure: the first one, and for a data set its reverse unless a task is chosen.

        Their pictures are described only when needed, if the kind allows that.

        Raises:
            LPNError: if a file cannot be used, or no query can be measured.
        """
        return [self.open().task]


@cache
def known_kinds() -> tuple[type[TaskSource], ...]:
    """Return the kinds of this package and of others (entry points `lpn.sources`), in the order of recognition."""
    modules = [import_module(f"{kinds.__name__}.{module.name}") for module in iter_modules(kinds.__path__)]
    found = [
        value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, TaskSource) and value.__module__ == module.__name__
        if not isabstract(value)
    ]
    found += [point.load() for point in entry_points(group=GROUP)]
    return tuple(sorted(found, key=lambda kind: -kind.priority))


def kind_of(options: SourceOptions) -> type[TaskSource]:
    """Recognise the kind of a source; InputError without one."""
    known = known_kinds()
    if options.source is None:
        nouns = ", ".join(kind.noun for kind in known[:-1])
        raise InputError(f"There is no SOURCE; give its path first: that of {nouns}, or {known[-1].noun}.")
    return next(kind for kind in known if kind.recognises(options))


def source_of(options: SourceOptions) -> TaskSource:
    """Recognise a source; InputError if no source is named, or an option does not fit its kind."""
    known, kind = known_kinds(), kind_of(options)
    if kind is known[-1] and not options.path.is_dir():
        return kind(options)  # its `open` reports the fault
    for option in fields(options):
        value = getattr(options, option.name)
        fitting = [other.noun for other in known if option.name in other.takes]
        if value != option.default and fitting and option.name not in kind.takes:
            written = f"--{'no-' if value is False else ''}{option.name.replace('_', '-')}"
            raise InputError(
                f"{printable(str(options.source))} is {kind.noun}, and {written} fits {listed(fitting)}; leave it out."
            )
    return kind(options)


def open_source(
    options: SourceOptions, names: Sequence[str] = (), weights: Sequence[float] | None = None
) -> OpenedSource:
    """Recognise a source and open it, see `TaskSource.open`."""
    return source_of(options).open(names, weights)


def file_names(*files: Path) -> str:
    """Name files to display, without their folders."""
    return listed([printable(file.resolve().name) for file in files])
