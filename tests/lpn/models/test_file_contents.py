"""A file given as a model is named for what it is, by its bytes, and no byte of it runs."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import lpn
from lpn.core.errors import ModelFileError
from lpn.models import file_contents
from tools.fixtures.without_torch import run_without_torch

PAGE = b"<!DOCTYPE html>\n<html><head><title>%s</title></head><body>Sign in</body></html>"


def saved(value: object, **how: Any) -> bytes:
    data = io.BytesIO()
    torch.save(value, data, **how)
    return data.getvalue()


# The bytes of a file, and how the sentence about it goes on behind its name.
FOREIGN: dict[str, tuple[bytes, str]] = {
    "Git LFS": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 198600000\n",
        "is a Git LFS pointer, the text that Git leaves in place of a large file; fetch the file itself with git lfs pull, or "
        "download it from the repository's page.",
    ),
    "page": (
        b"\xef\xbb\xbf  \n" + PAGE % b"Log in\n  to OneDrive",
        "is a web page ('Log in to OneDrive'); download the file itself, not its page, and log in where the site "
        "asks for it.",
    ),
    "page without a title": (b"<html><body>302 Found</body></html>", "is a web page; download the file itself"),
    "XHTML": (b'<?xml version="1.0"?><html xmlns="x"><title>a</title></html>', "is a web page ('a')"),
    "empty": (b"", "is empty; its download or copy broke off, so download or copy the file again."),
    "zeros": (b"\0" * 70_000, "is full of zeros; its download or copy broke off"),
    "cut": (saved({"a": torch.zeros(99)})[:-60], "is truncated: it has "),
}


@pytest.mark.parametrize("case", FOREIGN)
def test_a_file_of_another_kind_is_named(case: str, tmp_path: Path) -> None:
    data, sentence = FOREIGN[case]
    (tmp_path / "net_119.pth").write_bytes(data)
    with pytest.raises(ModelFileError) as caught:
        lpn.load(tmp_path / "net_119.pth")
    assert str(caught.value).startswith(f"net_119.pth {sentence}")
    assert "\n" not in str(caught.value)
    # Other endings give the same sentence.
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


def test_a_hidden_companion_is_no_model() -> None:
    assert file_contents.is_model_name("net_119.PTH")
    assert not file_contents.is_model_name("._net_119.pth")
