"""Search a gallery with one query: describe the picture, compare part by part, and rank under any part weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from lpn.core.numbers import shown_difference
from lpn.core.views import View
from lpn.datasets import Truth
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.models.base import Model, normalise, whitened
from lpn.models.contract import ForwardPass, check_shapes
from lpn.models.trace import Trace
from lpn.retrieval import scoring
from lpn.retrieval.csls import CslsTerms
from lpn.retrieval.metrics import JUNK


@dataclass(frozen=True)
class DescribedPicture:
    """A picture with its descriptor.

    Attributes:
        picture: the changed picture at its own resolution, (H, W, 3) uint8. In an unrolled view (SAFA), it does not show the
            shift of the network's input, which follows the unrolling.
        descriptor: parts of norm 1/sqrt(n), (n, D).
        activation: channel sum of the last feature map, (h, w), 0 .. 1; None without cells.
        trace: explains the descriptor cell by cell; None without a network, or if the network gives no cells.
    """

    picture: UInt8Array
    descriptor: Float32Array
    activation: Float32Array | None
    trace: Trace | None


@dataclass(frozen=True)
class Match:
    """One ranked tile.

    Attributes:
        rank: 1 for the nearest.
        index: position in the gallery.
        score: weighted mean cosine, -1 .. 1; under CSLS, less both of its terms.
        distance2: squared distance 2 - 2 score, from 0 to 4.
        gap: squared distance of the next tile minus this one's; None for the last tile.
        cosines: of each part, (n,).
        contributions: each part's exact share of distance2, (n,); under CSLS, with the part's share of both of its terms.
        true: True for a tile of the query's place; None if the place is unknown.
        constants: the two numbers that CSLS subtracts from the score, for query and tile; None without CSLS.
    """

    rank: int
    index: int
    score: float
    distance2: float
    gap: float | None
    cosines: Float32Array
    contributions: Float32Array
    true: bool | None
    constants: tuple[float, float] | None = None

    @property
    def shown_gap(self) -> float | None:
        """The gap as the difference of both tiles' rounded squared distances, see `shown_difference`."""
        return None if self.gap is None else shown_difference(self.distance2 + self.gap, self.distance2)


@dataclass(frozen=True, eq=False)
class Ranking:
    """A gallery in the order of its distance to one query, under one set of part weights.

    Attributes:
        cosines: each part's cosine with the query, (G, n).
        weights: the part weights, with sum one, (n,).
        scores: weighted mean cosines, (G,); under CSLS, less its terms.
        order: gallery positions from nearest to farthest, without junk, at most (G,).
        relevant: True for gallery pictures of the query's place, (G,); None if the place is unknown.
        lengths: n |q_i|^2 of each part of a region's query, (n,), see `scoring.contributions`; `cosines` are then n times inner
            products.
        csls: the terms of CSLS; None if it does not re-rank.
    """

    cosines: Float32Array
    weights: Float32Array
    scores: Float32Array
    order: Int64Array
    relevant: BoolArray | None
    lengths: Float32Array | None = None
    csls: CslsTerms | None = None

    @property
    def similarities(self) -> Float32Array:
        """The values whose weighted sums are the scores, (G, n): the cosines, under CSLS less its terms."""
        return self.cosines if self.csls is None else self.cosines - self.csls.query - self.csls.tiles

    def match(self, position: int) -> Match:
        """The match at a 0-based position of the order."""
        index = int(self.order[position])
        score, following = float(self.scores[index]), self.order[position + 1 : position + 2].tolist()
        cosines, csls = self.cosines[index], self.csls_of(index)
        terms = None if csls is None else csls[0] + csls[1]
        return Match(
            rank=position + 1,
            index=index,
            score=score,
            distance2=2.0 - 2.0 * score,
            gap=2.0 * (score - float(self.scores[following[0]])) if following else None,
            cosines=cosines,
            contributions=scoring.contributions(cosines, self.weights, self.lengths, terms),
            true=None if self.relevant is None else bool(self.relevant[index]),
            constants=None if csls is None else (float(csls[0] @ self.weights), float(csls[1] @ self.weights)),
        )

    def csls_of(self, index: int) -> tuple[Float32Array, Float32Array] | None:
        """Return the terms that CSLS subtracts from the cosines, for query and gallery picture, (n,) each; None without CSLS."""
        return None if self.csls is None else (self.csls.query, self.csls.tiles[index])

    def gains(self, leader: int, follower: int) -> Float64Array:
        """Return the lead of one gallery picture over another in d² by part: 2 w_i (cos_i(leader) - cos_i(follower)), (n,).

        A positive gain speaks for the leader; under CSLS it includes both of its terms.
        """
        ahead, behind = (self.similarities[index].astype(np.float64) for index in (leader, follower))
        return cast(Float64Array, 2 * self.weights.astype(np.float64) * (ahead - behind))

    def top(self, k: int) -> list[Match]:
        """Return the k nearest, or all if there are fewer."""
        return [self.match(position) for position in range(min(k, len(self.order)))]

    def holds(self, index: int) -> bool:
        """Return whether gallery picture `index` is ranked, that is, not junk."""
        return bool((self.order == index).any())

    def find(self, index: int) -> Match:
        """Return the match of gallery picture `index`."""
        return self.match(int(np.flatnonzero(self.order == index)[0]))

    def hardest_negative(self, besides: int | None = None) -> Match | None:
        """Return the nearest tile except known positives and gallery picture `besides`; None if none is left."""
        negative = self.order != besides
        if self.relevant is not None:
            negative &= ~self.relevant[self.order]
        ranks = np.flatnonzero(negative)
        return self.match(int(ranks[0])) if len(ranks) else None

    def positive(self) -> Match | None:
        """Return the nearest positive; None if the query has none, or its place is unknown."""
        if self.relevant is None or not self.relevant.any():
            return None
        return self.match(int(np.argmax(self.relevant[self.order])))


def describe_picture(
    model: Model, picture: UInt8Array, view: View, change: Change | float = UNCHANGED
) -> DescribedPicture:
    """Change a picture and describe it together with its mirror, in one batch.

    Args:
        change: applied first; a number turns the picture by that many degrees counter-clockwise.

    Raises:
        InputError: when the change leaves nothing of the picture.
    """
    change = change if isinstance(change, Change) else Change(rotate=change)
    return describe_pictures(model, [picture], view, [change])[0]


def describe_pictures(
    model: Model, pictures: Sequence[UInt8Array], view: View, changes: Sequence[Change] | None = None
) -> list[DescribedPicture]:
    """Change each picture and describe it together with its mirror, all in one batch; see `describe_picture`."""
    seen, batch = [], []
    for picture, change in zip(pictures, changes or [UNCHANGED] * len(pictures), strict=True):
        turned = change.apply(picture)
        batch.append(model.with_mirror(model.normalise(change.move(model.to_input_size(turned, view)))))
        seen.append(turned if model.contract.unrolled(view) else change.show(turned, model.input_size))
    outputs, passes = model.run(np.concatenate(batch), view), len(batch[0])
    described = []
    for i, picture in enumerate(seen):
        own = slice(passes * i, passes * (i + 1))
        one = ForwardPass._make(None if array is None else array[own] for array in outputs)
        if model.contract.has_cells:
            trace = Trace.from_pass(model, one, view)
            activation = scoring.activation(trace.activation)
            described.append(DescribedPicture(picture, normalise(trace.embedding), activation, trace))
            continue
        check_shapes(model.contract, {"pictures": (passes,), "parts": one.parts.shape})
        raw = cast(Float32Array, one.parts.sum(axis=0))
        centred = whitened(raw + model.centring(raw, view), model.whitening)
        described.append(DescribedPicture(picture, normalise(centred), None, None))
    return described


def rank(
    cosines: Float32Array,
    weights: Float32Array,
    labels: Int64Array | None = None,
    label: int | None = None,
    truth: Truth | None = None,
    lengths: Float32Array | None = None,
    csls: CslsTerms | None = None,
) -> Ranking:
    """Rank a gallery by weighted part cosines; ties keep gallery order, and junk is left out.

    Args:
        cosines: part cosines of the gallery with the query, (G, n), see `scoring.part_cosines`.
        weights: part weights with sum one, (n,).
        labels: the place of each gallery picture, (G,), -1 for junk; needed with `label`.
        label: the query's place; None if unknown.
        truth: the query's true matches and junk, used instead of labels.
        lengths, csls: see `Ranking`.
    """
    scores = cosines @ weights
    if csls is not None:
        scores = scores - csls.tiles @ weights - csls.query @ weights
    order = np.argsort(-scores, kind="stable")
    junk = np.zeros(len(scores), bool) if labels is None else labels == JUNK
    relevant = None if labels is None or label is None else (labels == label) & ~junk
    if truth is not None:
        junk = truth.unranked(len(scores))
        relevant = np.isin(np.arange(len(scores)), truth.good) if truth.known else None
    return Ranking(cosines, weights, scores, order[~junk[order]], relevant, lengths, csls=csls)
