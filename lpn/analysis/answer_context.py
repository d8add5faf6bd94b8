"""One answer among all answers of its task, in words: how large its lead is, and how often pictures like it fail."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lpn.analysis import breakdown
from lpn.analysis.breakdown import Rate
from lpn.analysis.query_outcomes import Outcomes, picture_columns
from lpn.core.tables import Column, Table

# A share of fewer right answers says little.
_FEWEST = 20
# From each share on, the words for it.
_SHARES = (
    (0.97, "almost all"),
    (0.83, "about nine tenths"),
    (0.71, "about three quarters"),
    (0.58, "about two thirds"),
)
# Columns that tell of the answer, or of one picture alone.
_NOT_OF_A_KIND = ("latitude", "longitude", "overlap", "semi")


def describe_lead(outcomes: Outcomes, lead: float) -> str:
    """Compare a right answer's lead in d² with those of all right answers; empty where there are few of them."""
    leads = outcomes.margin[outcomes.found]
    leads = leads[np.isfinite(leads)]
    if len(leads) < _FEWEST:
        return ""
    smaller = float((leads < lead).mean())
    comparison = "larger" if smaller >= 0.5 else "smaller"
    share = _in_words(max(smaller, 1 - smaller))
    return f"A lead of {lead:.3f} is {comparison} than that of {share} of the model's {len(leads):,} right answers."


def describe_failure(outcomes: Outcomes, table: Table, query: int) -> str:
    """Say what kind of picture a query is that fails more often than all do; empty where nothing of that is known.

    Several kinds may fail more often; the sentence names the worst of them.
    """
    known = np.flatnonzero(outcomes.known)
    overall = float(outcomes.failed[known].mean()) if len(known) else 1.0
    kinds = [
        (rate, column)
        for column in picture_columns(table)
        if column.name not in _NOT_OF_A_KIND and (rate := _rate_of(outcomes, column, query)) is not None
    ]
    kinds = [kind for kind in kinds if kind[0].interval[0] > overall]
    if not kinds:
        return ""
    rate, column = max(kinds, key=lambda kind: kind[0].share)
    shares = f"fail {100 * rate.share:.0f} % of the time, against {100 * overall:.0f} % over all"
    if (column.name, rate.name) == ("twins", "yes"):
        return f"This building has a twin elsewhere, and pictures of such buildings {shares}."
    return f"Where {column.name} is {rate.name}, pictures {shares}."


def _rate_of(outcomes: Outcomes, column: Column, query: int) -> Rate | None:
    """Return the failure rate of a query's bin; None where its value is unknown, or the column tells no kinds apart."""
    if not column.known[query]:
        return None
    rates: Sequence[Rate] = breakdown.rates(outcomes.failed, column, rows=np.flatnonzero(outcomes.known))
    if not 1 < len(rates) <= max(len(outcomes) // 2, 2):
        return None
    return next((one for one in rates if one.holds(column)[query]), None)


def _in_words(share: float) -> str:
    return next((words for least, words in _SHARES if share >= least), "about half")
