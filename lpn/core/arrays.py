"""Aliases of NumPy array types, one for each dtype and named for it."""

from __future__ import annotations

import zlib
from tokenize import TokenError
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

AnyArray = npt.NDArray[Any]
BoolArray = npt.NDArray[np.bool_]
UInt8Array = npt.NDArray[np.uint8]
Int8Array = npt.NDArray[np.int8]
Int64Array = npt.NDArray[np.int64]
IntegerArray = npt.NDArray[np.integer]
Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]
FloatingArray = npt.NDArray[np.floating]
ObjectArray = npt.NDArray[np.object_]

# Errors that NumPy raises for a damaged archive or array header.
DAMAGED_ARRAY = (
    OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile, zlib.error, SyntaxError, TokenError, OverflowError,
    MemoryError, RuntimeError,
)  # fmt: skip
