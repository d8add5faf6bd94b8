"""Files made to mislead a reader, and files that lost the part by which damage is told; see docs/robustness.md."""

from __future__ import annotations

import io
import shutil
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import onnx
import pytest
import torch

from lpn.cli import main
from lpn.core.errors import DataError, ModelFileError
from lpn.datasets.geo import read_positions
from lpn.datasets.integrity import DAMAGED, picture_error
from lpn.models.checkpoints import load_torch
from lpn.models.lpn import LPN
from lpn.models.onnx_engine import Engine
from lpn.models.options import read_options
from tests.conftest import Refused
from tools.fixtures import small_worlds


def verified(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    status = main.main(["doctor", str(path)])
    return status, capsys.readouterr().out


@pytest.mark.parametrize("name", ["model.onnx", "model.safetensors", "net.pth", "old.pth", "state.pt"])
def test_a_file_that_lost_its_checksum_is_no_whole_one(
    name: str, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The seal of an .onnx and the directory of a .pth are at the end, which is what a broken copy lacks."""
    file = tmp_path / name
    if name.startswith("model"):
        shutil.copy(model_file.with_suffix(file.suffix), file)
    else:
        torch.save({"a": torch.randn(1000)}, file, _use_new_zipfile_serialization=name != "old.pth")
    whole = file.read_bytes()
    assert verified(file, capsys)[0] == 0
    damaged = [whole[: len(whole) * 9 // 10], whole[:40], b"", b"not a model"]
    if (seal := whole.find(b"lpn-sha256:")) >= 0:
        damaged += [whole[:seal] + b"m" + whole[seal + 1 :], whole[: seal - 20]]
    for data in damaged:
        file.write_bytes(data)
        status, said = verified(tmp_path, capsys)
        assert status == 1, (len(data), said)
        assert f"DAMAGED: {file}: " in said


def test_a_damaged_file_is_named_in_one_line(
    tmp_path: Path, model_file: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    folder = tmp_path / "mine\nlpn: all is well"
    folder.mkdir()
    (folder / "model.onnx").write_bytes(model_file.read_bytes()[:-10])
    assert verified(folder, capsys)[1].count("\n") == 1
    assert refused("describe", "--model", folder / "none.onnx", "--images", "a", "--view", "drone", "--out", "b")


def _number(value: int) -> bytes:
    digits = [value >> shift & 127 for shift in range(0, max(value.bit_length(), 1), 7)]
    return bytes([*(digit | 128 for digit in digits[:-1]), digits[-1]])


@pytest.mark.parametrize("bit", [32, 34])
def test_an_onnx_whose_fields_have_two_numbers_is_not_opened(bit: int, model_file: Path, tmp_path: Path) -> None:
    """Protocol Buffers takes the low 32 bits of a key, so that this is a graph with weights in another file."""
    proto = onnx.load_model(model_file)
    weight = max(proto.graph.initializer, key=lambda one: len(one.raw_data))
    (tmp_path / "secret").write_bytes(weight.raw_data)
    weight.ClearField("raw_data")
    weight.data_location = onnx.TensorProto.EXTERNAL
    entry = weight.external_data.add()
    entry.key, entry.value = "location", "secret"
    del proto.metadata_props[[entry.key for entry in proto.metadata_props].index("seal")]
    graph = proto.graph.SerializeToString()
    proto.ClearField("graph")
    hidden = _number(7 << 3 | 2 | 1 << bit) + _number(len(graph)) + graph + proto.SerializeToString()
    (tmp_path / "model.onnx").write_bytes(hidden)
    with pytest.raises(ModelFileError, match="not an ONNX model"):
        Engine(tmp_path / "model.onnx")


def test_a_pth_that_unpacks_to_more_than_it_is_takes_no_memory(tmp_path: Path) -> None:
    whole = io.BytesIO()
    torch.save({"a": torch.zeros(5_000_000)}, whole)
    with zipfile.ZipFile(whole) as plain, zipfile.ZipFile(tmp_path / "bomb.pth", "w", zipfile.ZIP_DEFLATED) as packed:
        for name in plain.namelist():
            packed.writestr(name, plain.read(name))
    assert (tmp_path / "bomb.pth").stat().st_size < 100_000
    with pytest.raises(ModelFileError, match=r"claims to hold 20,\d\d\d,\d\d\d"):
        load_torch(tmp_path / "bomb.pth")


def test_a_pth_whose_tensors_repeat_one_number_takes_no_memory(tmp_path: Path) -> None:
    """As a safetensors file cannot: each tensor of these shapes has a single number behind it."""
    with torch.device("meta"):
        huge = LPN(replace(small_worlds.make_network().spec, embedding=1 << 17, n_parts=64, classes=2))
    state = {key: torch.zeros([1] * value.dim()).expand(value.shape) for key, value in huge.state_dict().items()}
    torch.save(state, tmp_path / "huge.pth")
    with pytest.raises(ModelFileError, match="claims to hold"):
        load_torch(tmp_path / "huge.pth")


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdef", "bcdefg", strict=True)
)


@pytest.mark.parametrize(
    "text", ["[" * 20_000, f"h: 0x{'f' * 9000}", BOMB + "h: *g", BOMB + "droprate: *g", "a: " + "x" * 200_000]
)
def test_options_of_any_kind_are_refused_in_one_sentence(text: str, tmp_path: Path) -> None:
    (tmp_path / "opts.yaml").write_text(text)
    started = time.process_time()
    with pytest.raises(ModelFileError, match=r"opts\.yaml") as refused:
        read_options(tmp_path / "opts.yaml")
    assert len(str(refused.value)) < 200
    assert time.process_time() - started < 20


def test_options_that_are_lists_are_no_reason_to_refuse(tmp_path: Path) -> None:
    (tmp_path / "opts.yaml").write_text(BOMB + "data_dir: *g\nname: two\nh: 384\n1: 2\n")
    read = read_options(tmp_path / "opts.yaml")
    assert (read["data_dir"], read["name"], read["h"]) == ("a list", "two", 384)
    assert 1 not in read


@pytest.mark.parametrize(
    "text",
    [
        '"a\nb\x1b[31m",x\n',
        "x" * 50_000 + "\n",
        'path,latitude,longitude\n"a\nb",1,2\n"a\nb",1,2\n',
        "path,latitude,longitude\na.jpg," + "9" * 100_000 + ",2\n",
    ],
)
def test_what_a_message_shows_of_a_file_of_positions_is_short_and_one_line(text: str) -> None:
    with pytest.raises(DataError) as refused:
        read_positions(text)
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 500


def test_a_png_that_claims_gigabytes_needs_no_room(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    file = tmp_path / "a.png"
    small_worlds.write(file, small_worlds.place(1))
    data = bytearray(file.read_bytes())
    place = data.index(b"IDAT") - 4
    data[place : place + 4] = b"\xff\xff\xff\xf0"
    file.write_bytes(data)
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (2 << 30), before[1]))
    try:
        assert picture_error(file, decode=True) == DAMAGED
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def test_a_model_of_many_epochs_without_its_state_is_not_trained_over(tmp_path: Path, refused: Refused) -> None:
    """Whoever copies a model to another machine and adds --resume must not lose it to a first epoch."""
    from lpn.models.checkpoints import save

    places = small_worlds.make_dataset(tmp_path / "places", train=3, test=2)
    out = tmp_path / "run"
    for extra in ({"epochs": "120"}, {}):
        save(small_worlds.make_network(), out / "last.safetensors", extra)
        kept = (out / "last.safetensors").read_bytes()
        told = refused("train", "--data", places, "--out", out, "--recipe", "small", "--batch", "2", "--resume")
        assert "state.pt" in told
        assert (out / "last.safetensors").read_bytes() == kept
