"""The command explain: exact evidence for one pair of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from lpn.cli.parsing import part_values
from lpn.cli.sweep import Sweep
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.numbers import signed
from lpn.core.views import View
from lpn.sources import Advanced, SourceOptions, source_of

if TYPE_CHECKING:
    from lpn.core.consoles import Console
    from lpn.datasets import Picture
    from lpn.explain import Evidence
    from lpn.library.answer import Answer
    from lpn.models.base import Model
    from lpn.retrieval import DescribedPicture
    from lpn.retrieval.calibration import Calibration
    from lpn.tasks.task import Task


@dataclass(kw_only=True)
class ExplainCommand(SourceOptions):
    """Split the score of a query and a tile exactly into its cells; works from the .onnx alone.

    With a SOURCE, queries and tiles are named as the explorer names them; without one they are picture files, as they may be with
    one. With --over, one query is changed step by step, see lpn explain --over --help.
    """

    MODES: ClassVar[dict[str, type[Sweep]]] = {"--over": Sweep}

    query: str
    """Name of the query, such as 0005/01, or a picture file."""
    match: str | None = None
    """Name of the tile to compare with, or a picture file; by default the source's top match."""
    view_query: Advanced[View] = "drone"
    """View of a query without a source: the branch that describes it."""
    view_match: Advanced[View] = "satellite"
    """View of the tile, likewise."""
    rotate: float = 0.0
    """Degrees counter-clockwise by which the query is rotated first."""
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
        from lpn.core.consoles import wide_console
        from lpn.core.files import check_outputs, write_atomic, write_json
        from lpn.datasets import Picture
        from lpn.descriptors.transforms import Change
        from lpn.drawing import pair_figure, verdicts
        from lpn.drawing.part_areas import PartAreas
        from lpn.explain import occlusion
        from lpn.library.answer import PairEvidence
        from lpn.library.gallery import answer_of
        from lpn.retrieval import scoring
        from lpn.retrieval.csls import CslsTerms

        check_outputs((self.json, ".json"), (self.png, ".png"))
        task = None if self.source is None else source_of(self).open((), part_values(self.weights)).task
        if task is None and (of_source := self.of_source()):
            raise InputError(f"{of_source[0]} is of a source, and none is given; name it: lpn explain SOURCE.")
        model = self.load() if task is None else task.model
        if model is None:
            raise InputError(
                f"{printable(str(self.source))} holds descriptors and no network, so no score can be split into cells."
            )
        views = (self.view_query, self.view_match) if task is None else task.views
        for view in views:
            model.check_view(view)
        calibration = None if task is None else task.calibration
        model = model.for_task(*views)
        if not model.contract.has_cells and (self.png is not None or not self.covering):
            raise InputError(
                f"{verdicts.no_cells(model.contract)} Give --covering and --json to measure places instead."
            )
        weights = scoring.part_weights(model.n_parts, part_values(self.weights))
        positions, pair = self._pair(task)
        files, pictures = zip(*pair, strict=True)
        query, tile = (
            retrieval.describe_picture(
                model, picture, view, Change(turn, zoom=_zoom(calibration, model, file, picture, view))
            )
            for picture, file, view, turn in zip(pictures, files, views, (self.rotate, 0), strict=True)
        )
        csls = _csls(task, query, tile) if task is not None and task.neighbours else None
        traces = None if query.trace is None or tile.trace is None else (query.trace, tile.trace)
        evidence = None if traces is None else explain.evidence(*traces, weights, csls)
        cosines = scoring.part_cosines(query.descriptor, tile.descriptor[None])[0]
        names = model.contract.names(views[0])
        console = wide_console(100)
        if self.match is None:
            console.print(f"The tile is {_short(files[1])}, the top match.", highlight=False, markup=False)
        losses = _losses(model, query, views[0], tile) if self.covering else None
        terms = None if csls is None else CslsTerms(csls[0], csls[1][None])
        answer = None if task is None else _answer(task, positions, query, weights, str(files[0]))
        if answer is None:
            ranking = retrieval.rank(cosines[None], weights, csls=terms)
            gallery = [Picture(files[1], 0, str(files[1]))]
            answer = answer_of(model, views, query, gallery, tile.descriptor[None], ranking, str(files[0]))
        of: dict[str, Any] = {"model": model.fingerprint, "match": str(files[1]), "rotate": self.rotate}
        of |= {"view_query": views[0], "view_match": views[1]}
        if losses is not None:
            of |= answer.to_dict() | occlusion.to_dict(cosines, weights, losses, names)
        elif evidence is not None:
            of |= replace(answer, pair_evidence=PairEvidence(evidence, None)).to_dict()
        taken = 0.0 if csls is None else float((csls[0] + csls[1]) @ weights)
        _show(console, cosines, weights, taken, evidence, names, model.contract.claim)
        if evidence is not None:
            said = verdicts.describe_evidence(evidence, names, *views, model.contract.part_noun)
            console.print(said, markup=False)
        if self.json is not None:
            write_json(self.json, of)
        if self.png is not None and evidence is not None and traces is not None:
            cut = [model.as_partitioned(one.picture, view) for one, view in zip((query, tile), views, strict=True)]
            titles = (f"{views[0]} {_short(files[0])}", f"{views[1]} {_short(files[1])}")
            areas = [
                PartAreas.of(model.contract, view, trace.size, trace) for view, trace in zip(views, traces, strict=True)
            ]
            figure = pair_figure.draw(
                evidence, (cut[0], cut[1]), titles, views, model.contract, (areas[0], areas[1]), losses
            )
            write_atomic(self.png, pair_figure.encode(figure))

    def _pair(self, task: Task | None) -> tuple[list[int | None], list[tuple[Path, UInt8Array]]]:
        """Return the positions of query and tile in a task, None for a file's, and the paths and the pixels of both."""
        from lpn.core import images
        from lpn.descriptors.transforms import Change
        from lpn.sources.opened import query_positions

        positions: list[int | None] = [None, None]
        sides: tuple[Sequence[Picture], ...] = ((), ()) if task is None else (task.queries, task.gallery)
        for side, given in enumerate((self.query, self.match)):
            if task is not None and given is not None and not Path(given).is_file():
                (positions[side],) = query_positions([given], sides[side], task.data_name)
        if self.match is None:
            if task is None or positions[0] is None:
                raise InputError("Nothing says which tile to compare with; give it as --match.")
            positions[1] = int(task.search(positions[0], change=Change(self.rotate)).order[0])
        pair = []
        for given, position, pictures in zip((self.query, self.match), positions, sides, strict=True):
            if position is None:
                pair.append((Path(given or ""), images.load_picture(given or "")))
            else:
                pair.append((pictures[position].path, pictures[position].load_cropped()))
        return positions, pair


def _answer(
    task: Task, positions: Sequence[int | None], query: DescribedPicture, weights: Float32Array, name: str
) -> Answer | None:
    """Return the answer of a task to a described query, compared with a tile; None if the task does not rank that tile."""
    from lpn.library.analyser import describe_tile
    from lpn.library.answer import SHOWN, Answer

    index, tile = positions
    ranking = task.start_search(index, query.descriptor)(weights)
    if tile is None or not ranking.holds(tile):
        return None
    return Answer(
        task=task,
        name=name,
        index=index,
        query=query,
        ranking=ranking,
        matches=ranking.top(SHOWN),
        chosen=ranking.find(tile),
        describe_tile=partial(describe_tile, model=task.model),
        source=query.picture,
        positive=ranking.positive(),
        errors_m=None if task.geometry is None or index is None else task.geometry.errors_m(index),
    )


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


def _losses(model: Model, query: DescribedPicture, view: View, tile: DescribedPicture) -> Float32Array:
    """Return the loss of each part's cosine for each covered square."""
    from lpn.core.progress import tracked
    from lpn.explain import occlusion

    steps = occlusion.occlude(model, query.picture, view, tile.descriptor)
    return list(tracked("Covering squares", steps, occlusion.SQUARES**2))[-1][1]


def _show(
    console: Console,
    cosines: Float32Array,
    weights: Float32Array,
    csls: float,
    evidence: Evidence | None,
    names: Sequence[str],
    claim: str,
) -> None:
    from lpn.core.text_tables import TextTable

    score = float(cosines @ weights) - csls
    taken = f"CSLS takes {csls:.4f}, " if csls else ""
    sums = () if evidence is None else evidence.part_sums
    several = len(names) > 1
    of_part = ("part", "cosine", "weight", "adds to the score") if several else ("score",)
    rows = []
    for part, name in enumerate(names):
        numbers = [signed(number, 4) for number in (cosines[part] * weights[part], *(values[part] for values in sums))]
        rows.append([*((name, signed(cosines[part], 4), f"{100 * weights[part]:.0f} %") if several else ()), *numbers])
    title = f"score {score:.4f}, {taken}squared distance {2 - 2 * score:.4f} ({claim})"
    head = (*of_part, *("cells for", "cells against", "constant")[: len(sums)])
    TextTable(head, rows, title, align="lr" if several else "r").print(console)


def _short(path: Path) -> str:
    """Return a picture's folder, which often names the place, and its name."""
    return printable("/".join(path.resolve().parts[-2:]))
