"""The packages that this distribution requires, by extra, and their installed versions."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from lpn.core.errors import MissingPackageError
from lpn.core.files import printable

NAME = "lpn-explorer"
# Packages that stand in for a required one, as they hold the same modules.
_STAND_INS = {"onnxruntime": "onnxruntime-gpu"}
# The required package that brings a module of another name.
_PACKAGES = {
    **{"yaml": "pyyaml", "umap": "umap-learn", "numba": "umap-learn", "sklearn": "umap-learn", "faiss": "faiss-cpu"},
    **{"affine": "rasterio", "orthomosaic": "pyorthomosaic", "fsspec": "ray"},
}
_PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"


@dataclass(frozen=True)
class Package:
    """A required package.

    Attributes:
        name: its name in the package index.
        wanted: the required versions, such as ">=1.26"; "" for any.
        installed: the installed version; None if it is not installed.
        fits: whether `installed` satisfies `wanted`.
    """

    name: str
    wanted: str
    installed: str | None
    fits: bool

    @property
    def requirement(self) -> str:
        """The argument of pip install: "numpy>=1.26"."""
        return self.name + self.wanted


@dataclass(frozen=True)
class Requirements:
    """The requirements of this distribution.

    Attributes:
        python: the required Python versions.
        base: the packages that are always required.
        extras: the packages of each extra but `all`, which has those of the others.
    """

    python: str
    base: tuple[Package, ...]
    extras: dict[str, tuple[Package, ...]]


def read_requirements() -> Requirements | None:
    """Read the requirements from a checkout's pyproject.toml, else from the installed metadata; None without either."""
    declared = _declared()
    if declared is None:
        return None
    python, base, extras = declared
    return Requirements(
        python,
        tuple(map(_package, base)),
        {extra: tuple(map(_package, lines)) for extra, lines in extras.items() if extra != "all"},
    )


def satisfies(version: str, wanted: str) -> bool:
    """Return whether a version is in a range such as ">=1.1.1,<1.2"."""
    from packaging.specifiers import SpecifierSet

    return SpecifierSet(wanted).contains(version, prereleases=True)


def broken_package(error: Exception) -> str:
    """Return one sentence about a package that cannot be imported."""
    reason = printable(f"{type(error).__name__}: {error}")[:300]
    return f"A package is missing or broken ({reason}); lpn doctor says more."


def missing_package(error: ModuleNotFoundError) -> MissingPackageError:
    """Return the error for a package that is not installed, with the extra that installs it."""
    module = (error.name or "").split(".")[0]
    package = _PACKAGES.get(module, module.lower().replace("_", "-"))
    _, _, extras = _declared() or ("", [], {})
    having = [extra for extra, lines in extras.items() if package in map(_name, lines)]
    extra = next((extra for extra in having if extra != "dev"), None)
    wanted = f"{NAME}[{extra}]" if extra else NAME
    return MissingPackageError(f"This needs the package {error.name}, which is not installed; pip install '{wanted}'.")


def _name(line: str) -> str:
    """Return the package that a line such as "numpy>=1.26" requires, in small letters."""
    return re.split(r"[^\w.-]", line, maxsplit=1)[0].lower()


def _package(line: str) -> Package:
    from packaging.requirements import Requirement
    from packaging.version import InvalidVersion

    requirement = Requirement(line)
    installed, fits = None, False
    try:
        installed = _version(requirement.name)
        fits = requirement.specifier.contains(installed, prereleases=True)
    except metadata.PackageNotFoundError:
        pass
    except (InvalidVersion, TypeError):  # remains of a broken installation
        installed = "unknown"
    return Package(requirement.name, str(requirement.specifier), installed, fits)


def _version(name: str) -> str:
    """Return the installed version of a package, or of its stand-in."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        if name not in _STAND_INS:
            raise
        return metadata.version(_STAND_INS[name])


def _declared() -> tuple[str, list[str], dict[str, list[str]]] | None:
    """Return the required Python, and the lines of the base packages and of each extra."""
    return _from_checkout() or _from_metadata()


def _from_checkout() -> tuple[str, list[str], dict[str, list[str]]] | None:
    try:
        project = tomllib.loads(_PYPROJECT.read_text(encoding="utf-8"))["project"]
        if project["name"] != NAME:
            return None
        return project["requires-python"], project["dependencies"], project["optional-dependencies"]
    except (OSError, ValueError, KeyError):
        return None


def _from_metadata() -> tuple[str, list[str], dict[str, list[str]]] | None:
    from packaging.requirements import Requirement

    try:
        installed = metadata.metadata(NAME)
    except metadata.PackageNotFoundError:
        return None
    markers = {line: Requirement(line).marker for line in metadata.requires(NAME) or []}
    extras = {
        extra: [
            line.partition(";")[0] for line, marker in markers.items() if marker and marker.evaluate({"extra": extra})
        ]
        for extra in installed.get_all("Provides-Extra") or []
    }
    base = [line for line, marker in markers.items() if marker is None or marker.evaluate({"extra": ""})]
    return installed["Requires-Python"] or "", base, extras
