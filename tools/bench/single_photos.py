"""Single photos on a map, of its place and of others: `python -m tools.bench.single_photos MAP --here F ... --elsewhere F ...`.

F is a photo, or a folder that is searched for photos. Each is registered as a visitor's own picture is, of which nothing is known
but its pixels: its metadata are left out, and the whole map is searched. It prints a line a photo and a table. `--every 3` takes
every third photo of each folder.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from explorer import uploads
from lpn.flight.locate.ground import MapFeatures
from lpn.flight.locate.matchers import open_matchers
from lpn.flight.locate.own_photo import register_own_photo
from lpn.flight.maps import Map, open_map

_ENDS = {".jpg", ".jpeg", ".png", ".webp"}


def photos_of(sources: Sequence[Path], every: int) -> Iterator[tuple[str, Path]]:
    """Yield the name of each source and a photo of it, every n-th of a folder in the order of names."""
    for source in sources:
        files = (
            sorted(file for file in source.rglob("*") if file.suffix.lower() in _ENDS) if source.is_dir() else [source]
        )
        for file in files[::every]:
            yield source.name, file


def accepted(basemap: Map, features: Sequence[MapFeatures], file: Path) -> tuple[bool, str]:
    """Register a photo of which its pixels alone are known, and return whether it is accepted, and the sentence."""
    picture = uploads.read(file.name, file.read_bytes()).picture
    photo = register_own_photo(basemap, features, picture, None, ())
    if not photo.whole_map:
        raise SystemExit(f"{basemap.name} is too large to be searched as a whole; take a smaller map.")
    return photo.answer.accepted, photo.answer.sentence


def main() -> None:
    """Register all photos, and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("--here", type=Path, nargs="+", required=True)
    parser.add_argument("--elsewhere", type=Path, nargs="+", required=True)
    parser.add_argument("--every", type=int, default=1)
    options = parser.parse_args()
    basemap = open_map(options.map)
    matchers = open_matchers()
    features = [MapFeatures(basemap, matcher) for matcher in matchers]
    table = Table("photos of", "place", "accepted", "of", "median s")
    for here, sources in ((True, options.here), (False, options.elsewhere)):
        rows: dict[str, list[tuple[bool, float]]] = {}
        for name, file in photos_of(sources, options.every):
            started = time.perf_counter()
            yes, sentence = accepted(basemap, features, file)
            rows.setdefault(name, []).append((yes, time.perf_counter() - started))
            print(
                f"{name} {file.name}: {'accepted' if yes else 'refused'}, {rows[name][-1][1]:.1f} s. {sentence}",
                flush=True,
            )
        for name, tries in rows.items():
            table.add_row(
                name, "the map's" if here else "another", str(sum(yes for yes, _ in tries)), str(len(tries)),
                f"{statistics.median(seconds for _, seconds in tries):.1f}",
            )  # fmt: skip
    Console(width=100, file=sys.stdout).print(table)


if __name__ == "__main__":
    main()
