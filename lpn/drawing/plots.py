"""Matplotlib figures as files, drawn without a window."""

from __future__ import annotations

import io
import os
from contextlib import suppress
from typing import Any, cast

from lpn.core.errors import OutputError
from lpn.core.files import cache_folder


def pyplot() -> Any:
    """Return Matplotlib's pyplot with the backend that draws into memory.

    Matplotlib caches its list of fonts in our cache folder, unless the user has a folder of Matplotlib settings.
    """
    own = os.path.join(os.environ.get("XDG_CONFIG_HOME") or "~/.config", "matplotlib"), "~/.matplotlib"  # noqa: PTH118
    if not any(os.path.isdir(os.path.expanduser(folder)) for folder in own):  # noqa: PTH111, PTH112 (no home is no error)
        with suppress(OutputError):  # no cache folder is no error
            os.environ.setdefault("MPLCONFIGDIR", str(cache_folder() / "matplotlib"))
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return cast(Any, pyplot)


def encode(figure: Any, dpi: int, kind: str = "png") -> bytes:
    """Encode a figure as a file, "png", "svg", or "pdf", and close it. Equal figures give equal files."""
    data = io.BytesIO()
    undated = {"png": "Software", "svg": "Date", "pdf": "CreationDate"}[kind]
    figure.savefig(data, format=kind, dpi=dpi, metadata={undated: None})
    pyplot().close(figure)
    return data.getvalue()
