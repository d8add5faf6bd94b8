"""The environment check of `lpn doctor`: packages, machine, and demo, each finding with its remedy."""

from __future__ import annotations

import importlib
import io
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from lpn.core import requirements, resources
from lpn.core.errors import OutputError
from lpn.core.files import cache_folder, check_writable, printable

Severity = Literal["OK", "note", "problem"]
# Names of modules that differ from the names of their packages.
_MODULES = {"opencv-python-headless": "cv2", "pillow": "PIL"}
_LITTLE_DISK, _MIN_DISK = 1 << 30, 50 << 20


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        name: the subject of the check.
        level: "OK"; "note" if something optional is missing; "problem" if something required is.
        message: the result.
        remedy: the remedy; may be empty.
    """

    name: str
    level: Severity
    message: str
    remedy: str = ""

    @property
    def healthy(self) -> bool:
        """True if this is no problem."""
        return self.level != "problem"

    @property
    def line(self) -> str:
        """The finding as one line of text."""
        remedy = f"; {self.remedy}" if self.remedy else ""
        return printable(f"{self.level:8}{self.name}: {self.message}{remedy}.")


def check_environment(demo: Path) -> Iterator[Finding]:
    """Run all checks; a check that fails is a finding, not an exception. No installed package is needed.

    Args:
        demo: the demo's folder.
    """
    checks: dict[str, Callable[[], Iterator[Finding]]] = {
        "Python and packages": _python_and_packages,
        "PyTorch": _torch,
        "ONNX Runtime": _onnx_runtime,
        "machine": _machine,
        "cache": _cache,
        "demo": lambda: _demo(demo),
    }
    for name, check in checks.items():
        try:
            yield from check()
        except Exception as error:  # a broken package may raise anything
            remedy = "repair the packages named above, or install it again"
            yield Finding(name, "problem", f"could not be checked ({type(error).__name__}: {error})", remedy)


def _python_and_packages() -> Iterator[Finding]:
    version = ".".join(map(str, sys.version_info[:3]))  # platform.python_version() may end in "+"
    required = requirements.read_requirements()
    if required is None:
        message = f"{version}; the requirements of {requirements.NAME} are unknown"
        yield Finding("Python", "note", message, "install it with pip")
        return
    from packaging.specifiers import SpecifierSet

    if SpecifierSet(required.python).contains(version, prereleases=True):
        yield Finding("Python", "OK", f"{version} in {sys.prefix}")
    else:
        wanted = f"{version}; {required.python} is needed"
        yield Finding("Python", "problem", wanted, "make an environment with a newer one")
    good = []
    for package in required.base:
        error = "" if (problem := _wrong_version(package)) else _import_error(package)
        if problem or error:
            install = f"pip install {'--force-reinstall ' if error else ''}'{package.requirement}'"
            yield Finding(package.name, "problem", problem or error, install)
        else:
            good.append(f"{package.name} {package.installed}")
    yield Finding("packages", "OK", ", ".join(good))
    for extra, packages in required.extras.items():
        wrong = [f"{package.name} {_wrong_version(package)}" for package in packages if not package.fits]
        if not wrong:
            message = ", ".join(f"{package.name} {package.installed}" for package in packages)
            yield Finding(f"extra {extra}", "OK", message)
        else:
            absent = all(package.installed is None for package in packages)
            remedy = f"pip install '{requirements.NAME}[{extra}]'"
            yield Finding(f"extra {extra}", "note", "not installed" if absent else ", ".join(wrong), remedy)


def _wrong_version(package: requirements.Package) -> str:
    """Return the defect of a package's version; empty if it is right."""
    if package.fits:
        return ""
    if package.installed is None:
        return "is not installed"
    return f"{package.installed} is installed, and {package.wanted} is needed"


def _import_error(package: requirements.Package) -> str:
    """Return the reason why a package cannot be imported; empty if it can. Its output, such as tracebacks, is discarded."""
    try:
        with redirect_stderr(io.StringIO()):
            importlib.import_module(_MODULES.get(package.name.lower(), package.name.lower()))
    except Exception as error:
        return f"{package.installed} cannot be imported ({type(error).__name__}: {error})"
    return ""


def _torch() -> Iterator[Finding]:
    if find_spec("torch") is None:
        return  # reported among the extras
    torch: Any = importlib.import_module("torch")
    if not torch.cuda.is_available():
        built = f", though built for CUDA {torch.version.cuda}" if torch.version.cuda else ""
        remedy = "trainings take long; if this machine has a GPU, install its driver and a torch for CUDA"
        yield Finding("GPU", "note", f"torch {torch.__version__} finds none{built}", remedy)
        return
    devices = [torch.cuda.get_device_properties(number) for number in range(torch.cuda.device_count())]
    names = ", ".join(f"{device.name} with {device.total_memory / 1e9:.0f} GB" for device in devices)
    yield Finding("GPU", "OK", f"torch {torch.__version__} on {names}")


def _onnx_runtime() -> Iterator[Finding]:
    with redirect_stderr(io.StringIO()):  # it prints a traceback if NumPy is broken
        import onnxruntime as ort

        from lpn.models import providers

    built = providers.available()
    message = f"{ort.__version__}, built with the providers {', '.join(built)}"
    if "cuda" in built or not _has_nvidia_driver():
        yield Finding("ONNX Runtime", "OK", message)
    else:
        remedy = f"to use the GPU of this machine for .onnx models: {providers.INSTALL}"
        yield Finding("ONNX Runtime", "note", message, remedy)


def _has_nvidia_driver() -> bool:
    return Path("/proc/driver/nvidia/version").exists() or shutil.which("nvidia-smi") is not None


def _machine() -> Iterator[Finding]:
    yield Finding("cores", "OK", f"{resources.usable_cores()} of {os.cpu_count() or 1} can be used")


def _cache() -> Iterator[Finding]:
    try:
        folder = cache_folder()
        check_writable(folder / "doctor")
    except OutputError as error:
        message, _, remedy = str(error).rstrip(".").partition("; ")
        if "LPN_CACHE" not in remedy:
            remedy = "make it writable, or set LPN_CACHE to a writable folder"
        yield Finding("cache", "problem", message, remedy)
        return
    free = shutil.disk_usage(folder).free
    level: Severity = "problem" if free < _MIN_DISK else "note" if free < _LITTLE_DISK else "OK"
    remedy = "" if level == "OK" else "free space, or set LPN_CACHE to a folder elsewhere"
    yield Finding("cache", level, f"{folder} can be written; {free / 1e9:.1f} GB are free there", remedy)


def _demo(demo: Path) -> Iterator[Finding]:
    from lpn.doctor.verify import verify

    damage = "its files are missing" if not demo.is_dir() else ""
    damage = damage or next((verdict.message for verdict in verify(demo) if not verdict.healthy), "")
    if damage:
        restore = "restore assets of the checkout (git checkout -- assets), or install lpn-explorer again"
        yield Finding("demo", "problem", damage.rstrip("."), restore)
    else:
        yield Finding("demo", "OK", "models and descriptors are undamaged")
