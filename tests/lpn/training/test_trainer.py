from __future__ import annotations

import csv
import io
import json
import math
import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from safetensors import safe_open
from torch import Tensor

import lpn
from lpn.cli.main import main
from lpn.core.errors import InputError, LPNError, ModelFileError
from lpn.core.progress import listening
from lpn.datasets import open_dataset
from lpn.models.backbones import backbone_of
from lpn.models.checkpoints import load_torch, save
from lpn.models.spec import ModelSpec
from lpn.tasks.opening import lazy_task
from lpn.training import learner
from lpn.training.model_selection import HeldOut, TestSplit
from lpn.training.recipe import Recipe
from lpn.training.recipes import RECIPES
from lpn.training.trainer import Trainer
from tests.conftest import RealRun
from tools.fixtures import small_worlds
from tools.fixtures.trainings import QUICK, losses, make_resnets_shallow


def trainer(data: Path, out: Path, recipe: Recipe = QUICK, **options: object) -> tuple[Trainer, io.StringIO]:
    said = io.StringIO()
    options.setdefault("from_scratch", "init" not in options)
    return Trainer(open_dataset(data), out, recipe, console=Console(file=said, width=200), **options), said


@pytest.fixture(autouse=True)
def _shallow(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "real_run" not in request.fixturenames:
        make_resnets_shallow(monkeypatch)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("train") / "places", train=12, test=6)


# Sets shuffled on their own, and a warm-up of the loss that the cut falls into.
RELEASED = replace(
    RECIPES["released"],
    backbone="resnet18",
    last_layer="layer3",
    size=32,
    epochs=3,
    batch=4,
    warmup_epochs=2,
    warmup="loss",
    precision="float32",
)


def _run_one_epoch(run: Trainer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupt a run at the beginning of its second epoch."""
    original = Trainer._epoch

    def killed(self: Trainer, epoch: int, *rest: object) -> dict[str, float]:
        if epoch == 1:
            raise KeyboardInterrupt
        return original(self, epoch, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_epoch", killed)
        with pytest.raises(KeyboardInterrupt):
            run.run()


@pytest.mark.parametrize(
    "recipe",
    [QUICK, pytest.param(RELEASED, marks=pytest.mark.slow)],
    ids=["small", "released"],
)
def test_a_resumed_run_has_the_losses_of_an_uninterrupted_one(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recipe: Recipe
) -> None:
    trainer(places, tmp_path / "whole", recipe)[0].run()
    run, _ = trainer(places, tmp_path / "cut", recipe)
    _run_one_epoch(run, monkeypatch)
    assert len(losses(tmp_path / "cut")) == 1
    # This is the state after a kill between the writing of state and model.
    (tmp_path / "cut" / "last.safetensors").unlink()
    (tmp_path / "cut" / "log.csv").unlink()
    resumed, said = trainer(places, tmp_path / "cut", recipe, resume=True)
    heard: list[tuple[str, int, int]] = []
    with listening(lambda *told: heard.append(told)):
        resumed.run()
    told = [count for stage, *count in heard if re.fullmatch(r"Epoch [23]/3, loss [\d.]+, [\d.]+ images/s", stage)]
    n = resumed.steps
    second, third = ([[epoch * n + step, 3 * n] for step in range(1, n)] for epoch in (1, 2))
    assert told == [*second, [3 * n, 3 * n], *third, [3 * n, 3 * n]], "a bar goes at the end of an epoch"
    assert "after epoch 1 of 3" in said.getvalue()
    assert "drone-to-satellite: R@1" in said.getvalue()
    assert losses(tmp_path / "cut") == losses(tmp_path / "whole")
    one, two = (load_torch(tmp_path / run / "last.safetensors").network.state_dict() for run in ("cut", "whole"))
    assert all(torch.equal(one[key], two[key]) for key in one)


def test_a_bare_resume_takes_data_and_settings_from_the_folder(
    places: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, settings = tmp_path / "run", ["--recipe", "small", "--size", "32", "--batch", "4", "--precision", "float32"]
    given = ["train", "--data", str(places), "--out", str(out), "--from-scratch", *settings, "--epochs", "1"]
    assert main([*given, "--lr", "0.002", "--evaluate-every", "1"]) == 0
    assert main(["train", "--out", str(out), "--resume"]) == 0
    said = capsys.readouterr().out
    assert "Resuming after epoch 1 of 1." in said
    assert "so 3 updates, of which 0 are left." in said
    # The command without a setting that it had, and with another one.
    assert main([*given, "--resume"]) == 0
    assert main(["train", "--out", str(out), "--resume", "--lr", "0.1"]) == 2
    assert "was started with another lr" in capsys.readouterr().err
    with safe_open(str(out / "last.safetensors"), framework="pt") as file:
        run = json.loads(file.metadata()["run"])
    assert run["packages"]["torch"] == torch.__version__
    assert {"command", "version", "machine", "date"} <= set(run)
    assert str(tmp_path) not in json.dumps(run)
    with (out / "log.csv").open(encoding="utf-8") as log:
        (row,) = csv.DictReader(log)
    assert float(row["loss"]) == pytest.approx(float(row["loss instance"]) + float(row["loss infonce"]), rel=1e-6)


def test_the_documented_lines_of_python_train(places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[3] / "docs" / "training.md").read_text(encoding="utf-8")
    lines = re.findall(r"^    (.*)$", page.partition("## From Python")[2].partition("\n## ")[0], re.MULTILINE)
    save(small_worlds.make_network(), tmp_path / "resnet18.safetensors")
    code = "\n".join(lines).replace("ROOT", str(places))
    code = code.replace("epochs=10, size=160", "epochs=1, size=32, batch=4, precision='float32'")
    found: dict[str, Any] = {}
    exec(code, found)
    assert len(lines) <= 10
    assert lpn.load(found["model"]).views == ("satellite", "drone")
    assert [row["epoch"] for row in found["trainer"].history] == [1]
    # The command goes on with the settings of the folder.
    assert main(["train", "--data", str(places), "--out", "runs/first", "--resume"]) == 0


def test_init_auto_takes_the_weights_that_are_here_and_names_them(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(ModelFileError, match="no weights of resnet18 here"):
        trainer(places, tmp_path / "none", init=Path("auto"))
    torch.manual_seed(5)
    weights = backbone_of(ModelSpec("resnet18", "layer3")).state_dict()
    file = tmp_path / "checkpoints" / "resnet18-1a2b.pth"
    file.parent.mkdir()
    torch.save(weights, file)
    run, said = trainer(places, tmp_path / "run", init=Path("auto"))
    assert f"--init auto takes {file}, of torch's folder of weights." in said.getvalue()
    assert torch.equal(run.network.branch("drone").model.state_dict()["conv1.weight"], weights["conv1.weight"])


def test_runs_are_not_overwritten_or_mixed(places: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no state\.pt"):
        trainer(places, tmp_path / "run", resume=True)
    quick = replace(QUICK, epochs=1, weather=1.0)
    model = trainer(places, tmp_path / "run", quick)[0].run()
    with safe_open(str(model), framework="pt") as file:
        assert json.loads(file.metadata()["recipe"])["weather"] == 1.0
    with pytest.raises(InputError, match="add --resume"):
        trainer(places, tmp_path / "run", quick)
    (tmp_path / "run" / "state.pt").rename(tmp_path / "state.pt")
    with pytest.raises(InputError, match=r"last\.safetensors of a training run"):
        trainer(places, tmp_path / "run", quick)
    (tmp_path / "state.pt").rename(tmp_path / "run" / "state.pt")
    with pytest.raises(InputError, match="0 or more"):
        trainer(places, tmp_path / "new", quick, evaluate_every=-1)
    with pytest.raises(InputError, match="another epochs, weather"):
        trainer(places, tmp_path / "run", replace(quick, epochs=5, weather=0.5), resume=True)
    others = small_worlds.make_dataset(tmp_path / "others", train=13, test=1)
    with pytest.raises(InputError, match="other training pictures"):
        trainer(others, tmp_path / "run", quick, resume=True)
    (tmp_path / "run" / "state.pt").write_bytes(b"half")
    with pytest.raises(ModelFileError, match="damaged"):
        trainer(places, tmp_path / "run", quick, resume=True)


@pytest.mark.slow
def test_the_best_epoch_is_kept_beside_the_last(places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scores = iter([30.0, 50.0, 40.0])
    task = "drone-to-satellite"
    monkeypatch.setattr(TestSplit, "measure", lambda *_, **__: {f"recall@1 {task}": next(scores)})
    run, said = trainer(places, tmp_path / "run", evaluate_every=1)
    run.run()
    with safe_open(str(tmp_path / "run" / "best.safetensors"), framework="pt") as file:
        found = file.metadata()
    assert (found["epoch"], found["score"]) == ("2", "50.0000")
    assert "on the test split" in found["chosen by"]
    assert "best.safetensors is the model of epoch 2" in said.getvalue()
    best, last = (load_torch(tmp_path / "run" / f"{name}.safetensors") for name in ("best", "last"))
    assert best.fingerprint != last.fingerprint


def test_held_out_places_choose_and_are_not_trained_on(places: Path, tmp_path: Path) -> None:
    quick = replace(QUICK, epochs=1)
    run, said = trainer(places, tmp_path / "run", quick, evaluate_every=1, validate=0.25)
    assert (len(run.places), load_torch(run.run()).spec.classes) == (9, 9)
    assert isinstance(run.validator, HeldOut)
    held = {picture.label for picture in run.validator.pictures["drone"]}
    assert len(held) == 3
    assert held.isdisjoint(run.places.labels)
    assert "on 3 places held out of the training" in said.getvalue()
    with (tmp_path / "run" / "log.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert {"recall@1 drone-to-satellite held out", "recall@1 drone-to-satellite"} <= set(row)
    again, _ = trainer(places, tmp_path / "again", quick, evaluate_every=1, validate=0.25)
    assert again.places.labels == run.places.labels
    with pytest.raises(InputError, match="other training pictures"):
        trainer(places, tmp_path / "run", quick, evaluate_every=1, resume=True)
    for share in (-0.1, 0.01, 1.0, float("nan")):
        with pytest.raises(InputError, match="holds out at least 2 places and leaves at least 2"):
            trainer(places, tmp_path / "other", quick, evaluate_every=1, validate=share)
    with pytest.raises(InputError, match="--evaluate-every"):
        trainer(places, tmp_path / "other", quick, validate=0.25)


@pytest.mark.slow
def test_float16_and_its_scaler_are_resumed(places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learner, "choose_dtype", lambda *_: torch.float16)
    quick = replace(QUICK, epochs=1)
    run, said = trainer(places, tmp_path / "run", quick)
    run.learner.mixed_precision.scaler = torch.amp.GradScaler("cpu", init_scale=1024.0)
    run.run()
    assert "Computing in float16" in said.getvalue()
    resumed, _ = trainer(places, tmp_path / "run", quick, resume=True)
    assert resumed.learner.mixed_precision.scaler.get_scale() == 1024.0


@pytest.mark.parametrize(
    ("third", "said"),
    [
        (90.0, "rose to 90 on average, from 6 at the first step, in epoch 3.* of epoch 2; start again with a smaller"),
        (float("nan"), "loss became nan in epoch 3, step 1; .* of epoch 2"),
    ],
)
def test_a_loss_that_explodes_stops_with_a_sentence(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, third: float, said: str
) -> None:
    run, told = trainer(
        places, tmp_path / "run", replace(QUICK, precision="float16", schedule="step", decay_epoch=3, warmup_epochs=3)
    )
    values = iter([6.0] * 3 + [3.0, 40.0, 3.0] + [third] * 3)
    monkeypatch.setattr(run.learner, "step", lambda *_: ({"loss": torch.tensor(next(values))}, 0.1))
    with pytest.raises(InputError, match=said):
        run.run()
    assert "on cpu (float16 needs a CUDA device);" in told.getvalue()
    assert "never decays, as --decay-epoch is 3 and the training has 3 epochs." in told.getvalue()
    assert "The warm-up of 3 epochs fills the training of 3" in told.getvalue()


def test_weights_that_are_no_numbers_are_not_saved(places: Path, tmp_path: Path) -> None:
    run, _ = trainer(places, tmp_path / "run", replace(QUICK, epochs=1))
    step, left = run.learner.optimizer.step, [run.steps]

    def spoil_at_last(*_: object) -> None:
        step()
        left[0] -= 1
        if left[0] == 0:
            run.network.heads[0].add_block[0].bias.data.fill_(float("inf"))

    run.learner.optimizer.step = spoil_at_last
    with pytest.raises(InputError, match="A weight is no longer a number"):
        run.run()
    assert not (tmp_path / "run" / "last.safetensors").exists()


def test_init_from_a_whole_model_fills_its_backbone_and_no_head(places: Path, tmp_path: Path) -> None:
    save(small_worlds.make_network(), tmp_path / "init.safetensors")
    run, said = trainer(places, tmp_path / "run", init=tmp_path / "init.safetensors")
    plain, _ = trainer(places, tmp_path / "plain")
    assert "init.safetensors fills 54 of the backbone's 54 tensors.\n" in said.getvalue()
    for found, initial in zip(run.network.heads, plain.network.heads, strict=True):
        assert torch.equal(found.add_block[0].weight, initial.add_block[0].weight)
    _, said = trainer(
        places, tmp_path / "more", replace(QUICK, last_layer="layer4"), init=tmp_path / "init.safetensors"
    )
    assert "start from random values: layer4" in said.getvalue()
    with pytest.raises(LPNError, match="no model file"):
        trainer(places, tmp_path / "other", init=tmp_path / "absent.pth")


def test_each_view_is_a_batch_of_its_own_unless_joined(places: Path, tmp_path: Path) -> None:
    def embedded(joint: bool, other: Tensor) -> Tensor:
        recipe = replace(QUICK, joint_views=joint, dropout=0.0)
        run, _ = trainer(places, tmp_path / f"{joint}", recipe)
        run.network.train()
        satellite = torch.randn(4, 3, 64, 64, generator=torch.Generator().manual_seed(1))
        return run.learner.outputs({"satellite": satellite, "drone": other})["satellite"][0].detach()

    drone = torch.randn(4, 3, 64, 64, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(embedded(False, drone), embedded(False, 3 * drone + 1))
    assert not torch.allclose(embedded(True, drone), embedded(True, 3 * drone + 1))


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_step_benchmarks_convolutions_and_uses_tf32_in_mixed_precision_only(
    places: Path, tmp_path: Path, precision: str
) -> None:
    run, _ = trainer(places, tmp_path / "run", replace(QUICK, precision=precision))
    cudnn, found = torch.backends.cudnn, []
    before = (cudnn.enabled, cudnn.benchmark, cudnn.allow_tf32)
    record = lambda *_: found.append((cudnn.enabled, cudnn.benchmark, cudnn.allow_tf32))  # noqa: E731
    backbone = run.network.branch("drone").model.get_submodule("layer2")
    backbone.register_forward_pre_hook(record)
    backbone.register_full_backward_hook(record)
    with closing(run.loader.stream(0, 1)) as stream:
        run.network.train()
        run.learner.step(next(stream), 0, run.steps)
    assert found == [(True, True, precision != "float32")] * 2
    assert (cudnn.enabled, cudnn.benchmark, cudnn.allow_tf32) == before


def test_a_run_starts_from_given_weights_or_says_that_it_does_not(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="--init FILE, let --init auto find them, or say --from-scratch"):
        trainer(places, tmp_path / "run", from_scratch=False)
    save(small_worlds.make_network(), tmp_path / "init.safetensors")
    with pytest.raises(InputError, match="exclude each other"):
        trainer(places, tmp_path / "run", init=tmp_path / "init.safetensors", from_scratch=True)
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(InputError, match="lpn train is one process, and WORLD_SIZE is 2; start it without torchrun"):
        trainer(places, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_class_layers_begin_as_the_text_or_the_released_code_says(places: Path, tmp_path: Path) -> None:
    """Kaiming initialisation, fan_out over the places (section IV-B), or N(0, 0.001) (wtyhub/LPN model.py:23-27)."""
    for name, expected in (("kaiming", math.sqrt(2 / 12)), ("normal", 0.001)):
        run, _ = trainer(places, tmp_path / name, replace(QUICK, class_init=name))
        for head in run.network.heads:
            weight = head.classifier[0].weight
            assert weight.shape[0] == 12
            assert float(weight.detach().std()) == pytest.approx(expected, rel=0.1)
            assert not head.classifier[0].bias.any()


@pytest.mark.slow
def test_some_epochs_on_real_pictures_beat_the_untrained_network(real_run: RealRun) -> None:
    assert "fills 90 of the backbone's 90 tensors" in real_run.output
    dataset = open_dataset(real_run.data)
    before, after = (
        lazy_task(lpn.load(model), dataset, "drone-to-satellite").evaluate()
        for model in (real_run.before, real_run.after)
    )
    assert after.ap > before.ap + 5
