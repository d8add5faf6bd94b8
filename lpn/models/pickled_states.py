"""The weights of a PyTorch file, read without running its code, whatever else a checkpoint holds."""

from __future__ import annotations

import io
import logging
import re
import threading
import warnings
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lpn.core.checksums import check_entries
from lpn.core.errors import ModelFileError
from lpn.core.files import first_few, printable

log = logging.getLogger(__name__)

_AGAIN = "copy it again from its source, or make it again"
_SAVE_AGAIN = "save the network's state_dict by torch.save where it was trained"
# Keys of the weights in checkpoints, in order of preference. Averaged weights (EMA) come last, because the released test code of
# the known methods does not use them.
_WEIGHTS = (
    *("state_dict", "model_state_dict", "model", "model_state", "net", "network", "module", "params", "weights"),
    *("state_dict_ema", "model_ema", "ema_state_dict", "ema", "params_ema"),
)
# Depth of nested dictionaries that are searched.
_MAX_DEPTH = 4
# torch's message about the first forbidden name in a pickle.
_NAMED = re.compile(r"GLOBAL ([\w.]+)")
# Types of the tensors that are read; others, such as DTensor and torchao's, do not contain their values.
_PLAIN = ("torch.Tensor", "torch.nn.parameter.Parameter", "torch.nn.parameter.Buffer")
# torch has one list of allowed names for the whole process.
_ALLOWING = threading.Lock()


class _StandIn:
    """A stand-in for a type or function of NumPy in a pickle, and for its result.

    Values of NumPy beside the weights are not needed, so NumPy reads no bytes of the file.
    """

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
    """Return the contents of a PyTorch file; only tensors are unpickled, and NumPy's values are ignored.

    Raises:
        ModelFileError: if it is damaged, or contains other objects; the message names the first of them.
    """
    check_entries(
        path, f"{_AGAIN}; if saved with torch.serialization.set_crc32_options(False), save it again without that"
    )
    stand_ins: Any = [(type("StandIn", (_StandIn,), {}), name) for name in _of_numpy()]
    try:
        with warnings.catch_warnings(), _ALLOWING, torch.serialization.safe_globals(stand_ins):
            warnings.simplefilter("ignore")
            # By this ending torch would choose another reader.
            file = io.BytesIO(path.read_bytes()) if path.suffix == ".safetensors" else path
            return torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler may raise anything
        named = _NAMED.search(str(error))
        if named is None:
            raise ModelFileError(
                f"{path.name} is truncated or not a PyTorch file of tensors alone, so it was not opened; copy it again, or "
                f"{_SAVE_AGAIN}."
            ) from error
        raise ModelFileError(
            f"{path.name} holds more than tensors: it names {printable(named[1])[:80]}, which may run code, so it was not "
            f"opened; {_SAVE_AGAIN}."
        ) from error


def find_state(loaded: Any, path: Path) -> dict[str, Tensor]:
    """Return the named tensors in the result of `unpickle`. With several state dicts, a warning names the chosen one.

    Raises:
        ModelFileError: if there are none, or several are equally likely.
    """
    state = _inner(loaded) if isinstance(loaded, dict) else {}
    items = _tensors(state)
    if not items or not all(isinstance(key, str) for key in items):
        keys = (
            [printable(str(key))[:40] for key in loaded] if isinstance(loaded, dict) else [f"a {type(loaded).__name__}"]
        )
        raise ModelFileError(
            f"{path.name} holds {first_few(keys, 4) or 'nothing'}; expected one state_dict of named tensors, so {_SAVE_AGAIN}."
        )
    for key, tensor in items.items():
        if (kind := f"{type(tensor).__module__}.{type(tensor).__name__}") not in _PLAIN:
            raise ModelFileError(
                f"In {path.name}, {printable(key)} is a {kind}; expected plain tensors, so {_SAVE_AGAIN}, each tensor whole "
                "and on the CPU."
            )
    if state is not loaded and len(others := _states(loaded)) > 1:
        keys = [printable(str(key))[:40] for key in others]
        log.warning("%s holds weights as %s; those of %s are read.", printable(path.name), ", ".join(keys), keys[0])
    return cast("dict[str, Tensor]", items)


def _inner(loaded: dict[Any, Any], depth: int = _MAX_DEPTH) -> dict[Any, Any]:
    """Return the state dict of a checkpoint; `loaded` itself without one."""
    states = _states(loaded, depth)
    named = next(iter(states), None)
    if named is not None and (named in _WEIGHTS or (len(states) == 1 and not _tensors(loaded))):
        return states[named]
    return loaded


def _states(loaded: dict[Any, Any], depth: int = _MAX_DEPTH) -> dict[Any, dict[Any, Any]]:
    """Return the state dicts among the values of a dictionary, those with usual names first."""
    states = {}
    for key in (*_WEIGHTS, *(key for key in loaded if key not in _WEIGHTS)) if depth else ():
        value = loaded.get(key)
        if isinstance(value, dict) and "param_groups" not in value:
            usual = key in _WEIGHTS
            inner = _inner(value, depth - 1) if usual else value
            tensors = _tensors(inner)
            if tensors and (usual or len(tensors) == len(inner)):
                states[key] = inner
    return states


def _tensors(values: dict[Any, Any]) -> dict[Any, Tensor]:
    return {key: value for key, value in values.items() if isinstance(value, Tensor)}
