"""Weights that are found on this machine: in torch's folder, and in Hugging Face's cache."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from lpn.core.errors import ModelFileError
from lpn.models import pretrained_weights
from lpn.models.pretrained_weights import find_weights


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Empty folders in place of this machine's own."""
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "torch"))


def test_torchvision_s_weights_are_taken_from_torch_s_folder(tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match=r"has no resnet18-\*\.pth of torchvision; give a file with --init"):
        find_weights("resnet18")
    folder = tmp_path / "torch" / "checkpoints"
    folder.mkdir(parents=True)
    for name in ("resnet18-f37072fd.pth", "vgg16_bn-6c64b313.pth"):
        (folder / name).touch()
    assert find_weights("resnet18")[0] == folder / "resnet18-f37072fd.pth"
    # Another network's name begins alike.
    with pytest.raises(ModelFileError, match="no weights of vgg16 here"):
        find_weights("vgg16")


def test_timm_s_weights_are_taken_from_its_caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = {
        "small_net": SimpleNamespace(hf_hub_id="timm/small_net.in1k", url="https://host/release/small-1234.pth"),
        "bare_net": SimpleNamespace(hf_hub_id=None, url=""),
    }
    timm = SimpleNamespace(is_model=known.__contains__, get_pretrained_cfg=known.__getitem__)
    monkeypatch.setattr(pretrained_weights, "import_timm", lambda: timm)
    with pytest.raises(ModelFileError, match=r"neither .*models--timm--small_net\.in1k nor .* pretrained=True"):
        find_weights("timm:small_net")
    with pytest.raises(ModelFileError, match=r"timm:bare_net: timm knows of none"):
        find_weights("timm:bare_net")
    in_torch = tmp_path / "torch" / "checkpoints" / "small-1234.pth"
    in_torch.parent.mkdir(parents=True)
    in_torch.touch()
    assert find_weights("timm:small_net")[0] == in_torch
    in_hub = tmp_path / "hub" / "models--timm--small_net.in1k" / "snapshots" / "a0" / "model.safetensors"
    in_hub.parent.mkdir(parents=True)
    in_hub.touch()
    assert find_weights("timm:small_net") == (in_hub, "the cache of Hugging Face, timm/small_net.in1k")
