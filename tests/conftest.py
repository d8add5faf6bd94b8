"""Fixtures shared by all tests."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from rich.console import Console

from lpn.datasets import open_dataset
from lpn.models.checkpoints import save
from lpn.training.recipes import RECIPES
from lpn.training.trainer import Trainer
from tools.fixtures import small_worlds


@pytest.fixture(scope="session", autouse=True)
def _cache_of_all(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Nor does what is made once for several tests, which is made before the cache of any one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No test reads or fills the user's cache."""
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="session")
def model_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exported model; `model.safetensors` lies beside it."""
    return small_worlds.make_model(tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set that no test may change."""
    return small_worlds.make_dataset(tmp_path_factory.mktemp("data") / "places")


@dataclass(frozen=True)
class RealRun:
    """A short training on real University-1652 pictures: the model before and after, and what was said."""

    data: Path
    before: Path
    after: Path
    said: str


@pytest.fixture(scope="session")
def real_run(tmp_path_factory: pytest.TempPathFactory) -> RealRun:
    """An LPN trained for five epochs on the pictures that LPN_MINI_DATA names; skips where it names none."""
    data, weights = os.environ.get("LPN_MINI_DATA"), os.environ.get("LPN_BACKBONE_WEIGHTS")
    if not data or not weights:
        pytest.skip("LPN_MINI_DATA and LPN_BACKBONE_WEIGHTS name no real pictures and weights")
    folder, said = tmp_path_factory.mktemp("real"), io.StringIO()
    recipe = replace(RECIPES["small"], size=128, epochs=5, warmup_epochs=0, ema=0.9)
    trainer = Trainer(
        open_dataset(data), folder / "run", recipe, init=Path(weights), console=Console(file=said, width=200)
    )
    save(trainer.network, folder / "before.safetensors")
    return RealRun(Path(data), folder / "before.safetensors", trainer.run(), said.getvalue())
