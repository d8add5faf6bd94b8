"""The command explain --over: retrieval of one query over rotation, shift, zoom, or the ten weathers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from lpn.cli.parsing import part_values
from lpn.core.consoles import Console, wide_console
from lpn.core.errors import InputError
from lpn.core.files import check_outputs, write_atomic
from lpn.core.numbers import signed
from lpn.core.progress import tracked
from lpn.core.text_tables import TextTable
from lpn.sources import SourceOptions, open_source
from lpn.sources.opened import query_positions

if TYPE_CHECKING:
    from lpn.core.views import View
    from lpn.explain.sweeps import SweepPoint, SweepResult
    from lpn.models.base import Model
    from lpn.tasks.task import Task

_BAR = 24


@dataclass(kw_only=True)
class Sweep(SourceOptions):
    """Rotate, shift, or zoom one query, or draw weathers on it: score and rank of its true match, and each part's cosine."""

    over: Literal["rotation", "shift", "shift-down", "zoom", "weather"]
    """Varied parameter: degrees counter-clockwise, pixels of the network's input to the right or down, a zoom factor, or the
    weather (the ten of lpn evaluate --weather all)."""
    query: str
    """Name of the query, as the explorer's picker shows it, such as 0005/01."""
    step: float | None = None
    """Step: degrees (15), pixels (a 32nd of the input), or the factor between zooms (1.1); weathers have none."""
    reach: float | None = None
    """Largest shift (a quarter of the input) or zoom (2), or strength of the weathers (1); a rotation covers the full circle."""
    weights: str | None = None
    """Weight of each part, such as 1,1,1,0; equal by default."""
    csv: Path | None = None
    """File to write the table to, as CSV."""

    def run(self) -> None:
        check_outputs((self.csv, ".csv"))
        console = wide_console()
        opened = open_source(self, [self.query], part_values(self.weights))
        task, model = opened.task, opened.model
        if model is None:
            raise InputError(
                f"{task.model_name} has descriptors and no network, so its queries cannot be changed; sweep a query of a data "
                "set with a model."
            )
        profile = _swept(task, model, self)
        title = f"{self.query} ({task.name}, {model.describe()})"
        _print(profile, title, task.views, console)
        if self.csv is not None:
            write_atomic(self.csv, profile.to_csv())


def _swept(task: Task, model: Model, options: Sweep) -> SweepResult:
    from lpn.explain import sweeps

    if options.over == "weather" and task.query_view == "satellite":
        raise InputError(
            "The queries are satellite tiles, which have no weather; choose another task, or another property to sweep."
        )
    position = query_positions([options.query], task.queries, task.data_name)[0]
    query, model = task.queries[position], model.for_task(*task.views)
    side = model.input_size[0 if options.over == "shift-down" else 1]
    steps = sweeps.changes_over(options.over, options.step, options.reach, side)
    changes = [change.for_picture(query) for change in steps]
    ranks = task.ranks_under(position)
    points = sweeps.sweep_points(model, query.load_cropped(), task.query_view, changes, ranks)
    return sweeps.SweepResult(options.over, tuple(tracked("Describing the changed query", points, len(changes))))


def _print(profile: SweepResult, title: str, views: tuple[View, View], console: Console) -> None:
    """Print a row for each transform with its score as a bar, and the gain of the best one."""
    from lpn.explain.sweeps import swept_label, swept_value

    blocks = str(console.encoding).lower().startswith("utf")
    scores = [point.followed.score for point in profile.points]
    low, span = min(scores), (max(scores) - min(scores)) or 1.0
    parts, rows = len(profile.points[0].followed.cosines), []
    of_parts = [f"cos {part}" for part in range(1, parts + 1 if parts > 1 else 1)]
    for point in profile.points:
        number = swept_label(profile.over, swept_value(profile.over, point.change), 4)
        bar = ("█" if blocks else "#") * (1 + round((point.followed.score - low) / span * (_BAR - 1)))
        cosines = [f"{cosine:.3f}" for cosine in point.followed.cosines if parts > 1]
        mark = "*" if point is profile.best else ""
        standing = str(point.followed.rank), f"{point.followed.score:.3f}"
        rows.append((number, mark, *standing, bar, *cosines, f"{point.top.score:.3f}"))
    head = (profile.over, "", "rank", "score", f"from {low:.3f} to {max(scores):.3f}", *of_parts, "top score")
    subject = (
        "the nearest true match" if profile.points[0].followed.true else "the top match, as there is no true match"
    )
    after = "\n".join([f"Score and rank of {subject}; * the highest score.", *_sentences(profile, views)])
    TextTable(head, rows, title, after, align="rrrrlr").print(console)


def _sentences(profile: SweepResult, views: tuple[View, View]) -> list[str]:
    """Describe the best transform in words, with and without the true match."""
    from lpn.drawing import verdicts

    lines = []
    if profile.points[0].followed.true:
        lines.append(_sentence("The true match scores highest", profile, profile.best))
        lines.append(_sentence("It ranks best", profile, profile.best_rank))
    lines.append(_sentence("The top score, which needs no truth, is highest", profile, profile.best_top_match))
    if guess := verdicts.describe_heading(profile, views):
        lines.append(guess)
    return lines


def _sentence(begin: str, profile: SweepResult, point: SweepPoint) -> str:
    gain, changed, tile = profile.gain(point), point.change.describe(), point.followed
    when = f"when {changed}" if changed else "for the unchanged query"
    subject = "the true match has" if tile.true else "the top match has"
    if gain is None or not changed:
        return f"{begin} {when}: {subject} rank {tile.rank}, score {tile.score:.3f}."
    ranks, score = gain
    before = f"instead of {tile.rank + ranks}" if ranks else "as before"
    return f"{begin} {when}: {subject} rank {tile.rank} {before}, score {tile.score:.3f} ({signed(score)})."
