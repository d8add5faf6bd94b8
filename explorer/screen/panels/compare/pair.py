"""The two tiles of the verdict: ranks without each part, the smallest change of weights, and the deciding cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from explorer.screen.fields import MAX_WEIGHT
from explorer.screen.result import ScreenResult
from lpn.analysis.comparison import Comparison
from lpn.core.numbers import rounded_to_sum, shown_difference, signed
from lpn.core.texts import counted, ordinal
from lpn.explain import lead_cells
from lpn.explain.counterfactual import Effect
from lpn.library.answer import pair_evidence
from lpn.retrieval import Match, scoring

# A difference below this between the lead and the sum of the cells comes from rounding.
_ROUNDED = 0.002
# Factors of the change, tried in order until the weights, rounded to two digits, put the truth first.
_FURTHER = (1.0, 1.01, 1.03, 1.1, 1.25, 1.5, 2.0)


@dataclass(eq=False)
class TilePair:
    """The comparison of the true tile with another one, or of the answer with the next tile if the truth is unknown.

    Attributes:
        comparison: None without another tile.
        usable: weights of two digits that put the truth first; empty if it is first, or if no weights do.
        effect: effect of these weights on all photos; None until it is computed.
    """

    result: ScreenResult
    comparison: Comparison | None
    usable: Sequence[float] = ()
    effect: Effect | None = None

    @classmethod
    def of(cls, result: ScreenResult) -> TilePair:
        """Compare the tiles of a result's verdict."""
        comparison = Comparison.of(result.analysis.ranking, result.first)
        return cls(result, comparison, () if comparison is None else _usable(result, comparison))

    def message(self, trying: bool) -> dict[str, Any]:
        """Return the comparison as JSON.

        Args:
            trying: whether the effect on all photos is being computed.
        """
        compared = self.comparison
        if compared is None:
            return {"said": ["There is no other tile to compare the answer with."], "rows": []}
        painted = self._painted(compared)
        return {
            "said": [self._lead(compared)],
            "rows": self._rows(compared),
            "change": self._change(compared),
            "weights": list(self.usable),
            "effect": _described(self.effect),
            "trying": trying,
            "account": self._account(),
            **painted,
        }

    def _name(self, match: Match) -> str:
        first = self.result.first
        role = "answer" if match.index == first.index else "truth" if match.true else "next tile"
        role = "nearest wrong tile" if match.true is False and first.true else role
        return f"the {role} {self.result.task.gallery[match.index].title}"

    def _lead(self, compared: Comparison) -> str:
        followed, other = compared.followed, compared.other
        lead = shown_difference(other.distance2, followed.distance2)
        verb = f"leads {self._name(other)} by {lead:.3f}" if lead >= 0 else f"is {-lead:.3f} behind {self._name(other)}"
        name = self._name(followed)
        return f"{name[:1].upper()}{name[1:]}, {ordinal(followed.rank)} of {self.result.task.tiles:,}, {verb}."

    def _rows(self, compared: Comparison) -> list[dict[str, Any]]:
        """Return each part's gain as the screen's rows show it, the truth's ranks, and the weights before and after."""
        without, weights = compared.without, compared.weights
        n = self.result.workspace.contract.n_parts
        now = 100 * self.result.analysis.ranking.weights
        then = None if weights is None or compared.followed.rank == 1 else 100 * weights
        gains = self.result.rows(self.result.rival)
        return [
            gains[part]
            | {
                "name": self.result.workspace.part_names[part],
                "without": None if without is None else without.without[part],
                "alone": None if without is None else without.alone[part],
                "now": f"{now[part]:.1f}",
                "then": "" if then is None else f"{then[part]:.1f}",
            }
            for part in range(n)
        ]

    def _change(self, compared: Comparison) -> str:
        followed = "truth" if compared.followed.true else "answer"
        if self.result.workspace.contract.n_parts == 1:
            return ""
        if compared.followed.rank == 1:
            return f"The {followed} is first already, so no weights need to change."
        if compared.weights is None:
            return f"No part weights at all put the {followed} first."
        fine = "" if self.usable else " The page cannot set weights as fine as these."
        return f"The smallest change of part weights that puts the {followed} first is in the last column.{fine}"

    def _painted(self, compared: Comparison) -> dict[str, Any]:
        """Return each cell's share of the truth's lead, and the sum of these shares in words."""
        analysis = self.result.analysis
        if analysis.query.trace is None:
            return {"photo": None}
        tiles = (analysis.task.gallery_descriptors[one.index] for one in (compared.followed, compared.other))
        cells = lead_cells(analysis.query.trace, analysis.ranking.weights, *tiles)
        lead = shown_difference(compared.other.distance2, compared.followed.distance2)
        at, nowhere = rounded_to_sum([float(cells.sum()), lead - float(cells.sum())], total=lead)
        if abs(nowhere) < _ROUNDED:
            at = lead
        rest = f" A further {signed(nowhere)} comes from no place, for example from CSLS." if at != lead else ""
        said = f"Magenta places speak for the {'truth' if compared.followed.true else 'answer'}, green for the other tile: "
        return {"photo": self.result.painted(cells), "places": f"{said}{signed(at)} together.{rest}"}

    def _account(self) -> dict[str, Any] | None:
        """Return the answer's score as the sum of its cells and constants, part by part; None without cells."""
        result, first, ranking = self.result, self.result.first, self.result.analysis.ranking
        csls = ranking.csls_of(first.index)
        pair = pair_evidence(result.analysis.query, result.described(first), ranking.weights, csls=csls)
        if pair is None:
            return None
        evidence = pair.evidence
        parts = [rounded_to_sum(list(map(float, terms))) for terms in zip(*evidence.part_sums, strict=True)]
        less = f" CSLS takes {signed(sum(evidence.csls_shares))}." if csls is not None else ""
        said = f"The answer's score, {first.score:.3f}, is the sum of all these terms.{less}"
        said += " Its distance is 2 less twice the score."
        return {
            "said": [said, f"Level of evidence: {result.workspace.contract.claim}."],
            "parts": [[signed(term) for term in (*of, sum(of))] for of in parts],
        }


def _usable(result: ScreenResult, compared: Comparison) -> list[float]:
    """Return weights of two digits near the smallest change that put the truth first, or an empty list."""
    if compared.weights is None or compared.followed.rank == 1:
        return []
    now, new = result.analysis.ranking.weights, compared.weights
    query = None if result.state.own else result.state.query
    search = result.task.start_search(query, result.analysis.query.descriptor)
    for factor in _FURTHER:
        further = np.maximum(now + factor * (new - now), 0)
        scaled = np.round(further * min(len(new) / further.sum(), MAX_WEIGHT / further.max()), 2)
        first = search(scoring.part_weights(len(new), scaled)).match(0)
        if first.true or first.index == compared.followed.index:
            return [float(one) for one in scaled]
    return []


def _described(effect: Effect | None) -> list[str]:
    if effect is None:
        return []
    gained, lost = len(effect.gained), len(effect.lost)
    helps = "They help" if effect.helps else "They harm" if lost > gained else "They neither help nor harm"
    return [
        f"Of {counted(effect.queries, 'photo')}, {gained:,} newly found and {lost:,} lost.",
        f"{helps}: R@1 goes from {effect.before:.1f} to {effect.after:.1f} %.",
    ]
