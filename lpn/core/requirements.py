"""The packages that this one asks for, by extra, and which of them are installed in the versions it asks for."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from lpn.core.files import printable

NAME = "lpn-explorer"
_CHECKOUT = Path(__file__).parents[2] / "pyproject.toml"


@dataclass(frozen=True)
class Package:
    """A package that is asked for.

    Attributes:
        name: as pip knows it.
        wanted: the range of versions, such as ">=1.26"; "" for any.
        found: the version that is installed, None where none is.
        fits: whether that is within the range.
    """

    name: str
    wanted: str
    found: str | None
    fits: bool

    @property
    def requirement(self) -> str:
        """What pip takes: "numpy>=1.26"."""
        return self.name + self.wanted


@dataclass(frozen=True)
class Asked:
    """What an installation asks for.

    Attributes:
        python: the range of Python's versions.
        base: what it cannot do without.
        extras: the packages of each extra.
    """

    python: str
    base: tuple[Package, ...]
    extras: dict[str, tuple[Package, ...]]


def asked() -> Asked | None:
    """What is asked for and what of it is there, by a checkout's pyproject.toml, else as it was installed; None where neither
    can be found."""
    told = _of_checkout() or _installed()
    if told is None:
        return None
    python, base, extras = told
    return Asked(python, tuple(_look(base)), {extra: tuple(_look(lines)) for extra, lines in extras.items()})


def within(version: str, wanted: str) -> bool:
    """Whether a version is in a range such as ">=1.1.1,<1.2"."""
    from packaging.specifiers import SpecifierSet

    return SpecifierSet(wanted).contains(version, prereleases=True)


def broken_package(error: Exception) -> str:
    """Return one sentence about a package that cannot be imported."""
    reason = printable(f"{type(error).__name__}: {error}")[:300]
    return f"A package is missing or broken ({reason}); lpn doctor says more."


def _look(lines: list[str]) -> Iterator[Package]:
    from packaging.requirements import Requirement
    from packaging.version import InvalidVersion

    for line in lines:
        requirement = Requirement(line)
        wanted = str(requirement.specifier)
        try:
            found = metadata.version(requirement.name)
            yield Package(requirement.name, wanted, found, requirement.specifier.contains(found, prereleases=True))
        except metadata.PackageNotFoundError:
            yield Package(requirement.name, wanted, None, False)
        except (InvalidVersion, TypeError):  # what was left of a broken installation
            yield Package(requirement.name, wanted, "unknown", False)


def _of_checkout() -> tuple[str, list[str], dict[str, list[str]]] | None:
    try:
        project = tomllib.loads(_CHECKOUT.read_text(encoding="utf-8"))["project"]
        if project["name"] != NAME:
            return None
        return project["requires-python"], project["dependencies"], project["optional-dependencies"]
    except (OSError, ValueError, KeyError):
        return None


def _installed() -> tuple[str, list[str], dict[str, list[str]]] | None:
    from packaging.requirements import Requirement

    try:
        told = metadata.metadata(NAME)
    except metadata.PackageNotFoundError:
        return None
    lines = metadata.requires(NAME) or []
    bare = {line: Requirement(line).marker for line in lines}
    extras = {
        extra: [line.partition(";")[0] for line, marker in bare.items() if marker and marker.evaluate({"extra": extra})]
        for extra in told.get_all("Provides-Extra") or []
    }
    base = [line for line, marker in bare.items() if marker is None or marker.evaluate({"extra": ""})]
    return told["Requires-Python"] or "", base, extras
