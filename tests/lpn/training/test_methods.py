"""Methods of each kind are trained for some steps on picture files, and then retrieve better than untrained."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import lpn
from lpn.datasets import open_dataset
from lpn.models.checkpoints import load_torch, save
from lpn.tasks.opening import lazy_task
from lpn.training.recipes import RECIPES, method
from lpn.training.trainer import Trainer
from tools.fixtures import small_worlds
from tools.fixtures.trainings import losses, make_resnets_shallow

PLACES = 12
STEPS = replace(
    RECIPES["small"],
    size=64,
    epochs=8,
    batch=6,
    warmup_epochs=0,
    lr=1e-3,
    ema=0.8,
    infonce=0.0,
    rotation=2.0,
    place_rotation=0.0,
    scale=0.05,
    colour=0.2,
    dropout=0.1,
    precision="float32",
)
# Each network, loss, and slope is compared with numbers elsewhere.
ON_PLACES: dict[str, dict[str, Any]] = {
    "lpn": {},
    "lpn on resnet50": {"backbone": "resnet50", "google": False, "n_parts": 2, "lr": 3e-3, "epochs": 5},
    "soft-margin as released": {"linear": False, "lr": 1e-4},
}
ON_PANORAMAS: dict[str, dict[str, Any]] = {
    "lpn-cvusa": {"n_parts": 2},
    "safa-lpn": {"size": 32, "width": 128},
}


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_views(tmp_path_factory.mktemp("methods") / "places", PLACES)


@pytest.fixture(scope="module")
def panoramas(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_cvusa(tmp_path_factory.mktemp("methods") / "pairs", PLACES)


@pytest.fixture(autouse=True)
def _shallow(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Build each ResNet with one block a stage: they learn in a fraction of the time.

    The released metric losses learn too little with so few blocks, and have a whole ResNet-18. Other tests compare the outputs of
    whole backbones with the published ones.
    """
    if not request.node.name.endswith("as released]"):
        make_resnets_shallow(monkeypatch)


def improves(data: Path, folder: Path, name: str, changes: dict[str, Any], task: str) -> Path:
    """Train by up to three seeds: rounding, which differs between processors, decides whether a few steps are enough."""
    dataset, told = open_dataset(data), []
    for seed in range(3):
        recipe = replace(method(name.split(" ")[0], STEPS), seed=seed, **changes)
        out = folder / f"run-{seed}"
        run = Trainer(dataset, out, recipe, console=Console(file=io.StringIO()), from_scratch=True)
        save(run.network, folder / "before.safetensors")
        model = run.run()
        before, after = (
            lazy_task(lpn.load(m), dataset, task).evaluate().ap for m in (folder / "before.safetensors", model)
        )
        if after > before + 5:
            return model
        told.append(f"AP {before:.1f} untrained, {after:.1f} trained")
    pytest.fail(f"{name}: {'; '.join(told)}")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "lpn" else pytest.mark.slow) for name in ON_PLACES]
)
def test_training_on_places_improves_retrieval(places: Path, tmp_path: Path, name: str) -> None:
    model = improves(places, tmp_path, name, ON_PLACES[name], "drone-to-satellite")
    expected = ("satellite", "drone") if name.endswith("as released") else ("satellite", "street", "drone")
    assert lpn.load(model).views == expected
    assert load_torch(model).spec.classes == PLACES
    first, *_, last = losses(model.parent)
    assert last < first


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_PANORAMAS)
def test_training_on_panoramas_improves_retrieval(panoramas: Path, tmp_path: Path, name: str) -> None:
    improves(panoramas, tmp_path, name, ON_PANORAMAS[name], "street-to-satellite")
