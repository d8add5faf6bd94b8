"""The command sweep: retrieval of one query over rotation, shift, or zoom."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import lpn
from lpn.cli.explain import part_values
from lpn.core.errors import InputError
from lpn.core.numbers import signed
from lpn.core.views import TaskName, views_of
from lpn.models.adapters import Kind

if TYPE_CHECKING:
    from rich.console import Console

    from lpn.core.views import View
    from lpn.datasets import Dataset
    from lpn.explain.sweeps import Point, SweepResult
    from lpn.models.base import Model

_BAR = 24


@dataclass
class SweepCommand:
    """Rotate, shift, or zoom one query step by step: score and rank of its true match, and each part's cosine."""

    data: Path
    """Data set in any layout of docs/data.md."""
    model: Path
    """Trained LPN: .onnx, .safetensors, or .pth."""
    query: str
    """Name of the query, as the explorer's picker shows it, such as 0005/01."""
    kind: Kind | None = None
    """Method of a published .pth whose entries do not tell it, such as dac; see docs/models.md."""
    task: TaskName | None = None
    """Views of query and gallery; by default the first task of the data set."""
    over: Literal["rotation", "shift", "shift-down", "zoom"] = "rotation"
    """Varied parameter: degrees counter-clockwise, pixels of the network's input to the right or down, or a zoom factor."""
    step: float | None = None
    """Step: degrees (15), pixels (a 32nd of the input), or the factor between zooms (1.1)."""
    reach: float | None = None
    """Largest shift (a quarter of the input) or zoom (2); a rotation covers the full circle."""
    weights: str | None = None
    """Weight of each part, such as 1,1,1,0; equal by default."""
    csv: Path | None = None
    """File to write the table to."""
    png: Path | None = None
    """File to draw the curves to; needs matplotlib, of the extra train."""

    def run(self) -> None:
        from lpn.core.consoles import wide_console
        from lpn.core.files import check_writable, write_atomic
        from lpn.datasets import open_dataset

        for file in filter(None, (self.csv, self.png)):
            check_writable(file)
        if self.png is not None:
            import matplotlib  # noqa: F401 (fail before the long computation)
        model, dataset = lpn.load(self.model, kind=self.kind), open_dataset(self.data)
        tasks = dataset.tasks()
        task = self.task or (tasks[0] if tasks else "none")
        if task not in tasks:
            raise InputError(
                f"The task is {task!r}; {dataset.root.name} offers {', '.join(tasks) or 'none'} in its test split."
            )
        console = wide_console()
        found = self._sweep(model, dataset, task, console)
        views = views_of(task)
        title = f"{self.query} ({task}, {model.describe()})"
        _print(found, title, views, console)
        if self.csv is not None:
            write_atomic(self.csv, found.to_csv())
        if self.png is not None:
            write_atomic(self.png, _draw(found, title))

    def _sweep(self, model: Model, dataset: Dataset, task: str, console: Console) -> SweepResult:
        import numpy as np
        from rich.progress import track

        from lpn import descriptors
        from lpn.explain import sweeps
        from lpn.retrieval import scoring

        query_view, gallery_view = views_of(task)
        for view in (query_view, gallery_view):
            model.check_view(view)
        model = model.for_task(query_view, gallery_view)
        side = model.input_size[0 if self.over == "shift-down" else 1]
        weights = scoring.part_weights(model.n_parts, part_values(self.weights))
        queries, gallery = dataset.queries(query_view), dataset.gallery(gallery_view)
        names = [entry.name for entry in queries]
        if self.query not in names:
            raise InputError(
                f"{dataset.root.name} has no {query_view} query {self.query}; its names are such as {names[0]}."
            )
        position = names.index(self.query)
        entry, truth = queries[position], dataset.truth(task)
        picture = entry.load_cropped()
        changes = [change.for_picture(entry) for change in sweeps.changes_over(self.over, self.step, self.reach, side)]
        tiles = descriptors.cached_descriptors(model, gallery, gallery_view)
        labels = np.array([tile.label for tile in gallery], np.int64)
        listed = None if truth is None else truth[position]
        points = sweeps.run_sweep(model, picture, query_view, tiles, weights, changes, labels, entry.label, listed)
        seen = track(points, f"Describing {self.query}", len(changes), console=console, transient=True)
        return sweeps.SweepResult(self.over, tuple(seen))


def _subject(profile: SweepResult) -> str:
    """Name the tile that scores and ranks refer to."""
    return "the nearest true match" if profile.points[0].true else "the top match, as there is no true match"


def _print(profile: SweepResult, title: str, views: tuple[View, View], console: Console) -> None:
    """Print a row for each transform with its score as a bar, and the gain of the best one."""
    from rich.table import Table

    from lpn.explain.sweeps import UNITS, swept_value

    blocks = str(console.encoding).lower().startswith("utf")
    scores = [point.score for point in profile.points]
    low, span = min(scores), (max(scores) - min(scores)) or 1.0
    table = Table(title=title, caption=f"Score and rank of {_subject(profile)}; * the highest score.")
    for name in (profile.over, "", "rank", "score"):
        table.add_column(name, justify="right")
    table.add_column(f"from {low:.3f} to {max(scores):.3f}", min_width=_BAR)
    for part in range(1, len(profile.points[0].cosines) + 1):
        table.add_column(f"cos {part}", justify="right")
    table.add_column("top score", justify="right")
    for point in profile.points:
        number = f"{swept_value(profile.over, point.change):.4g}{UNITS[profile.over]}"
        bar = ("█" if blocks else "#") * (1 + round((point.score - low) / span * (_BAR - 1)))
        cosines = [f"{cosine:.3f}" for cosine in point.cosines]
        mark = "*" if point is profile.best else ""
        table.add_row(number, mark, str(point.rank), f"{point.score:.3f}", bar, *cosines, f"{point.top_score:.3f}")
    console.print(table)
    for line in _sentences(profile, views):
        console.print(line, highlight=False, soft_wrap=True)


def _sentences(profile: SweepResult, views: tuple[View, View]) -> list[str]:
    """Describe the best transform in words, with and without knowledge of the true match."""
    from lpn.drawing import verdicts

    lines = []
    if profile.points[0].true:
        lines.append(_sentence("The true match scores highest", profile, profile.best))
        lines.append(_sentence("It ranks best", profile, profile.best_rank))
    lines.append(
        _sentence("The top score, which is seen without knowing the truth, is highest", profile, profile.best_top_match)
    )
    if guess := verdicts.describe_heading(profile, views):
        lines.append(guess)
    return lines


def _sentence(begin: str, profile: SweepResult, point: Point) -> str:
    gain, changed = profile.gain(point), point.change.describe()
    when = f"when {changed}" if changed else "with the query as it is"
    subject = "the true match has" if point.true else "the top match has"
    if gain is None or not changed:
        return f"{begin} {when}: {subject} rank {point.rank}, score {point.score:.3f}."
    ranks, score = gain
    before = f"instead of {point.rank + ranks}" if ranks else "as before"
    return f"{begin} {when}: {subject} rank {point.rank} {before}, score {point.score:.3f} ({signed(score)})."


def _draw(profile: SweepResult, title: str) -> bytes:
    """Draw scores, part cosines, and rank over the transform as a PNG file."""
    from lpn.drawing.plots import png, pyplot
    from lpn.explain.sweeps import UNITS, swept_value

    figure, (above, below) = pyplot().subplots(2, 1, figsize=(8, 6), sharex=True, height_ratios=(2, 1))
    along = [swept_value(profile.over, point.change) for point in profile.points]
    for part, cosines in enumerate(zip(*(point.cosines for point in profile.points), strict=True), 1):
        above.plot(along, cosines, linewidth=1, label=f"cosine of part {part}")
    above.plot(along, [point.score for point in profile.points], color="black", linewidth=2.5, label="score")
    above.plot(along, [point.top_score for point in profile.points], color="grey", linestyle=":", label="top score")
    above.set(title=title, ylabel=f"score of\n{_subject(profile)}")
    above.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1, 1))
    below.plot(along, [point.rank for point in profile.points], color="black", marker=".")
    below.set(ylabel="its rank", xlabel=f"{profile.over} ({UNITS[profile.over].strip()})")
    last = max(10, *(point.rank for point in profile.points))
    ticks = [tick * 10**power for power in range(7) for tick in (1, 2, 5) if tick * 10**power <= last]
    below.set_yscale("log")
    below.minorticks_off()
    below.set_yticks(ticks, [str(tick) for tick in ticks])
    below.set_ylim(last * 1.2, 0.8)
    figure.tight_layout()
    return png(figure, dpi=120)
