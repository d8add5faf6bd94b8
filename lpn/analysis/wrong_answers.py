"""The wrong answers of a task, the most wrong first, and what is measured of one that may be why."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float32Array, Int64Array
from lpn.core.tables import Table
from lpn.retrieval.scoring import part_weights
from lpn.tasks.query_outcomes import Outcomes

# Fewer right answers than this tell nothing about how large a lead usually is.
_FEWEST = 20
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


def share_of_larger_leads(outcomes: Outcomes, behind: float) -> float | None:
    """Return the share of the right answers that lead by more than some d², 0 .. 1; None where there are too few."""
    leads = outcomes.margin[outcomes.hits]
    leads = leads[np.isfinite(leads)]
    return None if len(leads) < _FEWEST else float((leads > behind).mean())


def most_alike(
    gallery: Float32Array, labels: Int64Array, tile: int, weights: npt.ArrayLike | None = None
) -> int | None:
    """Return the label of the other place that looks most like a tile to the model; None without another place.

    Among the tiles of other places, the one with the highest cosine decides; tiles labelled -1 are left out.

    Args:
        gallery: (G, n, D), descriptors of a task: each part has length 1/sqrt(n).
        labels: the place of each tile, (G,).
        weights: part weights, see `part_weights`.
    """
    others = np.flatnonzero((labels != labels[tile]) & (labels >= 0))
    if not len(others):
        return None
    scaled = gallery[tile] * part_weights(gallery.shape[1], weights)[:, None]
    cosines = gallery.reshape(len(gallery), -1) @ scaled.ravel()
    return int(labels[others[np.argmax(cosines[others])]])
