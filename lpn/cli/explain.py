"""The command explain: exact evidence for one pair of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from lpn.cli.parsing import part_values
from lpn.cli.sweep import Sweep
from lpn.core.consoles import Console, wide_console
from lpn.core.errors import InputError
from lpn.core.files import check_outputs, printable, write_atomic, write_json
from lpn.core.numbers import signed
from lpn.core.progress import tracked
from lpn.core.text_tables import TextTable
from lpn.core.views import View
from lpn.sources import Advanced, SourceOptions, source_of
from lpn.sources.opened import query_positions

if TYPE_CHECKING:
    from lpn.datasets import Picture
    from lpn.explain import Evidence
    from lpn.library.answer import Answer
    from lpn.models.base import Model


@dataclass(kw_only=True)
class ExplainCommand(SourceOptions):
    """Split the score of a query and a tile exactly into its cells; works from the .onnx alone.

    With a SOURCE, queries and tiles are named as the explorer names them, and the query may be a picture file. Without a
    SOURCE, both are picture files. With --over, one query is changed step by step, see lpn explain --over --help.
    """

    MODES: ClassVar[dict[str, type[Sweep]]] = {"--over": Sweep}

    query: str
    """Name of the query, such as 0005/01, or a picture file."""
    match: str | None = None
    """Tile to compare with, by its name or its file; by default the source's top match."""
    view_query: Advanced[View] = "drone"
    """Without a SOURCE, the query's view, which selects its branch."""
    view_match: Advanced[View] = "satellite"
    """Without a SOURCE, the tile's view."""
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
        from lpn.drawing import pair_figure, verdicts
        from lpn.explain import occlusion

        check_outputs((self.json, ".json"), (self.png, ".png"))
        answer = self._of_files() if self.source is None else self._of_source()
        task, query, tile, views = answer.task, answer.query, answer.described(answer.chosen), answer.task.views
        evidence = None if answer.pair_evidence is None else answer.pair_evidence.evidence
        files = (
            Path(self.query) if answer.index is None else task.queries[answer.index].path,
            task.gallery[answer.chosen.index].path,
        )
        console = wide_console(100)
        if self.match is None:
            console.print(f"The tile is {_short(files[1])}, the top match.", highlight=False, markup=False)
        _show(console, answer, evidence)
        if evidence is not None:
            said = verdicts.describe_evidence(evidence, task.part_names, *views, task.contract.part_noun)
            console.print(said, markup=False)
        assert task.model is not None
        losses = None
        if self.covering:
            steps = occlusion.occlude(task.model.for_task(*views), query.picture, views[0], tile.descriptor)
            losses = list(tracked("Covering squares", steps, occlusion.SQUARES**2))[-1][1]
        values: dict[str, Any] = {"model": task.model.fingerprint, "match": str(files[1]), "rotate": self.rotate}
        values |= {"view_query": views[0], "view_match": views[1]}
        if losses is None:
            values |= answer.to_dict()
        else:
            of_pair = answer.chosen.cosines, answer.ranking.weights
            values |= replace(answer, pair_evidence=None).to_dict()
            values |= occlusion.to_dict(*of_pair, losses, task.part_names)
        if self.json is not None:
            write_json(self.json, values)
        if self.png is not None and evidence is not None:
            (one, first), (other, second) = answer.drawn(query, 0), answer.drawn(tile, 1)
            titles = (f"{views[0]} {_short(files[0])}", f"{views[1]} {_short(files[1])}")
            figure = pair_figure.draw(evidence, (one, other), titles, views, task.contract, (first, second), losses)
            write_atomic(self.png, pair_figure.encode(figure))

    def _of_source(self) -> Answer:
        """Answer a source's query or a picture file, and compare it with the named tile or the top match."""
        from lpn.core import images
        from lpn.descriptors.transforms import Change
        from lpn.library.analyser import OwnPicture, QueryAnalyser, QueryRequest, describe_tile
        from lpn.library.answer import SHOWN

        weights = part_values(self.weights)
        task = source_of(self).open((), weights).task
        if task.model is None:
            raise InputError(
                f"{printable(str(self.source))} holds descriptors and no network, so no score can be split into cells."
            )
        self._check_cells(task.model.for_task(*task.views))
        query = _position(self.query, task.queries, task.data_name)
        tile = None if self.match is None else _position(self.match, task.gallery, task.data_name)
        if self.match is not None and tile is None:
            raise InputError(
                f"{printable(self.match)} is no tile of {task.data_name}; give the name of one, or leave the source out."
            )
        request = QueryRequest(
            OwnPicture(self.query, images.load_picture(self.query)) if query is None else query,
            Change(rotate=self.rotate),
            None if weights is None else tuple(weights),
            compare=tile,
            evidence=True,
        )
        answer = QueryAnalyser(task.model, partial(describe_tile, model=task.model)).analyse(task, request, SHOWN)
        if tile not in (None, answer.chosen.index):
            raise InputError(f"{self.match} is not ranked for this query; choose another tile.")
        return answer

    def _of_files(self) -> Answer:
        """Compare two picture files; the second is the whole gallery."""
        from lpn import retrieval
        from lpn.core import images
        from lpn.datasets import Picture
        from lpn.descriptors.transforms import Change
        from lpn.library.answer import pair_evidence
        from lpn.library.gallery import answer_of
        from lpn.retrieval import scoring

        if of_source := self.of_source():
            raise InputError(f"{of_source[0]} needs a source; name it: lpn explain SOURCE.")
        if self.match is None:
            raise InputError("Nothing says which tile to compare with; give it as --match.")
        views = (self.view_query, self.view_match)
        model = self.load()
        for view in views:
            model.check_view(view)
        model = model.for_task(*views)
        self._check_cells(model)
        weights = scoring.part_weights(model.n_parts, part_values(self.weights))
        query, tile = (
            retrieval.describe_picture(model, images.load_picture(file), view, Change(rotate=turn))
            for file, view, turn in zip((self.query, self.match), views, (self.rotate, 0), strict=True)
        )
        described = tile.descriptor[None]
        ranking = retrieval.rank(scoring.part_cosines(query.descriptor, described), weights)
        gallery = [Picture(Path(self.match), 0, self.match)]
        answer = answer_of(model, views, query, gallery, described, ranking, self.query)
        return replace(answer, tile=tile, pair_evidence=pair_evidence(query, tile, weights))

    def _check_cells(self, model: Model) -> None:
        """Raise InputError if the model has no cells, and the options ask for more than occlusion."""
        from lpn.drawing import verdicts

        if not model.contract.has_cells and (self.png is not None or not self.covering):
            raise InputError(
                f"{verdicts.no_cells(model.contract)} Give --covering and --json to measure squares of the query instead."
            )


def _position(given: str, pictures: Sequence[Picture], data_name: str) -> int | None:
    """Return the position of a picture by its name or its file; None for a file that is not among the pictures."""
    if not Path(given).is_file():
        return query_positions([given], pictures, data_name)[0]
    file = Path(given).resolve()
    same = (i for i, one in enumerate(pictures) if one.path.name == file.name and one.path.resolve() == file)
    return next(same, None)


def _show(console: Console, answer: Answer, evidence: Evidence | None) -> None:
    """Print each part's share of the score."""

    match, weights, names = answer.chosen, answer.ranking.weights, answer.task.part_names
    taken = f"CSLS subtracts {sum(match.constants):.4f}, " if match.constants else ""
    sums = () if evidence is None else evidence.part_sums
    several = len(names) > 1
    of_part = ("part", "cosine", "weight", "adds to the score") if several else ("score",)
    rows = []
    for part, name in enumerate(names):
        cosine, weight = match.cosines[part], weights[part]
        numbers = [signed(number, 4) for number in (cosine * weight, *(values[part] for values in sums))]
        rows.append([*((name, signed(cosine, 4), f"{100 * weight:.0f} %") if several else ()), *numbers])
    claim = answer.task.contract.claim
    title = f"score {match.score:.4f}, {taken}squared distance {match.distance2:.4f} ({claim})"
    head = (*of_part, *("cells for", "cells against", "constant")[: len(sums)])
    TextTable(head, rows, title, align="lr" if several else "r").print(console)


def _short(path: Path) -> str:
    """Return a picture's folder, which often names the place, and its name."""
    return printable("/".join(path.resolve().parts[-2:]))
