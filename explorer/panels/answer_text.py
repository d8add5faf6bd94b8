"""The verdict on an analysis in words."""

from __future__ import annotations

import math

from explorer.workspace import StateAnalysis
from lpn.drawing import verdicts


def verdict(analysis: StateAnalysis, part_names: list[str]) -> tuple[bool | None, str, str]:
    """Return whether the top match is right (None: unknown), a headline, and the reason; see `lpn.drawing.verdicts`."""
    first, depth = analysis.matches[0], analysis.ranking.depth
    if analysis.ranking.relevant is None:
        gap = "there is no other tile"
        if first.gap is not None:
            gap = f"the next tile is {first.gap:.3f} further away (d²)"
        own = "Your picture: nearest tile" if analysis.state.upload is not None else "Nearest tile"
        return None, own, f"Its true place is not known here; {gap}."
    if analysis.positive is None and depth is not None:
        return False, f"No true tile among the {depth} found", "The search does not tell what follows them."
    hardest_negative = next((match for match in analysis.matches if not match.true), None)
    error_m = None if analysis.errors_m is None else float(analysis.errors_m[first.index])
    if error_m is not None and not math.isfinite(error_m):  # a tile of an index without a position
        error_m = None
    return verdicts.verdict(first, analysis.positive, hardest_negative, part_names, error_m)
