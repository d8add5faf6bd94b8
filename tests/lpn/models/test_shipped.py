"""Models that ship: their cards, and their names in place of files."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

import lpn
from lpn.cli import main
from lpn.core.demo import ASSETS, DEMO, DEMO_BASELINE, DEMO_MODEL
from lpn.core.errors import InputError, ModelFileError
from lpn.core.views import TaskName, views_of
from lpn.datasets import open_dataset
from lpn.descriptors import shipped_or_cached
from lpn.models import shipped
from lpn.models.export import export
from lpn.models.quantize import quantize
from lpn.models.shipped import ModelCard, model_cards, model_file
from lpn.retrieval import metrics


@pytest.mark.parametrize("card", model_cards(), ids=lambda card: card.name)
def test_a_card_names_its_files_and_the_source_of_each_figure(card: ModelCard) -> None:
    assert (shipped.CARDS / f"{card.name}.json").is_file()
    assert re.fullmatch(r"[a-z0-9-]+", card.name)
    assert card.file().suffix == ".onnx"
    assert card.size == card.file().stat().st_size > 0
    if card.trained:
        assert card.file(trained=True).suffix == ".safetensors"
        assert card.file(trained=True).stat().st_size > 0
    assert card.commands
    assert card.seeds
    assert card.limits
    for one in card.figures:
        assert one.command.startswith("lpn ")
        assert re.fullmatch("[0-9a-f]{7,40}", one.commit)
        assert {"R@1", "AP"} <= one.percent.keys() == card.figures[0].percent.keys()
        assert all(0 <= low <= value <= high <= 100 for value, low, high in one.percent.values())


def test_every_model_in_the_assets_has_a_card() -> None:
    files = {card.file(trained) for card in model_cards() for trained in (False, True) if card.trained or not trained}
    assert files == {path for suffix in (".onnx", ".safetensors") for path in ASSETS.rglob(f"*{suffix}")}


@pytest.mark.parametrize("card", model_cards(), ids=lambda card: card.name)
def test_the_figures_on_the_demo_are_those_of_its_shipped_descriptors(card: ModelCard) -> None:
    model, dataset, tried = lpn.load(card.name), open_dataset(DEMO), 0
    for one in card.figures:
        if one.data != "the demo":  # the calibrated figures need further descriptors
            continue
        task: TaskName = one.task
        views = views_of(task)
        sides = dataset.queries(views[0]), dataset.gallery(views[1])
        query, gallery = (
            shipped_or_cached(model, pictures, view, DEMO, role)
            for pictures, view, role in zip(sides, views, ("query", "gallery"), strict=True)
        )
        labels = [[picture.label for picture in side] for side in sides]
        found = metrics.evaluate(query, labels[0], gallery, labels[1])
        assert one.percent["R@1"][0] == pytest.approx(found["recall@1"], abs=1)  # these are of 8 bits
        assert one.percent["AP"][0] == pytest.approx(found["ap"], abs=1)
        tried += 1
    assert tried


def test_a_name_opens_the_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "city-lpn").mkdir()  # a folder is no model
    assert lpn.load("city-lpn").fingerprint == lpn.load(DEMO_MODEL).fingerprint
    assert lpn.load(Path("city-baseline")).fingerprint == lpn.load(DEMO_BASELINE).fingerprint
    assert model_file("city-lpn", trained=True) == DEMO_MODEL.with_suffix(".safetensors")
    with pytest.raises(ModelFileError, match=r"^city-baseline ships as an \.onnx alone, .*; give city-lpn\.$"):
        export("city-baseline", tmp_path / "model.onnx")


def test_a_file_of_that_name_in_the_working_folder_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(DEMO_MODEL, tmp_path / "city-lpn")
    assert model_file("city-lpn") == Path("city-lpn")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("city-lnp", r"file at city-lnp, and no model of that name ships; the nearest is city-lpn \(lpn models"),
        ("zzz", "no model of that name ships; lpn models lists city-baseline, city-lpn"),
        ("city-lnp.onnx", "There is no model file at city-lnp.onnx; check the path"),
        ("models/city-lpn", "There is no model file at models/city-lpn; check the path"),
    ],
)
def test_a_wrong_name_is_told_the_nearest(name: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match=message):
        lpn.load(name)
    if "." not in name and "/" not in name:
        with pytest.raises(ModelFileError, match=message):
            export(name, tmp_path / "model.onnx")
        with pytest.raises(ModelFileError, match=message):
            quantize(name, open_dataset(DEMO), tmp_path / "model.onnx")


def test_a_damaged_card_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shipped, "CARDS", tmp_path)
    model_cards.cache_clear()
    (tmp_path / "a.json").write_text('{"format": "lpn-model-card/1", "name": 5}')
    try:
        with pytest.raises(ModelFileError, match=r"The card a.json is damaged \(.*install lpn-explorer again"):
            model_cards()
    finally:
        model_cards.cache_clear()


def test_the_command_lists_the_cards_and_shows_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(["models", "--json", str(tmp_path / "all.json")]) == 0
    told = capsys.readouterr().out
    cards = json.loads((tmp_path / "all.json").read_bytes())
    assert [card["name"] for card in cards] == [card.name for card in model_cards()]
    for card in cards:
        assert card["name"] in told
        assert Path(card["file"]).stat().st_size == card["bytes"]
        assert main.main(["models", card["name"]]) == 0
        shown = capsys.readouterr().out
        for text in (card["summary"], *card["limits"], *card["commands"], card["figures"][0]["command"]):
            assert " ".join(text.split()) in " ".join(shown.split())
    assert main.main(["models", "city"]) == 2
    assert "No model of the name city ships; " in capsys.readouterr().err
    with pytest.raises(InputError, match="the nearest is city-lpn"):
        shipped.model_card("city-lpm")


@pytest.mark.skipif(
    shutil.which("make") is None or not (ASSETS.parent / "Makefile").is_file(), reason="needs a checkout and make"
)
@pytest.mark.parametrize(
    ("model", "beside", "torch"),
    [
        ("", "", False),
        *((card.name, "", False) for card in model_cards()),
        ("city-lpn", "city-baseline", False),
        ("city-lpn", "runs/lpn.onnx", False),
        ("city-lpn", "runs/last.safetensors", True),
        ("net_last.pth", "city-lpn", True),
        ("no-such-model", "", True),
    ],
)
def test_make_explore_installs_torch_for_models_alone_that_need_it(
    model: str, beside: str, torch: bool, tmp_path: Path
) -> None:
    given = [f"VENV={tmp_path / 'env'}", f"MODEL={model}", f"BESIDE={beside}"]
    done = subprocess.run(
        ["make", "-n", "explore", *given], cwd=ASSETS.parent, capture_output=True, text=True, check=True
    )
    assert "lpn explore" in done.stdout
    assert ("torch==" in done.stdout) == torch
