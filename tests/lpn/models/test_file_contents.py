"""A file given as a model is named for what it is, by its bytes, and no byte of it runs."""

from __future__ import annotations

import argparse
import collections
import io
import os
import pathlib
import pickle
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import lpn
from lpn.core.errors import ModelFileError
from lpn.models import file_contents
from lpn.models.file_contents import check_trained_file, contents_of, names_in_pickle, pickle_protocol
from tools.fixtures.without_torch import run_without_torch

PAGE = b"<!DOCTYPE html>\n<html><head><title>%s</title></head><body>Sign in</body></html>"
XML = b'<?xml version="1.0" encoding="UTF-8"?>\n<Error><Code>AccessDenied</Code><Message>Expired</Message></Error>'


def archive(names: dict[str, bytes]) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as file:
        for name, content in names.items():
            file.writestr(name, content)
    return data.getvalue()


def tar(name: str) -> bytes:
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as file:
        file.addfile(tarfile.TarInfo(name), io.BytesIO())
    return data.getvalue()


def saved(value: object, **how: Any) -> bytes:
    data = io.BytesIO()
    torch.save(value, data, **how)
    return data.getvalue()


# The bytes of a file, and how the sentence about it goes on behind its name.
FOREIGN: dict[str, tuple[bytes, str]] = {
    "Git LFS": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 198600000\n",
        "is a Git LFS pointer, the text that Git leaves in place of a large file (of 198,600,000 bytes); fetch the "
        "file itself with git lfs pull, or download it from the repository's page.",
    ),
    "git-annex": (b"/annex/objects/SHA256E-s98--0f.pth\n", "is a git-annex pointer, "),
    "DVC": (
        b"outs:\n- md5: 0123\n  size: 98000\n  path: net.pth\n",
        "is a pointer of DVC, the text that stands in place",
    ),
    "virus scan": (
        PAGE % b"Google Drive - Virus scan warning",
        "is a web page of Google Drive in place of the file ('Google Drive - Virus scan warning'); open the link in "
        "a browser and choose 'Download anyway', or use gdown; where its quota is exceeded, wait a day.",
    ),
    "quota": (
        PAGE % b"Google Drive - Quota exceeded",
        "is a web page of Google Drive in place of the file ('Google Drive - Quota",
    ),
    "page": (
        b"\xef\xbb\xbf  \n" + PAGE % b"Log in\n  to OneDrive",
        "is a web page ('Log in to OneDrive'); download the file itself, not its page, and log in where the site "
        "asks for it.",
    ),
    "page without a title": (
        b"<html><body>302 Found</body></html>",
        "is a web page; download the file itself",
    ),
    "XHTML": (b'<?xml version="1.0"?><html xmlns="x"><title>a</title></html>', "is a web page ('a')"),
    "server": (
        XML,
        "is the error message of a server ('AccessDenied'); the download was refused, so ask for a new",
    ),
    "JSON": (
        b'{"error":"Invalid username or password."}',
        "is a JSON text ('Invalid username or password.'); if it",
    ),
    "JSON list": (b'[{"a": 1}]', "is a JSON text; "),
    "shards": (b'{"metadata": {}, "weight_map": {"a": "b"}}', "is the list of a model's files; give one of these, and"),
    "text": (
        b"Entry not found\n",
        "is a text that begins 'Entry not found'; download or copy the file again, or",
    ),
    "UTF-16": ("Access denied".encode("utf-16"), "is a text that begins 'Access denied'; "),
    "options": (b"DA: false\nLPN: true\n", "is a text that begins 'DA: false'; "),
    "empty": (b"", "is empty; its download or copy broke off, so download or copy the file again."),
    "zeros": (b"\0" * 70_000, "is full of zeros; its download or copy broke off"),
    "AppleDouble": (
        b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X",
        "is a companion that macOS writes beside a file; give the file of that name without '._'.",
    ),
    "gzip": (
        b"\x1f\x8b\x08\x08" + b"\x01" * 9,
        "is packed by gzip; unpack it, and give the model file inside",
    ),
    "xz": (b"\xfd7zXZ\x00" + b"\x01" * 9, "is packed by xz; "),
    "7z": (b"7z\xbc\xaf\x27\x1c" + b"\x01" * 9, "is a 7-Zip archive; unpack it"),
    "RAR": (b"Rar!\x1a\x07\x01\x00", "is a RAR archive; "),
    "tar": (tar("net_119.pth"), "is a tar archive; unpack it, and give the model file inside (tar -xf)."),
    "PDF": (b"%PDF-1.7\n%\xe2\xe3", "is a PDF document; give the file of weights."),
    "picture": (b"\xff\xd8\xff\xe0\x00\x10JFIF", "is a picture; "),
    "HDF5": (
        b"\x89HDF\r\n\x1a\n\x00\x00",
        "is an HDF5 file, as Keras and MATLAB write; give the weights as PyTorch's state_dict, a .safetensors, or "
        "an exported .onnx.",
    ),
    "MATLAB": (b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "is a MATLAB file; "),
    "npy": (b"\x93NUMPY\x01\x00v\x00{'descr'", "is an array of NumPy; "),
    "msgpack": (b"\x81\xa6params\x83\xa7encoder", "is a msgpack file, as Flax and JAX write; "),
    "TFLite": (b"\x1c\x00\x00\x00TFL3\x14\x00", "is a model of TensorFlow Lite; "),
    "Word": (
        archive({"[Content_Types].xml": b"<x/>", "word/document.xml": b""}),
        "is an Office document; ",
    ),
    "Keras": (
        archive({"config.json": b"{}", "model.weights.h5": b""}),
        "is a model of Keras; give the",
    ),
    "npz": (archive({"a.npy": b"", "b.npy": b""}), "is an archive of NumPy arrays (.npz); "),
    "run": (
        archive({"run/": b"", "run/net_119.pth": b"x", "run/opts.yaml": b"", "__MACOSX/run/._net_119.pth": b""}),
        "is a ZIP archive that holds run/net_119.pth; unpack it, and give that file.",
    ),
    "runs": (
        archive({"a/net_1.pth": b"", "b/net_2.pth": b""}),
        "is a ZIP archive that holds a/net_1.pth, b/net_2.pth; unpack it, and",
    ),
    "other": (archive({"readme.txt": b"x"}), "is a ZIP archive that holds readme.txt; give the file of weights."),
    "cut": (saved({"a": torch.zeros(99)})[:-60], "is truncated: it has "),
    "noise": (
        bytes(range(200, 255)) * 9,
        "is not a PyTorch file, or its begin is damaged; download or copy the file again, or save",
    ),
}


@pytest.mark.parametrize("case", FOREIGN)
def test_a_file_of_another_kind_is_named(case: str, tmp_path: Path) -> None:
    data, sentence = FOREIGN[case]
    (tmp_path / "net_119.pth").write_bytes(data)
    with pytest.raises(ModelFileError) as caught:
        lpn.load(tmp_path / "net_119.pth")
    assert str(caught.value).startswith(f"net_119.pth {sentence}")
    assert "\n" not in str(caught.value)
    # The sentence is the same under the other endings, as far as it is not about the ending.
    if case not in ("noise", "Word"):
        for ending in (".onnx", ".safetensors", ".bin"):
            (tmp_path / f"net_119{ending}").write_bytes(data)
            with pytest.raises(ModelFileError) as caught:
                lpn.load(tmp_path / f"net_119{ending}")
            assert str(caught.value).startswith(f"net_119{ending} {sentence}")


def test_a_file_of_another_kind_is_named_without_torch(tmp_path: Path) -> None:
    code = """
import sys, lpn
for name in sys.argv[1:]:
    try:
        lpn.load(name)
    except lpn.LPNError as error:
        print(error)
"""
    (tmp_path / "pointer.pth").write_bytes(FOREIGN["Git LFS"][0])
    (tmp_path / "net.pth").write_bytes(saved({"a": torch.zeros(1)}))
    done = run_without_torch(code, "pointer.pth", "net.pth", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    pointer, weights = done.stdout.splitlines()
    assert pointer.startswith("pointer.pth is a Git LFS pointer")
    assert "needs the package torch" in weights


def test_a_graph_and_weights_under_each_others_endings(tmp_path: Path, model_file: Path) -> None:
    (tmp_path / "lpn.pth").write_bytes(model_file.read_bytes())
    with pytest.raises(
        ModelFileError, match=r"^lpn\.pth is an ONNX graph under another ending; rename it to lpn\.onnx\.$"
    ):
        lpn.load(tmp_path / "lpn.pth")
    (tmp_path / "lpn.onnx").write_bytes(saved({"a": torch.zeros(1)}))
    with pytest.raises(
        ModelFileError, match=r"^lpn\.onnx is a PyTorch file under another ending; rename it to lpn\.pth\.$"
    ):
        lpn.load(tmp_path / "lpn.onnx")
    ours = model_file.with_suffix(".safetensors")
    (tmp_path / "ours.pth").write_bytes(ours.read_bytes())
    expected = lpn.load(ours)
    opened = lpn.load(tmp_path / "ours.pth")
    picture = np.ones((1, 3, *expected.input_size), np.float32)
    np.testing.assert_array_equal(opened.descriptors(picture, "drone"), expected.descriptors(picture, "drone"))


class _Runs:
    """Pickles as a call."""

    def __init__(self, function: Callable[..., object], *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


PICKLED: dict[str, tuple[object, list[str]]] = {
    "tensors": (
        {"a": torch.zeros(1), "b": torch.Size([2]), "c": torch.device("cpu"), "d": torch.float16, "e": {1j}},
        [],
    ),
    "numpy": ({"a": np.float64(1), "b": np.zeros(2), "c": np.dtype("i4"), "d": np.int64(2)}, []),
    "namespace": ({"args": argparse.Namespace(lr=0.1)}, ["argparse.Namespace"]),
    "defaultdict": (collections.defaultdict(list), ["collections.defaultdict", "builtins.list"]),
    "path": ({"out": pathlib.PurePosixPath("runs")}, [f"{pathlib.PurePosixPath.__module__}.PurePosixPath"]),
    "system": (_Runs(os.system, "true"), [f"{os.name}.system"]),
}


@pytest.mark.parametrize("case", PICKLED)
def test_the_names_in_a_pickle_are_read_without_running_it(case: str, tmp_path: Path) -> None:
    value, expected = PICKLED[case]
    files = {"new": (saved(value), 2), "legacy": (saved(value, _use_new_zipfile_serialization=False), 2)}
    files["protocol 4"] = (saved(value, pickle_protocol=4), 4)
    if case != "tensors":
        files["plain"] = (pickle.dumps(value), pickle.DEFAULT_PROTOCOL)
    for how, (data, protocol) in files.items():
        file = tmp_path / f"{how}.pth"
        file.write_bytes(data)
        assert names_in_pickle(file) == expected, how
        assert contents_of(file) == "pytorch", how
        check_trained_file(file)
        assert pickle_protocol(file) == protocol, how


def test_a_pickle_that_cannot_be_read_names_nothing(tmp_path: Path) -> None:
    (tmp_path / "net.pth").write_bytes(b"\x80\x02\xff\xff")
    assert names_in_pickle(tmp_path / "net.pth") == []
    (tmp_path / "net.pth").write_bytes(b"")
    assert (names_in_pickle(tmp_path / "net.pth"), pickle_protocol(tmp_path / "net.pth")) == ([], 0)
    (tmp_path / "net.pth").write_bytes(archive({"archive/data.pkl": b"\x80", "archive/version": b"3"}))
    assert (names_in_pickle(tmp_path / "net.pth"), pickle_protocol(tmp_path / "net.pth")) == ([], 0)
    with pytest.raises(ModelFileError, match=r"^net\.pth is not a PyTorch file of tensors alone"):
        lpn.load(tmp_path / "net.pth")
    assert file_contents.is_model_name("net_119.PTH")
    assert not file_contents.is_model_name("._net_119.pth")
