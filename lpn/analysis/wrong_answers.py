"""The wrong answers of a task, the most wrong first."""

from __future__ import annotations

import numpy as np

from lpn.core.arrays import Int64Array
from lpn.core.tables import Table
from lpn.tasks.query_outcomes import Outcomes

# The column of a table that says how far an answer lies from the place; one that metadata.csv names so has no unit.
_METRES = "distance"


def worst_first(outcomes: Outcomes, table: Table) -> Int64Array:
    """Return the queries whose first answer is wrong, the most wrong first, (F,).

    The farthest answer comes first; answers of unknown distance follow, by the rank of the first true match, the last first and
    one that is not in the gallery before all others; then those whose positive is farthest behind.
    """
    failed = np.flatnonzero(outcomes.failed)
    column = table.columns.get(_METRES)
    metres = column.values[failed] if column is not None and column.unit == "m" else np.full(len(failed), np.nan)
    far = np.where(np.isfinite(metres), -metres, np.inf)
    rank = outcomes.rank[failed]
    last = np.where(rank < 0, np.iinfo(np.int64).max, rank)
    return np.asarray(failed[np.lexsort((outcomes.margin[failed], -last, far))])
