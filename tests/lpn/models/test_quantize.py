from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest

import lpn
from lpn.cli import main
from lpn.core.errors import InputError, PictureError
from lpn.core.images import load_picture
from lpn.datasets import open_dataset
from lpn.models.checkpoints import save
from lpn.models.export import export
from lpn.models.lpn import LPN
from lpn.models.quantize import calibration_pictures, quantize
from lpn.models.spec import ModelSpec
from lpn.retrieval import describe_picture
from lpn.tasks.opening import lazy_task
from tests.conftest import RealRun, Refused
from tools.fixtures import seeded, small_worlds
from tools.fixtures.published_models import account_error, opened, small_denseuav


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
    assert set(agreement.cosines) == {"satellite", "drone"}
    assert min(agreement.cosines.values()) > 0.99
    assert (agreement.queries, agreement.gallery) == (6, 6)
    before, after = lpn.load(model_file), lpn.load(files[0])
    assert (before.precision, after.precision) == ("float32", "int8")
    assert before.fingerprint != after.fingerprint
    assert after.describe() == f"{before.describe()}, int8"
    picture = load_picture(open_dataset(data).queries("drone")[0].path)
    described = [describe_picture(model, picture, "drone").descriptor for model in (before, after)]
    assert 0 < np.abs(described[0] - described[1]).max() < 0.1


def test_calibration_pictures_are_spread_over_all_views(data: Path) -> None:
    dataset = open_dataset(data)
    chosen = calibration_pictures(dataset, ("satellite", "drone"), 5)
    assert [view for view, _ in chosen] == ["satellite"] * 3 + ["drone"] * 3
    drone = dataset.train("drone")
    assert [picture for view, picture in chosen if view == "drone"] == [drone[i] for i in (0, 2, 5)]
    with pytest.raises(InputError, match="no street pictures"):
        calibration_pictures(dataset, ("street",), 5)


def test_what_cannot_be_quantised_is_refused_in_words(
    data: Path, model_file: Path, int8_file: Path, tmp_path: Path
) -> None:
    dataset, small, smaller = open_dataset(data), tmp_path / "small.onnx", tmp_path / "smaller.onnx"
    quantize(model_file, dataset, small, 2)
    for model, out, pictures, least, said in (
        (model_file, model_file, 2, 0.9, "the model itself"),
        (model_file, tmp_path / "small.bin", 2, 0.9, r"ending in \.onnx"),
        (model_file, smaller, 0, 0.9, "at least one"),
        (model_file, smaller, 2, 2.0, "least cosine is 2.0; expected a number from -1 to 1"),
        (int8_file, smaller, 2, 0.9, "--storage float32"),
        (small, smaller, 2, 0.9, "already"),
    ):
        with pytest.raises(InputError, match=said):
            quantize(model, dataset, out, pictures, least)
    assert not smaller.exists()


def test_a_broken_calibration_picture_is_named(model_file: Path, tmp_path: Path) -> None:
    root = small_worlds.make_dataset(tmp_path / "places", train=2, test=2)
    broken = open_dataset(root).train("drone")[0].path
    broken.write_bytes(b"no picture")
    with pytest.raises(PictureError, match=broken.name):
        quantize(model_file, open_dataset(root), tmp_path / "small.onnx")
    assert not (tmp_path / "small.onnx").exists()


def test_the_command_says_how_close_it_is(
    data: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    out = tmp_path / "small.onnx"
    given = ["export", "--compute", "int8", "--out", str(out), "--pictures", "4", "--model"]
    assert main.main([*given, str(model_file), "--data", str(data)]) == 0
    said = capsys.readouterr().out
    assert "Wrote small.onnx" in said
    assert "satellite 0.9" in said
    assert "the same of 2 pictures first" in said
    assert "of 2 queries" in said
    of_onnx = lpn.load(out).fingerprint
    # A model that is not exported yet is exported first, with the same result.
    assert main.main([*given, str(model_file.with_suffix(".safetensors")), "--data", str(data)]) == 0
    assert lpn.load(out).fingerprint == of_onnx
    capsys.readouterr()
    before = out.read_bytes()
    for options, reason in (
        ([], "give a data set as --data"),
        (["--data", data, "--storage", "int8"], "leave --storage out"),
        (["--data", data, "--compute", "float32"], "belong to --compute int8; give it, or leave them out"),
    ):
        assert reason in refused(*given, model_file, *options)
    assert out.read_bytes() == before


@pytest.fixture(scope="module")
def transformer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exported vision transformer of one block."""
    folder = tmp_path_factory.mktemp("transformer")
    opened(small_denseuav(), folder, "h: 64\nw: 64\n")
    return export(folder / "net_119.pth", folder / "tokens.onnx")[0]


def test_a_transformer_s_linear_layers_compute_in_8_bits_and_its_account_stays_exact(
    transformer: Path, data: Path, tmp_path: Path
) -> None:
    model = transformer
    (file,), agreement = quantize(model, open_dataset(data), tmp_path / "small.onnx", 8)
    assert 0.98 < min(agreement.cosines.values()) < 1
    graph = onnx.load_model(file).graph
    makers = {name: node.op_type for node in graph.node for name in node.output}
    products = [node for node in graph.node if node.op_type in ("Conv", "MatMul", "Gemm")]
    ready = [node for node in products if {makers.get(name) for name in node.input[:2]} == {"DequantizeLinear"}]
    # The patches, the queries, keys, and values, the projection, and the two layers of the block, without the head.
    assert len(ready) == 5
    # Neither attention nor the residual stream is rounded.
    rounded = {makers.get(node.input[0]) for node in graph.node if node.op_type == "QuantizeLinear"}
    assert not rounded & {"Softmax", "Add"}
    before, after = lpn.load(model), lpn.load(file)
    assert (after.precision, after.contract) == ("int8", before.contract)
    firsts = []
    for one in (before, after):
        rows: dict[str, list[np.ndarray]] = {"satellite": [], "drone": []}
        for view, chosen in calibration_pictures(open_dataset(data), ("satellite", "drone"), 8):
            rows[view].append(describe_picture(one, load_picture(chosen.path), view).descriptor.ravel())
        firsts.append((np.stack(rows["drone"]) @ np.stack(rows["satellite"]).T).argmax(1))
    assert agreement.same_first == (firsts[0] == firsts[1]).mean()
    assert (agreement.queries, agreement.gallery) == (4, 4)
    picture = after.prepare(load_picture(open_dataset(data).queries("drone")[0].path), "drone")
    assert account_error(after, picture) < 1e-5
    assert np.abs(after.run(picture[None], "drone").parts - before.run(picture[None], "drone").parts).max() > 0


@pytest.mark.slow
def test_a_network_of_relu6_computes_in_8_bits_and_stays_exact(data: Path, tmp_path: Path) -> None:
    sizes = {"n_parts": 2, "embedding": 8, "classes": 3, "input_size": (64, 64)}
    made = LPN(ModelSpec("timm:tf_efficientnet_lite0", views=("satellite", "drone"), **sizes))
    backbone = made.branch("satellite").model
    backbone.load_state_dict(seeded.entries({key: list(value.shape) for key, value in backbone.state_dict().items()}))
    save(made, tmp_path / "lite.safetensors")
    export(tmp_path / "lite.safetensors", tmp_path / "lite.onnx")
    assert "Clip" in {node.op_type for node in onnx.load_model(tmp_path / "lite.onnx").graph.node}
    _, agreement = quantize(tmp_path / "lite.onnx", open_dataset(data), tmp_path / "small.onnx", 16)
    # 0.95 with each Clip in float32, as a convolution's output is then cut to 8 bits before it.
    assert min(agreement.cosines.values()) > 0.99
    ready, total = convolutions(tmp_path / "small.onnx")
    assert ready == total > 10
    picture, model = load_picture(open_dataset(data).queries("drone")[0].path), lpn.load(tmp_path / "small.onnx")
    assert account_error(model, model.prepare(picture, "drone")) < 1e-5


def test_a_model_that_8_bits_change_too_much_is_not_written(transformer: Path, data: Path, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"tokens\.onnx changes its \w+ descriptors: .* below 1, so nothing was"
    ) as said:
        quantize(transformer, open_dataset(data), tmp_path / "small.onnx", 4, least_cosine=1)
    assert "\n" not in str(said.value)
    assert not (tmp_path / "small.onnx").exists()


@pytest.mark.slow
def test_on_real_pictures_8_bits_cost_few_answers(real_run: RealRun, tmp_path: Path) -> None:
    """Rounding moves queries of either task both ways, and differs between processors, so both tasks count together."""
    dataset = open_dataset(real_run.data)
    quantize(real_run.exported, dataset, tmp_path / "small.onnx", 64)
    before, after = (
        [lazy_task(lpn.load(file), dataset, task).evaluate() for task in ("drone-to-satellite", "satellite-to-drone")]
        for file in (real_run.exported, tmp_path / "small.onnx")
    )
    queries = sum(one.queries for one in before)
    assert queries == 160
    lost = sum((one.recall["1"] - two.recall["1"]) * one.queries / 100 for one, two in zip(before, after, strict=True))
    assert lost <= 4.01
    assert abs(np.mean([one.ap for one in before]) - np.mean([one.ap for one in after])) < 2.5
