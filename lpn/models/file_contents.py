"""Kinds of files that are given as models, by their first bytes; nothing is unpickled, and no torch or safetensors is needed."""

from __future__ import annotations

import glob
import io
import pickletools
import re
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Literal

from lpn.core.errors import ModelFileError
from lpn.core.files import first_few, printable

# Endings of the files that can hold a model.
ENDINGS = (".pth", ".pth.tar", ".pt", ".ckpt", ".bin", ".safetensors", ".onnx")

FileFormat = Literal["pytorch", "safetensors", "onnx"]
_TITLES: dict[FileFormat, tuple[str, str]] = {
    "pytorch": ("a PyTorch file", ".pth"),
    "safetensors": ("a .safetensors file", ".safetensors"),
    "onnx": ("an ONNX graph", ".onnx"),
}


@dataclass(frozen=True)
class _Mark:
    """The signature of files that are no models.

    Attributes:
        pattern: of the first bytes.
        what: such a file, as in "It is ...".
        remedy: what to do, as the end of a sentence.
        detail: a pattern whose group tells more about the file.
    """

    pattern: bytes
    what: str
    remedy: str
    detail: bytes = b""


_AGAIN = "download or copy the file again"
_UNPACK = "unpack it, and give the model file inside"
_OTHER = "give the weights as PyTorch's state_dict, a .safetensors, or an exported .onnx"
UNPACKED = "give the file itself, or pack its folder again (zip -0 -r ../net.pth . in it)"
_PAGE = "download the file itself, not its page, and log in where the site asks for it"
# In this order: the first that fits names the file.
_MARKS = (
    _Mark(
        rb"version https://(git-lfs|hawser)",
        "a Git LFS pointer, the text that Git leaves in place of a large file",
        "fetch the file itself with git lfs pull, or download it from the repository's page",
        rb"(?m)^size (\d+)",
    ),
    _Mark(
        rb"(\.\./)*(\.git/annex|/annex)/objects/",
        "a git-annex pointer, the text that stands in place of a large file",
        "fetch the file itself with git annex get",
    ),
    _Mark(
        rb"(?s)outs:\s*\n.*md5: ",
        "a pointer of DVC, the text that stands in place of a large file",
        "fetch the file itself with dvc pull",
        rb"size: (\d+)",
    ),
    _Mark(
        rb"(?is)\s*<.*?(<title>\s*Google Drive|virus scan warning|scan this file for viruses|//drive\.google\.com)",
        "a web page of Google Drive in place of the file",
        "open the link in a browser and choose 'Download anyway', or use gdown; where its quota is exceeded, wait a day",
        rb"(?is)<title[^>]*>\s*(.*?)\s*</title>",
    ),
    _Mark(
        rb"(?is)\s*(<!doctype\s+html|<html|<head|<body|<script|<!--|<meta|(<\?xml[^>]*>\s*)?<!doctype\s+html|<\?xml[^>]*>\s*<html)",
        "a web page",
        _PAGE,
        rb"(?is)<title[^>]*>\s*(.*?)\s*</title>",
    ),
    _Mark(
        rb"(?is)\s*(<\?xml[^>]*>\s*)?<Error>",
        "the error message of a server",
        "the download was refused, so ask for a new link",
        rb"(?is)<(?:Code|Message)>(.*?)</",
    ),
    _Mark(rb"\s*<", "an XML text", _OTHER),
    _Mark(
        rb'(?s)\s*\{.*"weight_map"',
        "the list of a model's files",
        "give one of these, and the line that puts them together is named",
    ),
    _Mark(
        rb"(?s)\s*[{\[]\s*[\"\]}\[{]",
        "a JSON text",
        "if it is the error message of a server, the download was refused; otherwise give the file of weights",
        rb'(?s)"(?:message|error|detail|errorMessage)"\s*:\s*"(.*?)"',
    ),
    _Mark(
        rb"\x00\x05\x16\x07", "a companion that macOS writes beside a file", "give the file of that name without '._'"
    ),
    _Mark(rb"\x1f\x8b", "packed by gzip", f"{_UNPACK} (tar -xzf, or gunzip)"),
    _Mark(rb"BZh\d1AY", "packed by bzip2", f"{_UNPACK} (tar -xjf, or bunzip2)"),
    _Mark(rb"\xfd7zXZ\x00", "packed by xz", f"{_UNPACK} (tar -xJf, or unxz)"),
    _Mark(rb"\x28\xb5\x2f\xfd", "packed by Zstandard", f"{_UNPACK} (unzstd)"),
    _Mark(rb"7z\xbc\xaf\x27\x1c", "a 7-Zip archive", _UNPACK),
    _Mark(rb"Rar!\x1a\x07", "a RAR archive", _UNPACK),
    _Mark(rb"%PDF-", "a PDF document", "give the file of weights"),
    _Mark(rb"\xff\xd8\xff|\x89PNG\r\n|GIF8|RIFF....WEBP|II\*\0|MM\0\*", "a picture", "give the file of weights"),
    _Mark(rb"\x89HDF\r\n\x1a\n", "an HDF5 file, as Keras and MATLAB write", _OTHER),
    _Mark(rb"MATLAB 5\.0 MAT-file", "a MATLAB file", f"{_OTHER}; lpn compare reads saved descriptors"),
    _Mark(rb"\x93NUMPY", "an array of NumPy", _OTHER),
    _Mark(rb"....TFL3", "a model of TensorFlow Lite", _OTHER),
    _Mark(rb"\x04\x00{3}\x01\x00{3}\x03\x00{3}V 1|4\r?\n1\r?\n3\r?\nV 1", "a model of Torch7 (Lua)", _OTHER),
    _Mark(rb"GGUF", "a GGUF file of a language model", _OTHER),
    _Mark(rb"\x08\x01\x12.[\s\S]*(serve|saved_model|tensorflow|__saved_model)", "a model of TensorFlow", _OTHER),
    _Mark(rb"(?s)[\x81-\x8f\xde].{0,2}[\xa1-\xbf][a-z_]{2}", "a msgpack file, as Flax and JAX write", _OTHER),
    _Mark(rb"\x7fELF|MZ.{64}|\xcf\xfa\xed\xfe", "a program", "give the file of weights"),
    _Mark(rb"\x4c\x00\x00\x00\x01\x14\x02\x00", "a shortcut of Windows", "give the file that it leads to"),
)
# The parts of a checkpoint of TensorFlow, which have no mark of their own.
_TENSORFLOW = re.compile(r".*\.(data-\d{5}-of-\d{5}|ckpt(-\d+)?\.(index|meta))|checkpoint")
# A file of a model that is split over several, as libraries of language models write.
_PART = re.compile(r"(?P<model>.+)-\d{5}-of-(?P<files>\d{5})(?P<ending>\.\w{1,12})")
# The files that torch.distributed.checkpoint writes into a folder.
_DISTRIBUTED = re.compile(r".*\.distcp|\.metadata")
DISTRIBUTED = (
    "a distributed checkpoint of PyTorch",
    "make one file of it: python -m torch.distributed.checkpoint.format_utils dcp_to_torch FOLDER weights.pth",
)
# Errors of damaged archives and pickles.
_UNREADABLE = (
    *(OSError, ValueError, IndexError, KeyError, EOFError, OverflowError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error),
)
# Bytes at the begin of a file that are looked at.
_READ = 1 << 16
# Bytes of a pickle, without its tensors, that are looked at.
_MAX_PICKLE = 1 << 24
# The number that torch.save writes first in PyTorch's format of before 2020.
_LEGACY = 0x1950A86A20F9469CFC6C
# Modules by the names that pickles of Python 2, and of protocol 2, give them.
_RENAMED = {"__builtin__": "builtins", "copy_reg": "copyreg"}
# Names in a pickle of tensors that run no code.
_HARMLESS = re.compile(
    r"torch\.\w+|torch\.(storage\.\w+|nn\.parameter\.\w+|_utils\._rebuild_\w+|_tensor\._rebuild_\w+|serialization\._get_layout)|"
    r"collections\.(OrderedDict|Counter)|_codecs\.encode|builtins\.(bytearray|set|complex)|"
    r"numpy\.(dtype|ndarray|dtypes\.\w+|_?core\.multiarray\.(scalar|_reconstruct))"
)


def check_contents(path: Path, expected: FileFormat) -> None:
    """Check that a file begins as one of a kind does; its end may still be missing.

    Raises:
        ModelFileError: if it does not, with what the file is, as far as that is known, and what to do; or if it is unreadable.
    """
    held = contents_of(path)
    if held == expected or {held, expected} == {"pytorch", "safetensors"}:
        return
    if held is not None:
        what, suffix = _TITLES[held]
        raise ModelFileError(f"{path.name} is {what} under another ending; rename it to {path.stem}{suffix}.")
    what, remedy = _described(path)
    if not what and expected == "onnx":
        return  # nothing prescribes the order of its fields
    raise ModelFileError(
        f"{printable(path.name)} is {what or f'not {_TITLES[expected][0]}, or its begin is damaged'}; {remedy}."
    )


def contents_of(path: Path) -> FileFormat | None:
    """Return the kind of model that a file holds by its first bytes; None if it is of no known kind.

    Raises:
        ModelFileError: if it is missing or unreadable, or by its name one of the several files of a model, with what to do.
    """
    start = _start(path)
    _check_alone(path)
    if start.startswith(b"PK\x03\x04"):
        entries = _entries(path)
        # Without a list of entries, at the end, the archive is truncated.
        others = _script(entries or ()) or _models(entries or ())
        return "pytorch" if entries is not None and pickle_entry(entries) and not others else None
    if start[8:9] == b"{" and int.from_bytes(start[:8], "little") < 1 << 40:
        return "safetensors"
    if re.match(rb"\x80[\x02-\x05]", start):
        return "pytorch"
    # The version of the format, then the producer, its version, a domain, operators, or the graph.
    return "onnx" if re.match(rb"\x08[\x03-\x1f][\x12\x1a\x22\x3a\x42\x72]", start) else None


def part_of(name: str) -> tuple[int, str] | None:
    """Return the number of a model's files, and a pattern of their names, by the name of one; None if it is the only one."""
    match = _PART.fullmatch(name)
    if match is None or int(match["files"]) < 2:
        return None
    return int(match["files"]), f"{glob.escape(match['model'])}-*-of-{match['files']}{match['ending']}"


def is_model_name(name: str) -> bool:
    """Return whether a file of this name can hold a model; the hidden companions that macOS writes do not."""
    return name.lower().endswith(ENDINGS) and not name.startswith(".")


def check_trained_file(path: Path) -> None:
    """Check a model file's first bytes, without torch or safetensors installed.

    Raises:
        ModelFileError: if it does not, or is missing or unreadable.
    """
    if contents_of(path) != "safetensors":
        check_contents(path, "safetensors" if path.suffix == ".safetensors" else "pytorch")
    elif int.from_bytes(_start(path)[:8], "little") > path.stat().st_size - 8:
        raise ModelFileError(f"{printable(path.name)} is truncated; {_AGAIN}.")


def pickle_entry(entries: Sequence[str]) -> str | None:
    """Return the entry of a ZIP archive that is PyTorch's pickle, also where the archive was unpacked and packed again."""
    pickles = [entry for entry in entries if PurePosixPath(entry).name == "data.pkl" and "__MACOSX" not in entry]
    return pickles[0] if len(pickles) == 1 else None


def save_again(
    path: Path, expression: str, prelude: str = "", where: str = "", aim: str = "save its weights alone"
) -> str:
    """Return what to do, as the end of a sentence: the line of Python that saves weights alone, where it is safe to paste.

    Args:
        expression: the weights, with `{}` for the file's name.
        prelude: statements before it.
        where: the place to do it, as " where PACKAGE can be imported".
        aim: the first words of the returned sentence.
    """
    # The line stands in double quotes of a shell, so Python's are single ones.
    source, target = (
        "'" + str(file).replace("\\", "\\\\").replace("'", "\\'") + "'"
        for file in (path, path.with_name(f"{path.stem}-weights.pth"))
    )
    line = f"{prelude}import torch; torch.save({expression.format(source)}, {target})"
    # A name in the file, or of it, must not become a command of the shell that the line is pasted into.
    if any(letter in line for letter in '"$`!') or not line.isprintable():
        return f"{aim}{where}, by torch.save of its state_dict"
    return printable(f'{aim}{where}: python -c "{line}"')


def names_in_pickle(path: Path, every: bool = False) -> list[str]:
    """Return the classes and functions, such as "argparse.Namespace", that a PyTorch file or pickle names and that may run code.

    Nothing is unpickled. The list is empty if there are none, or the file cannot be read.

    Args:
        every: also those of tensors and NumPy's numbers, which run none.
    """
    names: dict[str, None] = {}
    with suppress(*_UNREADABLE):
        for name in _names(_pickle_bytes(path)):
            names[name] = None
    return [name for name in names if every or not _HARMLESS.fullmatch(name)]


def pickle_protocol(path: Path) -> int:
    """Return the protocol of a PyTorch file's pickle; 0 if it has none."""
    with suppress(*_UNREADABLE):
        start = _pickle_bytes(path).read(2)
        return int.from_bytes(start[1:]) if start.startswith(b"\x80") else 0
    return 0


def pickled_by(path: Path) -> Literal["torch", "unpacked", "python"]:
    """Return what wrote a pickle: torch.save; torch.save, in an archive from which it was unpacked; or Python's own pickle."""
    start = _start(path)
    if start.startswith(b"PK") or _LEGACY.to_bytes(10, "little") in start[:40]:
        return "torch"
    with suppress(*_UNREADABLE):
        if any(operation.name == "BINPERSID" for operation, _, _ in pickletools.genops(start)):
            return "unpacked"
    return "python"


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


def _check_alone(path: Path) -> None:
    """Check by its name that a file is not one of several that make up a model."""
    if _DISTRIBUTED.fullmatch(path.name):
        what, remedy = DISTRIBUTED
        raise ModelFileError(f"{printable(path.name)} is a part of {what}; {remedy}.")
    if (part := part_of(path.name)) is None:
        return
    files, pattern = part
    names = repr(pattern).replace("{", "{{").replace("}", "}}")
    safe = path.suffix == ".safetensors"
    read = "safetensors.torch.load_file(f)" if safe else "torch.load(f, 'cpu')"
    together = save_again(
        path,
        f"{{{{k: v for f in pathlib.Path({{}}).parent.glob({names}) for k, v in {read}.items()}}}}",
        "import pathlib; " + ("import safetensors.torch; " if safe else ""),
        aim="put them together",
    )
    raise ModelFileError(f"{printable(path.name)} is one of the {files} files of a model; {together}.")


def _entries(path: Path) -> list[str] | None:
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.namelist()
    except _UNREADABLE:
        return None


def _script(entries: Sequence[str]) -> bool:
    return any(PurePosixPath(entry).name == "constants.pkl" for entry in entries)


def _models(entries: Sequence[str]) -> list[str]:
    paths = [PurePosixPath(entry) for entry in entries if not entry.endswith("/")]
    return [str(path) for path in paths if is_model_name(path.name) and "__MACOSX" not in path.parts]


def _described(path: Path) -> tuple[str, str]:
    """Return what a file is that holds no model, "" if that is unknown, and what to do."""
    start = _start(path)
    if not start.strip(b"\0"):
        return ("full of zeros" if start else "empty"), f"its download or copy broke off, so {_AGAIN}"
    if start.startswith(b"PK"):
        return _described_archive(path)
    if start[257:262] == b"ustar":
        return "a tar archive", f"{_UNPACK} (tar -xf)"
    if _TENSORFLOW.fullmatch(path.name):
        return "a part of a checkpoint of TensorFlow", _OTHER
    text = start.removeprefix(b"\xef\xbb\xbf")
    if start[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = start.decode("utf-16", "replace").encode()
    for mark in _MARKS:
        if re.match(mark.pattern, text):
            return mark.what + _detail(mark, text), mark.remedy
    if line := _text_line(text):
        return f"a text that begins '{line}'", f"{_AGAIN}, or give the file of weights"
    return "", f"{_AGAIN}, or save the model again"


def _detail(mark: _Mark, text: bytes) -> str:
    """Return what the file tells about itself, in brackets; empty if it tells nothing."""
    match = re.search(mark.detail, text) if mark.detail else None
    if match is None:
        return ""
    line = _one_line(match[1])
    return f" (of {int(line):,} bytes)" if line.isdecimal() else f" ('{line}')"


def _described_archive(path: Path) -> tuple[str, str]:
    """Return what a ZIP archive is that PyTorch did not write."""
    entries = _entries(path)
    if entries is None:
        return f"truncated: it has {path.stat().st_size:,} bytes, and its end is missing", _AGAIN
    if _script(entries):
        return "a TorchScript archive, which holds code", save_again(path, "torch.jit.load({}, 'cpu').state_dict()")
    if models := _models(entries):
        few = first_few([printable(model)[:80] for model in models], 3)
        return f"a ZIP archive that holds {few}", f"unpack it, and give that {'file' if len(models) == 1 else 'folder'}"
    names = [PurePosixPath(entry) for entry in entries if not entry.endswith("/")]
    for known, what in (
        ("[Content_Types].xml", "an Office document"),
        ("META-INF/MANIFEST.MF", "a Java archive"),
        ("model.weights.h5", "a model of Keras"),
        ("serialized_exported_program.json", "a graph of torch.export (.pt2)"),
        ("archive_format", "a graph of torch.export (.pt2)"),
    ):
        if any(entry == known or entry.endswith(f"/{known}") for entry in entries):
            return what, _OTHER
    if names and all(name.suffix == ".npy" for name in names):
        return "an archive of NumPy arrays (.npz)", _OTHER
    few = first_few([printable(str(name))[:80] for name in names], 3) or "nothing"
    return f"a ZIP archive that holds {few}", "give the file of weights"


def _one_line(text: bytes) -> str:
    return printable(" ".join(text.decode("utf-8", "replace").split()))[:100]


def _text_line(start: bytes) -> str:
    """Return the first line of a text; empty if the bytes are no text."""
    try:
        text = start.decode() if len(start) < _READ else start[:-4].decode("utf-8", "ignore")
    except UnicodeDecodeError:
        return ""
    plain = all(character.isprintable() or character in "\t\r\n\f" for character in text)
    return next((line for line in (part.strip()[:60] for part in text.splitlines()) if line), "") if plain else ""


def _pickle_bytes(path: Path) -> BinaryIO:
    """Return the pickle of a PyTorch file, as a stream of one or more pickles."""
    if not zipfile.is_zipfile(path):
        with path.open("rb") as file:
            return io.BytesIO(file.read(_MAX_PICKLE))
    with zipfile.ZipFile(path) as archive:
        entry = pickle_entry(archive.namelist())
        if entry is None:
            raise ValueError("it has no pickle")
        with archive.open(entry) as file:
            return io.BytesIO(file.read(_MAX_PICKLE))


def _names(stream: BinaryIO) -> Iterator[str]:
    """Yield the global names of a stream's pickles, up to its first that is none."""
    strings: list[str] = []
    memo: dict[int, str] = {}
    # In PyTorch's format of before 2020 three pickles come before that of the tensors.
    first, count = True, 1
    while count:
        count -= 1
        last = ""
        for operation, argument, _ in pickletools.genops(stream):
            name = operation.name
            if name == "GLOBAL":
                module, _, function = str(argument).partition(" ")
                yield f"{_RENAMED.get(module, module)}.{function}"
            elif name == "STACK_GLOBAL":
                yield ".".join(strings[-2:])
            elif isinstance(argument, str) and "UNICODE" in name:
                strings.append(argument)
                last = argument
                continue
            elif name in ("BINGET", "LONG_BINGET") and argument in memo:
                strings.append(memo[argument])
            elif name in ("BINPUT", "LONG_BINPUT") and isinstance(argument, int) and last:
                memo[argument] = last
            elif name == "MEMOIZE":
                memo[len(memo)] = last
            elif first and name == "LONG1" and argument == _LEGACY:
                count = 3
            last = ""
        first, strings, memo = False, [], {}
