"""The packages that this distribution requires, by extra, and their installed versions."""

from __future__ import annotations

from importlib import metadata
from typing import TYPE_CHECKING, NamedTuple

from lpn.core.errors import MissingPackageError
from lpn.core.files import printable

if TYPE_CHECKING:
    from packaging.requirements import Requirement

NAME = "lpn-explorer"
# Packages that replace a required one, because they contain its modules.
_STAND_INS = {"onnxruntime": "onnxruntime-gpu"}
# The package of each module, if their names differ.
_PACKAGES = {
    **{"yaml": "pyyaml", "umap": "umap-learn", "numba": "umap-learn", "sklearn": "umap-learn", "faiss": "faiss-cpu"},
    **{"affine": "rasterio", "orthomosaic": "pyorthomosaic", "fsspec": "ray"},
}


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
    """Read the requirements of the installed distribution; None if it is not installed."""
    try:
        installed = metadata.metadata(NAME)
    except metadata.PackageNotFoundError:
        return None
    extras = {extra: _packages(extra) for extra in installed.get_all("Provides-Extra") or [] if extra != "all"}
    return Requirements(installed["Requires-Python"] or "", _packages(), extras)


def broken_package(error: Exception) -> str:
    """Return one sentence about a package that cannot be imported."""
    reason = printable(f"{type(error).__name__}: {error}")[:300]
    return f"A package is missing or broken ({reason}); lpn doctor says more."


def missing_package(error: ModuleNotFoundError) -> MissingPackageError:
    """Return the error for a package that is not installed, with the extra that installs it."""
    module = (error.name or "").split(".")[0]
    package = _PACKAGES.get(module, module.lower().replace("_", "-"))
    found = read_requirements()
    extras = {} if found is None else found.extras
    having = (extra for extra, packages in extras.items() if package in {one.name.lower() for one in packages})
    extra = next((extra for extra in having if extra != "dev"), None)
    wanted = f"{NAME}[{extra}]" if extra else NAME
    return MissingPackageError(f"This needs the package {error.name}, which is not installed; pip install '{wanted}'.")


def _packages(extra: str = "") -> tuple[Package, ...]:
    """Return the packages that are always required, or those of an extra."""
    from packaging.requirements import Requirement

    required = map(Requirement, metadata.requires(NAME) or [])
    return tuple(
        _package(one) for one in required if (one.marker.evaluate({"extra": extra}) if one.marker else not extra)
    )


def _package(requirement: Requirement) -> Package:
    from packaging.version import InvalidVersion

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
