from __future__ import annotations

import argparse
import collections
import os
import pathlib
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

import lpn
from lpn.core.errors import InputError, LPNError, ModelFileError
from lpn.models import checkpoints
from lpn.models.checkpoints import TorchModel, WeightType, exact_inference, load_backbone, load_torch, save
from lpn.models.lpn import LPN
from lpn.models.published_checkpoints import infer_spec
from lpn.models.spec import ModelSpec
from tools.fixtures import seeded, small_worlds


@pytest.mark.parametrize("case", ["n4", pytest.param("n1_baseline", marks=pytest.mark.slow)])
def test_published_checkpoint_gives_the_published_descriptors(case: str, tmp_path: Path) -> None:
    published = np.load(seeded.DATA / f"parity_{case}.npz")
    torch.save(seeded.state_dict(case), tmp_path / "net_119.pth")
    model = lpn.load(tmp_path / "net_119.pth")
    batch = seeded.pictures(7, 2, 256, 256)
    # The published arrays are (B, D, n), parts last.
    raw = model.part_embeddings(torch.from_numpy(batch), "drone").transpose(0, 2, 1).reshape(published["raw"].shape)
    assert np.abs(raw - published["raw"]).max() <= 1e-4 * np.abs(published["raw"]).max()
    found = model.descriptors(batch, "drone").transpose(0, 2, 1).reshape(published["descriptor"].shape)
    assert np.abs(found - published["descriptor"]).max() <= 1e-4 * np.abs(published["descriptor"]).max()
    assert model.views == ("satellite", "street", "drone")
    assert (model.n_parts, model.input_size) == (4 if case == "n4" else 1, (256, 256))


@pytest.mark.parametrize(
    "spec",
    [
        pytest.param(
            ModelSpec("vgg16_bn", views=("satellite", "street"), shared=False, n_parts=8, layout="cvusa", classes=5),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ModelSpec("resnet50", views=("satellite", "street"), shared=False, n_parts=4, layout="cvusa", classes=5),
            marks=pytest.mark.slow,
        ),
        ModelSpec("resnet18", views=("satellite", "street", "drone"), n_parts=6, classes=5),
        ModelSpec("resnet18", "layer3", views=("satellite",), shared=False, n_parts=1, classes=5),
    ],
    ids=lambda spec: f"{spec.backbone}-{len(spec.views)}",
)
def test_architecture_is_told_from_the_keys_and_survives_saving(spec: ModelSpec, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = LPN(spec)
    torch.save({f"module.{k}": v for k, v in network.state_dict().items()}, tmp_path / "net_last.pth")
    (tmp_path / "opts.yaml").write_text("h: 64\nw: 64\nstride: 1\npool: avg\ndroprate: 0.5\nLPN: true\n")
    published = load_torch(tmp_path / "net_last.pth")
    told = published.spec
    assert (told.backbone, told.last_layer, told.views, told.shared) == (
        spec.backbone,
        spec.last_layer,
        spec.views,
        spec.shared,
    )
    assert (told.n_parts, told.layout, told.input_size) == (spec.n_parts, spec.layout, (64, 64))
    save(network, tmp_path / "model.safetensors")
    ours = lpn.load(tmp_path / "model.safetensors")
    batch = seeded.pictures(1, 1, 64, 64)
    for view in spec.views:
        np.testing.assert_array_equal(ours.part_embeddings(batch, view), published.part_embeddings(batch, view))
    assert not list(tmp_path.glob("*.part"))


def test_cvusa_pairs_the_outer_ring_with_the_top_strip() -> None:
    spec = ModelSpec("vgg16_bn", views=("satellite", "street"), shared=False, n_parts=8, layout="cvusa")
    satellite, street = spec.partition("satellite"), spec.partition("street")
    assert satellite.labels(16, 16)[0, 0] == 0
    assert satellite.labels(16, 16)[8, 8] == 7
    assert street.labels(8, 8)[0, 0] == 0
    assert not satellite.align_corners


class _Attack:
    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> Any:
        return Path.touch, (self.target,)


def _refused(path: Path) -> str:
    with pytest.raises(ModelFileError) as caught:
        lpn.load(path)
    message = str(caught.value)
    assert "\n" not in message
    assert "Traceback" not in message
    return message


def test_pickled_code_is_refused_and_does_not_run(tmp_path: Path) -> None:
    torch.save({"model_1.model.conv1.weight": _Attack(tmp_path / "ran")}, tmp_path / "net.pth")
    assert "run code" in _refused(tmp_path / "net.pth")
    (tmp_path / "plain.pth").write_bytes(pickle.dumps(_Attack(tmp_path / "ran")))
    _refused(tmp_path / "plain.pth")
    assert not (tmp_path / "ran").exists()


def test_files_that_are_not_models_get_one_sentence(tmp_path: Path, model_file: Path) -> None:
    assert "no model file" in _refused(tmp_path / "absent.pth")
    safetensors = model_file.with_suffix(".safetensors")
    torch.save(small_worlds.make_network().state_dict(), tmp_path / "whole.pth")
    for name, source in (
        ("cut.pth", tmp_path / "whole.pth"),
        ("cut.safetensors", safetensors),
        ("cut.onnx", model_file),
    ):
        content = source.read_bytes()
        for length in (0, 10, len(content) // 2, len(content) - 100):
            (tmp_path / name).write_bytes(content[:length])
            _refused(tmp_path / name)
    for name in ("text.pth", "text.safetensors", "text.onnx"):
        (tmp_path / name).write_text("hello")
        _refused(tmp_path / name)
    torch.save([1, 2], tmp_path / "list.pth")
    assert "state_dict" in _refused(tmp_path / "list.pth")
    torch.save({"weight": torch.zeros(2)}, tmp_path / "other.pth")
    assert "not a checkpoint of a known model: it holds weight" in _refused(tmp_path / "other.pth")


def test_missing_and_misshapen_entries_are_named(tmp_path: Path) -> None:
    state = small_worlds.make_network().state_dict()
    lacking = {k: v for k, v in state.items() if k != "classifier2.add_block.1.running_mean"}
    torch.save(lacking, tmp_path / "lacking.pth")
    assert "classifier2.add_block.1.running_mean" in _refused(tmp_path / "lacking.pth")
    torch.save({k: v for k, v in state.items() if not k.startswith("classifier1.")}, tmp_path / "headless.pth")
    assert "classifier0, classifier2, classifier3" in _refused(tmp_path / "headless.pth")
    last = {k: v for k, v in state.items() if k != "classifier3.add_block.0.weight"}
    torch.save(last, tmp_path / "last.pth")
    assert "classifier3.add_block.0.weight" in _refused(tmp_path / "last.pth")
    torch.save(dict(state) | {"classifier0.add_block.0.weight": torch.tensor(1.0)}, tmp_path / "scalar.pth")
    assert "classifier0.add_block.0.weight" in _refused(tmp_path / "scalar.pth")
    wrong = dict(state) | {"classifier0.add_block.0.weight": torch.zeros(512, 99)}
    torch.save(wrong, tmp_path / "wrong.pth")
    assert "(512, 99)" in _refused(tmp_path / "wrong.pth")


def test_options_that_contradict_the_keys_are_refused(tmp_path: Path) -> None:
    state: dict[str, Tensor] = small_worlds.make_network().state_dict()
    for options, word in (({"LPN": True, "block": 6}, "block: 6"), ({"pool": "max"}, "pool: max")):
        with pytest.raises(ModelFileError, match=word):
            infer_spec(state, options)
    torch.save(state, tmp_path / "net.pth")
    for text in ("{: :", "h: tall\n", "stride: true\n", "droprate: high\n", "- h\n"):
        (tmp_path / "opts.yaml").write_text(text)
        assert "opts.yaml" in _refused(tmp_path / "net.pth")
    (tmp_path / "opts.yaml").write_text("")
    assert lpn.load(tmp_path / "net.pth").input_size == (256, 256)


def test_the_same_weights_read_with_other_options_are_another_model(tmp_path: Path) -> None:
    torch.save(small_worlds.make_network().state_dict(), tmp_path / "net.pth")
    large = lpn.load(tmp_path / "net.pth").fingerprint
    (tmp_path / "opts.yaml").write_text("h: 64\nw: 64\n")
    assert lpn.load(tmp_path / "net.pth").fingerprint != large


def test_a_backbone_is_loaded_as_far_as_it_goes(tmp_path: Path) -> None:
    source = small_worlds.make_network(seed=1).branch("drone").model.state_dict()
    torch.save({k: v for k, v in source.items() if not k.startswith("layer3.")}, tmp_path / "backbone.pth")
    network = small_worlds.make_network(seed=2)
    filled, total, missing = load_backbone(network, tmp_path / "backbone.pth")
    assert 0 < filled < total
    assert missing == ["layer3"]
    torch.testing.assert_close(network.branch("satellite").model.state_dict()["conv1.weight"], source["conv1.weight"])
    torch.save({"a": torch.zeros(1)}, tmp_path / "nothing.pth")
    with pytest.raises(LPNError, match=r"Nothing in nothing\.pth fits"):
        load_backbone(network, tmp_path / "nothing.pth")


@pytest.mark.parametrize(("storage", "share"), [("float16", 0.45), ("int8", 0.35)])
def test_a_model_in_fewer_bits_is_small_and_opens_and_fills_a_backbone(
    storage: WeightType, share: float, tmp_path: Path
) -> None:
    network = small_worlds.make_network(classes=300)
    whole, small = tmp_path / "whole.safetensors", tmp_path / "small.safetensors"
    save(network, whole)
    save(network, small, storage=storage)
    assert small.stat().st_size / whole.stat().st_size < share
    pictures = seeded.pictures(1, 2, 64, 64)
    found, expected = (lpn.load(file).descriptors(pictures, "drone") for file in (small, whole))
    assert 0 < np.abs(found - expected).max() < 5e-2 * np.abs(expected).max()
    other = small_worlds.make_network(n_parts=1, seed=1)
    heads = [head.add_block[0].weight.detach().clone() for head in other.heads]
    filled, total, missing = load_backbone(other, small)
    assert (filled, missing) == (total, [])
    for name, tensor in other.branch("drone").model.state_dict().items():
        own = network.branch("drone").model.state_dict()[name]
        step = 0.0 if own.ndim < 2 else 2**-11 if storage == "float16" else 0.5 / 127
        largest = own.abs().amax(tuple(range(1, own.ndim)), keepdim=True) if own.ndim > 1 else own
        assert bool(((tensor - own).abs() <= 1.01 * step * largest.abs()).all())
    assert all(torch.equal(head.add_block[0].weight, before) for head, before in zip(other.heads, heads, strict=True))
    network.heads[0].add_block[0].weight.data.fill_(7e4)
    with pytest.raises(InputError, match=rf"classifier0\.add_block\.0\.weight are too large for {storage}"):
        save(network, tmp_path / "large.safetensors", storage=storage)
    assert not (tmp_path / "large.safetensors").exists()


@pytest.mark.parametrize("fault", ["no kernels", "floats", "shape"])
def test_scales_that_fit_no_kernels_are_refused(fault: str, tmp_path: Path) -> None:
    tensors = {"model.weight": torch.ones(2, 3, 1, 1, dtype=torch.int8), "model.weight.scale": torch.ones(2, 1, 1, 1)}
    if fault == "no kernels":
        del tensors["model.weight"]
    elif fault == "floats":
        tensors["model.weight"] = torch.ones(2, 3, 1, 1)
    else:
        tensors["model.weight.scale"] = torch.ones(3, 1, 1, 1)
    save_file(tensors, tmp_path / "m.safetensors")
    with pytest.raises(ModelFileError, match=r"In m\.safetensors, model\.weight\.scale scales no kernels of 8 bits"):
        checkpoints.check_opens(tmp_path / "m.safetensors")


def test_complex_weights_are_refused_and_not_cut_to_real_ones(tmp_path: Path) -> None:
    save_file({"model.conv1.weight": torch.ones(2, 3, 1, 1, dtype=torch.complex64)}, tmp_path / "m.safetensors")
    with pytest.raises(ModelFileError, match=r"In m\.safetensors, model\.conv1\.weight is complex; give the weights"):
        lpn.load(tmp_path / "m.safetensors")


def test_equal_networks_give_equal_files(tmp_path: Path) -> None:
    network = small_worlds.make_network()
    files = [tmp_path / f"{copy}.safetensors" for copy in range(6)]
    for file in files:
        # The writer puts five entries into another order each time: by chance all are alike once in 120^5 times.
        save(network, file, {name: name for name in ("recipe", "figures", "epochs")})
    assert len({file.read_bytes() for file in files}) == 1
    length = int.from_bytes(files[0].read_bytes()[:8], "little")
    assert length % 8 == 0


def _cudnn() -> tuple[bool, bool, bool]:
    cudnn = torch.backends.cudnn
    return cudnn.enabled, cudnn.benchmark, cudnn.allow_tf32


def test_inference_leaves_cudnn_on_and_its_tf32_off(monkeypatch: pytest.MonkeyPatch) -> None:
    before = _cudnn()
    with exact_inference():
        assert _cudnn() == (True, False, False)
        assert torch.is_inference_mode_enabled()
    assert _cudnn() == before
    model, found = TorchModel(small_worlds.make_network()), []
    embed = model.network.embed
    monkeypatch.setattr(model.network, "embed", lambda *given: found.append(_cudnn()) or embed(*given))
    model.run(seeded.pictures(1, 2, 64, 64), "drone")
    model.descriptors(seeded.pictures(1, model.batch, 64, 64), "drone", mirror=False)
    assert found == [(True, False, False)] * 2  # each thread would time the algorithms for a full batch of its own
    assert _cudnn() == before


def test_descriptors_bring_only_parts_back_from_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    model, pictures = TorchModel(small_worlds.make_network()), seeded.pictures(1, 3, 64, 64)
    expected = model.run(pictures, "drone")
    copied: list[tuple[int, ...]] = []
    cpu = Tensor.cpu
    monkeypatch.setattr(Tensor, "cpu", lambda self: copied.append(tuple(self.shape)) or cpu(self))
    np.testing.assert_array_equal(model.part_embeddings(pictures, "drone"), expected.parts)
    assert copied == [expected.parts.shape]
    copied.clear()
    model.run(pictures, "drone")
    assert copied == [expected.parts.shape, expected.features.shape]


def _same(path: Path, state: dict[str, Tensor], tmp_path: Path) -> None:
    """Check that a file opens with the descriptors of a state dict that was saved alone."""
    torch.save(state, tmp_path / "alone.pth")
    batch = seeded.pictures(1, 1, 64, 64)
    found, expected = (lpn.load(file).descriptors(batch, "drone") for file in (path, tmp_path / "alone.pth"))
    np.testing.assert_array_equal(found, expected)


# What trainings save beside or around the weights.
WRAPS: dict[str, Any] = {
    "a number of NumPy": lambda state: {"epoch": 119, "state_dict": state, "best_acc": np.float64(0.75)},
    "other numbers of NumPy": lambda state: {
        "model": state,
        "best": {np.int64(3): np.float32(0.5), "text": np.str_("a"), "truth": np.bool_(True), "half": np.float16(1)},
        "type": np.dtype("f4"),
        "kind": np.float32,
        "random": ("MT19937", np.arange(624, dtype=np.uint32), 624, 0, 0.0),
        "objects": np.array([None, "a"], object),
    },
    "types of torch": lambda state: {
        "model_state_dict": state,
        "size": torch.Size([2]),
        "device": torch.device("cuda:0"),
        "dtype": torch.bfloat16,
    },
    "DataParallel": lambda state: {"model": {f"module.{key}": value for key, value in state.items()}},
    "Lightning": lambda state: {
        "pytorch-lightning_version": "2.1.0",
        "state_dict": {f"model.{key}": value for key, value in state.items()},
        "optimizer_states": [{"state": {0: {"exp_avg": torch.zeros(3)}}, "param_groups": []}],
        "hyper_parameters": {"lr": 0.1},
    },
    "an optimizer": lambda state: {
        "net": state,
        "optimizer": {"state": {0: {"momentum_buffer": torch.zeros(3)}}, "param_groups": [{"lr": 0.1}]},
    },
    "its average": lambda state: {"ema": {key: value + 1 for key, value in state.items()}, "params": state},
    "an average alone": lambda state: {"state_dict_ema": state},
    "model_state": lambda state: {"model_state": state},
    "nested": lambda state: {"checkpoint": 3, "model": {"state_dict": state, "name": "lpn"}},
    "numbers between the tensors": lambda state: {**state, "epoch": 119, "best": np.float64(0.5)},
}


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Tensor], np.ndarray]:
    """A state dict, and the descriptors of a file that holds it alone."""
    file = tmp_path_factory.mktemp("plain") / "alone.pth"
    state = small_worlds.make_network().state_dict()
    torch.save(state, file)
    return state, lpn.load(file).descriptors(seeded.pictures(1, 1, 64, 64), "drone")


@pytest.mark.parametrize("how", WRAPS)
def test_what_a_training_saves_opens_by_its_weights(
    how: str, plain: tuple[dict[str, Tensor], np.ndarray], tmp_path: Path
) -> None:
    state, expected = plain
    for form in ("new", "legacy"):
        file = tmp_path / f"{form}.pth"
        torch.save(WRAPS[how](state), file, _use_new_zipfile_serialization=form == "new")
        found = lpn.load(file).descriptors(seeded.pictures(1, 1, 64, 64), "drone")
        np.testing.assert_array_equal(found, expected, form)


@pytest.mark.parametrize("module", ["numpy.core.multiarray", "numpy._core.multiarray"])
def test_a_number_of_either_numpy_is_passed_over(module: str, tmp_path: Path) -> None:
    """NumPy 2 renamed the module that pickles of numbers name."""
    state = small_worlds.make_network().state_dict()
    torch.save(
        {"state_dict": state, "best": np.float64(0.5)}, tmp_path / "net.pth", _use_new_zipfile_serialization=False
    )
    data = (tmp_path / "net.pth").read_bytes()
    own = np.float64(0.5).__reduce__()[0].__module__
    assert f"c{own}\n".encode() in data
    (tmp_path / "net.pth").write_bytes(data.replace(f"c{own}\n".encode(), f"c{module}\n".encode()))
    _same(tmp_path / "net.pth", state, tmp_path)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_weights_of_another_precision_open(dtype: torch.dtype, tmp_path: Path) -> None:
    state = {
        key: value.to(dtype) if value.is_floating_point() else value
        for key, value in small_worlds.make_network().state_dict().items()
    }
    torch.save(state, tmp_path / "net.pth")
    _same(tmp_path / "net.pth", {key: value.to(torch.get_default_dtype()) for key, value in state.items()}, tmp_path)


@pytest.mark.parametrize("how", ["compressed", "no folder", "a folder more"])
def test_a_file_that_was_packed_again_opens_as_torch_packs_it_alone(how: str, tmp_path: Path) -> None:
    state = small_worlds.make_network().state_dict()
    torch.save(state, tmp_path / "net.pth")
    with (
        zipfile.ZipFile(tmp_path / "net.pth") as source,
        zipfile.ZipFile(tmp_path / "again.pth", "w", zipfile.ZIP_DEFLATED) as target,
    ):
        for name in source.namelist():
            own = {"no folder": name.partition("/")[2], "a folder more": f"download/{name}"}
            target.writestr(own.get(how, name), source.read(name))
    if how == "compressed":
        _same(tmp_path / "again.pth", state, tmp_path)
        return
    with pytest.raises(ModelFileError, match=r"is not a PyTorch file: .* unpack it if it is an archive"):
        lpn.load(tmp_path / "again.pth")


def test_weights_of_several_names_are_read_by_the_first_and_the_log_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state = small_worlds.make_network().state_dict()
    torch.save({"ema": state, "model": state, "epoch": 3}, tmp_path / "net.pth")
    (tmp_path / "opts.yaml").write_text("h: 64\nw: 64\n")
    lpn.load(tmp_path / "net.pth")
    assert [record.getMessage() for record in caplog.records] == [
        "net.pth holds weights as model, ema; those of model are read."
    ]


class _Net(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(2, 2)


class _Config:
    """A class of a package of somebody else."""


MORE: dict[str, tuple[Any, str]] = {
    "namespace": (lambda state: {"model": state, "args": argparse.Namespace(lr=0.01)}, "argparse.Namespace"),
    "defaultdict": (lambda state: {"net": state, "log": collections.defaultdict(list)}, "collections.defaultdict"),
    "a path": (
        lambda state: {"weights": state, "out": pathlib.PosixPath("runs")},
        f"{pathlib.PosixPath.__module__}.PosixPath",
    ),
    "a class": (lambda state: {"state_dict": state, "config": _Config()}, f"{__name__}._Config"),
    "a network": (lambda _: _Net(), f"{__name__}._Net"),
    "a network among others": (lambda _: {"model": _Net(), "best": np.float64(0.5)}, f"{__name__}._Net"),
}


@pytest.mark.parametrize("case", MORE)
def test_a_file_of_more_than_tensors_is_refused_with_what_it_names(case: str, tmp_path: Path) -> None:
    value, name = MORE[case]
    for form in (True, False):
        torch.save(value({"a": torch.ones(2)}), tmp_path / "net.pth", _use_new_zipfile_serialization=form)
        assert _refused(tmp_path / "net.pth") == (
            f"net.pth holds more than tensors: it names {name}, which may run code, so it was not opened; save the network's "
            "state_dict by torch.save where it was trained."
        )


def test_a_program_in_a_file_does_not_run(tmp_path: Path) -> None:
    class Runs:
        def __reduce__(self) -> Any:
            return os.system, (f"touch {tmp_path}/ran",)

    for how in ({}, {"_use_new_zipfile_serialization": False}, {"pickle_protocol": 4}):
        torch.save({"state_dict": {"a": torch.ones(2)}, "args": Runs()}, tmp_path / "net.pth", **how)  # type: ignore[arg-type]
        assert "so it was not opened; " in _refused(tmp_path / "net.pth")
        if "pickle_protocol" not in how:
            assert f"it names {os.name}.system, which may run code" in _refused(tmp_path / "net.pth")
        assert not (tmp_path / "ran").exists()


@pytest.mark.filterwarnings("ignore:.*torch.jit")
def test_what_holds_no_weights_says_what_it_holds(tmp_path: Path) -> None:
    file = tmp_path / "net.pth"
    for value, sentence in (
        ({"state": {}, "param_groups": [{"lr": 0.1}]}, "net.pth holds state, param_groups; expected one state_dict of"),
        (
            {"epoch": 3, "loss": 0.5},
            "net.pth holds epoch, loss; expected one state_dict of named tensors, so save the network's state_dict by torch.save",
        ),
        ({"a": np.ones((2, 2), np.float32)}, "net.pth holds a; expected one state_dict of named tensors"),
        (
            {"generator": {"a": torch.ones(2)}, "critic": {"a": torch.ones(2)}},
            "net.pth holds generator, critic; expected one",
        ),
        ({}, "net.pth holds nothing; expected"),
        (torch.zeros(3), "net.pth holds a Tensor; expected one state_dict of named tensors"),
        ({3: torch.zeros(3)}, "net.pth holds 3; expected"),
        (
            {"a": torch.zeros(3).to_sparse()},
            "In net.pth, a is no plain tensor but quantised, sparse, complex, or without values; give",
        ),
    ):
        torch.save(value, file)
        assert _refused(file).startswith(sentence)
    looped: dict[str, Any] = {}
    looped["model"] = looped
    torch.save(looped, file)
    assert "holds model; expected" in _refused(file)
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), str(file))
    assert _refused(file).startswith("net.pth is truncated or no PyTorch file of tensors alone, so it was not opened")
