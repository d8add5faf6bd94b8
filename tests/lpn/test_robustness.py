"""Bad input of every kind, see docs/robustness.md, where no other test covers it."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

import lpn
from lpn import descriptors
from lpn.cli import main
from lpn.core.errors import LPNError, ModelFileError, PictureError, StoreError
from lpn.datasets import open_dataset
from lpn.models.checkpoints import load_torch, save
from lpn.models.onnx_engine import Engine
from tests.conftest import Refused
from tools.fixtures import small_worlds

NAMES = ("ä ö.png", "with space.png", "new\nline.png", "\U0001f6f0.png", "%s & <b>.png", "'quote\".png")


def test_names_of_any_kind_are_described(model_file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "pictures of\nmine"
    for i, name in enumerate(NAMES):
        small_worlds.write(tmp_path / "a.png", small_worlds.place(i))
        (folder / name).parent.mkdir(exist_ok=True)
        (tmp_path / "a.png").rename(folder / name)
    files = descriptors.pictures_below(folder)
    store = descriptors.describe(lpn.load(model_file), files, "drone", tmp_path / "store", root=folder)
    assert {row.file for row in descriptors.open_store(tmp_path / "store").rows} == set(NAMES)
    assert all("\n" not in picture.name for picture in open_dataset(folder).lists()["pictures"])
    assert len(store.descriptors) == len(NAMES)


def test_links_that_lead_nowhere_or_in_a_circle_are_named(model_file: Path, tmp_path: Path) -> None:
    root = small_worlds.make_dataset(tmp_path / "places", train=1, test=3)
    place = root / "test" / "gallery_satellite" / "0002"
    (place / "gone.png").symlink_to(tmp_path / "absent.png")
    (place / "circle.png").symlink_to(place / "circle.png")
    (root / "test" / "loop").symlink_to(root)
    files = descriptors.pictures_below(root / "test")
    assert len(files) == 3 * 4 + 2
    with pytest.raises(PictureError, match=r"circle\.png .*cannot be read"):
        descriptors.describe(lpn.load(model_file), files, "satellite", tmp_path / "store")
    tiles = open_dataset(root).gallery("satellite")
    with pytest.raises(LPNError, match=r"(circle|gone|absent)\.png"):
        descriptors.cached_descriptors(lpn.load(model_file), tiles, "satellite")
    assert main.main(["doctor", "--data", str(root)]) == 1


def test_one_place_is_too_few_to_train_on_and_says_nothing_when_tested(
    model_file: Path, tmp_path: Path, refused: Refused, caplog: pytest.LogCaptureFixture
) -> None:
    root = small_worlds.make_dataset(tmp_path / "one", train=1, test=1)
    out = tmp_path / "run"
    assert "at least two" in refused("train", "--data", root, "--out", out, "--recipe", "small", "--from-scratch")
    assert main.main(["evaluate", str(root), "--model", str(model_file)]) == 0
    assert "one place only" in caplog.text


def test_a_model_that_computes_nan_is_told_before_anything_is_kept(
    model_file: Path, tmp_path: Path, data: Path
) -> None:
    file, proto = tmp_path / "model.onnx", onnx.load_model(model_file)
    for weight in proto.graph.initializer:
        if weight.name == "bias" or weight.dims == [4, 512]:
            weight.CopyFrom(onnx.numpy_helper.from_array(np.full((4, 512), np.nan, np.float32), weight.name))
    del proto.metadata_props[[entry.key for entry in proto.metadata_props].index("seal")]
    file.write_bytes(proto.SerializeToString())
    files = descriptors.pictures_below(data / "test" / "query_drone")
    with pytest.raises(ModelFileError, match="not finite"):
        descriptors.describe(Engine(file), files, "drone", tmp_path / "store")
    with pytest.raises(StoreError):
        descriptors.open_store(tmp_path / "store")


def test_a_flipped_byte_is_found_in_every_file(
    model_file: Path, store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    for source in (model_file, model_file.with_suffix(".safetensors")):
        whole = source.read_bytes()
        for place in rng.integers(0, len(whole), 5):
            copy = tmp_path / source.name
            copy.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
            with pytest.raises(ModelFileError):
                lpn.load(copy)
    for file in (path for path in store.rglob("*") if path.is_file()):
        whole = file.read_bytes()
        for place in rng.integers(0, len(whole), 5):
            file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
            assert main.main(["doctor", str(store)]) == 1
            assert "DAMAGED" in capsys.readouterr().out
        file.write_bytes(whole)
    assert main.main(["doctor", str(store)]) == 0
    next(store.glob("*/rows.json")).unlink()
    assert main.main(["doctor", str(store)]) == 1
    torch.save({"weight": torch.randn(1000)}, tmp_path / "net.pth")
    whole = (tmp_path / "net.pth").read_bytes()
    (tmp_path / "net.pth").write_bytes(whole[:2000] + bytes([whole[2000] ^ 1]) + whole[2001:])
    with pytest.raises(ModelFileError, match="is damaged"):
        load_torch(tmp_path / "net.pth")


def test_files_of_earlier_versions_without_checksums_are_read(model_file: Path, tmp_path: Path) -> None:
    proto = onnx.load_model(model_file)
    del proto.metadata_props[[entry.key for entry in proto.metadata_props].index("seal")]
    (tmp_path / "old.onnx").write_bytes(proto.SerializeToString())
    assert Engine(tmp_path / "old.onnx").n_parts == 4
    from safetensors import safe_open
    from safetensors.torch import save_file

    with safe_open(str(model_file.with_suffix(".safetensors")), framework="pt") as file:
        metadata = {key: value for key, value in file.metadata().items() if key != "seal"}
        save_file({key: file.get_tensor(key) for key in file.keys()}, tmp_path / "old.safetensors", metadata)  # noqa: SIM118
    assert lpn.load(tmp_path / "old.safetensors").n_parts == 4
    assert main.main(["doctor", str(tmp_path)]) == 0


def test_an_onnx_that_reaches_for_other_files_is_not_opened(model_file: Path, tmp_path: Path) -> None:
    proto, file = onnx.load_model(model_file), tmp_path / "inner" / "model.onnx"
    weight = max(proto.graph.initializer, key=lambda one: len(one.raw_data))
    (tmp_path / "secret").write_bytes(weight.raw_data)
    file.parent.mkdir()
    weight.ClearField("raw_data")
    weight.data_location = onnx.TensorProto.EXTERNAL
    entry = weight.external_data.add()
    entry.key = "location"
    for place in ("../secret", "/etc/passwd"):
        entry.value = place
        file.write_bytes(proto.SerializeToString())
        with pytest.raises(ModelFileError, match=f"takes weights from '{place}', which is no file beside it"):
            Engine(file)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"partitions": '{"drone": {"n": 3}}'}, "has 3 parts; expected 4"),
        ({"partitions": '{"drone": {"kind": "hexagons"}}'}, "contradict each other"),
        ({"partitions": "[" * 10**5}, "contradict each other"),
        ({"views": "moon"}, "expected one to three of"),
        ({"format": "lpn-explorer-onnx/1"}, "not one written by"),
        ({"format": "lpn-explorer-onnx/1", "spec": '{"n_parts": 3}'}, "has 3 parts; expected 4"),
        ({"format": "lpn-explorer-onnx/1", "spec": '{"n_parts": 1000000000}'}, "n_parts"),
    ],
)
def test_an_onnx_whose_metadata_lie_is_refused(
    change: dict[str, str], word: str, model_file: Path, tmp_path: Path
) -> None:
    proto = onnx.load_model(model_file)
    metadata = {entry.key: entry.value for entry in proto.metadata_props if entry.key != "seal"}
    onnx.helper.set_model_props(proto, metadata | change)
    (tmp_path / "lies.onnx").write_bytes(proto.SerializeToString())
    with pytest.raises(ModelFileError, match=word):
        Engine(tmp_path / "lies.onnx")


def test_an_onnx_whose_shapes_lie_is_told_when_it_runs(tmp_path: Path) -> None:
    from tools.fixtures.small_models import SPEC, onnx_file

    proto = onnx.load_model_from_string(onnx_file(sealed=False))
    reshape = next(one for one in proto.graph.initializer if one.name == "mix")
    reshape.CopyFrom(onnx.numpy_helper.from_array(np.zeros((7, 3, 1, 1), np.float32), "mix"))
    (tmp_path / "lies.onnx").write_bytes(proto.SerializeToString())
    with pytest.raises(ModelFileError):
        Engine(tmp_path / "lies.onnx").descriptors(np.ones((1, 3, *SPEC.input_size), np.float32), "drone")


def test_a_checkpoint_that_claims_to_be_huge_takes_no_memory(tmp_path: Path) -> None:
    from dataclasses import replace

    network = small_worlds.make_network()
    network.spec = replace(network.spec, embedding=1 << 17, classes=1 << 24)
    save(network, tmp_path / "huge.safetensors")
    started = time.process_time()
    with pytest.raises(ModelFileError, match=r"huge\.safetensors"):
        load_torch(tmp_path / "huge.safetensors")
    assert time.process_time() - started < 20


def test_a_port_in_use_is_one_sentence(refused: Refused, model_file: Path, data: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        given = ["explore", data, "--model", model_file, "--port"]
        assert f"Port {port} on 127.0.0.1 is in use; give another" in refused(*given, port)
    assert "cannot be listened on" in refused(*given, 99999)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="/proc, where nobody can write, is Linux's")
@pytest.mark.parametrize("command", ["describe", "export", "export in 8 bits", "train", "index", "evaluate"])
def test_a_place_that_cannot_be_written_is_one_sentence_before_any_work(
    command: str, model_file: Path, data: Path, store: Path, refused: Refused
) -> None:
    model, checkpoint, there = model_file, model_file.with_suffix(".safetensors"), "/proc/lpn"
    given = {
        "describe": ["--model", model, "--images", data, "--view", "drone", "--out", there],
        "export": ["--model", checkpoint, "--out", f"{there}.onnx"],
        "export in 8 bits": ["--model", model, "--compute", "int8", "--data", data, "--out", f"{there}.onnx"],
        "train": ["--data", data, "--out", there, "--recipe", "small", "--batch", "2", "--from-scratch"],
        "index": ["--descriptors", store, "--out", there],
        "evaluate": ["--model", model, data, "--json", f"{there}.json"],
    }[command]
    assert "cannot be written" in refused(command.split()[0], *given)
    assert not os.path.exists(there)  # noqa: PTH110
