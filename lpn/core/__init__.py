"""Foundations: errors, views, files, pictures, tables, logging, and the machine's resources.

It imports nothing else of `lpn`, and every package may import it. Importing it needs no installed package.
"""

from lpn.core.errors import (
    DataError,
    InputError,
    LPNError,
    MissingPackageError,
    ModelFileError,
    OutputError,
    PictureError,
    StoreError,
)
from lpn.core.views import VIEWS, TaskName, View, views_of

__all__ = [
    "VIEWS",
    "DataError",
    "InputError",
    "LPNError",
    "MissingPackageError",
    "ModelFileError",
    "OutputError",
    "PictureError",
    "StoreError",
    "TaskName",
    "View",
    "views_of",
]
