"""Files as trainings and people leave them: each opens with the descriptors of its weights, or is named with what to do."""

from __future__ import annotations

import argparse
import io
import os
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

import lpn
from lpn.models import file_contents
from lpn.models.checkpoints import TorchModel, read_state
from tools.fixtures import seeded, small_worlds
from tools.fixtures.small_models import refusal_of

State = dict[str, Tensor]
PICTURES = seeded.pictures(1, 1, 64, 64)
KERNELS = "model_1.model.conv1.weight"


@pytest.fixture(scope="module")
def weights() -> tuple[State, Any]:
    """Weights in bfloat16's values, and the descriptors that they give."""
    network = small_worlds.make_network()
    with torch.no_grad():
        for value in network.state_dict().values():
            value.copy_(value.bfloat16())
    return network.state_dict(), TorchModel(network).descriptors(PICTURES, "drone")


def saved(value: object, **how: Any) -> bytes:
    data = io.BytesIO()
    torch.save(value, data, **how)
    return data.getvalue()


def safetensors_of(state: State) -> bytes:
    return save_tensors({key: value.clone() for key, value in state.items()})


def prefixed(prefix: str, state: State) -> State:
    return {f"{prefix}{key}": value for key, value in state.items()}


def of_dtype(dtype: torch.dtype) -> Callable[[State], State]:
    return lambda state: {key: of.to(dtype) if of.is_floating_point() else of for key, of in state.items()}


# Forms in which training programs save weights: the further entries, and the wrappers.
OPENS: dict[str, Callable[[State], object]] = {
    "numbers of NumPy": lambda state: {
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
    "DataParallel": lambda state: {"model": prefixed("module.", state)},
    "Lightning": lambda state: {
        "pytorch-lightning_version": "2.1.0",
        "state_dict": prefixed("model.", state),
        "optimizer_states": [{"state": {0: {"exp_avg": torch.zeros(3)}}, "param_groups": []}],
        "hyper_parameters": {"lr": 0.1},
    },
    "an optimizer": lambda state: {
        "net": state,
        "optimizer": {"state": {0: {"momentum_buffer": torch.zeros(3)}}, "param_groups": [{"lr": 0.1}]},
    },
    "its average": lambda state: {"ema": {key: value + 1 for key, value in state.items()}, "params": state},
    "an average alone": lambda state: {"state_dict_ema": state},
    "average in a list": lambda state: {"step": 1, "model": state, "ema": {"shadow_params": [*state.values()]}},
    "average of torch": lambda state: {"n_averaged": torch.tensor(3), **prefixed("module.", state)},
    "model_state": lambda state: {"model_state": state},
    "nested": lambda state: {"checkpoint": 3, "model": {"state_dict": state, "name": "lpn"}},
    "numbers between the tensors": lambda state: {**state, "epoch": 119, "best": np.float64(0.5)},
    "types between": lambda state: {**state, "a.dtype": torch.qint8, "a.packed": (1, None)},
    "settings first": lambda state: OrderedDict(
        [("args", {"lr": 0.1, "betas": (0.9, 0.999)}), ("state_dict", state), ("angle_error", 4.5)]
    ),
    "the only dictionary of tensors": lambda state: {
        "encoder": prefixed("module.", state),
        "opt": {"param_groups": []},
        "epoch": 1,
    },
    "DeepSpeed": lambda state: {
        "module": state,
        "buffer_names": [],
        "optimizer": None,
        "param_shapes": [OrderedDict((key, value.shape) for key, value in state.items())],
    },
    "half precision": of_dtype(torch.bfloat16),
    "double precision": of_dtype(torch.float64),
}


# Names of NumPy and torch are read from the older form, too, whose reader is another one.
@pytest.mark.parametrize(
    ("case", "zipped"),
    [*((case, True) for case in OPENS), ("numbers of NumPy", False), ("types of torch", False)],
)
def test_what_a_training_saves_opens_by_its_weights(
    case: str, zipped: bool, weights: tuple[State, Any], tmp_path: Path
) -> None:
    torch.save(OPENS[case](weights[0]), tmp_path / "net.pth", _use_new_zipfile_serialization=zipped)
    np.testing.assert_array_equal(lpn.load(tmp_path / "net.pth").descriptors(PICTURES, "drone"), weights[1])


def packed_again(state: State) -> bytes:
    """Weights in an archive that is compressed, which torch's own is not."""
    data = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(saved(state))) as source,
        zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as target,
    ):
        for name in source.namelist():
            target.writestr(name, source.read(name))
    return data.getvalue()


def of_numpy(module: str) -> Callable[[State], bytes]:
    """Weights beside a number whose maker has the module's name in NumPy 1 or 2."""

    def make(state: State) -> bytes:
        data = saved({"state_dict": state, "best": np.float64(0.5)}, _use_new_zipfile_serialization=False)
        own = np.float64(0.5).__reduce__()[0].__module__
        return data.replace(f"c{own}\n".encode(), f"c{module}\n".encode())

    return make


FORMS: dict[str, tuple[str, Callable[[State], bytes], str]] = {
    "compressed": ("net.pth", packed_again, ""),
    "NumPy 1": ("net.pth", of_numpy("numpy.core.multiarray"), ""),
    "NumPy 2": ("net.pth", of_numpy("numpy._core.multiarray"), ""),
    "ending of an archive": ("net_119.zip", saved, ""),
    "pth as safetensors": ("model.safetensors", lambda state: saved({"state_dict": state}), ""),
    "safetensors as pth": ("net.pth", safetensors_of, ""),
    "options of Namespace": ("net.pth", saved, "!!python/object:argparse.Namespace\nh: 64\nlr: 0.01\nw: 64\n"),
    "size with a point": ("net.pth", saved, "h: 64.0\nw: 64\n"),
    "rate without a point": ("net.pth", saved, "h: 64\nw: 64\ndroprate: 5e-1\n"),
}


@pytest.mark.parametrize("case", FORMS)
def test_bytes_and_not_an_ending_tell_a_file(case: str, weights: tuple[State, Any], tmp_path: Path) -> None:
    name, make, options = FORMS[case]
    (tmp_path / name).write_bytes(make(weights[0]))
    if options:
        (tmp_path / "opts.yaml").write_text(options)
    np.testing.assert_array_equal(lpn.load(tmp_path / name).descriptors(PICTURES, "drone"), weights[1])


class _Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(2, 2)
        self.act = getattr  # as a network that keeps a function


class _Calls:
    """Pickles as a call that its own process need not be able to make."""

    def __init__(self, function: object, *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


# Values other than tensors in a file, and the first name in it that may run code.
MORE: dict[str, tuple[Any, str]] = {
    "namespace": (argparse.Namespace(lr=0.01), "argparse.Namespace"),
    "a network": (_Net(), f"{__name__}._Net"),
    "an activation": (nn.functional.relu, "torch.nn.functional.relu"),
    "a program": (_Calls(os.system, "touch ran"), f"{os.name}.system"),
}


@pytest.mark.parametrize("case", MORE)
@pytest.mark.parametrize("zipped", [True, False])
def test_a_file_of_more_than_tensors_is_refused_with_what_it_names(
    case: str, zipped: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    value, name = MORE[case]
    torch.save({"more": value, "state_dict": {"a": torch.ones(2)}}, "net.pth", _use_new_zipfile_serialization=zipped)
    assert refusal_of(Path("net.pth")) == (
        f"net.pth holds more than tensors: it names {name}, which may run code, so it was not opened; save the network's "
        "state_dict by torch.save where it was trained."
    )
    assert not Path("ran").exists()


NO_PLAIN = (
    f"In net.pth, {KERNELS} is no plain tensor but quantised, sparse, complex, or without values; give the weights"
)
LOOPED: dict[str, Any] = {}
LOOPED["model"] = LOOPED
# Files without a model's state dict, and the beginning of the sentence about each.
EMPTY: dict[str, tuple[Callable[[State], object], str]] = {
    "an optimizer": (lambda _: {"state": {}, "param_groups": [{"lr": 0.1}]}, "net.pth holds state, param_groups; exp"),
    "two": (lambda state: {"generator": state, "critic": state}, "net.pth holds generator, critic; expected one"),
    "nothing": (lambda _: {}, "net.pth holds nothing; expected"),
    "a tensor": (lambda _: torch.zeros(3), "net.pth holds a Tensor; expected one state_dict of named tensors"),
    "numbers as names": (lambda state: dict(enumerate(state.values())), "net.pth holds 0, 1, 2, 3, and "),
    "itself": (lambda _: LOOPED, "net.pth holds model; expected"),
    "sparse": (lambda _: {KERNELS: torch.zeros(3).to_sparse()}, NO_PLAIN),
    "without values": (lambda _: {KERNELS: torch.zeros(3, device="meta")}, NO_PLAIN),
    "complex": (lambda state: {**state, KERNELS: state[KERNELS].to(torch.complex64)}, NO_PLAIN),
    "quantised": (lambda state: {KERNELS: torch.quantize_per_tensor(state[KERNELS], 0.1, 0, torch.qint8)}, NO_PLAIN),
    "kernels of 8 bits": (lambda state: {**state, KERNELS: (state[KERNELS] * 100).to(torch.int8)}, NO_PLAIN),
    "diverged": (lambda state: {**state, KERNELS: state[KERNELS] * np.nan}, f"In net.pth, {KERNELS} holds values"),
    "another method": (
        lambda _: {"temp": torch.ones(1), "vision.norm": torch.ones(4)},
        "net.pth is not a checkpoint of a known model: it holds temp, vision.norm. Name its method with",
    ),
}


@pytest.mark.filterwarnings("ignore:torch.quantize_per_tensor")
@pytest.mark.parametrize("case", EMPTY)
def test_what_holds_no_plain_weights_says_what_it_holds(case: str, weights: tuple[State, Any], tmp_path: Path) -> None:
    make, sentence = EMPTY[case]
    torch.save(make(weights[0]), tmp_path / "net.pth")
    assert refusal_of(tmp_path / "net.pth").startswith(sentence)


def hole(state: State) -> bytes:
    """An archive of which one entry was lost."""
    data = bytearray(saved(state))
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        start = archive.getinfo("archive/data/8").header_offset
    data[start : start + 300] = bytes(300)
    return bytes(data)


def zipped(state: State) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("net_119.pth", saved(state))
    return data.getvalue()


def script(_: State) -> bytes:
    data = io.BytesIO()
    torch.jit.save(torch.jit.script(nn.Linear(2, 2)), data)
    return data.getvalue()


def second_half(state: State) -> bytes:
    return safetensors_of(dict([*state.items()][50:]))


PAGE = b"<!DOCTYPE html>\n<html><head><title>%s</title></head><body>Sign in</body></html>"
LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 198600000\n"
# The bytes of files that are no models, and the continuation of the sentence after the file's name.
FOREIGN: dict[str, tuple[bytes, str]] = {
    "Git LFS": (
        LFS,
        "is a Git LFS pointer, the text that Git leaves in place of a large file; fetch the file itself with git lfs pull, or "
        "download it from the repository's page.",
    ),
    "page": (
        b"\xef\xbb\xbf  \n" + PAGE % b"Log in\n  to OneDrive",
        "is a web page ('Log in to OneDrive'); download the file itself, not its page, and log in where the site "
        "asks for it.",
    ),
    "page without a title": (b"\n\n<html lang='en'><body>Found</body></html>", "is a web page; download the file"),
    "XHTML": (b'<?xml version="1.0"?><html xmlns="x"><title>a</title></html>', "is a web page ('a')"),
    "empty": (b"", "is empty; its download or copy broke off, so download or copy the file again."),
    "zeros": (b"\0" * 70_000, "is full of zeros; its download or copy broke off"),
    "cut": (saved({"a": torch.zeros(99)})[:-60], "is truncated: it has "),
}
ALONE = "is truncated or not a PyTorch file of tensors alone, so it was not opened; copy it again, or save the"
# A file's name, its bytes, and a part of the sentence.
BYTES: dict[str, tuple[str, Callable[[State], bytes], str]] = {
    "zipped": ("net.pth.zip", zipped, "is not a PyTorch file: it begins with 'PK\\x03\\x04"),
    "a folder more": ("net.pth", lambda state: saved(state).replace(b"archive/", b"arch/ve/"), "unpack it if it is an"),
    "protocol 4": ("net.pth", lambda state: saved(state, pickle_protocol=4), ALONE),
    "a pickle that calls": ("net.pth", lambda _: pickle.dumps(_Calls(os.system, "touch ran")), ALONE),
    "TorchScript": ("net.pth", script, ALONE),
    "arrays": ("model.pkl", lambda state: pickle.dumps({key: of.numpy() for key, of in state.items()}), ALONE),
    "one part": ("a-00002.safetensors", second_half, "The backbone in a-00002.safetensors is not one of"),
    "no tensor": ("a.safetensors", lambda _: save_tensors({}, {"key": "value"}), "a.safetensors holds no tensors;"),
    "half a file": ("a.safetensors", lambda state: safetensors_of(state)[:-1000], "is damaged, truncated, or no"),
    "begin of a safetensors": ("a.safetensors", lambda _: b"\x10\0\0", "it begins with '\\x10\\x00\\x00'; download"),
    "complex safetensors": (
        "a.safetensors",
        lambda state: safetensors_of({KERNELS: state[KERNELS].to(torch.complex64)}),
        f"In a.safetensors, {KERNELS} is complex; give the weights",
    ),
    "hole": ("net.pth", hole, "is damaged: an entry does not match its checksum; copy it again"),
    "a text": ("net.onnx", lambda _: b"hello", "net.onnx is not an ONNX model or is truncated"),
}


@pytest.mark.filterwarnings("ignore:.*torch.jit")
@pytest.mark.parametrize("case", BYTES)
def test_a_file_of_a_report_is_named(
    case: str, weights: tuple[State, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    name, make, sentence = BYTES[case]
    (tmp_path / name).write_bytes(make(weights[0]))
    assert sentence in refusal_of(tmp_path / name)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("case", FOREIGN)
def test_a_file_of_another_kind_is_named_whatever_its_ending(case: str, tmp_path: Path) -> None:
    data, sentence = FOREIGN[case]
    for ending in (".pth", ".onnx", ".safetensors", ".bin"):
        (tmp_path / f"net_119{ending}").write_bytes(data)
        assert refusal_of(tmp_path / f"net_119{ending}").startswith(f"net_119{ending} {sentence}")


def test_a_file_cut_anywhere_and_a_missing_one_get_one_sentence(
    weights: tuple[State, Any], tmp_path: Path, model_file: Path
) -> None:
    assert "no model file" in refusal_of(tmp_path / "absent.pth")
    whole = {
        "cut.pth": saved(weights[0]),
        "cut.safetensors": model_file.with_suffix(".safetensors").read_bytes(),
        "cut.onnx": model_file.read_bytes(),
    }
    for name, data in whole.items():
        for length in (10, len(data) // 2, len(data) - 100):
            (tmp_path / name).write_bytes(data[:length])
            refusal_of(tmp_path / name)


def test_a_graph_and_weights_under_each_others_endings(tmp_path: Path, model_file: Path) -> None:
    (tmp_path / "lpn.pth").write_bytes(model_file.read_bytes())
    sentence = "lpn.pth is an ONNX graph under another ending; rename it to lpn.onnx."
    assert refusal_of(tmp_path / "lpn.pth") == sentence
    (tmp_path / "lpn.onnx").write_bytes(saved({"a": torch.zeros(1)}))
    sentence = "lpn.onnx is a PyTorch file under another ending; rename it to lpn.pth."
    assert refusal_of(tmp_path / "lpn.onnx") == sentence
    assert file_contents.is_model_name("net_119.PTH")
    assert not file_contents.is_model_name("._net_119.pth")


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
    sentence = refusal_of(tmp_path / "net.pth")
    assert sentence.startswith("In net.pth, a is a torch.distributed.")
    assert "DTensor; expected plain tensors, so save" in sentence


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


def test_scales_of_other_programs_are_entries_like_others(tmp_path: Path) -> None:
    state = {"stages.0.layer_scale1.scale": torch.ones(3), "head.weight": torch.ones(2, 3)}
    (tmp_path / "caformer.safetensors").write_bytes(save_tensors(state))
    assert read_state(tmp_path / "caformer.safetensors").keys() == state.keys()
