"""Turn, shift, zoom, and weather of the shown photo: rank, distance, and each part's share, drawn as they are computed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from explorer.compute.background_jobs import WorkCancelledError
from explorer.screen.fields import OneOf, PanelField
from explorer.screen.fragments import fragment
from explorer.screen.panel import Panel, PanelPart, Tab
from explorer.screen.result import ScreenResult
from lpn.core.texts import ordinal
from lpn.descriptors.transforms import Change
from lpn.explain import sweeps
from lpn.explain.sweeps import SweepPoint, SweepResult, SweptProperty, signed_value, swept_label
from lpn.models.base import Model

_LABELS: dict[SweptProperty, str] = {
    "shift": "Shift right",
    "shift-down": "Shift down",
    "zoom": "Zoom",
    "rotation": "Turn",
    "weather": "Weather",
}
OVER = PanelField("sweep_over", OneOf(tuple(_LABELS)), "shift", "sweep")


class PhotoSweep:
    """The sweep of one result over one property.

    Attributes:
        key: equal for results of equal sweeps.
        total: number of points.
        points: the points computed so far.
        follows: the name of the tile whose rank is drawn.
    """

    def __init__(self, over: SweptProperty, result: ScreenResult, model: Model) -> None:
        self.over, self._result = over, result
        analysis, task, state = result.analysis, result.task, result.state
        query = task.queries[state.query]
        height, width = result.workspace.contract.input_size
        base = Change(0.0 if over == "rotation" else state.angle, weather=result.workspace.weather)
        changes = sweeps.changes_over(over, side=height if over == "shift-down" else width)
        changes = [one.for_picture(query, analysis.zoom) for one in sweeps.apply_to_base(over, base, changes)]
        self.base, self.total = changes[0], len(changes)
        self.points: tuple[SweepPoint, ...] = ()
        follow = None if analysis.positive else result.first.index
        self.follows = "truth" if analysis.positive else "answer"
        rank = task.ranks_under(None if state.own else state.query, analysis.ranking.weights)
        described = result.workspace.scored_model(model, task).for_task(*task.views)
        self._ahead: Iterator[SweepPoint] = sweeps.sweep_points(
            described, analysis.source, task.query_view, changes, rank, follow
        )
        self.key = sweep_key(over, result)

    def step(self) -> bool:
        """Compute the next point; return False if there is none."""
        point = next(self._ahead, None)
        self.points += () if point is None else (point,)
        return point is not None

    def message(self, now: float) -> dict[str, Any]:
        """Return the points so far as JSON, sorted by the swept property.

        Args:
            now: the angle of the photo on the screen.
        """
        over, profile = self.over, SweepResult(self.over, self.points, self.base)
        points = sorted(self.points, key=lambda one: signed_value(over, one.change))
        values = [signed_value(over, one.change) for one in points]
        here = now if over == "rotation" else signed_value(over, self.base)
        ranks = [one.followed.rank for one in points]
        return {
            "over": over,
            "done": len(points),
            "total": self.total,
            "follows": self.follows,
            "x": values,
            "labels": [swept_label(over, value) for value in values],
            "rank": ranks,
            "last": min(10 ** math.ceil(math.log10(max(ranks, default=1))), self._result.task.tiles),  # on the axis
            "distance": [round(one.followed.distance2, 4) for one in points],
            "nearest": [round(one.top.distance2, 4) for one in points],
            "shares": [
                [round(float(share), 4) for share in of]
                for of in zip(*(one.followed.contributions for one in points), strict=True)
            ],
            "now": here,
            "names": self._result.workspace.part_names,
            "word": self._result.workspace.contract.part_noun,
            "said": self._said(profile) if len(points) == self.total else [],
        }

    def _said(self, profile: SweepResult) -> list[str]:
        best, ranked, before = profile.best, profile.best_rank, profile.unchanged
        assert before is not None
        said = [f"For the unchanged photo, the {self.follows} is {_standing(before)}."]
        if best is not before:
            said.append(f"It is nearest at {self._at(best)}: {_standing(best)}.")
        if ranked.followed.rank < best.followed.rank:
            said.append(f"Its best rank is {ordinal(ranked.followed.rank)}, at {self._at(ranked)}.")
        firsts = sum(point.followed.rank == 1 for point in profile.points)
        said.append(f"It is first at {firsts} of {self.total} steps.")
        if self.over == "weather":
            said += self._worst(profile, before)
        elif self.over in ("shift", "shift-down") and self._result.workspace.contract.n_parts > 1:
            noun = self._result.workspace.contract.part_noun
            said.append(f"The {noun}s stay in the middle while the place moves through them.")
        heading = profile.heading()
        if heading is not None and self._result.task.views == ("drone", "satellite"):
            said.append(self._heading(heading))
        return said

    def _worst(self, profile: SweepResult, before: SweepPoint) -> list[str]:
        """Name the weather of the lowest score, and the part whose share grows most in it."""
        worst = min(profile.points, key=lambda point: point.followed.score)
        if worst is before:
            return []
        said = [f"It suffers most {worst.change.weather.describe()}: {_standing(worst)}."]
        names = self._result.workspace.part_names
        if len(names) > 1:
            least, most = before.followed.contributions, worst.followed.contributions
            part = int(np.argmax(most - least))
            noun = self._result.workspace.contract.part_noun
            figures = f"from {least[part]:.3f} to {most[part]:.3f}"
            said.append(f"There, the share of {noun} {names[part]} grows most: {figures}.")
        return said

    def _heading(self, guess: float) -> str:
        """Describe the guess of the photo's heading by the nearest tile alone."""
        state, places = self._result.state, self._result.task.geometry
        place = None if places is None or state.own else places.queries[state.query]
        known = None if place is None else place.heading
        said = f"By the nearest tile alone, the photo's top points {guess:.0f}° clockwise from north"
        if known is None:
            return f"{said}, a guess."
        return f"{said}; its true heading is {known % 360:.0f}°."

    def _at(self, point: SweepPoint) -> str:
        return swept_label(self.over, signed_value(self.over, point.change))


def sweep_key(over: SweptProperty, result: ScreenResult) -> object:
    """Return the key of a result's sweep: property, photo, its turn unless swept, followed tile, and part weights."""
    analysis, state = result.analysis, result.state
    followed = None if analysis.positive else result.first.index
    angle = 0.0 if over == "rotation" else state.angle
    photo = state.place, state.model, result.task.key, state.query, state.own
    return over, *photo, angle, followed, analysis.ranking.weights.tobytes()


def _standing(point: SweepPoint) -> str:
    return f"{ordinal(point.followed.rank)}, at {point.followed.distance2:.3f}"


class _SweepPart(PanelPart):
    """Computes one point of the newest sweep in each call, so that a change takes effect at once."""

    def __init__(self, tab: Tab) -> None:
        super().__init__(tab)
        self._sweep: PhotoSweep | None = None
        self._closed = False

    def show(self) -> float | None:
        result, over = self.tab.result, self.tab.state[OVER]
        if result is None or self._closed:
            return None
        choices = {
            key: label for key, label in _LABELS.items() if key != "weather" or result.task.query_view != "satellite"
        }
        model = self.tab.background.queued(result.workspace.model, background=True)
        if model is None or over not in choices:
            why = (
                "Saved descriptors have no network, which a sweep needs." if model is None else "A tile has no weather."
            )
            self.tab.send({"html": fragment("sweep/sweep", choices=choices, over=over, why=why)})
            return None
        if self._sweep is None or self._sweep.key != sweep_key(over, result):
            self._sweep = PhotoSweep(over, result, model)
        try:
            goes_on = self._sweep.step()
        except WorkCancelledError:  # the tab has left
            return None
        if not self._closed:
            message = self._sweep.message(result.state.angle)
            self.tab.send({"html": fragment("sweep/sweep", choices=choices, why="", **message)})
        return 0.0 if goes_on else None

    def close(self) -> None:
        self._closed = True


PANEL = Panel(
    "sweep", "Shift, zoom, weather", _SweepPart, "z", "beside", (OVER,), lambda workspace: workspace.model is not None
)
