"""ImageNet weights of a backbone on this machine, in the folders of torch and timm. Nothing is downloaded."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from lpn.core.errors import ModelFileError
from lpn.models.spec import TIMM, is_timm
from lpn.models.timm_networks import import_timm

# The value of `--init` that searches for a file.
AUTO = "auto"
# The names of timm's files on Hugging Face.
_HUB_FILES = ("model.safetensors", "pytorch_model.bin")


def find_weights(backbone: str) -> tuple[Path, str]:
    """Find the ImageNet weights of a backbone on this machine: the file, and its place in words.

    Args:
        backbone: one of `spec.BACKBONES`, or "timm:" and the name of a network of timm.

    Raises:
        ModelFileError: if there are none; the message names the searched folders and a remedy.
        InputError: if the network is timm's, and timm is missing or lacks it.
    """
    return _of_timm(backbone.removeprefix(TIMM)) if is_timm(backbone) else _of_torch(backbone)


def _of_torch(backbone: str) -> tuple[Path, str]:
    folder = _torch_folder()
    # torchvision's names: resnet18-f37072fd.pth.
    files = sorted(folder.glob(f"{backbone}-*.pth"))
    if not files:
        raise ModelFileError(
            f"There are no weights of {backbone} here: {folder} has no {backbone}-*.pth of torchvision; give a file with --init."
        )
    return files[0], "torch's folder of weights"


def _of_timm(name: str) -> tuple[Path, str]:
    timm = import_timm()
    configuration = timm.get_pretrained_cfg(name) if timm.is_model(name) else None
    repository = str(getattr(configuration, "hf_hub_id", None) or "")
    home = Path(os.environ.get("HF_HOME") or Path.home() / ".cache" / "huggingface")
    folder = (
        Path(os.environ.get("HF_HUB_CACHE") or home / "hub") / f"models--{repository.replace('/', '--')}" / "snapshots"
    )
    files = sorted(file for known in _HUB_FILES for file in folder.glob(f"*/{known}")) if repository else []
    if files:
        # Snapshots of other revisions may lie beside it.
        return max(files, key=lambda file: file.stat().st_mtime), f"the cache of Hugging Face, {repository}"
    address = str(getattr(configuration, "url", None) or "")
    if address and (file := _torch_folder() / address.rpartition("/")[2]).is_file():
        return file, "torch's folder of weights"
    if not repository and not address:
        raise ModelFileError(f"There are no weights of {TIMM}{name}: timm knows of none; give a file with --init.")
    raise ModelFileError(
        f"There are no weights of {TIMM}{name} here: neither {folder.parent} nor {_torch_folder()} has them; let "
        f"timm.create_model({name!r}, pretrained=True) fetch them once, or give a file with --init."
    )


def _torch_folder() -> Path:
    return Path(torch.hub.get_dir()) / "checkpoints"
