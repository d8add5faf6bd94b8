"""Files of public reports, rebuilt small: each opens with the descriptors of its weights, or is named with what to do."""

from __future__ import annotations

import io
import pickle
import sys
import types
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save as save_tensors
from torch import Tensor, nn
from torch.distributed._shard.sharded_tensor import ShardedTensor

import lpn
from lpn.core.errors import ModelFileError
from lpn.models.checkpoints import TorchModel, read_state
from tools.fixtures import seeded, small_worlds

State = dict[str, Tensor]


@dataclass(frozen=True)
class FieldFile:
    """A file of a public report.

    Attributes:
        make: writes it into a folder, given weights, and returns what a person gives as the model.
        sentence: a part of the sentence that refuses it; None if it opens.
    """

    make: Callable[[Path, State], Path]
    sentence: str | None = None


class _Calls:
    """Pickles as a call that its own process need not be able to make."""

    def __init__(self, function: object, *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


class _Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(2, 2)
        self.act = getattr  # as a network that keeps a function


def saved(values: Callable[[State], object], name: str = "net_119.pth", **how: Any) -> Callable[[Path, State], Path]:
    """Write weights and further values by torch.save."""

    def make(folder: Path, state: State) -> Path:
        torch.save(values(state), folder / name, **how)
        return folder / name

    return make


def written(data: bytes, name: str = "net_119.pth") -> Callable[[Path, State], Path]:
    def make(folder: Path, _: State) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return make


def foreign(module: str, name: str) -> type:
    """A class of a package that is not installed here; it can be pickled until the test ends."""
    package = module.partition(".")[0]
    sys.modules.setdefault(package, types.ModuleType(package))
    home = sys.modules.setdefault(module, types.ModuleType(module))
    found: type = type(name, (), {"__module__": module, "__qualname__": name})
    setattr(home, name, found)
    return found


def of_foreign(module: str, name: str, values: Callable[[State, Any], object]) -> Callable[[Path, State], Path]:
    def make(folder: Path, state: State) -> Path:
        before = set(sys.modules)
        try:
            torch.save(values(state, foreign(module, name)()), folder / "net_119.pth")
        finally:
            for added in set(sys.modules) - before:
                del sys.modules[added]
        return folder / "net_119.pth"

    return make


def data_of(state: State) -> bytes:
    data = io.BytesIO()
    torch.save(state, data)
    return data.getvalue()


def truncated(folder: Path, state: State) -> Path:
    data = data_of(state)
    (folder / "net_119.pth").write_bytes(data[: len(data) // 2])
    return folder / "net_119.pth"


def of_arrays(folder: Path, state: State) -> Path:
    values = {"model": {key: value.numpy() for key, value in state.items()}, "__author__": "a person"}
    (folder / "model_final.pkl").write_bytes(pickle.dumps(values))
    return folder / "model_final.pkl"


def zipped(folder: Path, state: State) -> Path:
    with zipfile.ZipFile(folder / "net_119.pth.zip", "w") as archive:
        archive.writestr("net_119.pth", data_of(state))
    return folder / "net_119.pth.zip"


def script(folder: Path, _: State) -> Path:
    torch.jit.save(torch.jit.script(nn.Linear(2, 2)), str(folder / "net_119.pth"))
    return folder / "net_119.pth"


def options(text: str) -> Callable[[Path, State], Path]:
    """Weights alone, with an opts.yaml beside them."""

    def make(folder: Path, state: State) -> Path:
        (folder / "opts.yaml").write_text(text)
        return saved(lambda state: state)(folder, state)

    return make


def deepspeed(state: State) -> object:
    shapes = OrderedDict((key, value.shape) for key, value in state.items())
    return {"module": state, "buffer_names": [], "optimizer": None, "param_shapes": [shapes], "ds_version": "0.14.0"}


def archive(names: tuple[str, ...], name: str) -> Callable[[Path, State], Path]:
    """A ZIP archive that holds the weights under several names."""

    def make(folder: Path, state: State) -> Path:
        with zipfile.ZipFile(folder / name, "w") as target:
            for entry in names:
                target.writestr(entry, data_of(state))
        return folder / name

    return make


def run_of(model: str, *others: str, given: str = "") -> Callable[[Path, State], Path]:
    """A folder of a training: the model, and what else it saved; or one file there as the model."""

    def make(folder: Path, state: State) -> Path:
        for name in others:
            torch.save({"last_epoch": 1}, folder / name)
        (folder / model).write_bytes(safetensors_of(state) if model.endswith("safetensors") else data_of(state))
        return folder / given

    return make


def safetensors_of(state: State) -> bytes:
    return save_tensors({key: value.clone() for key, value in state.items()})


def parts(given: str) -> Callable[[Path, State], Path]:
    """A model that is split over two files."""

    def make(folder: Path, state: State) -> Path:
        items = list(state.items())
        for number, part in enumerate((items[:50], items[50:]), 1):
            (folder / f"model-0000{number}-of-00002.safetensors").write_bytes(safetensors_of(dict(part)))
        return folder / given

    return make


def changed(data: Callable[[State], bytes], name: str) -> Callable[[Path, State], Path]:
    """Write bytes that are made of the weights."""

    def make(folder: Path, state: State) -> Path:
        (folder / name).write_bytes(data(state))
        return folder / name

    return make


def diverged(state: State) -> object:
    return {**state, "model_1.model.conv1.weight": torch.full_like(state["model_1.model.conv1.weight"], np.nan)}


def averaged(state: State) -> object:
    return {"n_averaged": torch.tensor(3), **{f"module.{key}": value for key, value in state.items()}}


def quantised(state: State) -> object:
    key = "model_1.model.conv1.weight"
    return {**state, key: torch.quantize_per_tensor(state[key], 0.1, 0, torch.qint8)}


def of_bytes(state: State) -> object:
    key = "model_1.model.conv1.weight"
    return {
        **state,
        key: (state[key] * 100).to(torch.int8),
        f"{key}.scale": torch.full((len(state[key]), 1, 1, 1), 0.01),
    }


def hole(state: State) -> bytes:
    """An archive of which one entry was lost."""
    data = bytearray(data_of(state))
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        start = archive.getinfo("archive/data/8").header_offset
    data[start : start + 300] = bytes(300)
    return bytes(data)


def settings_first(state: State) -> object:
    return OrderedDict([("args", {"lr": 0.1, "betas": (0.9, 0.999)}), ("state_dict", state), ("angle_error", 4.5)])


def named(state: State, config: object) -> object:
    return {"state_dict": state, "config": config}


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"5" * 64 + b"\nsize 1160000000\n"
QUOTA = (
    b"<!DOCTYPE html><html><head><title>Google Drive - Quota exceeded</title></head><body>Sorry, you can't view or download "
    b"this file at this time.</body></html>"
)
ALONE = "is truncated or no PyTorch file of tensors alone, so it was not opened; copy it again, or save the"


def more(name: str) -> str:
    return f"holds more than tensors: it names {name}, which may run code, so it was not opened; save the"


FIELD: dict[str, FieldFile] = {
    "numpy 1 scalar": FieldFile(
        saved(
            lambda state: {"epoch": 3, "state_dict": state, "best": np.float64(0.5)},
            _use_new_zipfile_serialization=False,
        )
    ),
    "LFS pointer": FieldFile(written(LFS), "is a Git LFS pointer"),
    "LFS pointer as safetensors": FieldFile(written(LFS, "model.safetensors"), "is a Git LFS pointer"),
    "quota page": FieldFile(written(QUOTA), "is a web page ('Google Drive - Quota exceeded'); download"),
    "truncated": FieldFile(truncated, "is truncated: it has "),
    "zipped": FieldFile(zipped, "is not a PyTorch file: it begins with 'PK\\x03\\x04"),
    "options of Namespace": FieldFile(options("!!python/object:argparse.Namespace\nh: 64\nlr: 0.01\nw: 64\n")),
    "OmegaConf": FieldFile(
        of_foreign("omegaconf.dictconfig", "DictConfig", named), more("omegaconf.dictconfig.DictConfig")
    ),
    "whole network": FieldFile(
        saved(lambda _: {"epoch": 3, "model": _Net(), "ema": None}),
        more("tests.lpn.models.test_field_checkpoints._Net"),
    ),
    "protocol 4": FieldFile(saved(lambda state: state, pickle_protocol=4), ALONE),
    "TorchScript": FieldFile(script, ALONE),
    "numbers as names": FieldFile(
        saved(lambda state: {"state_dict": dict(enumerate(state.values()))}),
        "holds state_dict; expected one state_dict of named tensors",
    ),
    "pth as safetensors": FieldFile(saved(lambda state: {"state_dict": state}, "model.safetensors")),
    "bfloat16": FieldFile(saved(lambda state: state)),
    "picture": FieldFile(
        written(b"\xff\xd8\xff\xe0\0\x10JFIF\0", "mosaic.jpg"), "is not a PyTorch file: it begins with '\\xff\\xd8\\xff"
    ),
    "DeepSpeed": FieldFile(saved(deepspeed, "mp_rank_00_model_states.pt")),
    "arrays": FieldFile(of_arrays, ALONE),
    "encoder": FieldFile(
        saved(
            lambda state: {
                "encoder": {f"module.{key}": v for key, v in state.items()},
                "opt": {"param_groups": []},
                "epoch": 1,
            }
        )
    ),
    "average in a list": FieldFile(
        saved(lambda state: {"step": 1, "model": state, "ema": {"decay": 0.99, "shadow_params": [*state.values()]}})
    ),
    "activation": FieldFile(
        saved(lambda state: {"state_dict": state, "activation": nn.functional.relu}), more("torch.nn.functional.relu")
    ),
    "ending of an archive": FieldFile(saved(lambda state: state, "net_119.zip")),
    "diverged": FieldFile(
        saved(diverged), "conv1.weight holds values that are not finite; take an earlier checkpoint."
    ),
    "another method": FieldFile(
        saved(lambda _: {"temp": torch.ones(1), "xvlm.vision_encoder.norm.weight": torch.ones(4)}, "net_209.pth"),
        "is not a checkpoint of a known model: it holds temp, xvlm.vision_encoder.norm.weight. Name its method with --kind",
    ),
    "average of torch": FieldFile(saved(averaged)),
    "one part": FieldFile(
        parts("model-00002-of-00002.safetensors"), "The backbone in model-00002-of-00002.safetensors is not one of"
    ),
    "without a tensor": FieldFile(
        changed(lambda _: save_tensors({}, {"key": "value"}), "model.safetensors"),
        "model.safetensors holds no tensors; expected a state_dict of named tensors.",
    ),
    "half of a safetensors": FieldFile(
        changed(lambda state: safetensors_of(state)[:-1000], "model.safetensors"),
        "model.safetensors is damaged, truncated, or no .safetensors file; copy it again from where it came",
    ),
    "begin of a safetensors": FieldFile(
        written(b"\x10\0\0", "model.safetensors"),
        "is not a .safetensors file: it begins with '\\x10\\x00\\x00'; download",
    ),
    "file without an ending": FieldFile(run_of("vgg19", "optimizer.bin", "scheduler.bin", given="vgg19")),
    "sharded tensors": FieldFile(
        saved(lambda state: {"state": {"model": {"a": _Calls(ShardedTensor), **state}}}),
        more("torch.distributed._shard.sharded_tensor.api.ShardedTensor"),
    ),
    "size with a point": FieldFile(options("h: 64.0\nw: 64\n")),
    "rate without a point": FieldFile(options("h: 64\nw: 64\ndroprate: 5e-1\n")),
    "quantised": FieldFile(
        saved(quantised),
        "In net_119.pth, model_1.model.conv1.weight is no plain tensor but quantised, sparse, complex, or without",
    ),
    "kernels of 8 bits": FieldFile(
        saved(of_bytes),
        "In net_119.pth, model_1.model.conv1.weight is no plain tensor but quantised, sparse, complex, or without",
    ),
    "types between": FieldFile(saved(lambda state: {**state, "a.dtype": torch.qint8, "a.packed": (1, None)})),
    "hole": FieldFile(changed(hole, "net_119.pth"), "is damaged: an entry does not match its checksum; copy it again"),
    "compiled by Lightning": FieldFile(
        saved(lambda state: {"state_dict": {f"model._orig_mod.{key}": value for key, value in state.items()}})
    ),
    "page after empty lines": FieldFile(
        written(b"\n\n\n<html lang='en'><title>Sign in</title></html>"), "is a web page ('Sign in'); download the file"
    ),
    "settings first": FieldFile(saved(settings_first)),
}


@pytest.fixture(scope="module")
def weights() -> tuple[State, Any]:
    """Weights in bfloat16's values, and the descriptors that they give."""
    network = small_worlds.make_network()
    with torch.no_grad():
        for value in network.state_dict().values():
            value.copy_(value.bfloat16())
    return network.state_dict(), TorchModel(network).descriptors(seeded.pictures(1, 1, 64, 64), "drone")


def test_tensors_of_several_processes_are_named(tmp_path: Path) -> None:
    """Torch can make such tensors of the file once its part for several processes is imported, as by a compiled model."""
    from torch import distributed
    from torch.distributed.device_mesh import init_device_mesh
    from torch.distributed.tensor import Replicate, distribute_tensor

    distributed.init_process_group("gloo", store=distributed.HashStore(), rank=0, world_size=1)
    try:
        tensor = distribute_tensor(torch.ones(2), init_device_mesh("cpu", (1,)), [Replicate()])
        torch.save({"model": {"a": tensor}}, tmp_path / "net.pth")
    finally:
        distributed.destroy_process_group()
    with pytest.raises(
        ModelFileError, match=r"In net\.pth, a is a torch\.distributed\..*DTensor; expected plain tensors, so save"
    ):
        lpn.load(tmp_path / "net.pth")


@pytest.mark.filterwarnings("ignore:.*torch.jit", "ignore:torch.quantize_per_tensor")
@pytest.mark.parametrize("case", FIELD)
def test_a_file_of_a_report_opens_or_is_named(case: str, weights: tuple[State, Any], tmp_path: Path) -> None:
    state, expected = weights
    if case == "bfloat16":
        state = {key: value.bfloat16() if value.is_floating_point() else value for key, value in state.items()}
    path = FIELD[case].make(tmp_path, state)
    if (sentence := FIELD[case].sentence) is None:
        np.testing.assert_array_equal(lpn.load(path).descriptors(seeded.pictures(1, 1, 64, 64), "drone"), expected)
        return
    with pytest.raises(ModelFileError) as caught:
        lpn.load(path)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_scales_of_other_programs_are_entries_like_others(tmp_path: Path) -> None:
    state = {"stages.0.layer_scale1.scale": torch.ones(3), "head.weight": torch.ones(2, 3)}
    (tmp_path / "caformer.safetensors").write_bytes(save_tensors(state))
    assert read_state(tmp_path / "caformer.safetensors").keys() == state.keys()
