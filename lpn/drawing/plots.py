"""Matplotlib figures as PNG files, drawn without a window."""

from __future__ import annotations

import io
import os
from typing import Any, cast

from lpn.core.files import cache_folder


def pyplot() -> Any:
    """Return Matplotlib's pyplot with the backend that draws into memory; its list of fonts is kept in our cache."""
    os.environ.setdefault("MPLCONFIGDIR", str(cache_folder() / "matplotlib"))
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return cast(Any, pyplot)


def png(figure: Any, dpi: int) -> bytes:
    """Encode a figure as a PNG file, and close it. Equal figures give equal files."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=dpi, metadata={"Software": None})
    pyplot().close(figure)
    return data.getvalue()
