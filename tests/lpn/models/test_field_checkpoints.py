"""Files of public reports, rebuilt small: each opens with the descriptors of its weights, or is named with what to do."""

from __future__ import annotations

import datetime
import functools
import gzip
import io
import pathlib
import pickle
import sys
import tarfile
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
import yaml
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
    """Write what torch.save makes of some values around the weights."""

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


def unpacked(folder: Path, state: State) -> Path:
    with zipfile.ZipFile(io.BytesIO(data_of(state))) as archive:
        archive.extractall(folder)
    return folder / "archive"


def entry_alone(folder: Path, state: State) -> Path:
    return unpacked(folder, state) / "data.pkl"


def of_arrays(folder: Path, state: State) -> Path:
    values = {"model": {key: value.numpy() for key, value in state.items()}, "__author__": "a person"}
    (folder / "model_final.pkl").write_bytes(pickle.dumps(values))
    return folder / "model_final.pkl"


def beside_its_companion(folder: Path, state: State) -> Path:
    """A folder of a volume on which macOS keeps a file's attributes in another file."""
    (folder / "._net_119.pth").write_bytes(b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X")
    saved(lambda state: state)(folder, state)
    return folder


def zipped(folder: Path, state: State) -> Path:
    with zipfile.ZipFile(folder / "net_119.pth.zip", "w") as archive:
        archive.writestr("net_119.pth", data_of(state))
    return folder / "net_119.pth.zip"


def tar_gz(folder: Path, state: State) -> Path:
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as archive:
        entry, content = tarfile.TarInfo("run/net_119.pth"), data_of(state)
        entry.size = len(content)
        archive.addfile(entry, io.BytesIO(content))
    (folder / "checkpoint.tar.gz").write_bytes(gzip.compress(data.getvalue(), 0))
    return folder / "checkpoint.tar.gz"


def script(folder: Path, _: State) -> Path:
    torch.jit.save(torch.jit.script(nn.Linear(2, 2)), str(folder / "net_119.pth"))
    return folder / "net_119.pth"


def options(text: str) -> Callable[[Path, State], Path]:
    """Weights alone, with an opts.yaml beside them."""

    def make(folder: Path, state: State) -> Path:
        (folder / "opts.yaml").write_text(text)
        return saved(lambda state: state)(folder, state)

    return make


def extra_state(state: State) -> object:
    return {
        "model": {**state, "_extra_state": {"train_infos": {"lr": np.float64(1e-3)}}},
        "optimizer": {"param_groups": []},
    }


def deepspeed(state: State) -> object:
    shapes = OrderedDict((key, value.shape) for key, value in state.items())
    return {"module": state, "buffer_names": [], "optimizer": None, "param_shapes": [shapes], "ds_version": "0.14.0"}


def of_device(_: State) -> object:
    rebuild = torch._utils._rebuild_device_tensor_from_numpy
    return {"a": _Calls(rebuild, np.zeros(2, np.float32), torch.float32, "cpu", False)}


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


def half_detector(_: State) -> object:
    """A detector's checkpoint: whole networks in half precision, in place of weights."""
    return {"epoch": -1, "best_fitness": np.array([0.5]), "model": _Net().half(), "ema": _Net().half(), "updates": 3}


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


def scheduled(state: State) -> object:
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=0.1)
    scheduler = torch.optim.lr_scheduler.MultiStepLR(optimizer, [10, 20])
    return {"model_state_dict": state, "scheduler_state_dict": scheduler.state_dict()}


def contrastive(state: State) -> object:
    return {"state_dict": {"module.queue": torch.zeros(2), **{f"module.encoder_q.{k}": v for k, v in state.items()}}}


def settings_first(state: State) -> object:
    return OrderedDict([("args", {"lr": 0.1, "betas": (0.9, 0.999)}), ("state_dict", state), ("angle_error", 4.5)])


def named(state: State, config: object) -> object:
    return {"state_dict": state, "config": config}


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"5" * 64 + b"\nsize 1160000000\n"
QUOTA = (
    b"<!DOCTYPE html><html><head><title>Google Drive - Quota exceeded</title></head><body>Sorry, you can't view or download "
    b"this file at this time.</body></html>"
)
BLOB = b"\n\n\n\n\n<!DOCTYPE html>\n<html lang=en>\n<head>\n<title>net/net_119.pth at master</title></head></html>"
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
    "numpy 2 scalar": FieldFile(saved(lambda state: {"step": np.int64(3), "pipeline": state, "loss": np.float32(0.5)})),
    "extra state": FieldFile(saved(extra_state)),
    "LFS pointer": FieldFile(written(LFS), "is a Git LFS pointer"),
    "LFS pointer as safetensors": FieldFile(written(LFS, "model.safetensors"), "is a Git LFS pointer"),
    "quota page": FieldFile(written(QUOTA), "is a web page ('Google Drive - Quota exceeded'); download"),
    "blob page": FieldFile(written(BLOB), "is a web page ('net/net_119.pth at master')"),
    "truncated": FieldFile(truncated, "is truncated: it has "),
    "unpacked": FieldFile(unpacked, "holds no model file (net_*.pth, "),
    "zipped": FieldFile(zipped, "is not a PyTorch file: it begins with 'PK\\x03\\x04"),
    "pth.tar": FieldFile(saved(lambda state: {"epoch": 3, "state_dict": state}, "checkpoint.pth.tar")),
    "tuple option": FieldFile(options("h: 64\noptimizer_betas: !!python/tuple\n- 0.9\n- 0.999\nw: 64\n")),
    "options of Namespace": FieldFile(options("!!python/object:argparse.Namespace\nh: 64\nlr: 0.01\nw: 64\n")),
    "path of Windows": FieldFile(
        saved(lambda state: {"model": state, "out": _Calls(pathlib.WindowsPath, "runs")}),
        more("pathlib.WindowsPath"),
    ),
    "loss among settings": FieldFile(
        saved(lambda state: {"state_dict": state, "hyper_parameters": {"loss": nn.MSELoss()}}),
        more("torch.nn.modules.loss.MSELoss"),
    ),
    "OmegaConf": FieldFile(
        of_foreign("omegaconf.dictconfig", "DictConfig", named),
        more("omegaconf.dictconfig.DictConfig"),
    ),
    "whole network": FieldFile(
        saved(lambda _: {"epoch": 3, "model": _Net(), "ema": None}),
        more("tests.lpn.models.test_field_checkpoints._Net"),
    ),
    "mmengine": FieldFile(
        of_foreign("mmengine.logging.history_buffer", "HistoryBuffer", named),
        more("mmengine.logging.history_buffer.HistoryBuffer"),
    ),
    "protocol 4": FieldFile(
        saved(lambda state: state, pickle_protocol=4),
        ALONE,
    ),
    "TorchScript": FieldFile(script, ALONE),
    "empty": FieldFile(written(b""), "is empty; its download or copy broke off"),
    "TPU": FieldFile(
        saved(of_device),
        ALONE,
    ),
    "Torch7": FieldFile(
        written(b"\x04\0\0\0\x01\0\0\0\x03\0\0\0V 1\r\0\0\0nn.Sequential", "net_119.t7"),
        "is not a PyTorch file: it begins with '\\x04\\x00",
    ),
    "zeros": FieldFile(written(bytes(5000)), "is full of zeros; its download or copy broke off"),
    "several": FieldFile(
        saved(lambda state: {"a": state, "b": state}, "id_00070000.pt"),
        "holds a, b; expected one state_dict of named tensors, so save the network",
    ),
    "several, whose names a shell would run": FieldFile(
        saved(lambda state: {"a$(touch b)": state, "b`id`": state}, "it's.pt"),
        "holds a$(touch b), b`id`; expected one",
    ),
    "numbers as names": FieldFile(
        saved(lambda state: {"state_dict": dict(enumerate(state.values()))}),
        "holds state_dict; expected one state_dict of named tensors",
    ),
    "pth as safetensors": FieldFile(saved(lambda state: {"state_dict": state}, "model.safetensors")),
    "bfloat16": FieldFile(saved(lambda state: state)),
    "tar.gz": FieldFile(tar_gz, "is not a PyTorch file: it begins with '\\x1f\\x8b"),
    "picture": FieldFile(
        written(b"\xff\xd8\xff\xe0\0\x10JFIF\0", "mosaic.jpg"), "is not a PyTorch file: it begins with '\\xff\\xd8\\xff"
    ),
    "DeepSpeed": FieldFile(saved(deepspeed, "mp_rank_00_model_states.pt")),
    "entry alone": FieldFile(
        entry_alone,
        ALONE,
    ),
    "part of TensorFlow": FieldFile(
        written(b"\x17\x2b\x11\x3d" * 99, "model.ckpt-9.data-00000-of-00001"),
        "is not a PyTorch file: it begins with '\\x17+\\x11=",
    ),
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
    "compiled and parallel": FieldFile(
        saved(lambda state: {"model": {f"_orig_mod.module.{key}": value for key, value in state.items()}})
    ),
    "average in a list": FieldFile(
        saved(lambda state: {"step": 1, "model": state, "ema": {"decay": 0.99, "shadow_params": [*state.values()]}})
    ),
    "beside its companion": FieldFile(beside_its_companion),
    "text of a server": FieldFile(
        written(b"Repository not found", "pytorch_model.bin"),
        "is not a PyTorch file: it begins with 'Repository not f'; download or copy the file again, unpack it",
    ),
    "class as a key": FieldFile(
        of_foreign(
            "pytorch_lightning.callbacks.model_checkpoint",
            "ModelCheckpoint",
            lambda state, config: {"state_dict": state, "callbacks": {type(config): {"best": np.float64(1)}}},
        ),
        more("pytorch_lightning.callbacks.model_checkpoint.ModelCheckpoint"),
    ),
    "pandas": FieldFile(
        of_foreign("pandas_of_another_version.core.indexes", "Index", named),
        more("pandas_of_another_version.core.indexes.Index"),
    ),
    "DataParallel": FieldFile(saved(lambda state: {f"module.{key}": value for key, value in state.items()})),
    "date": FieldFile(
        saved(lambda state: {"model": state, "saved": datetime.datetime(2024, 5, 1)}),
        more("datetime.datetime"),
    ),
    "bytes": FieldFile(saved(lambda state: {"model": state, "digest": b"abc", "log": bytearray(b"abc")})),
    "option of NumPy": FieldFile(options(yaml.dump({"h": 64, "lr": np.float64(0.01), "w": 64}))),
    "option of an enumeration": FieldFile(
        options("h: 64\nmode: !!python/object/apply:training.modes.Mode\n- 1\nw: 64\n")
    ),
    "Lightning's prefix": FieldFile(
        saved(lambda state: {"state_dict": {f"model.{key}": value for key, value in state.items()}}, "epoch=3.ckpt")
    ),
    "activation": FieldFile(
        saved(lambda state: {"state_dict": state, "activation": nn.functional.relu}),
        more("torch.nn.functional.relu"),
    ),
    "partial": FieldFile(
        saved(lambda state: {"state_dict": state, "norm": functools.partial(nn.BatchNorm2d, eps=1e-3)}),
        more("functools.partial"),
    ),
    "archive of an agent": FieldFile(
        archive(("policy.pth", "pytorch_variables.pth"), "agent.zip"),
        "is not a PyTorch file: it begins with 'PK",
    ),
    "state of random numbers": FieldFile(
        saved(lambda state: {"state_dict": state, "random": np.random.RandomState(0).get_state()})
    ),
    "ending of an archive": FieldFile(saved(lambda state: state, "net_119.zip")),
    "mixed precision": FieldFile(
        saved(
            lambda state: {"start_epoch": 3, "model": state, "optimizer": {"param_groups": []}, "amp": {"scale": 2.0}}
        )
    ),
    "weight": FieldFile(saved(lambda state: {"weight": state, "train_loss": [0.1, 0.2], "val_iou": 0.5})),
    "diverged": FieldFile(
        saved(diverged), "conv1.weight holds values that are not finite; take an earlier checkpoint."
    ),
    "another method": FieldFile(
        saved(lambda _: {"temp": torch.ones(1), "xvlm.vision_encoder.norm.weight": torch.ones(4)}, "net_209.pth"),
        "is not a checkpoint of a known model: it holds temp, xvlm.vision_encoder.norm.weight. Name its method with --kind",
    ),
    "archive named .tar": FieldFile(
        archive(("run/net_119.pth",), "models.tar"), "is not a PyTorch file: it begins with 'PK"
    ),
    "settings": FieldFile(
        of_foreign("utils_of_a_training", "HParams", named),
        more("utils_of_a_training.HParams"),
    ),
    "damaged begin": FieldFile(
        changed(lambda state: b"\xe2\x80\x8b\x99" + data_of(state)[4:], "net_119.pth"),
        "is not a PyTorch file: it begins with '\\xe2\\x80\\x8b\\x99",
    ),
    "average of torch": FieldFile(saved(averaged)),
    "one part": FieldFile(
        parts("model-00002-of-00002.safetensors"),
        "The backbone in model-00002-of-00002.safetensors is not one of",
    ),
    "folder of parts": FieldFile(
        parts(""), "holds 2 models (model-00001-of-00002.safetensors, model-00002-of-00002.safetensors); name"
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
    "folder of a trainer": FieldFile(
        run_of("model.safetensors", "optimizer.pt", "scheduler.pt", "rng_state.pth", "training_args.bin")
    ),
    "folder without an ending": FieldFile(
        run_of("vgg19", "optimizer.bin", "scheduler.bin"), "holds no model file (net_*.pth, .pth, .pt, .safetensors, or"
    ),
    "file without an ending": FieldFile(run_of("vgg19", "optimizer.bin", "scheduler.bin", given="vgg19")),
    "settings alone": FieldFile(
        saved(lambda _: types.SimpleNamespace(lr=0.1), "training_args.bin"),
        more("types.SimpleNamespace"),
    ),
    "sharded tensors": FieldFile(
        saved(lambda state: {"state": {"model": {"a": _Calls(ShardedTensor), **state}}}),
        more("torch.distributed._shard.sharded_tensor.api.ShardedTensor"),
    ),
    "function of dill": FieldFile(
        of_foreign("dill_of_a_training", "_create_function", named),
        more("dill_of_a_training._create_function"),
    ),
    "class of a script": FieldFile(
        of_foreign("__main__", "BaseSettings", named),
        more("__main__.BaseSettings"),
    ),
    "Paddle": FieldFile(
        changed(lambda state: pickle.dumps({key: value.numpy() for key, value in state.items()}, 2), "net.pdparams"),
        ALONE,
    ),
    "detector": FieldFile(
        saved(half_detector, "best.pt"),
        more("tests.lpn.models.test_field_checkpoints._Net"),
    ),
    "size with a point": FieldFile(options("h: 64.0\nw: 64\n")),
    "rate without a point": FieldFile(options("h: 64\nw: 64\ndroprate: 5e-1\n")),
    "quantised": FieldFile(
        saved(quantised),
        "In net_119.pth, model_1.model.conv1.weight is no plain tensor but quantised, sparse, or without",
    ),
    "kernels of 8 bits": FieldFile(
        saved(of_bytes),
        "In net_119.pth, model_1.model.conv1.weight is no plain tensor but quantised, sparse, or without",
    ),
    "types between": FieldFile(saved(lambda state: {**state, "a.dtype": torch.qint8, "a.packed": (1, None)})),
    "torchao": FieldFile(
        of_foreign("torchao.dtypes", "AffineQuantizedTensor", named),
        more("torchao.dtypes.AffineQuantizedTensor"),
    ),
    "hole": FieldFile(changed(hole, "net_119.pth"), "is damaged: an entry does not match its checksum; copy it again"),
    "compiled by Lightning": FieldFile(
        saved(lambda state: {"state_dict": {f"model._orig_mod.{key}": value for key, value in state.items()}})
    ),
    "comment of a program": FieldFile(
        written(b"# net.py:281:0\n"), "is not a PyTorch file: it begins with '# net.py:281:0"
    ),
    "schedule": FieldFile(saved(scheduled)),
    "name of a checkpoint": FieldFile(
        written(b"model_final.pth", "last_checkpoint"),
        "is not a PyTorch file: it begins with 'model_final.pth'",
    ),
    "page after empty lines": FieldFile(
        written(b"\n\n\n<html lang='en'><title>Sign in</title></html>"), "is a web page ('Sign in'); download the file"
    ),
    "tuple": FieldFile(
        saved(lambda _: (torch.zeros(2), torch.zeros(2))), "holds a tuple; expected one state_dict of named tensors"
    ),
    "contrastive": FieldFile(
        saved(contrastive), "is not a checkpoint of a known model: it holds queue, encoder_q.model_1.model.conv1.weight"
    ),
    "student and teacher": FieldFile(
        saved(lambda state: {"student": state, "teacher": state, "epoch": 3}),
        "holds student, teacher, epoch; expected one state_dict of named tensors",
    ),
    "settings first": FieldFile(saved(settings_first)),
    "encoder and decoder": FieldFile(
        saved(lambda state: {"encoder": state, "decoder": {"a": torch.zeros(2)}, "best_loss": 0.5}, "checkpoint.tar"),
        "holds encoder, decoder, best_loss; expected one state_dict",
    ),
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
