"""The command explain: exact evidence for one pair of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lpn
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.numbers import signed
from lpn.core.views import View
from lpn.sources import CalibrateOption, CslsOption, KindOption, PoolingOption

if TYPE_CHECKING:
    from lpn.core.consoles import Console
    from lpn.explain import Evidence
    from lpn.models.base import Model
    from lpn.retrieval import DescribedPicture
    from lpn.retrieval.calibration import Calibration
    from lpn.tasks.task import Task


@dataclass
class ExplainCommand:
    """Split the score of a pair of pictures exactly into its cells; works from the .onnx alone."""

    model: Path
    """Trained LPN: .onnx (needs no torch), .safetensors, or .pth."""
    query: Path
    """Picture file of the query."""
    match: Path
    """Picture file of the tile to compare with."""
    kind: KindOption = None
    pooling: PoolingOption = None
    view_query: View = "drone"
    """View of the query: the branch that describes it."""
    view_match: View = "satellite"
    """View of the tile."""
    rotate: float = 0.0
    """Degrees counter-clockwise by which the query is rotated first."""
    data: Path | None = None
    """Data set of the pair, for --calibrate and --csls."""
    calibrate: CalibrateOption = None
    csls: CslsOption = 0
    weights: str | None = None
    """Weight of each part, such as 1,1,0,1; equal by default."""
    covering: bool = False
    """Measure instead the loss of score when a square of the query is blurred (occlusion): approximate, for every model."""
    json: Path | None = None
    """File to write score, parts, and every cell to, as JSON."""
    png: Path | None = None
    """Figure to write, as PNG of 1200 pixels in width and, for square pictures and four parts, 1026 in height: both pictures with
    their parts and the evidence of each cell, and bars of the parts."""

    def run(self) -> None:
        from lpn import explain, retrieval
        from lpn.core import images
        from lpn.core.consoles import wide_console
        from lpn.core.files import check_outputs, write_atomic, write_json
        from lpn.datasets import Picture, open_dataset
        from lpn.descriptors.transforms import Change
        from lpn.drawing import pair_figure, verdicts
        from lpn.drawing.part_areas import PartAreas
        from lpn.explain import occlusion
        from lpn.library.answer import PairEvidence
        from lpn.library.gallery import answer_of
        from lpn.retrieval import scoring
        from lpn.retrieval.csls import CslsTerms
        from lpn.sources import open_data
        from lpn.tasks.opening import task_calibration

        check_outputs((self.json, ".json"), (self.png, ".png"))
        if self.data is None and (self.calibrate or self.csls):
            raise InputError(
                "--calibrate and --csls take all pictures of the pair's data set; give its folder with --data."
            )
        model, views = lpn.load(self.model, kind=self.kind, pooling=self.pooling), (self.view_query, self.view_match)
        for view in views:
            model.check_view(view)
        task = calibration = None
        if self.data is not None:
            dataset = open_dataset(self.data)
            calibration = task_calibration(model, dataset, self.calibrate)
            if self.csls:
                name = f"{self.view_query}-to-{self.view_match}"
                task = open_data(model, self.model.name, dataset, name, calibration is not None, self.csls).task
            if calibration is not None:
                model = calibration.applied(model)
        model = model.for_task(*views)
        if not model.contract.has_cells and (self.png is not None or not self.covering):
            raise InputError(
                f"{verdicts.no_cells(model.contract)} Give --covering and --json to measure places instead."
            )
        weights = scoring.part_weights(model.n_parts, part_values(self.weights))
        pictures = images.load_picture(self.query), images.load_picture(self.match)
        query, tile = (
            retrieval.describe_picture(
                model, picture, view, Change(turn, zoom=_zoom(calibration, model, file, picture, view))
            )
            for picture, file, view, turn in zip(
                pictures, (self.query, self.match), views, (self.rotate, 0), strict=True
            )
        )
        csls = None if task is None else _csls(task, query, tile)
        traces = None if query.trace is None or tile.trace is None else (query.trace, tile.trace)
        evidence = None if traces is None else explain.evidence(*traces, weights, csls)
        cosines = scoring.part_cosines(query.descriptor, tile.descriptor[None])[0]
        names = model.contract.names(self.view_query)
        console = wide_console(100)
        losses = _losses(model, query, self.view_query, tile, console) if self.covering else None
        terms = None if csls is None else CslsTerms(csls[0], csls[1][None])
        ranking = retrieval.rank(cosines[None], weights, csls=terms)
        answer = answer_of(
            model,
            views,
            query,
            [Picture(self.match, 0, str(self.match))],
            tile.descriptor[None],
            ranking,
            str(self.query),
        )
        of: dict[str, Any] = {"model": model.fingerprint, "match": str(self.match), "rotate": self.rotate}
        of |= {"view_query": self.view_query, "view_match": self.view_match}
        if losses is not None:
            of |= answer.to_dict() | occlusion.to_dict(cosines, weights, losses, names)
        elif evidence is not None:
            of |= replace(answer, pair_evidence=PairEvidence(evidence, None)).to_dict()
        taken = 0.0 if csls is None else float((csls[0] + csls[1]) @ weights)
        _show(console, cosines, weights, taken, evidence, names, model.contract.claim)
        if evidence is not None:
            console.print(verdicts.describe_evidence(evidence, names, *views), markup=False)
        if self.json is not None:
            write_json(self.json, of)
        if self.png is not None and evidence is not None and traces is not None:
            cut = [model.as_partitioned(one.picture, view) for one, view in zip((query, tile), views, strict=True)]
            titles = (f"{self.view_query} {_short(self.query)}", f"{self.view_match} {_short(self.match)}")
            areas = [
                PartAreas.of(model.contract, view, trace.size, trace) for view, trace in zip(views, traces, strict=True)
            ]
            figure = pair_figure.draw(
                evidence, (cut[0], cut[1]), titles, views, model.contract, (areas[0], areas[1]), losses
            )
            write_atomic(self.png, pair_figure.encode(figure))


def part_values(text: str | None) -> list[float] | None:
    """Parse part weights such as "1,1,0,1"; InputError if they are not numbers."""
    if text is None:
        return None
    try:
        return [float(item) for item in text.split(",")]
    except ValueError as error:
        raise InputError(f"The weights are {text!r}; expected a number for each part, such as 1,1,0,1.") from error


def _zoom(calibration: Calibration | None, model: Model, file: Path, picture: UInt8Array, view: View) -> float:
    """Return a picture's zoom under a calibration: its own where it took part, else the one that is chosen for it."""
    if calibration is None:
        return 1.0
    zooms = {listed.resolve(): zoom for listed, zoom in calibration.zooms.get(view, {}).items()}
    return zooms.get(file.resolve()) or calibration.own_zoom(model, picture, view)


def _csls(task: Task, query: DescribedPicture, tile: DescribedPicture) -> tuple[Float32Array, Float32Array]:
    """Return the terms of CSLS over a task for a pair's query and tile, (n,) each; they are subtracted from its cosines."""
    from lpn.retrieval import scoring
    from lpn.retrieval.csls import CslsTerms, hubness

    queries, tiles = task.sides()
    of_tile = task.contract.n_parts * hubness(queries, tile.descriptor[None], task.neighbours)
    cosines = scoring.part_cosines(query.descriptor, tiles)
    return CslsTerms.of_query(cosines, of_tile, task.neighbours).query, of_tile[0]


def _losses(
    model: Model, query: DescribedPicture, view: View, tile: DescribedPicture, console: Console
) -> Float32Array:
    """Return the loss of each part's cosine for each covered square."""
    from rich.progress import Progress

    from lpn.explain import occlusion

    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("Covering", total=occlusion.SQUARES**2)
        for progress in occlusion.occlude(model, query.picture, view, tile.descriptor):
            bar.update(task, completed=progress[0])
    return progress[1]


def _show(
    console: Console,
    cosines: Float32Array,
    weights: Float32Array,
    csls: float,
    evidence: Evidence | None,
    names: Sequence[str],
    claim: str,
) -> None:
    from rich.table import Table

    score = float(cosines @ weights) - csls
    taken = f"CSLS takes {csls:.4f}, " if csls else ""
    table = Table(title=f"score {score:.4f}, {taken}squared distance {2 - 2 * score:.4f} ({claim})")
    sums = () if evidence is None else evidence.part_sums
    several = len(names) > 1
    of_part = ("part", "cosine", "weight", "adds to the score") if several else ("score",)
    for name in (*of_part, *("cells for", "cells against", "constant")[: len(sums)]):
        table.add_column(name, justify="left" if name == "part" else "right")
    for part, name in enumerate(names):
        numbers = [signed(number, 4) for number in (cosines[part] * weights[part], *(values[part] for values in sums))]
        table.add_row(*((name, signed(cosines[part], 4), f"{100 * weights[part]:.0f} %") if several else ()), *numbers)
    console.print(table)


def _short(path: Path) -> str:
    """Return a picture's folder, which often names the place, and its name."""
    return printable("/".join(path.resolve().parts[-2:]))
