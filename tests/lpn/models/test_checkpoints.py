from __future__ import annotations

from dataclasses import replace
from pathlib import Path

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
from lpn.models.spec import ModelSpec
from tools.fixtures import seeded, small_worlds
from tools.fixtures.small_models import refusal_of


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
        ModelSpec("resnet18", views=("satellite", "street", "drone"), n_parts=6, classes=5),
        ModelSpec("resnet18", "layer3", views=("satellite",), shared=False, n_parts=1, classes=5),
    ],
    ids=["three views", "one view"],
)
def test_architecture_is_told_from_the_keys_and_survives_saving(spec: ModelSpec, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = LPN(spec)
    torch.save({f"module.{k}": v for k, v in network.state_dict().items()}, tmp_path / "net_last.pth")
    (tmp_path / "opts.yaml").write_text("h: 64\nw: 64\nstride: 1\npool: avg\ndroprate: 0.5\nLPN: true\n")
    published = load_torch(tmp_path / "net_last.pth")
    assert published.spec == replace(spec, input_size=(64, 64))
    save(network, tmp_path / "model.safetensors")
    ours = lpn.load(tmp_path / "model.safetensors")
    batch = seeded.pictures(1, 1, 64, 64)
    for view in spec.views:
        np.testing.assert_array_equal(ours.part_embeddings(batch, view), published.part_embeddings(batch, view))
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(
    ("lost", "changed", "said"),
    [
        ("classifier2.add_block.1.running_mean", {}, "classifier2.add_block.1.running_mean"),
        ("classifier1.", {}, "classifier0, classifier2, classifier3"),
        ("classifier3.add_block.0.weight", {}, "classifier3.add_block.0.weight"),
        ("-", {"classifier0.add_block.0.weight": torch.tensor(1.0)}, "classifier0.add_block.0.weight"),
        ("-", {"classifier0.add_block.0.weight": torch.zeros(512, 99)}, "(512, 99)"),
    ],
)
def test_missing_and_misshapen_entries_are_named(
    lost: str, changed: dict[str, Tensor], said: str, tmp_path: Path
) -> None:
    state = small_worlds.make_network().state_dict() | changed
    torch.save({key: value for key, value in state.items() if not key.startswith(lost)}, tmp_path / "net.pth")
    assert said in refusal_of(tmp_path / "net.pth")


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
