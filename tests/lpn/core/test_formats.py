"""Each kind of file names its format: a file of a later version is neither called damaged nor replaced."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import onnx
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from lpn import descriptors
from lpn.core.checksums import crc_of_values
from lpn.core.errors import DataError, InputError, LPNError, ModelFileError, StoreError
from lpn.core.formats import is_newer
from lpn.datasets import metadata
from lpn.descriptors import open_store
from lpn.index import DescriptorKind, create_index
from lpn.models.base import Model
from lpn.models.checkpoints import load_torch
from lpn.models.onnx_engine import Engine
from lpn.models.spec import ModelSpec
from lpn.reproduce.measure import FORMAT, MeasuredFigures, MeasurementStore
from lpn.training.recipes import RECIPES
from lpn.training.run_folder import Provenance, ResumeState, read_state

LATER = r"by a later version of lpn \(.*and this one knows .*\); install the newer version of lpn-explorer\.$"


def change(file: Path, to: Callable[[dict[str, Any]], object]) -> None:
    """Change the values of a JSON file."""
    values = json.loads(file.read_bytes())
    to(values)
    file.write_text(json.dumps(values))


def of_later(file: Path) -> None:
    def later(values: dict[str, Any]) -> None:
        kind, _, number = values["format"].partition("/")
        values["format"] = f"{kind}/{int(number) + 7}"
        values["unknown"] = [1]

    change(file, later)


@pytest.mark.parametrize(
    ("found", "newer"),
    [
        ("lpn-index/3", True),
        ("lpn-index/10", True),
        ("lpn-index/2", False),
        ("lpn-index/3b", False),
        ("lpn-index/²", False),
        ("lpn-index/" + "9" * 5000, False),
        ("lpn-other/3", False),
        (3, False),
    ],
)
def test_a_later_number_of_the_same_kind_is_newer(found: object, newer: bool) -> None:
    assert is_newer(found, "lpn-index/2") is newer


def test_a_later_store_is_neither_read_nor_replaced(store: Path, model: Model, data: Path) -> None:
    files = descriptors.pictures_below(data / "test" / "query_drone")
    of_later(store / "store.json")
    before = (store / "store.json").read_bytes()
    with pytest.raises(StoreError, match=r"store\.json in .* was written " + LATER):
        open_store(store)
    with pytest.raises(StoreError, match=LATER):
        create_index(store, DescriptorKind("0123456789abcdef", 2, 8))
    with pytest.raises(StoreError, match=LATER):
        descriptors.describe(model, files, "drone", store, root=data)
    assert (store / "store.json").read_bytes() == before
    (store / "store.json").unlink()
    (rows,) = store.glob("*/rows.json")
    of_later(rows)
    with pytest.raises(StoreError, match=r"rows\.json in .* was written " + LATER):
        descriptors.describe(model, files, "drone", store, root=data)
    assert rows.exists()


def test_later_model_files_are_named(model_file: Path, tmp_path: Path) -> None:
    proto = onnx.load_model(model_file)
    for entry in proto.metadata_props:
        entry.value = {"format": "lpn-explorer-onnx/3", "seal": "none"}.get(entry.key, entry.value)
    onnx.save_model(proto, tmp_path / "later.onnx")
    del proto.metadata_props[[entry.key for entry in proto.metadata_props].index("seal")]
    onnx.save_model(proto, tmp_path / "later.onnx")
    with pytest.raises(ModelFileError, match=r"later\.onnx was written " + LATER):
        Engine(tmp_path / "later.onnx")
    with safe_open(str(model_file.with_suffix(".safetensors")), "pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        told = {key: value for key, value in file.metadata().items() if key != "seal"}
    save_file(tensors, tmp_path / "later.safetensors", {**told, "format": "lpn-explorer/2"})
    with pytest.raises(ModelFileError, match=r"later\.safetensors was written " + LATER):
        load_torch(tmp_path / "later.safetensors")
    described = json.dumps({**json.loads(told["spec"]), "depth": 3})
    with pytest.raises(ModelFileError, match=r"an entry 'depth', which this version .* install the newer version"):
        ModelSpec.from_json(described)


def test_a_state_of_another_version_says_which_way(tmp_path: Path) -> None:
    recipe, file = RECIPES["small"], tmp_path / "state.pt"
    ResumeState([], 1.0, dict.fromkeys(("network", "average", "optimizer", "scaler"))).write(file, recipe, "places")
    assert read_state(file, recipe, "places").first_loss == 1.0
    values = torch.load(file, weights_only=True)
    for version in (99, None):
        torch.save({**values, "format": version}, file)
        with pytest.raises(ModelFileError, match=rf"has the format {version}, and this version of lpn knows \d"):
            read_state(file, recipe, "places")


def test_measurements_are_read_and_those_of_a_later_version_are_left_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "measured.json"
    made = Provenance("lpn reproduce table1", "0", "CPU, 1 cores", "2026-11-22")
    figures = {"key": {"values": [1.0, 2.0], "protocol": "As published.", "made": msgspec.structs.asdict(made)}}
    expected = {"key": MeasuredFigures((1.0, 2.0), "As published.", made)}
    checksum = crc_of_values([figures, {}])
    file.write_text(json.dumps({"format": FORMAT, "checksum": checksum, "figures": figures, "tables": {}}))
    assert MeasurementStore(file)._file.figures == expected
    assert not caplog.records
    change(file, lambda values: values["figures"]["key"].update(values=[3.0, 2.0]))
    assert MeasurementStore(file)._file.figures == {}
    assert "is damaged; its figures are measured again" in caplog.text
    of_later(file)
    with pytest.raises(InputError, match=r"measured\.json was written " + LATER):
        MeasurementStore(file)


def test_a_later_world_is_not_read(tmp_path: Path) -> None:
    from lpn.core.demo import DEMO

    shutil.copy(DEMO / "world.json", tmp_path)
    of_later(tmp_path / "world.json")
    with pytest.raises(LPNError, match=r"world\.json in .* was written " + LATER):
        metadata.columns(tmp_path, ["test/query_drone/0300/image-01.webp"])


@pytest.mark.parametrize(
    "plan", ["[" * 100_000, '{"districts": [{"number": 1e999}]}', '{"districts": [{"number": "one"}]}', "[]"]
)
def test_a_damaged_plan_of_a_world_is_one_sentence(plan: str, tmp_path: Path) -> None:
    (tmp_path / "world.json").write_text(plan)
    with pytest.raises(DataError, match=r"world\.json in .* is damaged or not the plan of .* world; render it again"):
        metadata.columns(tmp_path, ["test/query_drone/0300/image-01.webp"])


@pytest.mark.parametrize("held", ['{"key": {"values": [1' + "0" * 400 + '], "protocol": ""}}', "[" * 100_000])
def test_measurements_that_are_none_are_made_again(held: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "measured.json").write_text(held)
    assert MeasurementStore(tmp_path / "measured.json")._file.figures == {}
    assert "its figures are measured again" in caplog.text
