"""The sentences the app says about an answer."""

from __future__ import annotations

import numpy as np

from explorer.exhibit import Answer
from lpn.words import ordinal


def verdict(answer: Answer, part_names: list[str]) -> tuple[bool | None, str, str]:
    """Whether the top match is true, a headline, and one sentence that says why.

    The part that decides is the one with the largest exact difference of shares of the squared distance.
    """
    first, truth = answer.matches[0], answer.truth
    gap = f"the next tile is {first.gap:.3f} further away (d²)" if first.gap is not None else "there is no other tile"
    if answer.state.upload is not None:
        return None, "Your picture: nearest tile", f"Its true place is not known here; {gap}."
    if truth is None:
        return None, "No true tile", "The gallery has no tile of this place, so no answer can be right."
    if truth.rank == 1:
        rival = next((match for match in answer.matches if not match.true), None)
        if rival is None:
            return True, "Found: the top match is true", f"No wrong tile is near; {gap}."
        part = int(np.argmax(rival.shares - truth.shares))
        gain = float(rival.shares[part] - truth.shares[part])
        ahead = rival.distance2 - truth.distance2
        return (
            True,
            "Found: the top match is true",
            f"It leads the best wrong tile by {ahead:.3f} (d²); part {part_names[part]} does most of it (+{gain:.3f}).",
        )
    part = int(np.argmax(truth.shares - first.shares))
    loss = float(truth.shares[part] - first.shares[part])
    behind = truth.distance2 - first.distance2
    where = "" if answer.off is None else f" The answer is {answer.off[first.index]:,.0f} m off."
    return (
        False,
        f"Wrong: the true tile is {ordinal(truth.rank)}",
        f"It is {behind:.3f} (d²) behind the top match; part {part_names[part]} costs it most ({loss:+.3f}).{where}",
    )
