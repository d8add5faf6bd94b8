"""Commands that make and search indexes of tiles: index, search."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import lpn
from lpn.commands.reasons import part_values
from lpn.commands.using import ViewName
from lpn.errors import InputError
from lpn.files import printable

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from lpn.geo import Positions
    from lpn.index import Found
    from lpn.model import FloatArray, Model

_BATCH_BYTES = 64 << 20
"""Of descriptors added at once: what a killed run does over again."""


@dataclass
class MakeIndex:
    """Put the descriptors of a store into an index that lpn search searches; resumable."""

    descriptors: Path
    """Store that lpn describe wrote, of the tiles to find."""
    out: str
    """Folder of the index, or milvus://host:port/collection; what is there already is added to."""
    data: Path | None = None
    """Folder whose geo.csv gives the tiles' positions; the described pictures lie in it."""
    engine: Literal["exact", "faiss", "milvus"] | None = None
    """exact misses nothing; faiss is for millions of tiles on one machine, milvus for a server. By default what --out is."""
    precision: Literal["float32", "float16", "int8"] = "float32"
    """Of the copy that exact scans: float16 and int8 take more disk and are searched faster, with the same answers."""
    replace: bool = False
    """Add all tiles anew, also those whose names are there, as after a picture has changed."""

    def run(self) -> None:
        import numpy as np
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from lpn import features
        from lpn.index import Kind, create_index

        store = features.open_store(self.descriptors)
        manifest = store.manifest
        names = [Path(row.file).as_posix() for row in manifest.rows]
        if manifest.cropped:
            raise InputError(
                f"{self.descriptors} holds cropped pictures, of which several can share a file; index whole ones."
            )
        places = _positions(self.data, names)
        kind = Kind(manifest.fingerprint, manifest.n_parts, manifest.embedding)
        step = max(1, _BATCH_BYTES // (4 * kind.numbers))
        added = 0
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with create_index(self.out, kind, self.engine, self.precision) as index, Progress(*columns) as bar:
            task = bar.add_task("Indexing", total=len(names))
            for start in range(0, len(names), step):
                some = np.arange(start, min(start + step, len(names)))
                if not self.replace:
                    some = some[~index.holds(names[start : start + step])]
                if len(some):
                    chosen = [names[i] for i in some.tolist()]
                    index.add(chosen, store.rows(some), None if places is None else places[some])
                    added += len(some)
                bar.update(task, completed=min(start + step, len(names)))
            print(f"{printable(_shown(self.out))} holds {index.count()} tiles, {added} of them added now.")


@dataclass
class Search:
    """Find the tiles of an index that a picture matches best, and each part's share of the distance."""

    index: str
    """Folder of the index, or milvus://host:port/collection."""
    model: Path
    """Trained LPN whose descriptors the index holds: .onnx (needs no torch), .safetensors, or .pth."""
    picture: Path
    """Picture file to find."""
    view: ViewName = "drone"
    """What the picture shows: the branch that describes it."""
    rotate: float = 0.0
    """Degrees counter-clockwise it is turned first."""
    weights: str | None = None
    """Weight of each part, such as 1,1,0,1; all alike by default."""
    top: int = 10
    """Tiles listed."""
    box: tuple[float, float, float, float] | None = None
    """Only tiles within south, west, north, and east degrees; west beyond east is across the antimeridian."""
    json: Path | None = None
    """File to write the tiles to, with scores, parts, and positions."""

    def run(self) -> None:
        from lpn import explain, images, retrieval
        from lpn.files import check_writable, write_whole
        from lpn.index import open_index

        if self.json is not None:
            check_writable(self.json)
        model = lpn.load(self.model)
        model.check_view(self.view)
        weights = explain.part_weights(model.n_parts, part_values(self.weights))
        with open_index(self.index, model.fingerprint) as index:
            query = retrieval.describe_picture(
                model, images.load_picture(self.picture), self.view, self.rotate
            ).descriptor
            # One more than is listed, for the gap after the last.
            found = index.search(query, weights, self.top + 1, self.box)
        matches = _matches(found, query, weights, self.top, model, self.view)
        _show(matches, model.spec.partition(self.view).names())
        if self.json is not None:
            asked: dict[str, Any] = {
                "index": _shown(self.index),
                "model": model.fingerprint,
                "picture": str(self.picture),
            }
            asked |= {"view": self.view, "rotate": self.rotate, "weights": weights.tolist(), "box": self.box}
            write_whole(self.json, (json.dumps(asked | {"matches": matches}, indent=1) + "\n").encode())


def _matches(
    found: Found, query: FloatArray, weights: FloatArray, top: int, model: Model, view: ViewName
) -> list[dict[str, Any]]:
    """What is told of each tile."""
    import numpy as np

    from lpn import explain

    cosines = explain.part_cosines(query, found.vectors)
    shares = explain.contributions(cosines, weights)
    names = model.spec.partition(view).names()
    matches = []
    for i, name in enumerate(found.ids[:top]):
        score = float(found.scores[i])
        gap = 2 * (score - float(found.scores[i + 1])) if i + 1 < len(found) else None
        match: dict[str, Any] = {"rank": i + 1, "tile": name, "score": score, "distance2": 2 - 2 * score, "gap": gap}
        match["parts"] = [
            {"name": part, "cosine": float(cosines[i, p]), "share": float(shares[i, p])} for p, part in enumerate(names)
        ]
        if not np.isnan(found.positions[i]).any():
            match["latitude"], match["longitude"] = found.positions[i].tolist()
        matches.append(match)
    return matches


def _show(matches: list[dict[str, Any]], names: list[str]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title="part: its share of the squared distance", title_justify="right")
    for name in ("rank", "tile", "score", "gap", *names):
        table.add_column(name, justify="left" if name == "tile" else "right")
    for match in matches:
        gap = "" if match["gap"] is None else f"{match['gap']:.4f}"
        shares = (f"{part['share']:.4f}" for part in match["parts"])
        table.add_row(str(match["rank"]), Text(printable(match["tile"])), f"{match['score']:.4f}", gap, *shares)
    console = Console(width=max(100, Console().width))
    console.print(table if matches else "There is no tile to compare with.")


def _positions(root: Path | None, names: list[str]) -> npt.NDArray[np.float64] | None:
    """Latitude and longitude of each tile by `geo.csv`, (N, 2), NaN where it has none; None without a data set.

    Raises:
        DataError: when there is no such file, or it cannot be read.
        InputError: when it has none of the tiles.
    """
    import numpy as np

    from lpn import geo
    from lpn.errors import DataError

    if root is None:
        return None
    known = geo.positions(root)
    if known is None:
        raise DataError(f"{root} has no {geo.NAME}; leave --data out, or write one (docs/data.md).")
    paths = _paths(known, names)
    held = set(known.paths)
    if not any(path in held for path in paths):
        raise InputError(
            f"{geo.NAME} in {root} has no position for any of the {len(names)} tiles, the first being {printable(names[0])}; "
            "give the data set that was described."
        )
    found = np.full((len(names), 2), np.nan)
    for i, path in enumerate(paths):
        if path in held:
            place = known.below([path])[0]
            found[i] = place.latitude, place.longitude
    return found


def _paths(known: Positions, names: list[str]) -> list[str]:
    """The tiles' paths below the data set's folder, of which the described folder may be one inside.

    Which one, those paths in `geo.csv` say that end as the tiles' do: the folder that has most of them.
    """
    wanted = set(names)
    folders: Counter[str] = Counter()
    for path in known.paths:
        parts = path.split("/")
        for depth in range(len(parts)):
            if "/".join(parts[depth:]) in wanted:
                folders["".join(f"{part}/" for part in parts[:depth])] += 1
    above = folders.most_common(1)[0][0] if folders else ""
    return [above + name for name in names]


def _shown(where: str) -> str:
    """A place without the password that its address may hold."""
    scheme, separator, rest = where.partition("://")
    return f"{scheme}://{rest.rpartition('@')[2]}" if separator else where
