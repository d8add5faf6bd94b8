"""MATLAB 5 files, read by scipy in a separate process, because a damaged file can crash the reader."""

from __future__ import annotations

import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from lpn.core.errors import DataError
from lpn.core.files import printable

# Limits of a file's size, and of its reader's memory and time.
MAX_BYTES = 4_000_000_000
_MEMORY = 3 * MAX_BYTES
_SECONDS = 300
_READER = """
import pickle, sys, warnings
warnings.simplefilter("ignore")
from scipy.io import loadmat
path, simplify, memory, *names = sys.argv[1:]
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, (int(memory), resource.getrlimit(resource.RLIMIT_AS)[1]))
except (ImportError, ValueError, OSError):
    pass
try:
    values = loadmat(path, simplify_cells=simplify == "True", variable_names=names)
    found = {name: values[name] for name in names if name in values}
except Exception as error:
    found = str(error) or type(error).__name__
pickle.dump(found, sys.stdout.buffer, protocol=5)
"""


def load(path: Path, names: Sequence[str], expected: str, simplify: bool = False) -> dict[str, Any]:
    """Read named variables of a MATLAB 5 file, as `scipy.io.loadmat` returns them; missing ones are left out.

    Args:
        expected: the expected contents, for messages.
        simplify: return structs as dicts, and squeeze arrays.

    Raises:
        DataError: if the file cannot be read, is not a MATLAB 5 file, or is damaged.
        ModuleNotFoundError: if scipy is not installed.
    """
    if find_spec("scipy") is None:
        raise ModuleNotFoundError("No module named 'scipy'", name="scipy")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"it has more than {MAX_BYTES // 1_000_000} MB")
        with path.open("rb") as file:
            head = file.read(128)
            if head.startswith(b"MATLAB 7.3"):
                raise ValueError(
                    "it is no MATLAB 5 file but one of 7.3; save it by save(..., '-v7') or scipy.io.savemat"
                )
            if head[126:] != b"IM":
                raise ValueError("it is no MATLAB 5 file of a little-endian machine")
        return _read(path, names, simplify)
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error).strip().partition("\n")[0]
        raise DataError(f"{path.name} cannot be read ({printable(reason)}); expected {expected}.") from error


def _read(path: Path, names: Sequence[str], simplify: bool) -> dict[str, Any]:
    command = [sys.executable, "-P", "-c", _READER, str(path.absolute()), str(simplify), str(_MEMORY), *names]
    with tempfile.TemporaryFile() as output:
        try:
            reader = subprocess.run(command, stdout=output, stderr=subprocess.DEVNULL, timeout=_SECONDS, check=False)
        except subprocess.TimeoutExpired as error:
            raise ValueError("its reader did not end in time, so it is damaged") from error
        if reader.returncode:
            raise ValueError("its reader crashed, so it is damaged")
        output.seek(0)
        values: dict[str, Any] | str = pickle.load(output)
    if isinstance(values, str):
        raise ValueError(values)
    return values
