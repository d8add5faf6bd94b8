"""The verdict on an answer: whether it is right, and the parts that decide it.

The shares s_i of the parts, with their terms under CSLS, add up to the squared distance of the ranking. In each part, the
answer has the gain g_i = s_i(rival) - s_i(answer) over its rival, and the gains add up to its lead. The rival of a right answer
is the nearest wrong tile, and of a wrong answer the nearest true tile. Without a known true tile, the rival is the next tile.

- Right: a part *decides* if the remaining parts alone rank a wrong tile first. If no part decides, the part of the largest
  gain *adds most* to the lead.
- Wrong: a part prefers the answer or its rival by the sign of its gain; below a bound, it hardly differs. The bound is lowered
  until the named parts that prefer the wrong tile outweigh the named parts that prefer the truth.

A part that does not count, because its weight is 0 or it is empty in the query, is never named.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from lpn.core.arrays import Float64Array, Int64Array
from lpn.core.numbers import distance, rounded_to_sum, shown_difference
from lpn.core.texts import listed, ordinal
from lpn.retrieval import Match, Ranking

# Tolerance of equal scores: the errors of float32 cosines and their sums are smaller.
_EQUAL = 1e-5
# Gains in d² within this difference are alike.
_ALIKE = 5e-4
# A lead below this is nearly a tie.
_TIE = 1e-3
# Bounds below which a part hardly differs; the first one at which the named parts explain the order is used.
_BOUNDS = (5e-3, _TIE, 1e-5)
_NUMBERS = ("three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")


@dataclass(frozen=True, eq=False)
class Verdict:
    """The verdict on the first tile of a ranking.

    Attributes:
        sign: True if it is right, False if it is wrong or nothing could be right, None if the truth is unknown.
        headline: the reason in a few words, without a full stop.
        sentence: the lead and its consequences, in one or two sentences.
        answer: the first tile.
        rival: the compared tile; None without one.
        gains: each part's gain over the rival in d², (n,); None without one.
        parts: the parts that the headline names: they decide, add most, or prefer the wrong tile.
    """

    sign: bool | None
    headline: str
    sentence: str
    answer: Match
    rival: Match | None = None
    gains: Float64Array | None = None
    parts: tuple[int, ...] = ()

    @property
    def lead(self) -> float:
        """The difference of the displayed distances of rival and answer, see `shown_difference`; 0 without a rival."""
        return 0.0 if self.rival is None else shown_difference(self.rival.distance2, self.answer.distance2)

    @property
    def figures(self) -> list[float]:
        """The displayed gains: rounded, they add up to the lead."""
        return [] if self.gains is None else rounded_to_sum(self.gains.tolist(), total=self.lead)


def judge(ranking: Ranking, names: Sequence[str], noun: str = "part", error_m: float | None = None) -> Verdict:
    """Judge the first tile of a ranking.

    Args:
        names: of the parts, (n,).
        noun: the noun for a part.
        error_m: metres from the query's place to the first tile; None if unknown.
    """
    answer = ranking.match(0)
    rival = ranking.hardest_negative() if answer.true else ranking.positive()
    if rival is None and answer.true:
        return Verdict(True, "Found: there is no wrong tile", "All tiles that are searched show the place.", answer)
    if rival is None:
        return _without_truth(ranking, answer)
    words, gains = _Words(names, noun), ranking.gains(answer.index, rival.index)
    found = Verdict(answer.true, "", "", answer, rival, gains)
    counted = np.flatnonzero(ranking.weights * (1 if ranking.lengths is None else ranking.lengths))
    if answer.true:
        headline, parts, sentence = _right(ranking, found, counted, words)
    else:
        headline, parts, sentence = _wrong(found, gains, counted, words)
        sentence += "" if error_m is None else f" The answer lies {distance(error_m)} from the place photographed."
    return Verdict(answer.true, headline, sentence, answer, rival, gains, parts)


def _without_truth(ranking: Ranking, answer: Match) -> Verdict:
    """Compare an answer with the next tile if the truth is unknown, or no tile is true."""
    rival = next(iter(ranking.top(2)[1:]), None)
    lead = None if rival is None else shown_difference(rival.distance2, answer.distance2)
    gains = None if rival is None else ranking.gains(answer.index, rival.index)
    if ranking.relevant is not None:
        why = "The gallery has no tile of this place, so no answer can be right."
        return Verdict(False, "No true tile", why, answer, rival, gains)
    leads = "There is no other tile." if lead is None else f"It leads the next tile by {lead:.3f}."
    return Verdict(None, "No truth is known", leads, answer, rival, gains)


def _ranks_without(ranking: Ranking) -> Int64Array:
    """Return the rank of the nearest true tile without each part, (n,); a tie counts as if the true tile came first."""
    assert ranking.relevant is not None
    weights = np.where(np.eye(len(ranking.weights)), 0.0, ranking.weights[:, None])
    scores = ranking.similarities @ weights
    true, wrong = ranking.order[ranking.relevant[ranking.order]], np.zeros(len(scores), bool)
    wrong[ranking.order] = True
    wrong[true] = False
    ahead = scores > scores[true].max(axis=0) + _EQUAL
    return cast(Int64Array, 1 + np.array([np.count_nonzero(one & wrong) for one in ahead.T]))


def _right(ranking: Ranking, found: Verdict, counted: Int64Array, words: _Words) -> tuple[str, tuple[int, ...], str]:
    assert found.gains is not None
    leads = f"It leads the nearest wrong tile by {found.lead:.3f}"
    if len(counted) == 1:
        return f"Lead over the nearest wrong tile: {found.lead:.3f}", (), f"{leads}."
    ranks = _ranks_without(ranking)
    if deciding := [part for part in counted.tolist() if ranks[part] > 1]:
        which = {1: "it", 2: "either one"}.get(len(deciding), "any one of them")
        headline = f"{words.named(deciding)} decide{_s(deciding)}: without {which}, a wrong tile wins"
        falls = [f"{ordinal(int(ranks[part]))} without {words.lower([part])}" for part in deciding]
        return headline, tuple(deciding), f"{leads}; the nearest true tile would be {listed(falls)}."
    if float(found.gains.sum()) < _TIE:
        return "Nearly a tie: the nearest wrong tile is 0.001 behind or less", (), f"{leads}."
    most = _alike(found.gains, counted)
    figures = [found.figures[part] for part in most]
    alike = ", alike" if len(most) > 1 else ""
    of = "of" if round(sum(figures), 3) <= found.lead else "to"
    shown = listed([f"{figure:.3f}" for figure in figures])
    headline = f"{words.named(most)} add{_s(most)} most{alike}: {shown} {of} the lead of {found.lead:.3f}"
    return headline, tuple(most), f"{leads}."


def _wrong(found: Verdict, gains: Float64Array, counted: Int64Array, words: _Words) -> tuple[str, tuple[int, ...], str]:
    assert found.rival is not None
    total = float(gains.sum())
    behind = f"The nearest true tile is {ordinal(found.rival.rank)}, {found.lead:.3f} behind the answer."
    if len(counted) == 1:
        return f"The truth lies {found.lead:.3f} farther than the answer", (), behind
    for bound in _BOUNDS[: 2 if total < _TIE else 3]:
        wrong = [part for part in counted.tolist() if gains[part] >= bound]
        true = [part for part in counted.tolist() if gains[part] <= -bound]
        if wrong and gains[wrong].sum() + gains[true].sum() > _EQUAL:
            named = wrong if len(wrong) < len(counted) else _alike(gains, counted)
            return words.preferences(wrong, true, counted.tolist(), named), tuple(named), behind
    return "Nearly a tie: the nearest true tile is 0.001 behind or less", (), behind


def _alike(gains: Float64Array, counted: Int64Array) -> list[int]:
    """Return the part of the largest gain, and the parts of nearly equal gain, inner parts first."""
    return [part for part in counted.tolist() if gains[part] >= gains[counted].max() - _ALIKE]


def _s(parts: Sequence[int]) -> str:
    return "s" if len(parts) == 1 else ""


class _Words:
    """The parts in words: "ring 4", "rings 1 and 4", by the numbers at the beginning of their names, if any."""

    def __init__(self, names: Sequence[str], noun: str) -> None:
        numbers = [re.match(r"\d+", name) for name in names]
        self._names, self._noun = names, noun
        self._short = [name if number is None else number[0] for name, number in zip(names, numbers, strict=True)]

    def named(self, parts: Sequence[int]) -> str:
        """Name parts at the beginning of a sentence."""
        return f"{self._noun.capitalize()}{'' if len(parts) == 1 else 's'} {listed([self._short[i] for i in parts])}"

    def preferences(
        self, wrong: Sequence[int], true: Sequence[int], counted: Sequence[int], most: Sequence[int]
    ) -> str:
        """Name the parts that prefer the wrong tile, and those that prefer the truth; the others hardly differ."""
        if true:
            outvote, them = "outvotes" if len(wrong) == 1 else "outvote", "it" if len(true) == 1 else "them"
            others = listed([self._short[part] for part in wrong]) if len(true) > 1 < len(wrong) else self.lower(wrong)
            return f"{self.named(true)} prefer{_s(true)} the truth, {others} {outvote} {them}"
        if len(wrong) < len(counted):
            even = [part for part in counted if part not in wrong]
            rest = f"{self.lower(even)} hardly differs" if len(even) == 1 else "the others hardly differ"
            return f"{self.named(wrong)} prefer{_s(wrong)} the wrong tile, {rest}"
        number = "Both" if len(wrong) == 2 else f"All {dict(enumerate(_NUMBERS, 3)).get(len(wrong), len(wrong))}"
        of_all = "" if len(counted) == len(self._names) else " that count"
        return f"{number} {self._noun}s{of_all} prefer the wrong tile, {self._most(wrong, most)}"

    def _most(self, wrong: Sequence[int], most: Sequence[int]) -> str:
        if len(most) == len(wrong):
            return "all alike"
        word = self._names[most[0]].partition(" ")[2]
        if len(most) > 1 or word not in ("centre", "outer"):
            return f"{self.lower(most)} most"
        return "the outer one most" if word == "outer" else "the centre most"

    def lower(self, parts: Sequence[int]) -> str:
        """Name parts within a sentence."""
        text = self.named(parts)
        return f"{text[:1].lower()}{text[1:]}"
