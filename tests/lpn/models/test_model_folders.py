"""A folder stands for the model in it, as released code chooses it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

import lpn
from lpn.cli import main
from lpn.core.errors import ModelFileError
from lpn.models.model_folders import file_in
from lpn.models.shipped import model_file as named_file
from tools.fixtures import small_worlds

# The files of a folder, and the one that is read.
CHOICES = {
    "the newest by number": (("net_9.pth", "net_019.pth", "net_119.pth", "opts.yaml", "train.jpg"), "net_119.pth"),
    "the last": (("net_119.pth", "net_last.pth"), "net_last.pth"),
    "beside other weights": (("net_039.pth", "optimizer.pth", "._net_119.pth"), "net_039.pth"),
    "the only one": (("weights_e1_0.9515.pth", "readme.md"), "weights_e1_0.9515.pth"),
    "beside what a training resumes from": (
        ("model.safetensors", "optimizer.pt", "scheduler.pt", "scaler.pt", "rng_state_0.pth", "training_args.bin"),
        "model.safetensors",
    ),
    "one of ours": (("best.safetensors", "last.safetensors", "state.pt", "log.csv"), "best.safetensors"),
    "the last of ours": (("last.safetensors", "state.pt"), "last.safetensors"),
    "an exported one": (("lpn.onnx", "lpn.street.onnx"), "lpn.onnx"),
    "one level deeper": (("three_view_long_share_d0.75_256_s1_google/net_119.pth", "notes.txt"), "*/net_119.pth"),
    "in the released code's folder": (
        ("model/lpn/net_079.pth", "model/lpn/net_119.pth", "train.py"),
        "model/lpn/net_119.pth",
    ),
    "a model in a folder before those below": (("net_119.pth", "old/net_019.pth"), "net_119.pth"),
}


def filled(folder: Path, names: tuple[str, ...]) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")
    return folder


@pytest.mark.parametrize("case", CHOICES)
def test_the_file_that_released_code_would_read(case: str, tmp_path: Path) -> None:
    names, expected = CHOICES[case]
    (chosen,) = filled(tmp_path / "run", names).glob(expected)
    assert file_in(tmp_path / "run") == chosen
    assert named_file(tmp_path / "run") == chosen


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        (("a/net_119.pth", "b/net_119.pth"), r"run holds 2 folders with models \(a, b\); name the one that is meant\."),
        (
            ("weights_e1_0.95.pth", "weights_end.pth"),
            r"run holds 2 models \(weights_e1_0\.95\.pth, weights_end\.pth\); name the file that is meant\.",
        ),
        (("lpn.onnx", "lpn.safetensors"), r"run holds 2 models \(lpn\.onnx, lpn\.safetensors\); name the file"),
        (("lpn.onnx", "lpn.v2.pth"), r"run holds 2 models \(lpn\.onnx, lpn\.v2\.pth\); name the file"),
        (("train.py", "a/b/c/net_119.pth"), r"run holds no model file \(net_\*\.pth, .*\); name the file, or the"),
    ],
)
def test_a_folder_that_leaves_it_open_names_what_it_holds(
    names: tuple[str, ...], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(ModelFileError, match=sentence):
        lpn.load(filled(tmp_path / "run", names))


def test_the_log_says_which_of_several_is_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file_in(filled(tmp_path, ("net_119.pth",)))
    assert not caplog.records
    file_in(filled(tmp_path, ("net_9.pth",)))
    assert [record.getMessage() for record in caplog.records] == [f"{tmp_path}/net_119.pth is the model that is read."]


def test_a_command_takes_a_folder_with_the_options_in_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "model" / "lpn"
    run.mkdir(parents=True)
    torch.save(small_worlds.make_network(seed=1).state_dict(), run / "net_019.pth")
    torch.save(small_worlds.make_network(seed=2).state_dict(), run / "net_119.pth")
    (run / "opts.yaml").write_text("h: 64\nw: 64\n")
    assert main.main(["doctor", "--model", str(tmp_path)]) == 0
    assert "n = 4, 64 x 64" in capsys.readouterr().out
    assert lpn.load(tmp_path).fingerprint == lpn.load(run / "net_119.pth").fingerprint


def test_the_name_of_a_shipped_model_comes_before_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    filled(tmp_path / "city-lpn", ("net_119.pth",))
    assert named_file("city-lpn").is_relative_to(Path(lpn.__file__).parents[1])
    assert named_file("./city-lpn") == Path("city-lpn/net_119.pth")
    shutil.move("city-lpn", "own-lpn")
    assert named_file("own-lpn") == Path("own-lpn/net_119.pth")
