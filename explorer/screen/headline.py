"""The headline of an answer: found or missed, and which rings decide, by the exact shares of the squared distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lpn.analysis.analyser import Analysis
from lpn.core.arrays import BoolArray
from lpn.retrieval import Match

# A ring whose shares of two tiles differ by less is even; the second bound serves where the first names too few.
_EVEN, _FINE = 0.005, 0.001
_WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight")


@dataclass(frozen=True)
class Headline:
    """A verdict and its reason, as sentences.

    Attributes:
        found: whether the first tile is true; None where the truth is not known.
        title: what follows "Found" or "Missed", else the whole headline.
        reason: one sentence of at most 20 words.
    """

    found: bool | None
    title: str
    reason: str


def headline(analysis: Analysis, answer: Match, rival: Match | None, word: str, ends: tuple[str, str]) -> Headline:
    """Say how an answer ended, and why.

    Args:
        rival: the nearest wrong tile of a found answer, the truth of a missed one, else the next tile.
        word: the noun for a part, such as "ring".
        ends: names of the first and the last part, such as "the centre" and "the outer one".
    """
    total = analysis.task.tiles
    gaps = [] if rival is None else (rival.contributions - answer.contributions).tolist()
    lead = sum(gaps)
    if answer.true is None:
        name = analysis.task.gallery[answer.index].title
        return Headline(None, f"Nearest of {total:,}: {name}", f"No truth is known. Lead over the next: {lead:.2f}.")
    if answer.true:
        reason = "No other tile is ranked." if rival is None else _why_found(analysis, gaps, lead, word)
        return Headline(True, f"first of {total:,}", reason)
    if rival is None or not rival.true:
        return Headline(False, "the truth is not among the tiles", "No tile of its place is ranked.")
    return Headline(False, f"truth is {_ordinal(rival)} of {total:,}", _why_missed(gaps, word, ends))


def _why_found(analysis: Analysis, gaps: list[float], lead: float, word: str) -> str:
    if len(gaps) == 1:
        return f"Lead over the next tile: {lead:.2f}."
    winners = {part: index for part, (index, true) in enumerate(_without_each(analysis)) if not true}
    if len(winners) == 1:
        part, index = next(iter(winners.items()))
        return f"{_listed([part], word)} decides: without it, {analysis.task.gallery[index].title} wins."
    if winners:
        each = "either" if len(winners) == 2 else "any"
        return f"{_listed(list(winners), word)} decide: without {each} one, another tile wins."
    best = int(np.argmax(gaps))
    return f"{_listed([best], word)} adds most: {gaps[best]:.2f} of the lead of {lead:.2f}."


def _why_missed(gaps: list[float], word: str, ends: tuple[str, str]) -> str:
    if len(gaps) == 1:
        return f"The truth lies {gaps[0]:.2f} farther than the answer."
    for bound in (_EVEN, _FINE):
        wrong = [part for part, gap in enumerate(gaps) if gap >= bound]
        right = [part for part, gap in enumerate(gaps) if gap <= -bound]
        if sum(gaps[part] for part in wrong) > -sum(gaps[part] for part in right):
            break
    if len(wrong) == len(gaps):
        number = _WORDS[len(gaps)] if len(gaps) < len(_WORDS) else str(len(gaps))
        most = int(np.argmax(gaps))
        name = {0: ends[0], len(gaps) - 1: ends[1]}.get(most, f"{word} {most + 1}")
        return f"All {number} {word}s prefer the wrong tile, {name} most."
    verb = "prefers" if len(wrong) == 1 else "prefer"
    if not right:
        return f"{_listed(wrong, word)} {verb} the wrong tile, none the truth."
    verb, them = ("prefers", "it") if len(right) == 1 else ("prefer", "them")
    others = _listed(wrong, word).lower()
    return f"{_listed(right, word)} {verb} the truth, {others} outvote{'s' if len(wrong) == 1 else ''} {them}."


def _without_each(analysis: Analysis) -> list[tuple[int, bool]]:
    """Return the tile that wins without each part, and whether it is true."""
    ranking = analysis.ranking
    ranked = ranking.order[: ranking.depth]
    terms = ranking.similarities[ranked] * ranking.weights
    relevant: BoolArray | None = ranking.relevant
    found = []
    for part in range(terms.shape[1]):
        index = int(ranked[int(np.argmax(np.delete(terms, part, axis=1).sum(axis=1)))])
        found.append((index, relevant is not None and bool(relevant[index])))
    return found


def _ordinal(match: Match) -> str:
    if match.beyond:
        return match.rank_text
    ending = "th" if 10 < match.rank % 100 < 14 else {1: "st", 2: "nd", 3: "rd"}.get(match.rank % 10, "th")
    return f"{match.rank:,}{ending}"


def _listed(parts: Sequence[int], word: str) -> str:
    """Return "Ring 2", or "Rings 1, 2 and 4"."""
    numbers = [str(part + 1) for part in parts]
    if len(numbers) == 1:
        return f"{word.capitalize()} {numbers[0]}"
    return f"{word.capitalize()}s {', '.join(numbers[:-1])} and {numbers[-1]}"
