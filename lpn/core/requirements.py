"""The packages that this distribution requires, by extra, and their installed versions."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from lpn.core.errors import MissingPackageError
from lpn.core.files import printable

NAME = "lpn-explorer"
# Packages that replace a required one, because they hold its modules.
_STAND_INS = {"onnxruntime": "onnxruntime-gpu"}
# The required package of a module whose name differs.
_PACKAGES = {
    **{"yaml": "pyyaml", "umap": "umap-learn", "numba": "umap-learn", "sklearn": "umap-learn", "faiss": "faiss-cpu"},
    **{"affine": "rasterio", "orthomosaic": "pyorthomosaic", "fsspec": "ray"},
}
_PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"


class Package(NamedTuple):
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


class Requirements(NamedTuple):
    """The required Python versions, the packages that are always required, and those of each extra but `all`."""

    python: str
    base: tuple[Package, ...]
    extras: dict[str, tuple[Package, ...]]


def read_requirements() -> Requirements | None:
    """Read the requirements from a checkout's pyproject.toml, else from the installed metadata; None without either."""
    declared = _declared()
    if declared is None:
        return None
    python, base, extras = declared
    of_extras = {extra: tuple(map(_package, lines)) for extra, lines in extras.items() if extra != "all"}
    return Requirements(python, tuple(map(_package, base)), of_extras)


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
    """Return the lower-case package name of a requirement such as "numpy>=1.26"."""
    return re.split(r"[^\w.-]", line, maxsplit=1)[0].lower()


def _package(line: str) -> Package:
    from packaging.requirements import Requirement
    from packaging.version import InvalidVersion

    requirement = Requirement(line)
    name, wanted = requirement.name, requirement.specifier
    for one in filter(None, (name, _STAND_INS.get(name))):
        try:
            installed = metadata.version(one)
            return Package(name, str(wanted), installed, wanted.contains(installed, prereleases=True))
        except metadata.PackageNotFoundError:
            continue
        except (InvalidVersion, TypeError):  # remains of a broken installation
            return Package(name, str(wanted), "unknown", False)
    return Package(name, str(wanted), None, False)


def _declared() -> tuple[str, list[str], dict[str, list[str]]] | None:
    """Return the required Python, and the lines of the base packages and of each extra."""
    try:
        project = tomllib.loads(_PYPROJECT.read_text(encoding="utf-8"))["project"]
        if project["name"] == NAME:
            return project["requires-python"], project["dependencies"], project["optional-dependencies"]
    except (OSError, ValueError, KeyError):
        pass  # no checkout
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
