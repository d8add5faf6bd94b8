"""The errors that a user can correct. Every message is one sentence for the user."""

from __future__ import annotations


class LPNError(Exception):
    """Base of all errors that a user can correct; the message says what is wrong, what was expected, and what to do."""


class ModelFileError(LPNError):
    """A model file is missing, damaged, or of a kind that cannot be used."""


class DataError(LPNError):
    """A data set folder is missing, empty, or not laid out as expected."""


class OtherKindError(DataError):
    """A file is of another kind than its name suggests; a reader of several files may skip it."""


class PictureError(LPNError):
    """A picture cannot be read."""


class StoreError(LPNError):
    """A descriptor store cannot be read or written."""


class NewerStoreError(StoreError):
    """A later version wrote the store; it must not be replaced like a damaged one."""


class OutputError(LPNError):
    """A file cannot be written."""


class InputError(LPNError):
    """An array or option has the wrong shape, type, or value."""


class DivergedError(InputError):
    """A training's loss or weights are out of bounds, so it cannot continue."""


class MissingPackageError(LPNError):
    """A feature needs a package of an extra that is not installed."""
