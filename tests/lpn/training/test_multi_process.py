from __future__ import annotations

import csv
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from lpn.core.errors import InputError
from lpn.training.multi_process import ProcessGroup
from lpn.training.recipes import Recipe
from tests.lpn.training.two_processes import INDEPENDENT, METRIC, RECIPE, trainer
from tools.fixtures import layouts, small_worlds
from tools.fixtures.trainings import losses, make_resnets_shallow

ROOT = Path(__file__).parents[3]


def torchrun(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Two processes on this machine, as a person starts them."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *arguments]
    return subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False, timeout=300, cwd=ROOT)


@pytest.fixture(autouse=True)
def _shallow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Train networks of few layers here as the two processes do."""
    make_resnets_shallow(monkeypatch)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("shared")
    layouts.training_gaps(root / "gaps")
    return small_worlds.make_dataset(root / "places", train=16, test=3)


@pytest.fixture(scope="module")
def shared(places: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two processes' runs: `whole`, and `cut`, which was resumed."""
    out = tmp_path_factory.mktemp("runs")
    done = torchrun("-m", "tests.lpn.training.two_processes", places, out)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.slow
def test_two_processes_train_as_one_does(places: Path, shared: Path, tmp_path: Path) -> None:
    run, threads = trainer(places, tmp_path / "alone"), torch.get_num_threads()
    before = {name: weight.detach().clone() for name, weight in run.network.named_parameters()}
    torch.set_num_threads(1)  # as torchrun does
    run.run()
    torch.set_num_threads(threads)
    assert losses(shared / "whole") == pytest.approx(losses(tmp_path / "alone"), rel=1e-4)
    weights = torch.load(shared / "weights0.pt", weights_only=True)
    # Processors sum in other orders, so single weights differ more on some; a tensor as a whole moves alike.
    for name, parameter in run.network.named_parameters():
        alone, together = parameter.detach(), weights[name].detach()
        assert (together - alone).norm() <= 0.01 * (alone - before[name]).norm(), name


@pytest.mark.slow
@pytest.mark.parametrize(("name", "recipe"), [("independent", INDEPENDENT), ("gaps", RECIPE), ("metric", METRIC)])
def test_two_processes_train_as_one_does_by_other_recipes(
    places: Path, shared: Path, tmp_path: Path, name: str, recipe: Recipe
) -> None:
    """Sets that are shuffled on their own, and places with gaps, where some rows of a batch show another place."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    data = places if name == "independent" else places.with_name("gaps")
    trainer(data, tmp_path / "alone", recipe=recipe).run()
    torch.set_num_threads(threads)
    assert losses(shared / name) == pytest.approx(losses(tmp_path / "alone"), rel=1e-4)


@pytest.mark.slow
def test_both_processes_have_the_same_weights(shared: Path) -> None:
    one, two = (torch.load(shared / f"weights{rank}.pt", weights_only=True) for rank in (0, 1))
    assert all(torch.equal(one[name], two[name]) for name in one)


@pytest.mark.slow
def test_a_shared_run_is_resumed_to_the_same_losses(shared: Path) -> None:
    assert "after epoch 1 of 2" in (shared / "cut.txt").read_text()
    assert losses(shared / "cut") == losses(shared / "whole")
    one, two = (load_file(shared / run / "last.safetensors") for run in ("cut", "whole"))
    assert all(torch.equal(one[name], two[name]) for name in one)


@pytest.mark.slow
def test_two_processes_make_the_updates_that_are_announced(places: Path, tmp_path: Path) -> None:
    quick = ("--recipe", "small", "--size", 32, "--batch", 4, "--epochs", 2, "--from-scratch")
    done = torchrun("-m", "lpn", "train", "--data", places.with_name("gaps"), "--out", tmp_path / "run", *quick)
    assert done.returncode == 0, done.stderr
    announced = "Training on 10 places in satellite, street, drone, google: 2 steps of 4 places an epoch, 2 epochs, so 4 updates."
    assert done.stdout.count(announced) == 1
    with (tmp_path / "run" / "log.csv").open() as file:
        pictures = [float(row["seconds"]) * float(row["images_per_second"]) for row in csv.DictReader(file)]
    # Each step has four pictures of each of four sets.
    assert pictures == pytest.approx([2 * 4 * 4, 2 * 4 * 4], rel=1e-3)


@pytest.mark.slow
def test_an_error_in_one_process_ends_all_with_its_sentence(places: Path, tmp_path: Path) -> None:
    data = tmp_path / "places"
    shutil.copytree(places, data)
    small_worlds.spoilt_png(data / "train" / "drone" / "0003" / "image-01.png")
    quick = ("--recipe", "small", "--size", 64, "--batch", 4, "--epochs", 1, "--from-scratch")
    done = torchrun("-m", "lpn", "train", "--data", data, "--out", tmp_path / "run", *quick)
    assert done.returncode != 0
    said = [line for line in done.stderr.splitlines() if line.startswith("lpn: ")]
    assert sum("0003/image-01.png is cut short or damaged" in line for line in said) == 1
    assert not (tmp_path / "run" / "last.safetensors").exists()


def test_a_batch_is_shared_evenly_or_refused() -> None:
    groups = [ProcessGroup(torch.device("cpu"), rank, 3) for rank in range(3)]
    assert [row for group in groups for row in range(12)[group.share(12)]] == list(range(12))
    for batch in (8, 3):
        with pytest.raises(InputError, match="multiple of 3, at least 6"):
            groups[0].share(batch)
