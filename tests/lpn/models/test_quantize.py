from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

import lpn
from lpn import explain
from lpn.cli import main
from lpn.core.errors import InputError, PictureError
from lpn.core.images import load_picture
from lpn.datasets import open_dataset
from lpn.models.checkpoints import save
from lpn.models.export import export
from lpn.models.network import LPN
from lpn.models.quantize import calibration_pictures, quantize
from lpn.models.spec import ModelSpec
from lpn.retrieval import describe_picture, evaluate, scoring
from tests.conftest import RealRun
from tools.fixtures import small_worlds


def convolutions(file: Path) -> tuple[int, int]:
    """How many convolutions of a graph read dequantised numbers, and how many it has."""
    graph = onnx.load_model(file).graph
    makers = {name: node.op_type for node in graph.node for name in node.output}
    nodes = [node for node in graph.node if node.op_type == "Conv"]
    ready = [node for node in nodes if {makers.get(name) for name in node.input[:2]} == {"DequantizeLinear"}]
    return len(ready), len(nodes)


def test_every_convolution_computes_in_8_bits_and_descriptors_stay(
    data: Path, model_file: Path, tmp_path: Path
) -> None:
    files, agreement = quantize(model_file, open_dataset(data), tmp_path / "small.onnx", 16)
    assert files == [tmp_path / "small.onnx"]
    ready, total = convolutions(files[0])
    assert ready == total > 10
    assert convolutions(model_file)[0] == 0
    assert set(agreement) == {"satellite", "drone"}
    assert min(agreement.values()) > 0.99
    before, after = lpn.load(model_file), lpn.load(files[0])
    assert (before.precision, after.precision) == ("float32", "int8")
    assert before.fingerprint != after.fingerprint
    assert after.describe() == f"{before.describe()}, int8"
    picture = load_picture(open_dataset(data).queries("drone")[0].path)
    described = [describe_picture(model, picture, "drone").descriptor for model in (before, after)]
    assert 0 < np.abs(described[0] - described[1]).max() < 0.1


def test_a_quantised_model_s_evidence_still_adds_up(data: Path, model_file: Path, tmp_path: Path) -> None:
    quantize(model_file, open_dataset(data), tmp_path / "small.onnx", 4)
    model, found = lpn.load(tmp_path / "small.onnx"), open_dataset(data)
    query, tile = (
        describe_picture(model, load_picture(entry.path), view)
        for entry, view in ((found.queries("drone")[0], "drone"), (found.gallery("satellite")[0], "satellite"))
    )
    assert query.trace is not None
    assert tile.trace is not None
    weights = scoring.part_weights(4)
    evidence = explain.evidence(query.trace, tile.trace, weights)
    score = float((query.descriptor * tile.descriptor).sum())
    assert sum(float(values.sum()) for values in evidence.part_sums) == pytest.approx(score, abs=1e-5)


@pytest.mark.slow
def test_views_with_weights_of_their_own_are_calibrated_by_their_own_pictures(data: Path, tmp_path: Path) -> None:
    torch.manual_seed(2)
    spec = ModelSpec("resnet18", "layer3", views=("satellite", "drone"), n_parts=2, shared=False, input_size=(64, 64))
    save(LPN(spec), tmp_path / "apart.safetensors")
    export(tmp_path / "apart.safetensors", tmp_path / "apart.onnx")
    files, agreement = quantize(tmp_path / "apart.onnx", open_dataset(data), tmp_path / "small.onnx", 6)
    assert [file.name for file in files] == ["small.onnx", "small.drone.onnx"]
    assert min(agreement.values()) > 0.98
    assert lpn.load(files[0]).precision == "int8"


def test_calibration_pictures_are_spread_over_all_views(data: Path) -> None:
    dataset = open_dataset(data)
    chosen = calibration_pictures(dataset, ("satellite", "drone"), 5)
    assert [view for view, _ in chosen] == ["satellite"] * 3 + ["drone"] * 3
    drone = dataset.train("drone")
    assert [picture for view, picture in chosen if view == "drone"] == [
        drone[0],
        drone[round((len(drone) - 1) / 2)],
        drone[-1],
    ]
    with pytest.raises(InputError, match="no street pictures"):
        calibration_pictures(dataset, ("street",), 5)


def test_what_cannot_be_quantised_is_refused_in_words(data: Path, model_file: Path, tmp_path: Path) -> None:
    dataset = open_dataset(data)
    with pytest.raises(InputError, match="the model itself"):
        quantize(model_file, dataset, model_file)
    with pytest.raises(InputError, match=r"ending in \.onnx"):
        quantize(model_file, dataset, tmp_path / "small.bin")
    with pytest.raises(InputError, match="at least one"):
        quantize(model_file, dataset, tmp_path / "small.onnx", 0)
    export(model_file.with_suffix(".safetensors"), tmp_path / "stored.onnx", "int8")
    with pytest.raises(InputError, match="--storage float32"):
        quantize(tmp_path / "stored.onnx", dataset, tmp_path / "small.onnx", 2)
    quantize(model_file, dataset, tmp_path / "small.onnx", 2)
    with pytest.raises(InputError, match="already"):
        quantize(tmp_path / "small.onnx", dataset, tmp_path / "smaller.onnx", 2)
    assert not (tmp_path / "smaller.onnx").exists()


def test_a_broken_calibration_picture_is_named(model_file: Path, tmp_path: Path) -> None:
    root = small_worlds.make_dataset(tmp_path / "places", train=2, test=2)
    broken = open_dataset(root).train("drone")[0].path
    broken.write_bytes(b"no picture")
    with pytest.raises(PictureError, match=broken.name):
        quantize(model_file, open_dataset(root), tmp_path / "small.onnx")
    assert not (tmp_path / "small.onnx").exists()


def test_the_command_says_how_close_it_is(
    data: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "small.onnx"
    given = ["--model", str(model_file), "--data", str(data), "--out", str(out), "--pictures", "4"]
    assert main.main(["quantize", *given]) == 0
    said = capsys.readouterr().out
    assert "Wrote small.onnx" in said
    assert "satellite 0.9" in said


@pytest.mark.slow
def test_on_real_pictures_8_bits_cost_at_most_one_query(real_run: RealRun, tmp_path: Path) -> None:
    dataset = open_dataset(real_run.data)
    quantize(real_run.exported, dataset, tmp_path / "small.onnx", 64)
    before, after = (
        evaluate.evaluate(lpn.load(file), dataset, "drone-to-satellite")
        for file in (real_run.exported, tmp_path / "small.onnx")
    )
    one = 100 / before.queries
    assert after.recall["1"] >= before.recall["1"] - one
    assert abs(after.ap - before.ap) < one
