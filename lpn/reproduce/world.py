"""A rendered world laid out as the paper's data sets: places with a "google" set, panoramas, and landmarks."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import shutil
from pathlib import Path

from lpn.core.files import write_atomic
from lpn.core.images import load_picture
from lpn.datasets import Picture, open_dataset

# Side of a landmark's region in its query, as a fraction of the picture's.
_REGION = 0.8


def prepare(world: Path, out: Path) -> dict[str, Path]:
    """Lay a world out as the data sets that the tables need, in a folder of its own in `out`, if that is not done yet.

    places: University-1652's layout. The first half of a training place's street pictures become train/street, and the others
    train/google, as pictures of the ground from another source. landmarks: the street pictures of the test places in
    Paris6k's layout. The first two of a place are queries by their middle, and all of its pictures are good.

    Returns:
        The folder of "places", and of "panoramas" (in CVUSA's layout) and "landmarks" if the world was rendered with panoramas
        and street pictures. With too few street pictures, "places" is the world itself.
    """
    dataset, folder = open_dataset(world), out / f"world-{_digest(world)}"
    made = {"places": world}
    streets = dataset.train("street")
    if streets and len(streets) >= 2 * len({picture.label for picture in streets}):
        made["places"] = folder / "places"
        if not made["places"].is_dir():
            _places(world, streets, made["places"])
    if (world / "test" / "gallery_street").is_dir():
        made["landmarks"] = folder / "landmarks"
        if not made["landmarks"].is_dir():
            _landmarks(dataset.gallery("street"), made["landmarks"])
    if (world / "cvusa" / "splits").is_dir():
        made["panoramas"] = world / "cvusa"
    return made


def _digest(world: Path) -> str:
    """Hash a world and its present pictures."""
    digest = hashlib.sha256((world / "world.json").read_bytes())
    for file in _files(world):
        digest.update(f"{file.relative_to(world)} {file.stat().st_size}\n".encode())
    return digest.hexdigest()[:12]


def _files(world: Path) -> list[Path]:
    return [file for split in ("train", "test") for file in sorted((world / split).rglob("*")) if file.is_file()]


def _places(world: Path, streets: list[Picture], out: Path) -> None:
    made = out.with_name(out.name + ".new")
    shutil.rmtree(made, ignore_errors=True)
    of_place: dict[int, list[str]] = {}
    for picture in streets:
        of_place.setdefault(picture.label, []).append(picture.path.relative_to(world).as_posix())
    later = [name for names in of_place.values() for name in names[len(names) // 2 :]]
    moved = {name: name.replace("train/street/", "train/google/", 1) for name in later}
    for file in _files(world):
        name = file.relative_to(world).as_posix()
        _link(file, made / moved.get(name, name))
    if (world / "geo.csv").is_file():
        with (world / "geo.csv").open(encoding="utf-8-sig", newline="") as source:
            rows = list(csv.DictReader(source))
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]))
        writer.writeheader()
        writer.writerows({**row, "path": moved.get(row["path"], row["path"])} for row in rows)
        write_atomic(made / "geo.csv", text.getvalue().encode())
    os.replace(made, out)


def _landmarks(pictures: list[Picture], out: Path) -> None:
    made = out.with_name(out.name + ".new")
    shutil.rmtree(made, ignore_errors=True)
    of_place: dict[int, list[str]] = {}
    for picture in pictures:
        names = of_place.setdefault(picture.label, [])
        names.append(f"place{picture.label:04d}_{len(names) + 1:06d}")
        _link(picture.path, made / "pictures" / f"{names[-1]}{picture.path.suffix}")
        if len(names) <= 2:
            height, width = load_picture(picture.path).shape[:2]
            near, far = (1 - _REGION) / 2, (1 + _REGION) / 2
            box = f"{near * width:.1f} {near * height:.1f} {far * width:.1f} {far * height:.1f}"
            query = made / "gt" / f"place{picture.label:04d}_{len(names)}"
            write_atomic(query.with_name(query.name + "_query.txt"), f"{names[-1]} {box}\n".encode())
    for label, names in of_place.items():
        for number in range(1, min(2, len(names)) + 1):
            for kind, listed in (("good", names), ("ok", []), ("junk", [])):
                text = "".join(f"{name}\n" for name in listed)
                write_atomic(made / "gt" / f"place{label:04d}_{number}_{kind}.txt", text.encode())
    os.replace(made, out)


def _link(source: Path, target: Path) -> None:
    """Link a file under another name, or copy it if the file system cannot."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
