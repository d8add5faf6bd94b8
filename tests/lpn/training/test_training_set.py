"""Places with gaps, as University-1652's release has them: each is trained on in the views that it has."""

from __future__ import annotations

import io
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from lpn.core import images
from lpn.core.errors import DataError, InputError
from lpn.datasets import open_dataset
from lpn.models.checkpoints import load_torch
from lpn.training.learner import Learner
from lpn.training.loader import Loader
from lpn.training.model_selection import HeldOut
from lpn.training.recipe import Recipe
from lpn.training.recipes import RECIPES
from lpn.training.trainer import Trainer
from lpn.training.training_set import Fold, TrainingSet, paired_pictures
from tests.lpn.training.test_losses import total_loss
from tools.fixtures import layouts
from tools.fixtures.trainings import QUICK, make_resnets_shallow

SETS = layouts.TRAIN_SETS
# Pictures as they are, so that a batch tells which files it has.
PLAIN = {"size": 32, "padding": 0, "satellite_rotation": 0.0, "flip": "none", "precision": "float32"}
BY_PLACE = replace(RECIPES["released"], sampling="places", batch=4, **PLAIN)
BY_PICTURE = replace(RECIPES["released"], batch=4, **PLAIN)
TRAINED = [1, 2, 3, 4, 5, 8, 9, 10, 11, 12]


@pytest.fixture(scope="module")
def gaps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return layouts.training_gaps(tmp_path_factory.mktemp("gaps") / "places")


def training_set(root: Path, **options: Any) -> tuple[TrainingSet, str]:
    said = io.StringIO()
    made = TrainingSet(open_dataset(root), Console(file=said, width=200), **options)
    return made, said.getvalue()


def test_a_place_needs_pictures_of_two_views_and_no_more(gaps: Path) -> None:
    places, said = training_set(gaps)
    assert places.labels == TRAINED
    assert places.views == ("satellite", "street", "drone")
    assert said.splitlines() == [
        "Places left out, without a picture in all but one of satellite, street, drone: 0006, 0007.",
        "Places without a picture in satellite, trained on in their other views: 0004.",
        "Places without a picture in street, trained on in their other views: 0002, 0005.",
        "Places without a picture in drone, trained on in their other views: 0003.",
        "Places without a picture in google, trained on in their other views: 0001, 0002.",
    ]
    counts = {name: [len(of) for of in files] for name, files in places.files.items()}
    assert counts["google"] == [0, 0, *[2] * 8]
    assert counts["satellite"] == [1, 1, 1, 0, *[1] * 6]
    # Without google, place 5 has no street picture, and satellite and drone all the same.
    assert training_set(gaps, names=("satellite", "drone", "street"))[0].labels == TRAINED


def test_broken_pictures_are_named_and_left_out(tmp_path: Path) -> None:
    drone = layouts.training_gaps(tmp_path / "places") / "train" / "drone"
    cut, broken = sorted((drone / "0008").iterdir())[0], sorted((drone / "0006").iterdir())
    cut.write_bytes(cut.read_bytes()[:-20])
    for file in broken:
        file.write_bytes(b"no picture")
    places, said = training_set(tmp_path / "places")
    assert f"{1 + len(broken)} of " in said.splitlines()[0]
    assert (
        f"training pictures cannot be used and are left out: train/drone/0006/{broken[0].name} is not a picture" in said
    )
    assert places.labels == TRAINED
    assert cut not in places.files["drone"][TRAINED.index(8)]


def test_sets_without_any_place_that_is_trained_on_are_none(tmp_path: Path) -> None:
    root = layouts.training_gaps(tmp_path)
    for label in (*range(1, 6), *range(8, 13)):
        for name in ("street", "google"):
            shutil.rmtree(root / "train" / name / f"{label:04d}", ignore_errors=True)
    places, _ = training_set(root)
    assert (places.labels, places.views) == ([1, 2, 5, *range(8, 13)], ("satellite", "drone"))
    assert set(places.files) == {"satellite", "drone"}
    shutil.rmtree(root / "train" / "drone")
    with pytest.raises(DataError, match=r"No place of .* has pictures in two of satellite, street, google"):
        training_set(root)
    for file in (root / "train" / "satellite").rglob("*.png"):
        file.write_bytes(b"")
    with pytest.raises(DataError, match="has pictures in train/street, train/google; training needs train/satellite"):
        training_set(root)


def drawn(loader: Loader, epochs: int) -> list[tuple[str, int, tuple[int, Path]]]:
    """Return the set, the label of the row, and the place and the file of the picture in it, of every row."""
    places = loader.places
    assert isinstance(places, TrainingSet)
    known = {
        images.normalise(images.resize(images.load_picture(file), 32, 32)).tobytes(): (place, file)
        for files in places.files.values()
        for place, of in enumerate(files)
        for file in of
    }
    return [
        (name, int(label), known[picture.contiguous().numpy().tobytes()])
        for batch in loader.stream(0, epochs)
        for name, pictures in batch.sets.items()
        for label, picture in zip(batch.labels[name], pictures, strict=True)
    ]


@pytest.mark.parametrize("recipe", [BY_PLACE, BY_PICTURE], ids=["places", "pictures"])
def test_every_row_shows_the_place_of_its_label(gaps: Path, recipe: Recipe) -> None:
    loader = Loader(training_set(gaps)[0], recipe, torch.device("cpu"), workers=1)
    assert loader.steps == {"places": 10 // 4, "pictures": 9 // 4}[recipe.sampling]
    rows = drawn(loader, 40)
    assert len(rows) == 40 * loader.steps * 4 * len(SETS)
    assert all(label == place for _, label, (place, _) in rows)
    # Each place is seen in every set that it has, or that stands in for it.
    seen = {name: {loader.places.labels[label] for of, label, _ in rows if of == name} for name in SETS}
    by_picture = recipe.sampling == "pictures"
    assert seen["satellite"] == set(TRAINED) - {4}
    assert seen["drone"] == set(TRAINED) - {3}
    assert seen["street"] == set(TRAINED) - ({2, 5} if by_picture else {2})
    assert seen["google"] == set(TRAINED) - ({1, 2} if by_picture else {2})
    if by_picture:
        # Within an epoch no picture is drawn twice, over all epochs each is drawn, and sets differ in their order.
        epochs = np.array_split(np.arange(len(rows)), 40)
        assert all(len({rows[i] for i in epoch}) == len(epoch) for epoch in epochs)
        files = loader.places.files
        assert {file for *_, (_, file) in rows} == {file for places in files.values() for of in places for file in of}
        orders = [[label for of, label, _ in rows if of == name] for name in ("satellite", "drone")]
        assert orders[0] != orders[1]


def test_rows_of_a_place_agree_but_in_the_view_that_it_lacks(gaps: Path) -> None:
    places = training_set(gaps)[0]
    own: set[int] = set()
    for batch in Loader(places, BY_PLACE, torch.device("cpu"), workers=1).stream(0, 5):
        rows = np.stack([batch.labels[name].numpy() for name in SETS], axis=1)
        for row in rows:
            values, counts = np.unique(row, return_counts=True)
            place = int(values[counts.argmax()])
            own.add(place)
            lacking = [name for name, label in zip(SETS, row, strict=True) if label != place]
            expected = {2: ["street", "google"], 3: ["drone"], 4: ["satellite"]}.get(places.labels[place], [])
            assert lacking == expected or places.labels[place] == 2
    assert len(own) > 8


def test_pair_losses_compare_the_rows_of_one_place_only() -> None:
    recipe = replace(QUICK, infonce=1.0, instance=0.0, label_smoothing=0.0)
    rng = np.random.default_rng(0)
    outputs = {
        name: (torch.from_numpy(rng.standard_normal((4, 2, 3))).float(), torch.zeros(4, 2, 9))
        for name in ("satellite", "drone")
    }
    labels = {"satellite": torch.tensor([0, 1, 2, 3]), "drone": torch.tensor([0, 7, 2, 3])}
    rows = [0, 2, 3]
    kept = {name: (parts[rows], scores[rows]) for name, (parts, scores) in outputs.items()}
    for changes in ({}, {"pooling": "safa", "metric": "soft_margin", "infonce": 0.0}):
        changed = replace(recipe, **changes)
        alone = total_loss(kept, {name: torch.tensor([0, 2, 3]) for name in labels}, changed)
        torch.testing.assert_close(total_loss(outputs, labels, changed), alone)
    labels["drone"] = torch.tensor([0, 7, 8, 6])
    outputs["drone"][0].requires_grad_()
    loss = total_loss(outputs, labels, recipe)
    assert float(loss.detach()) == 0
    loss.backward()
    assert outputs["drone"][0].grad is not None
    assert not outputs["drone"][0].grad.any()


TINY = {"backbone": "resnet18", "last_layer": "layer3", "size": 32, "batch": 3, "epochs": 2, "warmup_epochs": 0}


@pytest.mark.parametrize("name", ["paper", "small", "metric-released"])
def test_the_updates_that_are_announced_are_those_that_run(
    gaps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    recipe = replace(RECIPES[name], **TINY, lr=1e-5, precision="float32")
    make_resnets_shallow(monkeypatch)
    steps: list[int] = []
    step = Learner.step
    monkeypatch.setattr(Learner, "step", lambda self, *rest: (steps.append(rest[1]), step(self, *rest))[1])
    run = Trainer(open_dataset(gaps), tmp_path / "run", recipe, console=Console(quiet=True), from_scratch=True)
    # Two places have no drone picture, or no tile, and so one view alone without their street pictures.
    places, updates = (10, 6) if recipe.street else (8, 4)
    said = rf"Training on {places} places in [a-z, ]+: {updates // 2} steps of 3 .* an epoch.*, 2 epochs, so {updates} updates\."
    assert re.fullmatch(said, run.plan())
    assert load_torch(run.run()).spec.classes == places
    assert steps == list(range(updates))


def test_folds_and_held_out_places_may_have_gaps(gaps: Path) -> None:
    held: dict[int, dict[str, list[Path]]] = {}
    for number in range(3):
        places, _ = training_set(gaps)
        out = places.hold_out(Fold(number, 3), 0)
        assert sorted([*out, *places.labels]) == TRAINED
        assert all(len(files) == len(places.labels) for files in places.files.values())
        held |= out
    assert sorted(held) == TRAINED
    validator = HeldOut(held, BY_PLACE.zoom)
    assert validator.description == "R@1 of drone-to-satellite on 8 places held out of the training"
    for pictures in validator.pictures.values():
        assert {picture.label for picture in pictures} == set(TRAINED) - {3, 4}
    alone = {3: held[3], 4: held[4]}
    assert set(paired_pictures(alone)) == {"street", "satellite"}
    with pytest.raises(InputError, match="No place that is held out"):
        paired_pictures({4: held[4]})
