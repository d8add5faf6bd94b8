"""Teachers: what they say of a batch, the loss that follows it, and a training that learns it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from rich.console import Console
from torch import Tensor

from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.datasets import open_dataset
from lpn.models import checkpoints
from lpn.models.base import Model
from lpn.models.checkpoints import TorchModel
from lpn.models.contract import Contract, ForwardPass
from lpn.models.network import LPN
from lpn.models.spec import ModelSpec
from lpn.training.distillation import Teachers
from lpn.training.losses import descriptors, distillation_loss, total_loss
from lpn.training.recipes import RECIPES
from lpn.training.trainer import Trainer
from tools.fixtures import small_worlds
from tools.fixtures.trainings import QUICK, losses

VIEWS: tuple[View, ...] = ("satellite", "drone")
ALONE = replace(QUICK, epochs=4, batch=8, instance=0.0, infonce=0.0, distillation=1.0)


def network(seed: int, size: int = 32, views: tuple[View, ...] = VIEWS) -> TorchModel:
    torch.manual_seed(seed)
    spec = ModelSpec("resnet18", "layer3", views=views, n_parts=2, classes=4, input_size=(size, size), shared=False)
    return TorchModel(LPN(spec), f"teacher {seed}")


def batch(size: int = 32, rows: int = 3) -> dict[str, Tensor]:
    noise = torch.Generator().manual_seed(7)
    return {view: torch.randn(rows, 3, size, size, generator=noise) for view in VIEWS}


def test_a_batch_is_described_by_the_mean_of_all_teachers_cosines() -> None:
    models, sets = [network(1), network(2)], batch()
    found = Teachers(models, VIEWS).descriptors(sets)
    cosines = []
    for model in models:
        tiles, drones = (model.descriptors(sets[view].numpy(), view, mirror=False).reshape(3, -1) for view in VIEWS)
        cosines.append(tiles @ drones.T)
    np.testing.assert_allclose(found["satellite"] @ found["drone"].T, np.mean(cosines, axis=0), atol=1e-5)


class _Other(Model):
    """A teacher of another size and preparation, which keeps what it is shown."""

    def __init__(self) -> None:
        self.contract = Contract(
            "other", "other", VIEWS, (16, 24), 1, 3, "one vector", mean=(0.5, 0.5, 0.5), std=(0.25, 0.5, 1.0)
        )
        self.shown: list[Float32Array] = []

    def run(self, images: Float32Array, view: View) -> ForwardPass:  # noqa: ARG002
        self.shown.append(images)
        return ForwardPass(images.mean(axis=(2, 3))[:, None])


def test_a_teacher_sees_the_pictures_as_it_takes_them() -> None:
    teacher, picture = _Other(), np.full((32, 32, 3), (51, 102, 153), np.uint8)
    shown = torch.from_numpy(images.normalise(picture))[None]
    Teachers([teacher], VIEWS).descriptors({"satellite": shown, "drone": shown})
    expected = np.array([(0.2 - 0.5) / 0.25, (0.4 - 0.5) / 0.5, (0.6 - 0.5) / 1.0])
    assert [one.shape for one in teacher.shown] == [(1, 3, 16, 24)] * 2
    np.testing.assert_allclose(
        teacher.shown[0][0].transpose(1, 2, 0), np.broadcast_to(expected, (16, 24, 3)), atol=1e-5
    )


def test_a_teacher_has_every_view_of_the_training() -> None:
    with pytest.raises(InputError, match=r"has no branch for drone; give another --teacher"):
        Teachers([network(1, views=("satellite", "street"))], VIEWS)


def test_the_loss_is_the_divergence_in_both_directions() -> None:
    noise = torch.Generator().manual_seed(3)
    first, second, one, other = (descriptors(torch.randn(5, 2, 8, generator=noise)) for _ in range(4))
    assert distillation_loss(one, other, (one, other), 0.1).abs() < 1e-6
    by_hand = 0.0
    for rows, taught in ((first @ second.T, one @ other.T), (second @ first.T, other @ one.T)):
        p, q = ((table / 0.1).softmax(dim=1) for table in (taught, rows))
        by_hand += float((p * (p / q).log()).sum(dim=1).mean()) / 2
    assert float(distillation_loss(first, second, (one, other), 0.1)) == pytest.approx(by_hand, rel=1e-4)


def test_the_weight_of_the_recipe_counts() -> None:
    noise = torch.Generator().manual_seed(4)
    outputs = {view: (torch.randn(5, 2, 8, generator=noise), torch.zeros(5, 2, 4)) for view in VIEWS}
    taught = {view: F.normalize(torch.randn(5, 6, generator=noise)) for view in VIEWS}
    labels = {view: torch.arange(5) for view in VIEWS}
    once, thrice = (total_loss(outputs, labels, replace(ALONE, distillation=w), taught=taught) for w in (1.0, 3.0))
    assert once > 0
    torch.testing.assert_close(thrice, 3 * once)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("taught") / "places", train=24, test=4)


@pytest.fixture(scope="module")
def teacher(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _saved(tmp_path_factory.mktemp("teacher") / "teacher.safetensors", 1)


def _saved(path: Path, seed: int) -> Path:
    checkpoints.save(network(seed, size=48).network, path, {})
    return path


def trainer(places: Path, out: Path, *teachers: Path, recipe: object = ALONE, resume: bool = False) -> Trainer:
    quiet = Console(quiet=True)
    options = {"console": quiet, "from_scratch": True, "test": False, "teachers": teachers, "resume": resume}
    return Trainer(open_dataset(places), out, recipe, **options)  # type: ignore[arg-type]


def test_a_training_learns_the_teacher_s_similarities_and_goes_on_with_no_other(
    places: Path, teacher: Path, tmp_path: Path
) -> None:
    trainer(places, tmp_path / "whole", teacher).run()
    whole = losses(tmp_path / "whole")
    assert whole[-1] < 0.8 * whole[0]
    with pytest.raises(InputError, match="other training pictures or teachers"):
        trainer(places, tmp_path / "whole", _saved(tmp_path / "other.safetensors", 2), resume=True)


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_a_teacher_and_its_weight_come_together(places: Path, teacher: Path, tmp_path: Path, weight: float) -> None:
    recipe = replace(QUICK, distillation=weight)
    with pytest.raises(InputError, match=r"distillation = \d, and (a|no) --teacher is given; give both, or neither"):
        trainer(places, tmp_path / "run", *([] if weight else [teacher]), recipe=recipe)


def test_no_teacher_sees_an_unrolled_tile() -> None:
    with pytest.raises(InputError, match="distillation = 1 with polar"):
        replace(RECIPES["safa-paper"], distillation=1.0)
