"""Speed: the ratios of `tools.bench` to the peer and to the limit, which differ by machine and fail nothing."""

from __future__ import annotations

from functools import partial

from lpn.core.errors import DataError
from tools.keep.measures import Figures, Measure, Value, reported

BENCHES = ("evaluate", "search", "describe", "query", "train")


def ratios(name: str) -> Figures:
    """Run one benchmark of `tools.bench`, and return by how much each figure beats the peer, and its ratio to the limit."""
    from tools.bench.__main__ import measured

    figures: dict[str, Value] = {}
    for one in measured(name):
        figures[f"{one.what}, {one.unit}"] = float(f"{one.ours:.3g}")
        for what, ratio in (("times the peer", one.gain), ("of the limit", one.excess)):
            if ratio is not None:
                figures[f"{one.what}, {what}"] = round(ratio, 2)
    if not figures:
        raise DataError(f"python -m tools.bench {name} measured nothing; run it to see why.")
    return figures


MEASURES = tuple(Measure(f"speed-{name}", partial(ratios, name), {"*": reported()}, slow=True) for name in BENCHES)
