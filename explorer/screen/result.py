"""An answer as one JSON message with all its numbers, so that no number differs between two places of the screen."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from explorer.feeds import Feeds
from explorer.screen.fields import ScreenState
from explorer.workspace import Workspace
from lpn.core import images
from lpn.core.arrays import Float32Array, Float64Array, FloatingArray, UInt8Array
from lpn.core.numbers import rounded_to_sum, shown_difference, wrap_degrees
from lpn.core.texts import ordinal
from lpn.core.views import View
from lpn.drawing import overlays
from lpn.explain import Evidence
from lpn.explain.attribution import SideEvidence
from lpn.library.analyser import OwnPicture, QueryRequest
from lpn.library.answer import Answer, pair_evidence
from lpn.library.matching_turn import matching_turn
from lpn.retrieval import DescribedPicture, Match, scoring
from lpn.tasks.task import Task

# Tiles of the strip; the truth takes the last place if it is farther away.
STRIP = 6
# For the scale of all bars: maxima of the sampled queries and of their descriptor values, and the percentage of bars that fit.
_SAMPLE, _MOST_NUMBERS, _FITS = 200, 2_000_000_000, 99
# A gain below this is called even.
_EVEN = 0.005
# Step of a scale.
_STEP = 0.1


@dataclass(frozen=True)
class BarScale:
    """Values at the ends of the bars, in squared distance: for a part under equal weights, and for the sum."""

    part: float
    total: float


@dataclass(frozen=True, eq=False)
class ScreenResult:
    """An analysis with the tile that the user compares.

    Attributes:
        question: the question to the task.
        address: address of the photo's picture, relative to the page.
    """

    workspace: Workspace
    feeds: Feeds
    state: ScreenState
    question: QueryRequest
    analysis: Answer
    scale: BarScale
    address: str

    @property
    def task(self) -> Task:
        """The task of the analysis."""
        return self.analysis.task

    @property
    def own(self) -> OwnPicture | None:
        """The user's photo that is shown; None for a query."""
        return self.question.query if isinstance(self.question.query, OwnPicture) else None

    @cached_property
    def first(self) -> Match:
        """The nearest tile."""
        return self.analysis.ranking.match(0)

    @property
    def rival(self) -> Match | None:
        """The tile that the verdict compares the answer with."""
        return self.analysis.verdict.rival

    @cached_property
    def compared(self) -> Match | None:
        """The tile that the user chose to compare, else `rival`."""
        chosen = self.state.compare
        return self.analysis.ranking.find(chosen) if chosen is not None and self.pinned else self.rival

    @cached_property
    def pinned(self) -> bool:
        """True if the user chose the compared tile."""
        chosen = self.state.compare
        return chosen is not None and chosen != self.first.index and self.analysis.ranking.holds(chosen)

    @cached_property
    def large(self) -> dict[int, Match]:
        """The tiles shown with their cells, by their positions: answer, compared tile, and truth."""
        return {
            match.index: match for match in (self.first, self.compared, self.analysis.positive) if match is not None
        }

    @cached_property
    def evidence(self) -> dict[int, Evidence]:
        """The evidence of the photo with each tile of `large`; empty unless the state asks for it."""
        if self.state.heat != "evidence":
            return {}
        ranking = self.analysis.ranking
        pairs = {
            index: pair_evidence(
                self.analysis.query, self.described(match), ranking.weights, csls=ranking.csls_of(index)
            )
            for index, match in self.large.items()
        }
        return {index: pair.evidence for index, pair in pairs.items() if pair is not None}

    @property
    def headline(self) -> dict[str, Any]:
        """The headline: whether the photo is found, its rank, and the reason."""
        verdict = self.analysis.verdict
        # Without a known truth the headline cannot grade this answer, and its lead is shown.
        reason = f"{verdict.headline}." + (f" {verdict.sentence}" if verdict.sign is None else "")
        return {"found": verdict.sign, "title": self._title(self.analysis.positive), "reason": reason}

    def message(self) -> dict[str, Any]:
        """Return the result as JSON."""
        state, workspace = self.state, self.workspace
        compared, pinned, truth, shown = self.compared, self.pinned, self.analysis.positive, self.large
        strip = self._strip(compared if pinned else None)
        tiles = {match.index: self._tile(match, match.index in shown) for match in (*strip, *shown.values())}
        weights = np.asarray(state.weights or [1.0] * workspace.contract.n_parts)
        return {
            "photo": self._photo(),
            "angle": state.angle,
            "headline": self.headline,
            "answer": self.first.index,
            "rival": None if compared is None else compared.index,
            "rival_word": self._word(compared, pinned),
            "pinned": pinned,
            "truth": None if truth is None else truth.index,
            "rows": self.rows(compared),
            "strip": [match.index for match in strip],
            "tiles": tiles,
            "rank": None if truth is None else truth.rank,
            "nearest": round(self.first.distance2, 3),
            "scale": {"part": self.scale.part * float(weights.max() / weights.mean()), "total": self.scale.total},
            "weights": list(state.weights),
        }

    def _title(self, truth: Match | None) -> str:
        """Return the text after "Found" or "Missed", or the nearest tile if the truth is unknown."""
        total = f"{self.task.tiles:,}"
        if self.first.true is None:
            return f"Nearest of {total}: {self.task.gallery[self.first.index].title}"
        if self.first.true:
            return f"first of {total}"
        if truth is None:
            return "no tile of the place"
        return f"truth is {ordinal(truth.rank)} of {total}"

    def _strip(self, pinned: Match | None) -> list[Match]:
        """Return the nearest tiles; the truth or the chosen tile comes last if it is farther away."""
        nearest = self.analysis.matches[:STRIP]
        there = {match.index for match in nearest}
        behind = (match for match in (self.analysis.positive, pinned) if match is not None and match.index not in there)
        further = {match.index: match for match in behind}
        return [*nearest[: STRIP - len(further)], *further.values()]

    def _word(self, compared: Match | None, pinned: bool) -> str:
        if compared is None or pinned:
            return "pinned"
        return "truth" if compared.true else "next"

    def rows(self, compared: Match | None) -> list[dict[str, Any]]:
        """Return for each part how much nearer the answer is than the compared tile, and whether that favours the truth.

        The gains are rounded as in the verdict: they add up to the difference of the shown distances.
        """
        if compared is None:
            return [{"gain": "", "minus": False, "prefers": None}] * self.workspace.contract.n_parts
        lead = shown_difference(compared.distance2, self.first.distance2)
        gains = rounded_to_sum((compared.contributions - self.first.contributions).tolist(), total=lead)
        judged = self.first.true is not None and compared.true is not None and self.first.true != compared.true
        return [
            {
                "gain": f"{abs(gain):.3f}",
                "minus": gain < 0,
                "prefers": (gain > 0) == self.first.true if judged and abs(gain) >= _EVEN else None,
            }
            for gain in gains
        ]

    def _photo(self) -> dict[str, Any]:
        analysis = self.analysis
        pair = self.evidence.get(self.first.index)
        height, width = self.workspace.as_partitioned(analysis.source, self.task.query_view).shape[:2]
        panorama = self.state.own == "" and self.task.queries[self.state.query].panorama
        return {
            "src": self.address,
            "name": analysis.name,
            "own": bool(self.state.own),
            "around": panorama,
            "aspect": width / height if max(width, height) >= 2 * min(width, height) else 1.0,
            "zoom": analysis.zoom,
            **self._heat(analysis.query, self.task.query_view, 0, None if pair is None else self._signed(pair.query)),
        }

    def _tile(self, match: Match, described: bool) -> dict[str, Any]:
        shares = rounded_to_sum(match.contributions.tolist(), total=match.distance2)
        quarter = self.quarter(match)
        tile = {
            "name": self.task.gallery[match.index].title,
            "src": f"{self.feeds.pictures(self.task, 'tile')}{match.index}",
            "rank": str(match.rank),
            "true": match.true,
            "distance": f"{match.distance2:.3f}",
            "shares": shares,
            "quarter": quarter,
        }
        if not described:
            return tile
        known = self.described(match)
        height, width = self.workspace.as_partitioned(known.picture, self.task.gallery_view).shape[:2]
        aspect = width / height if max(width, height) >= 2 * min(width, height) else 1.0
        pair = self.evidence.get(match.index)
        cells = self._heat(known, self.task.gallery_view, quarter, None if pair is None else self._signed(pair.tile))
        if self.state.heat == "occlusion":  # occlusion covers the photo alone
            cells["heat"] = None
        return tile | {"aspect": aspect, **cells}

    def described(self, match: Match) -> DescribedPicture:
        """Return a described tile."""
        return self.analysis.described(match)

    def quarter(self, match: Match) -> int:
        """Return the quarter turns, counter-clockwise, that best align a tile with the unturned photo."""
        analysis = replace(self.analysis, chosen=match)
        turn = matching_turn(analysis, None if self.state.own else self.state.query, 0.0, None)
        if turn is None:
            return 0
        degrees = turn.degrees
        if turn.source == "model":  # the model compared the turned photo with the tile
            degrees = float(wrap_degrees(degrees - self.state.angle))
        return round(degrees / 90) % 4

    def _heat(
        self, described: DescribedPicture, view: View, quarter: int, signed: FloatingArray | None
    ) -> dict[str, Any]:
        """Return the parts of a picture and the values of its cells, turned by quarters, row by row as base64 of bytes.

        Activation is scaled to bytes from 0 to 255. `signed` values from -1 to 1 replace it; the byte of 0 is 128.
        """
        areas = self.workspace.areas(view, described)
        if areas is None:
            return {"parts": None, "heat": None}
        labels = np.rot90(areas.labels, quarter)
        parts = {
            "rows": labels.shape[0],
            "columns": labels.shape[1],
            "labels": _bytes(np.where(labels < 0, 255, labels).astype(np.uint8)),
            "boxes": [_turned(box, quarter) for box in areas.boxes],
            "straight": areas.straight,
        }
        values = described.activation if signed is None else signed
        if values is None:
            return {"parts": parts, "heat": None}
        heat = np.rot90(images.enlarge(values, *areas.labels.shape), quarter)
        strongest = []
        for part in range(len(areas.inside)):
            inside = np.rot90(areas.inside[part], quarter)
            cell = int(np.argmax(np.where(inside, heat, -2.0))) if inside.any() else -1
            strongest.append([] if cell < 0 else [cell % heat.shape[1], cell // heat.shape[1]])
        cells = np.round(255 * heat if signed is None else 128 + 127 * heat).astype(np.uint8)
        return {"parts": parts, "heat": _bytes(cells), "strongest": strongest, "signed": signed is not None}

    def covered(self, losses: Float32Array) -> dict[str, Any]:
        """Return the photo's parts with each covered square's loss of score in place of its activation.

        Args:
            losses: each part's loss of cosine, see `lpn.explain.occlusion.occlude`, (n, rows, columns); NaN if not measured yet.
        """
        return self.painted(np.tensordot(self.analysis.ranking.weights, np.nan_to_num(losses), 1))

    def painted(self, cells: FloatingArray) -> dict[str, Any]:
        """Return the photo's parts with signed values of its cells, (h, w), scaled to -1 .. 1, instead of the activation."""
        return self._heat(self.analysis.query, self.task.query_view, 0, cells / overlays.evidence_limit(cells))

    def _signed(self, side: SideEvidence) -> Float64Array:
        """Return each cell's share of its pair's score, scaled to -1 .. 1 by the greatest share of all pairs of the result."""
        weights = self.analysis.ranking.weights
        sides = [one for pair in self.evidence.values() for one in (pair.query, pair.tile)]
        return side.score_map(weights) / overlays.evidence_limit(*(one.score_map(weights) for one in sides))


def measured_scale(task: Task) -> BarScale:
    """Return the ends of all bars of a task; 99 % of the bars fit, in a sample of queries with their answers and rivals."""
    n = task.contract.n_parts
    queries, gallery = task.sides()
    weights = scoring.part_weights(n)
    count = max(min(_SAMPLE, len(queries), _MOST_NUMBERS // max(gallery.size, 1)), 1)
    sample = np.unique(np.linspace(0, len(queries) - 1, count).astype(int))
    shares = []
    for query in sample.tolist():
        found = task.start_search(query, queries[query])(weights)
        first = found.match(0)
        rival = found.hardest_negative() if first.true else found.positive() or found.hardest_negative()
        shares += [match.contributions for match in (first, rival) if match is not None]
    part = float(np.percentile(np.concatenate(shares), _FITS))
    total = float(np.percentile([share.sum() for share in shares], _FITS))
    return BarScale(_rounded_up(part), _rounded_up(total))


def _rounded_up(value: float) -> float:
    return max(round(float(np.ceil(round(value / _STEP, 6))) * _STEP, 1), _STEP)


def _turned(box: Sequence[float], quarter: int) -> list[float]:
    """Turn a box, in shares of its picture's sides, by quarter turns counter-clockwise."""
    left, top, right, bottom = box
    return [left, top, right, bottom] if quarter == 0 else _turned((top, 1 - right, bottom, 1 - left), quarter - 1)


def _bytes(cells: UInt8Array) -> str:
    return b64encode(np.ascontiguousarray(cells).tobytes()).decode()
