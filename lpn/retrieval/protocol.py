"""Evaluation protocols: changes of the queries, the parts that are compared, and the sentence that reports both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import Float32Array, Int64Array
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.models.base import normalise
from lpn.retrieval import csls


@dataclass(frozen=True)
class Protocol:
    """An evaluation protocol; the default is the published one of University-1652.

    Attributes:
        change: applied to each query first; its weather falls on the gallery in its place where the queries are tiles and
            the gallery is not, as University-WX has it.
        parts: 1-based parts to use, None for all (Table V).
        branch: the branch that describes both sides, None for each view's own (Table VI).
        average: average the queries of one place into one.
        centre: subtract the mean of the queries' descriptors from each query, and that of the gallery's from each tile.
        csls: the number of nearest queries by which CSLS re-ranks, see `lpn.retrieval.csls`; 0 for no re-ranking.
        released: read and rotate pictures as the released test code does, see `Change.released`, and carry features over to
            landmarks as released, see `lpn.retrieval.transfer`.
    """

    change: Change = UNCHANGED
    parts: tuple[int, ...] | None = None
    branch: View | None = None
    average: bool = False
    centre: bool = False
    csls: int = 0
    released: bool = False

    def chosen(self, n_parts: int) -> tuple[int, ...]:
        """The 1-based parts to use, without duplicates, in the given order.

        Raises:
            InputError: when a part does not exist, or no part is given.
        """
        chosen = tuple(range(1, n_parts + 1)) if self.parts is None else tuple(dict.fromkeys(self.parts))
        if not chosen or any(not 1 <= part <= n_parts for part in chosen):
            raise InputError(f"The parts are {', '.join(map(str, chosen)) or 'none'}; there are parts 1 to {n_parts}.")
        return chosen

    def select(self, descriptors: Float32Array) -> Float32Array:
        """The used parts of descriptors (N, n, D): (N, m, D)."""
        chosen = self.chosen(descriptors.shape[1])
        if chosen == tuple(range(1, descriptors.shape[1] + 1)):
            return descriptors
        return descriptors[:, np.array(chosen) - 1]

    def compared(self, query: Float32Array, tiles: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return what is ranked by inner product of descriptors (Q, n, D) and (G, n, D): the used parts, scaled by CSLS if asked.

        Raises:
            InputError: when CSLS wants more queries than there are.
        """
        sides = self.select(query), self.select(tiles)
        return csls.scaled(*sides, self.csls) if self.csls else sides


def centred(descriptors: Float32Array) -> Float32Array:
    """Subtract the mean of descriptors (N, n, D) from each of them, part by part, and scale parts to norm 1/sqrt(n) again."""
    return normalise(descriptors - descriptors.mean(axis=0))


def averaged(descriptors: Float32Array, labels: Int64Array) -> tuple[Float32Array, Int64Array]:
    """Sum the descriptors (Q, n, D) of each place's queries and normalise each part.

    Returns:
        Descriptors (P, n, D) and the places' labels (P,), ascending.
    """
    order = np.argsort(labels, kind="stable")
    places, starts = np.unique(labels[order], return_index=True)
    sums = [descriptors[rows].sum(axis=0) for rows in np.split(order, starts[1:])]
    return normalise(np.stack(sums)), places


def sentence(
    clauses: Sequence[str],
    parts: tuple[int, ...],
    n_parts: int,
    averaged_from: int | None = None,
    listed: bool = False,
    trapezoid: bool = True,
    neighbours: int = 0,
) -> str:
    """The protocol in words.

    Args:
        clauses: about the descriptors and the changes of the queries.
        parts: the parts used, 1-based.
        averaged_from: number of pictures behind the averaged queries; None for queries that are not averaged.
        listed: True if true matches and junk come from lists rather than from labels.
        trapezoid: True if AP is integrated by the trapezoid rule; False if it is the mean precision at the true matches.
        neighbours: of CSLS, see `Protocol.csls`.
    """
    clauses = [*clauses]
    if parts != tuple(range(1, n_parts + 1)):
        clauses.append(f"part{'s' if len(parts) > 1 else ''} {', '.join(map(str, parts))} of {n_parts} only")
    if averaged_from is not None:
        clauses.append(f"the {averaged_from} query pictures averaged to one query per place")
    clauses.append(
        f"ranked by inner product less half of each tile's mean inner product with its {neighbours} nearest queries (CSLS)"
        if neighbours
        else "ranked by inner product"
    )
    clauses.append(
        "true matches and junk by the data set's lists, junk taken out of the ranking"
        if listed
        else "true matches by label, gallery pictures labelled -1 taken out of the ranking"
    )
    clauses.append("a query without a true match counts as missed")
    clauses.append("AP by the trapezoid rule" if trapezoid else "AP as the mean precision at the true matches")
    return f"Protocol: {'; '.join(clauses)}."
