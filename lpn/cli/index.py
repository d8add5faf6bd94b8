"""The commands index and search."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import lpn
from lpn.cli.parsing import part_values
from lpn.core.arrays import Float32Array
from lpn.core.consoles import wide_console
from lpn.core.errors import InputError
from lpn.core.files import check_outputs, printable, write_json
from lpn.core.resources import ProviderName
from lpn.core.text_tables import TextTable
from lpn.core.texts import counted
from lpn.core.views import View
from lpn.sources import ModelOptions

if TYPE_CHECKING:
    from lpn.index import SearchResult
    from lpn.models.base import Model


@dataclass
class IndexCommand:
    """Put the descriptors of a store, or the windows of a map, into an index that lpn search searches; resumable."""

    out: str
    """Folder of the index, or an address such as milvus://host:port/collection; tiles are added to an existing index."""
    descriptors: str | None = None
    """Store of tiles written by lpn describe; an address such as s3://bucket/store is copied to this machine first."""
    map: Path | None = None
    """Map whose windows are described into the index block by block, so that they need not fit in memory; needs --model."""
    model: Path | None = None
    """With --map: trained LPN, .onnx, .safetensors, or .pth."""
    size: tuple[float, ...] = ()
    """With --map: sides of the windows in metres, such as 70 100 140; by default five, at most 300 m and 0.6 of the map."""
    overlap: float = 0.5
    """With --map: share of a window's side that its neighbour covers, too."""
    turns: int = 1
    """With --map: headings at which each window is described. With 8, lpn locate describes a photo of unknown heading once, not
    eight times."""
    box: tuple[float, float, float, float] | None = None
    """With --map: south, west, north, and east in degrees; windows with their centres elsewhere are left to other machines."""
    provider: ProviderName = "auto"
    """With --map: provider: auto (LPN_PROVIDER, else a GPU if one works, else the CPU), cpu, cuda, or, for an .onnx, any
    of ONNX Runtime's, such as coreml."""
    data: Path | None = None
    """Folder with the tiles' positions, in geo.csv or as its data set gives them."""
    engine: Literal["exact", "faiss", "milvus"] | None = None
    """exact finds every match; faiss is for millions of tiles on one machine, milvus for a server; by default that of --out."""
    replace: bool = False
    """Add all tiles again, also existing names, for example after pictures or positions have changed."""

    def run(self) -> None:
        from lpn.descriptors.places import local_store
        from lpn.index import create_index
        from lpn.index.tiles import open_tiles

        if self.map is not None:
            self._index_map(self.map)
            return
        if self.descriptors is None or self.model is not None or self.size or self.turns != 1 or self.box is not None:
            raise InputError(
                "An index is of descriptors or a map's windows; give --descriptors, or --map with --model."
            )
        with local_store(self.descriptors) as store:
            tiles = open_tiles(store, self.data)
            with create_index(self.out, tiles.kind, self.engine) as index:
                added = tiles.add_to(index, self.replace)
                held = counted(index.count(), "tile")
                print(f"{printable(_displayed(self.out))} holds {held}, {added} of them added now.")
        if there := len(tiles.names) - added:
            print(f"{there} were there already and are left; give --replace where pictures or positions changed.")

    def _index_map(self, where: Path) -> None:
        from lpn.flight.locate.retrieval import pyramid_sizes
        from lpn.flight.maps import open_map
        from lpn.index import create_index
        from lpn.index.base import check_box
        from lpn.index.from_map import index_windows, window_describer, windows_kind

        if self.descriptors is not None or self.data is not None or self.model is None:
            raise InputError("A map's windows need --model, not --descriptors or --data; give --map with --model.")
        model = lpn.load(self.model, self.provider).in_role("satellite", None)
        basemap, box = open_map(where), check_box(self.box)
        if not 1 <= self.turns <= 360:
            raise InputError(f"Windows cannot be described at {self.turns} headings; expected 1 to 360 as --turns.")
        sizes = self.size or pyramid_sizes(basemap, [])
        kind = windows_kind(model, basemap, sizes, self.overlap, self.turns)
        if kind.windows is None or not kind.windows.count:
            raise InputError(
                f"No window of {min(sizes):.0f} m or more fits on the map {printable(basemap.name)}; give smaller ones as --size."
            )
        describe = window_describer(model, basemap)
        with create_index(self.out, kind, self.engine) as index:
            added = index_windows(index, basemap, describe, again=self.replace, box=box)
            print(f"{printable(_displayed(self.out))} holds {index.count()} windows, {added} of them added now.")

    def resume_hint(self) -> str:
        """Return how to resume after a stop."""
        return f"The tiles that {printable(_displayed(self.out))} has by now are kept; the same command goes on."


@dataclass(kw_only=True)
class SearchCommand(ModelOptions):
    """Find the tiles of an index that a picture matches best, and each part's share of the distance."""

    index: str
    """Folder of a store or an index, or an address such as milvus://host:port/collection."""
    model: Path = field()  # no default, unlike in `ModelOptions`
    """Trained LPN whose descriptors the index holds: .onnx (needs no torch), .safetensors, or .pth."""
    picture: Path
    """Picture file to find."""
    view: View = "drone"
    """View of the picture: the branch that describes it."""
    rotate: float = 0.0
    """Degrees counter-clockwise by which it is rotated first."""
    weights: str | None = None
    """Weight of each part, such as 1,1,0,1; equal by default."""
    top: int = 10
    """Number of listed tiles."""
    box: tuple[float, float, float, float] | None = None
    """South, west, north, and east bounds in degrees; west > east crosses the antimeridian."""
    json: Path | None = None
    """File to write the tiles to, with scores, parts, and positions, as JSON."""

    def run(self) -> None:
        from lpn import retrieval
        from lpn.core import images
        from lpn.index import open_index
        from lpn.index.base import check_count
        from lpn.retrieval import scoring

        check_count(self.top)
        check_outputs((self.json, ".json"))
        model = self.load()
        # An index holds a gallery (`lpn.index.tiles`).
        model = model.in_role(self.view, "query" if model.contract.roles == "role" else None)
        weights = scoring.part_weights(model.n_parts, part_values(self.weights))
        with open_index(self.index, model.fingerprint) as index:
            query = retrieval.describe_picture(
                model, images.load_picture(self.picture), self.view, self.rotate
            ).descriptor
            # One tile more than is listed, if the index returns it, for the gap after the last one.
            wanted = self.top + (index.most is None or self.top < index.most)
            result = index.search(query, weights, wanted, self.box)
        matches = _matches(result, query, weights, self.top, model, self.view)
        _show(matches, model.contract.names(self.view))
        if self.json is not None:
            request: dict[str, Any] = {
                "index": _displayed(self.index),
                "model": model.fingerprint,
                "picture": str(self.picture),
            }
            request |= {"view": self.view, "rotate": self.rotate, "weights": weights.tolist(), "box": self.box}
            write_json(self.json, request | {"matches": matches})


def _matches(
    result: SearchResult, query: Float32Array, weights: Float32Array, top: int, model: Model, view: View
) -> list[dict[str, Any]]:
    import numpy as np

    from lpn.retrieval import scoring

    cosines = scoring.part_cosines(query, result.vectors)
    contributions = scoring.contributions(cosines, weights)
    names = model.contract.names(view)
    matches = []
    for i, name in enumerate(result.ids[:top]):
        score = float(result.scores[i])
        gap = 2 * (score - float(result.scores[i + 1])) if i + 1 < len(result) else None
        match: dict[str, Any] = {"rank": i + 1, "tile": name, "score": score, "distance2": 2 - 2 * score, "gap": gap}
        match["parts"] = [
            {"name": part, "cosine": float(cosines[i, p]), "contribution": float(contributions[i, p])}
            for p, part in enumerate(names)
        ]
        if not np.isnan(result.positions[i]).any():
            match["latitude"], match["longitude"] = result.positions[i].tolist()
        matches.append(match)
    return matches


def _show(matches: list[dict[str, Any]], names: list[str]) -> None:
    if not matches:
        print("There is no tile to compare with.")
        return
    rows = []
    for match in matches:
        gap = "" if match["gap"] is None else f"{match['gap']:.4f}"
        contributions = (f"{part['contribution']:.4f}" for part in match["parts"])
        rows.append((str(match["rank"]), printable(match["tile"]), f"{match['score']:.4f}", gap, *contributions))
    title = "part: its contribution to the squared distance"
    TextTable(("rank", "tile", "score", "gap", *names), rows, title, align="rlr").print(wide_console(100))


def _displayed(where: str) -> str:
    """Return an address without its password."""
    scheme, separator, rest = where.partition("://")
    return f"{scheme}://{rest.rpartition('@')[2]}" if separator else where
