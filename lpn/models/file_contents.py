"""Kinds of model files by their first bytes; nothing is unpickled, and neither torch nor safetensors is needed."""

from __future__ import annotations

import re
import zipfile
import zlib
from pathlib import Path
from typing import Literal

from lpn.core.errors import ModelFileError
from lpn.core.files import printable

# Endings of the files that can hold a model.
ENDINGS = (".pth", ".pth.tar", ".pt", ".ckpt", ".bin", ".safetensors", ".onnx")

FileFormat = Literal["pytorch", "safetensors", "onnx"]
_TITLES: dict[FileFormat, tuple[str, str]] = {
    "pytorch": ("a PyTorch file", ".pth"),
    "safetensors": ("a .safetensors file", ".safetensors"),
    "onnx": ("an ONNX graph", ".onnx"),
}
_AGAIN = "download or copy the file again"
_POINTER = re.compile(rb"version https://(git-lfs|hawser)")
_PAGE = re.compile(rb"(?i)(\xef\xbb\xbf)?\s*(<\?xml[^>]*>\s*)?<(!doctype\s+html|html|head|body|script|!--|meta)")
_TITLE = re.compile(rb"(?is)<title[^>]*>\s*(.*?)\s*</title>")
# The number of bytes read from the beginning of a file, and the number quoted in a refusal.
_READ, _SHOWN = 1 << 16, 16


def check_contents(path: Path, expected: FileFormat) -> None:
    """Check that a file begins like one of its kind; its end may be missing.

    Raises:
        ModelFileError: if it is unreadable, or of another kind; the message names that kind, if known, and a remedy.
    """
    held = contents_of(path)
    if held == expected or {held, expected} == {"pytorch", "safetensors"}:
        return
    if held is not None:
        what, suffix = _TITLES[held]
        raise ModelFileError(f"{path.name} is {what} under another ending; rename it to {path.stem}{suffix}.")
    start = _start(path)
    known = _known(path, start)
    if known is None and expected == "onnx":
        return  # its fields may have any order
    what, remedy = known or (
        f"not {_TITLES[expected][0]}: it begins with {printable(repr(start[:_SHOWN])[1:])}",
        f"{_AGAIN}, unpack it if it is an archive, or give weights as PyTorch's state_dict, a .safetensors, or an exported .onnx",
    )
    raise ModelFileError(f"{printable(path.name)} is {what}; {remedy}.")


def contents_of(path: Path) -> FileFormat | None:
    """Return the kind of model that a file holds by its first bytes; None if it is of no known kind.

    Raises:
        ModelFileError: if it is missing or unreadable.
    """
    start = _start(path)
    if start.startswith(b"PK\x03\x04"):
        return "pytorch" if any(re.fullmatch(r"[^/]+/data\.pkl", entry) for entry in _entries(path) or ()) else None
    if start[8:9] == b"{" and int.from_bytes(start[:8], "little") < 1 << 40:
        return "safetensors"
    if re.match(rb"\x80[\x02-\x05]", start):
        return "pytorch"
    # The version of the format, then the producer, its version, a domain, operators, or the graph.
    return "onnx" if re.match(rb"\x08[\x03-\x1f][\x12\x1a\x22\x3a\x42\x72]", start) else None


def is_model_name(name: str) -> bool:
    """Return whether a file of this name can hold a model; macOS's hidden companion files cannot."""
    return name.lower().endswith(ENDINGS) and not name.startswith(".")


def check_trained_file(path: Path) -> None:
    """Check a model file's first bytes, without torch or safetensors installed.

    Raises:
        ModelFileError: if they are wrong, or the file is missing or unreadable.
    """
    if contents_of(path) != "safetensors":
        check_contents(path, "safetensors" if path.suffix == ".safetensors" else "pytorch")
    elif int.from_bytes(_start(path)[:8], "little") > path.stat().st_size - 8:
        raise ModelFileError(f"{printable(path.name)} is truncated; {_AGAIN}.")


def _start(path: Path) -> bytes:
    if not path.is_file():
        raise ModelFileError(f"There is no model file at {path}; check the path.")
    try:
        with path.open("rb") as file:
            return file.read(_READ)
    except OSError as error:
        raise ModelFileError(
            f"{path} cannot be read ({error.strerror or error}); check that it is readable."
        ) from error


def _entries(path: Path) -> list[str] | None:
    """Return the entries of a ZIP archive; None without its directory at the end."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.namelist()
    except (OSError, ValueError, RuntimeError, EOFError, OverflowError, zipfile.BadZipFile, zlib.error):
        return None


def _known(path: Path, start: bytes) -> tuple[str, str] | None:
    """Return the actual kind of a file, and the remedy; None if it is unknown."""
    if not start.strip(b"\0"):
        return ("full of zeros" if start else "empty"), f"its download or copy broke off, so {_AGAIN}"
    if start.startswith(b"PK") and _entries(path) is None:
        return f"truncated: it has {path.stat().st_size:,} bytes, and its end is missing", _AGAIN
    if _POINTER.match(start):
        return (
            "a Git LFS pointer, the text that Git leaves in place of a large file",
            "fetch the file itself with git lfs pull, or download it from the repository's page",
        )
    if _PAGE.match(start):
        title = _TITLE.search(start)
        named = f" ('{printable(' '.join(title[1].decode('utf-8', 'replace').split()))[:100]}')" if title else ""
        return f"a web page{named}", "download the file itself, not its page, and log in where the site asks for it"
    return None
