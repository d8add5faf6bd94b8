"""The model file in a folder, chosen as in released code: the newest `net_*.pth` of the only run there."""

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

# Names of checkpoints of each epoch. Released code sorts them as texts, so that `net_last.pth` comes last.
_EPOCH = re.compile(r"net_(last|\d{1,9})\.pth")
# The models of our own training, the better one first; other files lie beside them.
_OWN = ("best.safetensors", "last.safetensors")
# Files beside a model, from which a training resumes.
_STATE = re.compile(
    r"state\.pt|(optimizer|scheduler|scaler|sampler|rng_state|random_states|training_args)(_\d{1,6})?\.(pt|pth|bin)"
)
# The number of levels searched below a folder, as for model/NAME in the released code's folder.
_MAX_DEPTH = 2
_SHOWN = 5


def file_in(folder: Path) -> Path:
    """Return the only model file in a folder or in the only run below it.

    If a run has several checkpoints `net_*.pth`, the newest is taken, and logged.

    Raises:
        ModelFileError: if there is none, or several are possible; the message names them.
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
    """Leave out the files of an exported model's further views, such as `lpn.street.onnx` beside `lpn.onnx`."""
    others = [name for name in files if name.endswith(".onnx")]
    return [name for name in files if not (name in others and f"{Path(name).stem.rpartition('.')[0]}.onnx" in others)]


def _epoch(name: str) -> int:
    number = name.removeprefix("net_").removesuffix(".pth")
    return 1 << 30 if number == "last" else int(number)


def _models(folder: Path) -> list[str]:
    files = [entry.name for entry in _scan(folder) if is_model_name(entry.name) and entry.is_file()]
    return sorted(name for name in files if not _STATE.fullmatch(name))


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
