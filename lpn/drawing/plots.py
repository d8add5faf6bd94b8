"""Matplotlib without a window, and its figures as PNG files."""

from __future__ import annotations

import io
from typing import Any, cast


def pyplot() -> Any:
    """Matplotlib's pyplot, drawing into memory."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return cast(Any, pyplot)


def png(figure: Any, dpi: int) -> bytes:
    """A figure as a PNG file, the same for the same figure; the figure is closed."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=dpi, metadata={"Software": None})
    pyplot().close(figure)
    return data.getvalue()
