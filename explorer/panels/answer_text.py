"""The sentences the app says about an answer."""

from __future__ import annotations

from explorer.workspace import StateAnalysis
from lpn.drawing import verdicts
from lpn.drawing.verdicts import ordinal

__all__ = ["ordinal", "verdict"]


def verdict(analysis: StateAnalysis, part_names: list[str]) -> tuple[bool | None, str, str]:
    """Whether the top match is true, a headline, and one sentence that says why; see `lpn.drawing.verdicts.verdict`."""
    first = analysis.matches[0]
    if analysis.state.upload is not None:
        gap = (
            f"the next tile is {first.gap:.3f} further away (d²)" if first.gap is not None else "there is no other tile"
        )
        return None, "Your picture: nearest tile", f"Its true place is not known here; {gap}."
    rival = next((match for match in analysis.matches if not match.true), None)
    metres = None if analysis.errors_m is None else float(analysis.errors_m[first.index])
    return verdicts.verdict(first, analysis.positive, rival, part_names, metres)
