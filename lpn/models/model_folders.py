"""The model file in a folder, as released code chooses it: the newest `net_*.pth` of the one run there."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path

from lpn.core.errors import ModelFileError
from lpn.core.files import first_few, printable
from lpn.models.file_contents import is_model_name

log = logging.getLogger(__name__)

# Names that trainings give to one checkpoint an epoch. Released code sorts them as texts, so that `net_last.pth` comes last.
_EPOCH = re.compile(r"net_(last|\d{1,9})\.pth")
# The models of a training of this project, the better one first, beside which it keeps other files.
_OWN = ("best.safetensors", "last.safetensors")
# Files that trainings save beside a model, to be resumed from.
_STATE = re.compile(
    r"state\.pt|(optimizer|scheduler|scaler|sampler|rng_state|random_states|training_args)(_\d{1,6})?\.(pt|pth|bin)"
)
# Folders below one that are searched, such as model/NAME in the folder of the released code.
_MAX_DEPTH = 2
_SHOWN = 5


def file_in(folder: Path) -> Path:
    """Return the one model file in a folder or in the one run below it.

    Several files `net_*.pth` are checkpoints of one run, of which the newest is taken, and the log says which.

    Raises:
        ModelFileError: if there is none, or if it is not clear which is meant, with their names.
    """
    level = [folder]
    for _ in range(_MAX_DEPTH + 1):
        runs = {run: files for run in level if (files := _models(run))}
        if len(runs) > 1:
            names = first_few([printable(str(run.relative_to(folder))) for run in runs], _SHOWN)
            raise ModelFileError(
                f"{printable(str(folder))} holds {len(runs)} folders with models ({names}); name the one that is meant."
            )
        for run, files in runs.items():
            return _chosen(run, files)
        level = [below for run in level for below in _folders(run)]
    raise ModelFileError(
        f"{printable(str(folder))} holds no model file (net_*.pth, .pth, .pt, .safetensors, or .onnx); name the file, or the "
        "folder that holds it."
    )


def _chosen(folder: Path, files: list[str]) -> Path:
    epochs = sorted((name for name in files if _EPOCH.fullmatch(name)), key=_epoch)
    own = [name for name in _OWN if name in files]
    candidates = own[:1] or epochs[-1:] or _without_groups(files)
    if len(candidates) > 1:
        names = first_few([printable(name) for name in candidates], _SHOWN)
        raise ModelFileError(
            f"{printable(str(folder))} holds {len(candidates)} models ({names}); name the file that is meant."
        )
    file = folder / candidates[0]
    level = logging.WARNING if len(files) > 1 else logging.INFO
    log.log(level, "%s is the model that is read.", printable(str(file)))
    return file


def _without_groups(files: list[str]) -> list[str]:
    """Return the files but those of further views of an exported model, `lpn.street.onnx` beside `lpn.onnx`."""
    stems = {name.removesuffix(".onnx") for name in files if name.endswith(".onnx")}
    return [
        name for name in files if name not in {f"{stem}.onnx" for stem in stems if stem.rpartition(".")[0] in stems}
    ]


def _epoch(name: str) -> tuple[int, str]:
    match = _EPOCH.fullmatch(name)
    assert match is not None
    return (1 << 30 if match[1] == "last" else int(match[1])), name


def _models(folder: Path) -> list[str]:
    return sorted(
        entry.name
        for entry in _scan(folder)
        if is_model_name(entry.name) and entry.is_file() and not _STATE.fullmatch(entry.name)
    )


def _folders(folder: Path) -> list[Path]:
    return sorted(Path(entry.path) for entry in _scan(folder) if entry.is_dir() and not entry.name.startswith("."))


def _scan(folder: Path) -> Iterator[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            yield from entries
    except OSError as error:
        raise ModelFileError(
            f"{printable(str(folder))} cannot be read ({error.strerror or error}); check that it is readable."
        ) from error
