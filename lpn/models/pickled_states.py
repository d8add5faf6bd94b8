"""Read the weights of a PyTorch file without running its code, whatever else a checkpoint holds."""

from __future__ import annotations

import importlib.util
import io
import logging
import os
import pickle
import re
import threading
import warnings
import zipfile
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, cast

import numpy as np
import torch
from torch import Tensor

from lpn.core.checksums import check_entries
from lpn.core.errors import ModelFileError
from lpn.core.files import first_few, printable
from lpn.models.file_contents import UNPACKED, names_in_pickle, pickle_entry, pickle_protocol, pickled_by, save_again

log = logging.getLogger(__name__)

_AGAIN = "copy it again from where it came, or make it again"
# Keys under which checkpoints keep the weights, in order of preference. Averaged weights (EMA) come last, because the released
# test code of the known methods uses the weights that are not averaged.
_WEIGHTS = (
    *("state_dict", "model_state_dict", "model", "model_state", "net", "network", "module", "params", "weights"),
    *("state_dict_ema", "model_ema", "ema_state_dict", "ema", "params_ema"),
)
# Depth of nested dictionaries to which weights are searched.
_MAX_DEPTH = 4
# Names of functions that run programs or code.
_ATTACK = re.compile(
    r"(os|posix|nt|sys|subprocess|shutil|socket|runpy|importlib|pty|ctypes|webbrowser|pickle|_pickle|timeit)\..*|"
    r"builtins\.(eval|exec|execfile|compile|__import__|open|breakpoint)"
)
# Names by which pickles give away unsupported kinds of tensors, each with the kind and its remedy.
_OTHER_TENSORS = (
    (
        re.compile(r"torch\.distributed\.(_?tensor|_shard)\..*"),
        "tensors that are spread over several processes; save them whole where it was trained, as get_model_state_dict of "
        "torch.distributed.checkpoint.state_dict returns them with StateDictOptions(full_state_dict=True, cpu_offload=True)",
    ),
    (
        re.compile(r"torch\._utils\._rebuild_(xla|device)_tensor.*"),
        "tensors of a TPU or NPU; save them again where it was trained, on the CPU: "
        "torch.save({k: v.cpu() for k, v in model.state_dict().items()}, 'weights.pth')",
    ),
    (re.compile(r"torchao\..*Tensor"), "tensors quantised by torchao; give the weights as they were trained"),
)
# Functions that rebuild tensors and NumPy's arrays.
_VALUES = re.compile(r"torch\._utils\._rebuild_.*|numpy\..*\.(_reconstruct|_frombuffer)")
# torch keeps one list of allowed names for the whole process.
_ALLOWING = threading.Lock()
_LOAD = "torch.load({}, 'cpu', weights_only=False)"


class _StandIn:
    """Stands for a class or function that a pickle names, and for the object that it would make. It runs and stores nothing.

    Values of NumPy beside the weights are not needed, so NumPy reads no bytes of the file either.
    """

    named: ClassVar[str] = ""

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def __setstate__(self, _: object) -> None:
        pass


@cache
def _of_numpy() -> tuple[str, ...]:
    """Return the names of NumPy's scalar types and dtypes, and of the functions that unpickle its scalars and arrays."""
    makers = ("scalar", "_reconstruct")
    scalars = [name for name in dir(np) if isinstance(kind := getattr(np, name), type) and issubclass(kind, np.generic)]
    return (
        *(f"numpy.{name}" for name in ("dtype", "ndarray", *scalars)),
        *(f"numpy.dtypes.{name}" for name in dir(np.dtypes) if name.endswith("DType")),
        *(f"numpy.{core}.multiarray.{name}" for core in ("core", "_core") for name in makers),
    )


def unpickle(path: Path) -> Any:
    """Return the contents of a PyTorch file; only tensors are unpickled, and values of NumPy are passed over.

    Raises:
        ModelFileError: if it is damaged, or names other objects; the message lists them, and has a line of Python that saves
            the weights alone.
    """
    whole = check_entries(
        path, f"{_AGAIN}, or save it again where it was saved with torch.serialization.set_crc32_options(False)"
    )
    try:
        return _load(path, _of_numpy())
    except Exception as error:  # the unpickler may raise anything
        names = names_in_pickle(path)
        if whole or names or isinstance(error, pickle.UnpicklingError) or pickled_by(path) != "torch":
            raise _refusal(path, names) from error
        raise ModelFileError(
            f"{path.name} is not a PyTorch file or is truncated; expected a saved state_dict."
        ) from error


def _load(path: Path, stood_for: Iterable[str]) -> Any:
    """Return the contents of a PyTorch file, with a stand-in for all that has one of these names."""
    stand_ins: Any = [(type("StandIn", (_StandIn,), {"named": name}), name) for name in stood_for]
    with warnings.catch_warnings(), _ALLOWING, torch.serialization.safe_globals(stand_ins):
        warnings.simplefilter("ignore")
        return torch.load(_as_torch_packs(path), map_location="cpu", weights_only=True)


def _as_torch_packs(path: Path) -> Path | BinaryIO:
    """Return the file; if somebody zipped it again under other folders, return its entries under torch's folder."""
    if path.suffix == ".safetensors":  # torch goes by this ending
        return io.BytesIO(path.read_bytes())
    if not zipfile.is_zipfile(path):
        return path
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        folder = (pickle_entry(names) or "").removesuffix("data.pkl")
        if folder.count("/") == 1 and all(name.startswith(folder) for name in names):
            return path
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as target:
            for name in names:
                if name.startswith(folder) and not name.endswith("/"):
                    target.writestr(f"archive/{name[len(folder) :]}", archive.read(name))
    packed.seek(0)
    return packed


def _refusal(path: Path, names: Sequence[str]) -> ModelFileError:
    """Return the error for a pickle that names more than tensors, with the line of Python that saves its weights alone."""
    few = first_few([printable(name)[:80] for name in names], 3)
    if attack := [name for name in names if _ATTACK.fullmatch(name)]:
        return ModelFileError(
            f"{path.name} would run code by {printable(attack[0])[:80]}, which no training saves, so it was not opened; do not "
            "open it with another program either."
        )
    by = pickled_by(path)
    if by == "unpacked":
        return ModelFileError(f"{path.name} is an unpacked entry of a PyTorch file; {UNPACKED}.")
    if by == "python":
        what = f" and names {few}" if names else ""
        line = _saved_again(path, names, "pickle.load(open({}, 'rb'))", "import pickle; ")
        return ModelFileError(
            f"{path.name} is a pickle that torch.save did not write{what}, which may run code, so it was not opened; if you "
            f"trust it, {line}."
        )
    every = names_in_pickle(path, every=True)
    if (other := _other_tensors(path, every)) is not None:
        return other
    if (protocol := pickle_protocol(path)) > 2:
        return ModelFileError(
            f"{path.name} was saved with pickle protocol {protocol}, which may run code, so it was not opened; tensors alone are "
            f"read with protocol 2, so if you trust it, {save_again(path, _LOAD)}."
        )
    if not names:
        return ModelFileError(
            f"{path.name} is not a PyTorch file of tensors alone, so it was not opened further (it may run code); "
            "expected a saved state_dict()."
        )
    if not any(_VALUES.fullmatch(name) for name in every):
        return ModelFileError(
            f"{path.name} holds no tensors, but names {few}, which may run code, so it was not opened; give the file of the "
            "network's weights."
        )
    place = _place_of_weights(path, names)
    what = f"holds other things than tensors: it names {few}"
    if place.endswith(".state_dict()"):
        own = [printable(name)[:80] for name in names if not name.startswith(("torch.", "builtins."))] or [few]
        what = f"holds a whole network, saved with torch.save(model): it names {first_few(own, 3)}"
    return ModelFileError(
        f"{path.name} {what}, which may run code, so it was not opened; if you trust it, "
        f"{_saved_again(path, names, _LOAD + place, _prelude(names))}."
    )


def _other_tensors(path: Path, names: Sequence[str]) -> ModelFileError | None:
    """Return the error for tensors of an unsupported kind, by the names in a pickle or of their classes; None without them."""
    for pattern, sentence in _OTHER_TENSORS:
        if any(pattern.fullmatch(name) for name in names):
            return ModelFileError(f"{path.name} holds {sentence}.")
    return None


def _saved_again(path: Path, names: Sequence[str], expression: str, prelude: str) -> str:
    """Return what to do with a file that names classes, as the end of a sentence."""
    if any(name.startswith("__main__.") for name in names):
        return "save its weights alone in the script that made it, by torch.save of its state_dict"
    return save_again(path, expression, prelude, _where(names))


def _where(names: Sequence[str]) -> str:
    """Return " where PACKAGES can be imported", with the packages missing on this machine; empty if none is missing."""
    packages = sorted({name.partition(".")[0] for name in names})
    missing = [printable(package)[:40] for package in packages if not _importable(package)]
    return f" where {first_few(missing, 3)} can be imported" if missing else ""


def _importable(package: str) -> bool:
    """Return whether a package can be imported here, without importing it."""
    try:
        return importlib.util.find_spec(package) is not None
    except (ImportError, ValueError):
        return False


def _prelude(names: Sequence[str]) -> str:
    """Return the statements that let paths of another system, and of a later Python, be unpickled here; empty without them."""
    own, other = ("PosixPath", "WindowsPath") if os.name == "posix" else ("WindowsPath", "PosixPath")
    prelude = ""
    if any(name.startswith("pathlib._local.") for name in names):
        prelude = "import pathlib, sys; sys.modules['pathlib._local'] = pathlib; "
    if any(name.startswith("pathlib.") and name.endswith(other) for name in names):
        prelude = (prelude or "import pathlib; ") + f"pathlib.{other} = pathlib.{own}; "
    return prelude


def _place_of_weights(path: Path, names: Iterable[str]) -> str:
    """Return what leads to the weights in a pickle that names more than tensors, as "['model']" or ".state_dict()"."""
    with suppress(Exception):  # the unpickler may raise anything
        loaded = _load(path, [*_of_numpy(), *names])
        if isinstance(loaded, _StandIn):
            return ".state_dict()"
        keys, state = _inner(loaded)
        if not _has_tensors(state):
            objects = [key for key, value in state.items() if isinstance(value, _StandIn)]
            key = next((key for key in _WEIGHTS if key in objects), objects[0])
            return _subscript([key]) + ".state_dict()"
        return _subscript(keys)
    return _subscript(["state_dict"])


def _subscript(keys: Iterable[object]) -> str:
    return "".join(f"[{key!r}]" for key in keys).replace("{", "{{").replace("}", "}}")


def find_state(loaded: Any, path: Path) -> dict[str, Tensor]:
    """Return the named tensors in the result of `unpickle`. If there are several state dicts, a warning says which one is read.

    Raises:
        ModelFileError: if there are none, or it is not clear which are the model.
    """
    state = _inner(loaded)[1] if isinstance(loaded, dict) else {}
    items = {key: value for key, value in state.items() if isinstance(value, Tensor)}
    if not items or not all(isinstance(key, str) for key in items):
        raise _no_state(loaded, path)
    kinds = sorted({f"{type(tensor).__module__}.{type(tensor).__name__}" for tensor in items.values()})
    if (other := _other_tensors(path, kinds)) is not None:
        raise other
    if state is not loaded and len(others := _states(loaded)) > 1:
        keys = [printable(str(key))[:40] for key in others]
        log.warning("%s holds weights as %s; those of %s are read.", printable(path.name), ", ".join(keys), keys[0])
    return cast("dict[str, Tensor]", items)


def _inner(loaded: dict[Any, Any], depth: int = _MAX_DEPTH) -> tuple[list[Any], dict[Any, Any]]:
    """Return the keys that lead to a checkpoint's state dict, and the state dict; no keys and `loaded` itself without one."""
    states = _states(loaded, depth)
    named = next(iter(states), None)
    if named is not None and (named in _WEIGHTS or (len(states) == 1 and not _has_tensors(loaded))):
        keys, state = states[named]
        return [named, *keys], state
    return [], loaded


def _states(loaded: dict[Any, Any], depth: int = _MAX_DEPTH) -> dict[Any, tuple[list[Any], dict[Any, Any]]]:
    """Return the state dicts among the values of a dictionary, those of the usual names first."""
    if not depth:
        return {}
    states = {}
    for key in (*_WEIGHTS, *(key for key in loaded if key not in _WEIGHTS)):
        value = loaded.get(key)
        if not isinstance(value, dict) or "param_groups" in value:
            continue
        if key in _WEIGHTS:
            inner = _inner(value, depth - 1)
            if _has_tensors(inner[1]):
                states[key] = inner
        elif value and all(isinstance(tensor, Tensor) for tensor in value.values()):
            states[key] = [], value
    return states


def _has_tensors(values: dict[Any, Any]) -> bool:
    return any(isinstance(value, Tensor) for value in values.values())


def _no_state(loaded: object, path: Path) -> ModelFileError:
    """Return the error for a file without a state dict, or with several of no usual name."""
    expected = "expected a state_dict of named tensors"
    if not isinstance(loaded, dict):
        return ModelFileError(f"{path.name} holds a {type(loaded).__name__}; {expected}.")
    states = _states(loaded)
    if len(states) == 1:
        return ModelFileError(
            f"{path.name} holds a state dict as {printable(str(next(iter(states))))[:40]} whose keys are not strings; {expected}."
        )
    if states:
        named = first_few([printable(str(key))[:40] for key in states], 4)
        expression = "torch.load({}, 'cpu')" + _subscript([next(iter(states))])
        return ModelFileError(
            f"{path.name} holds several state dicts ({named}), and no name says which one is the model; "
            f"{save_again(path, expression)}."
        )
    if "param_groups" in loaded:
        return ModelFileError(f"{path.name} holds the state of an optimizer; give the file of the network's weights.")
    for key, values in [("", loaded), *loaded.items()]:
        if isinstance(values, dict) and any(
            isinstance(v, _StandIn) and "_reconstruct" in v.named for v in values.values()
        ):
            inner = _LOAD + (_subscript([key]) if key else "")
            expression = f"{{{{k: torch.as_tensor(v) for k, v in {inner}.items() if hasattr(v, 'shape')}}}}"
            return ModelFileError(
                f"{path.name} holds arrays of NumPy in place of tensors; if you trust it, {save_again(path, expression)}."
            )
    named = first_few([printable(str(key))[:40] for key in loaded], 4) or "nothing"
    return ModelFileError(f"{path.name} holds no named tensors, but {named}; {expected}.")
