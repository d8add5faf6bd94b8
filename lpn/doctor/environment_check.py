"""What a machine has of what is needed here, each with what to do where something is wrong."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from lpn.core import requirements, resources
from lpn.core.errors import LPNError, OutputError
from lpn.core.files import check_writable, printable

Level = Literal["OK", "note", "problem"]
HOST, PORT = "127.0.0.1", 8080
"""What the explorer listens on unless told otherwise."""
_USES = {
    "train": "training, export, reading .pth and .safetensors",
    "world": "rendering a world with Blender",
    "data": "CVACT, and results saved by the published code",
    "search": "searching 8- and 16-bit indexes quickly",
    "faiss": "approximate search of millions of tiles",
    "ray": "describing on many machines",
    "milvus": "search on a server",
    "umap": "a second map of descriptors",
    "dev": "the tests",
}
_MODULES = {
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "numpy": "numpy",
    "onnxruntime": "onnxruntime",
    "rich": "rich",
    "tyro": "tyro",
    "viser": "viser",
}
_LITTLE_MEMORY, _LITTLE_DISK, _NO_DISK = 1 << 30, 1 << 30, 50 << 20
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        name: of it.
        level: "OK"; "note" where something is missing that is not needed for everything; "problem" where it is.
        said: what was found.
        remedy: what to do; empty where nothing need be done.
    """

    name: str
    level: Level
    said: str
    remedy: str = ""

    @property
    def line(self) -> str:
        """It as one line for a person."""
        remedy = f"; {self.remedy}" if self.remedy else ""
        return printable(f"{self.level:8}{self.name}: {self.said}{remedy}.")


def look(demo: Path) -> Iterator[Finding]:
    """Look at everything, one after the other; what fails is a finding, and no exception. No package need be there for it.

    Args:
        demo: folder of the demo that the explorer opens when nothing is chosen.
    """
    for name, check in {
        "Python and packages": _python_and_packages,
        "ONNX Runtime": _onnxruntime,
        "PyTorch": _torch,
        "machine": _machine,
        "cache": _cache,
        "port": _port,
        "demo": lambda: _demo(demo),
        "browser": _browser,
    }.items():
        try:
            yield from check()
        except ModuleNotFoundError as error:
            module = (error.name or "").partition(".")[0]
            package = next((package for package, of in _MODULES.items() if of == module), module)
            yield Finding(
                name, "problem", f"could not be looked at without the package {package}", f"pip install {package}"
            )
        except Exception as error:  # a broken package raises anything
            remedy = "mend the packages that are named above, or install it again"
            yield Finding(name, "problem", f"could not be looked at ({type(error).__name__}: {error})", remedy)


def to_dict(findings: list[Finding]) -> dict[str, Any]:
    """The keys of the JSON file."""
    return {"healthy": healthy(findings), "findings": [asdict(finding) for finding in findings]}


def healthy(findings: list[Finding]) -> bool:
    """Whether nothing that is needed is broken."""
    return all(finding.level != "problem" for finding in findings)


def _python_and_packages() -> Iterator[Finding]:
    found = ".".join(map(str, sys.version_info[:3]))  # not as a build may call itself: "3.13.0+"
    told = requirements.asked()
    if told is None:
        yield Finding(
            "Python", "note", f"{found}; what {requirements.NAME} asks for is not known", "install it with pip"
        )
        return
    if requirements.within(found, told.python):
        yield Finding("Python", "OK", f"{found} in {sys.prefix}")
    else:
        yield Finding("Python", "problem", f"{found}; {told.python} is needed", "make an environment with a newer one")
    good = []
    for package in told.base:
        broken = _broken(package)
        if broken:
            again = f"pip install --force-reinstall '{package.requirement}'"
            yield Finding(package.name, "problem", broken, again if package.fits else _install(package.requirement))
        else:
            good.append(f"{package.name} {package.found}")
    yield Finding("packages", "OK", ", ".join(good))
    for extra, of in told.extras.items():
        yield _extra(extra, of)


def _broken(package: requirements.Package) -> str:
    """What is wrong with a package of the base; empty where nothing is."""
    if not package.fits:
        return _unfit(package)
    try:
        with _unheard():
            importlib.import_module(_MODULES.get(package.name.lower(), package.name))
    except Exception as error:
        return f"{package.found} cannot be imported ({type(error).__name__}: {error})"
    return ""


@contextmanager
def _unheard() -> Iterator[None]:
    """Keep off the terminal what libraries write there while they are imported, a traceback for what is said in one line."""
    with ExitStack() as after:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        after.callback(os.close, nowhere)
        for number, stream in ((1, sys.stdout), (2, sys.stderr)):
            if stream is None:  # closed before the start
                continue
            stream.flush()
            before = os.dup(number)
            after.callback(os.close, before)
            after.callback(os.dup2, before, number)
            after.callback(stream.flush)
            os.dup2(nowhere, number)
        yield


def _unfit(package: requirements.Package) -> str:
    if package.found is None:
        return "is not installed"
    return f"{package.found} is installed, and {package.wanted} is needed"


def _install(requirement: str) -> str:
    return f"pip install '{requirement}'"


def _extra(extra: str, of: tuple[requirements.Package, ...]) -> Finding:
    use, name = _USES.get(extra, "further things"), f"extra {extra}"
    wrong = [package for package in of if not package.fits]
    if not wrong:
        return Finding(name, "OK", ", ".join(f"{package.name} {package.found}" for package in of))
    missing = all(package.found is None for package in of)
    said = "not installed" if missing else ", ".join(f"{package.name} {_unfit(package)}" for package in wrong)
    return Finding(name, "note", said, f"for {use}: {_install(f'{requirements.NAME}[{extra}]')}")


def _onnxruntime() -> Iterator[Finding]:
    if find_spec("onnxruntime") is None:
        return  # said among the packages
    with _unheard():
        ort: Any = importlib.import_module("onnxruntime")
    providers = [name.removesuffix("ExecutionProvider") for name in ort.get_available_providers()]
    said = f"{ort.__version__} computes on {ort.get_device()}; providers: {', '.join(providers)}"
    if "CPU" in providers:
        yield Finding("ONNX Runtime", "OK", said)
    else:
        yield Finding("ONNX Runtime", "problem", said, "pip install --force-reinstall onnxruntime, which has the CPU's")


def _torch() -> Iterator[Finding]:
    if find_spec("torch") is None:
        return  # said among the extras
    torch: Any = importlib.import_module("torch")
    if not torch.cuda.is_available():
        built = f", though built for CUDA {torch.version.cuda}" if torch.version.cuda else ""
        remedy = "trainings take long; where this machine has one, install its driver and a torch for CUDA"
        yield Finding("GPU", "note", f"torch {torch.__version__} finds none{built}", remedy)
        return
    of = [torch.cuda.get_device_properties(number) for number in range(torch.cuda.device_count())]
    names = ", ".join(f"{one.name} with {one.total_memory / 1e9:.0f} GB" for one in of)
    yield Finding("GPU", "OK", f"torch {torch.__version__} on {names}")


def _machine() -> Iterator[Finding]:
    cores, there = resources.usable_cores(), os.cpu_count() or 1
    yield Finding("cores", "OK", f"{cores} of {there} can be used")
    if (memory := resources.memory()) is None:
        return
    total, free = memory
    said = f"{free / 1e9:.1f} of {total / 1e9:.1f} GB are free"
    if free < _LITTLE_MEMORY:
        yield Finding(
            "memory", "note", said, "close other programs; the explorer takes about half a GB, trainings more"
        )
    else:
        yield Finding("memory", "OK", said)


def _cache() -> Iterator[Finding]:
    from lpn.descriptors import cache_folder

    try:
        folder = cache_folder()
    except OutputError as error:
        said, _, remedy = str(error).rstrip(".").partition("; ")
        yield Finding("cache", "problem", said, remedy)
        return
    try:
        check_writable(folder / "doctor")
    except OutputError as error:
        remedy = "make it writable, or set LPN_CACHE to a folder that is"
        yield Finding("cache", "problem", str(error).partition(";")[0], remedy)
        return
    free = shutil.disk_usage(folder).free
    said = f"{folder} can be written; {free / 1e9:.1f} GB are free there"
    level: Level = "problem" if free < _NO_DISK else "note" if free < _LITTLE_DISK else "OK"
    yield Finding("cache", level, said, "" if level == "OK" else "free space, or set LPN_CACHE to a folder elsewhere")


def _port() -> Iterator[Finding]:
    if taken := resources.port_taken(HOST, PORT):
        yield Finding(
            "port", "note", taken.removeprefix("Port "), "close what uses it, or start the explorer with --port"
        )
    else:
        yield Finding("port", "OK", f"{PORT} on {HOST} is free")


def _demo(demo: Path) -> Iterator[Finding]:
    if not demo.is_dir():
        yield Finding("demo", "note", "not part of this installation", "give lpn explore --data and --model")
        return
    flaw = _demo_flaw(demo)
    if flaw is None:
        yield Finding("demo", "OK", "model, descriptors, and pictures are what they were")
    else:
        yield Finding("demo", "problem", flaw.rstrip("."), "bring assets/demo back: git checkout -- assets/demo")


def _demo_flaw(demo: Path) -> str | None:
    import lpn
    from lpn.descriptors import open_store
    from lpn.descriptors.cache import STORES
    from lpn.doctor.verify import verify

    for verdict in verify(demo):
        if not verdict.whole:
            return verdict.said
    try:
        model = lpn.load(demo / "lpn.onnx")
        for store in sorted(path for path in (demo / STORES).iterdir() if path.is_dir()):
            manifest = open_store(store).manifest
            if manifest.fingerprint != model.fingerprint:
                return f"lpn.onnx is not the model that {STORES}/{store.name} was made with, so one of them is damaged"
            role = {"query": "query", "gallery": "gallery"}[store.name.partition("_")[0]]
            for row in manifest.rows:
                picture = demo / "test" / f"{role}_{manifest.view}" / row.file
                if not picture.is_file() or picture.stat().st_size != row.size:
                    return f"{picture.relative_to(demo)} is missing or another"
    except LPNError as error:
        return str(error)
    except FileNotFoundError as error:
        return f"{error.filename} is missing"
    return None


def _browser() -> Iterator[Finding]:
    found: Callable[[str], str | None] = shutil.which
    path = next((path for name in _BROWSERS if (path := found(name))), None) or _playwrights()
    if path is None:
        yield Finding("browser", "note", "no Chromium is found here", "the tests need one: apt-get install chromium")
    else:
        yield Finding("browser", "OK", path)


def _playwrights() -> str | None:
    """The Chromium that Playwright installed."""
    try:
        own = os.environ.get("PLAYWRIGHT_BROWSERS_PATH") or Path.home() / ".cache" / "ms-playwright"
    except RuntimeError:  # this user has no home
        return None
    return next((str(path) for path in sorted(Path(own).glob("chromium*")) if path.is_dir()), None)
