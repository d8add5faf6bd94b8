"""The sentences the app says about an answer."""

from __future__ import annotations

from explorer.workspace import Answer
from lpn.drawing import verdicts
from lpn.drawing.verdicts import ordinal

__all__ = ["ordinal", "verdict"]


def verdict(answer: Answer, part_names: list[str]) -> tuple[bool | None, str, str]:
    """Whether the top match is true, a headline, and one sentence that says why; see `lpn.drawing.verdicts.verdict`."""
    first = answer.matches[0]
    if answer.state.upload is not None:
        gap = (
            f"the next tile is {first.gap:.3f} further away (d²)" if first.gap is not None else "there is no other tile"
        )
        return None, "Your picture: nearest tile", f"Its true place is not known here; {gap}."
    rival = next((match for match in answer.matches if not match.true), None)
    metres = None if answer.off is None else float(answer.off[first.index])
    return verdicts.verdict(first, answer.truth, rival, part_names, metres)
