"""Fixtures shared by all tests."""

from __future__ import annotations

import copy
import functools
import gc
import importlib
import io
import os
import shutil
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, settings
from rich.console import Console
from scipy.io import loadmat

from lpn.cli.main import main
from lpn.core.files import exclusive_lock
from lpn.datasets import matlab, open_dataset
from lpn.models.checkpoints import save
from lpn.models.export import export
from lpn.training.recipes import RECIPES
from lpn.training.trainer import Trainer
from tools.fixtures import small_worlds

Refused = Callable[..., str]
MakeOnce = Callable[[str, Callable[[Path], object]], Path]

# Properties are tried with the same examples each time, however busy the machine is.
settings.register_profile(
    "tests",
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
settings.load_profile("tests")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect no garbage while collecting tests, which makes millions of objects that stay; leave these out later too.

    Later, too, it is collected more rarely than by default, which took a sixth of an export's time.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.set_threshold(50_000, 20, 20)
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put long files first, so that no process works on one alone at the end, and the browser's files one after another.

    A process keeps its browser and its app as long as no other file comes between. A slow test takes as long as 60 quick ones.
    """
    length: Counter[Path] = Counter()
    for item in items:
        length[item.path] += 60 if item.get_closest_marker("slow") else 1
    items.sort(key=lambda item: ("e2e" not in item.path.parts, -length[item.path], item.path))


@pytest.fixture(scope="session", autouse=True)
def _session_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep fixtures of a session or module, which exist before a test's own cache, away from the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("XDG_DATA_HOME", str(tmp_path_factory.mktemp("home")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _one_core() -> Iterator[None]:
    """Let ONNX Runtime and OpenCV use one core, as OMP_NUM_THREADS=1 lets PyTorch.

    Their threads spin while they wait for each other, which takes the cores from the tests that run beside.
    """
    with pytest.MonkeyPatch.context() as patch:
        if os.environ.get("OMP_NUM_THREADS") == "1":
            patch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
        yield


@pytest.fixture(scope="session", autouse=True)
def _operators_read_once() -> Iterator[None]:
    """Let PyTorch's exporter parse its table of operators once for each process, and not in each export.

    Parsing takes a fifth of the time in which a small network is exported. Each export gets a copy of the table, which it may
    extend.
    """
    export_program = torch.onnx.export

    def export_with_cache(*given: Any, **options: Any) -> Any:
        registry = importlib.import_module("torch.onnx._internal.exporter._registration").ONNXRegistry
        if not hasattr(registry, "read_once"):
            registry.read_once = functools.cache(registry.from_torchlib)
            registry.from_torchlib = staticmethod(lambda **version: _copy_registry(registry.read_once(**version)))
        return export_program(*given, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.onnx, "export", export_with_cache)
        yield


def _copy_registry(registry: Any) -> Any:
    own = copy.copy(registry)
    own.functions = {operator: list(found) for operator, found in registry.functions.items()}
    return own


@pytest.fixture(scope="session", autouse=True)
def _matlab_files_read_here() -> Iterator[None]:
    """Read MATLAB files in this process: only damaged ones need one of their own, and its start takes half a second."""

    def read(path: Path, names: Sequence[str], simplify: bool) -> dict[str, Any]:
        values = loadmat(path, simplify_cells=simplify, variable_names=names)
        return {name: values[name] for name in names if name in values}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matlab, "_read", read)
        yield


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give each test a cache, and a folder of the user's own files."""
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home"))


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    """A function that runs a command which is refused, and returns its sentence, which may stand beside progress."""

    def run(*words: object) -> str:
        assert main([str(word) for word in words]) == 2
        (said,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("lpn")]
        return said

    return run


@pytest.fixture(scope="session")
def make_once(tmp_path_factory: pytest.TempPathFactory) -> MakeOnce:
    """A function that fills a folder once for all pytest-xdist workers; no test may change its contents.

    The first worker that asks for a name fills the folder, the others wait for it.
    """
    base = tmp_path_factory.getbasetemp()
    root = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"

    def make(name: str, fill: Callable[[Path], object]) -> Path:
        folder, partial = root / name / "whole", root / name / "partial"
        (root / name).mkdir(parents=True, exist_ok=True)
        with exclusive_lock(root / name, wait=True):
            if not folder.exists():
                shutil.rmtree(partial, ignore_errors=True)
                partial.mkdir()
                fill(partial)
                partial.rename(folder)
        return folder

    return make


@pytest.fixture(scope="session")
def model_file(make_once: MakeOnce) -> Path:
    """An exported, untrained LPN of four parts; `model.safetensors` lies beside it."""
    return make_once("model", small_worlds.make_model) / "model.onnx"


@pytest.fixture(scope="session")
def one_part_model_file(make_once: MakeOnce) -> Path:
    """The same of one part, the global baseline; `model.safetensors` lies beside it."""
    return make_once("one-part", lambda folder: small_worlds.make_model(folder, n_parts=1)) / "model.onnx"


@pytest.fixture(scope="session")
def data(make_once: MakeOnce) -> Path:
    """Six training and 14 test places in University-1652's layout."""
    return make_once("data", lambda folder: small_worlds.make_dataset(folder / "places")) / "places"


@dataclass(frozen=True)
class RealRun:
    """A short training on real University-1652 pictures.

    Attributes:
        before, after: the checkpoints before and after the training.
        exported: `after` as an `.onnx`.
        output: the console output.
    """

    data: Path
    before: Path
    after: Path
    exported: Path
    output: str


@pytest.fixture(scope="session")
def real_run(make_once: MakeOnce) -> RealRun:
    """An LPN trained for four epochs on the first 160 places of LPN_MINI_DATA; skips where that is not set."""
    data, weights = os.environ.get("LPN_MINI_DATA"), os.environ.get("LPN_BACKBONE_WEIGHTS")
    if not data or not weights:
        pytest.skip("LPN_MINI_DATA and LPN_BACKBONE_WEIGHTS name no real pictures and weights")

    def train(folder: Path) -> None:
        for view in ("satellite", "drone"):
            for place in sorted(Path(data, "train", view).iterdir())[:160]:
                shutil.copytree(place, folder / "places" / "train" / view / place.name)
        output = io.StringIO()
        recipe = replace(RECIPES["small"], size=64, epochs=4, batch=16, warmup_epochs=0, ema=0.8)
        console = Console(file=output, width=200)
        trainer = Trainer(open_dataset(folder / "places"), folder / "run", recipe, init=Path(weights), console=console)
        save(trainer.network, folder / "before.safetensors")
        export(trainer.run().rename(folder / "after.safetensors"), folder / "after.onnx")
        (folder / "output.txt").write_text(output.getvalue())

    folder = make_once("real-run", train)
    files = [folder / name for name in ("before.safetensors", "after.safetensors", "after.onnx")]
    return RealRun(Path(data), *files, (folder / "output.txt").read_text())
