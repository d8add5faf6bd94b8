"""Makes `assets/demo` from a rendered world and two models: `python -m assets.pack WORLD LPN BASELINE OUT`.

LPN and BASELINE are the `last.safetensors` of two trainings, with n = 4 and n = 1. The demo holds the test split's drone pictures
and tiles, each as queries and as gallery, and their positions. It holds each model as `.onnx` for the explorer and as
`.safetensors` for `lpn train --init`, and its descriptors of all pictures, so that the explorer has nothing to compute before it
shows its page.
"""

from __future__ import annotations

import csv
import io
import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import lpn
from lpn import descriptors
from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.files import write_atomic
from lpn.core.views import View
from lpn.datasets import Dataset, Picture, open_dataset
from lpn.descriptors import STORES, DescriptorKind, PartialStore, Precision, descriptor_reader, row_of, write_store
from lpn.models.base import Model
from lpn.models.checkpoints import load_torch, save
from lpn.models.export import export
from lpn.retrieval.calibration import Calibration
from lpn.tasks.opening import FOLDER, NAME, new_calibration

QUALITY = {"drone": 62, "satellite": 72}
"""Quality of WebP; sensor noise does not survive it, and is most of what a better one would cost."""

SAME = {"query_drone": "gallery_drone", "gallery_satellite": "query_satellite"}
"""The other role of each folder's pictures, so that satellite-to-drone is offered too, see `linked_folder`."""

# View, pictures, and precision on disk of a store.
Side = tuple[View, Sequence[Picture], Precision]

LARGEST = {".onnx": 4_000_000, ".safetensors": 4_000_000}
"""Bytes of a model's file."""


def main() -> None:
    """Copy, shrink, describe."""
    world, model, baseline, out = (Path(argument) for argument in sys.argv[1:5])
    if out.exists():
        sys.exit(f"{out} is there already; delete it or choose another place.")
    whole, out = out, out.with_name(out.name + ".part")
    shutil.rmtree(out, ignore_errors=True)
    kept: dict[str, str] = {}
    for role, view in (("query", "drone"), ("gallery", "satellite")):
        for source in sorted((world / "test" / f"{role}_{view}").glob("*/*.jpg")):
            picture = cv2.cvtColor(images.load_picture(source), cv2.COLOR_RGB2BGR)
            data = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, QUALITY[view]])[1].tobytes()
            inside = source.relative_to(world)
            kept[inside.as_posix()] = inside.with_suffix(".webp").as_posix()
            write_atomic(out / kept[inside.as_posix()], data)
    link_other_roles(out / "test")
    with (world / "geo.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    lines = [[kept[row[0]], *row[1:]] for row in rows if row[0] in kept]
    write_atomic(out / "geo.csv", ("\n".join(",".join(line) for line in [header, *lines]) + "\n").encode())
    plan = json.loads((world / "world.json").read_bytes())
    plan["buildings"] = [building for building in plan["buildings"] if building["split"] == "test"]
    plan["pictures"] = [{**shot, "path": kept[shot["path"]]} for shot in plan["pictures"] if shot["path"] in kept]
    write_atomic(out / "world.json", json.dumps(plan, separators=(",", ":")).encode())
    pack_model(model, "lpn", out, out / STORES)
    pack_model(baseline, "baseline", out, out / STORES / "baseline")
    pack_calibration(out)
    out.rename(whole)


def pack_model(trained: Path, name: str, out: Path, stores: Path) -> None:
    """Write a model as `.onnx`, the LPN as `.safetensors` too, and its descriptors of the pictures in `out`."""
    export(trained, out / f"{name}.onnx", "int8")
    if name == "lpn":  # the baseline is there to be compared with, and nobody trains from it
        save(load_torch(trained).network, out / f"{name}.safetensors", storage="int8")
    for file in out.glob(f"{name}.*"):
        if (size := file.stat().st_size) > (largest := LARGEST[file.suffix]):
            sys.exit(f"{file.name} has {size:,} bytes, and the demo's may have {largest:,}; train a smaller network.")
    opened, dataset = lpn.load(out / f"{name}.onnx"), open_dataset(out)
    for folder, (view, pictures, precision) in sides_of(dataset).items():
        files = [picture.path for picture in pictures]
        descriptors.describe(opened, files, view, stores / folder, root=out / "test" / folder, precision=precision)
    link_other_roles(stores)


def sides_of(dataset: Dataset) -> dict[str, Side]:
    """Return the view, the pictures, and the precision on disk of each store of the demo, by its name."""
    # 8 bits change a part's cosine by less than 0.001, and halve the largest files.
    return {
        "query_drone": ("drone", dataset.queries("drone"), "int8"),
        "gallery_satellite": ("satellite", dataset.gallery("satellite"), "float16"),
    }


def pack_calibration(out: Path) -> None:
    """Write the calibration of the demo's model, and the calibrated descriptors."""
    model, dataset = lpn.load(out / "lpn.onnx"), open_dataset(out)
    write_calibration(model, out, new_calibration(model, dataset), sides_of(dataset))
    link_other_roles(out / FOLDER)


def write_calibration(model: Model, root: Path, calibration: Calibration, sides: Mapping[str, Side]) -> None:
    """Write a calibration of a model, and calibrated descriptors, into a data set's folder.

    Args:
        sides: by the store's name, see `sides_of`.
    """
    read, moved = descriptor_reader(root), calibration.applied(model)
    for name, (view, pictures, precision) in sides.items():
        rows = [row_of(picture.path, picture.path.parents[1], picture.box) for picture in pictures]
        kind = DescriptorKind.of_model(moved, view, precision=precision)
        described = calibration.read(model, pictures, view, read)

        def fill(partial: PartialStore, described: Float32Array = described) -> None:
            partial.put(range(len(described)), described)

        write_store(root / FOLDER / name, kind, rows, fill)
    values: dict[str, Any] = {
        "fingerprint": np.array(model.fingerprint),
        "ratio": np.array(calibration.ratio),
        "tried": np.array(sorted(calibration.tried.items()), np.float64).reshape(-1, 2),
        "levels": np.array([(level.zoom, level.cost) for level in calibration.levels], np.float64).reshape(-1, 2),
        "level_means": np.array([level.mean for level in calibration.levels], np.float32),
    }
    for view, zooms in calibration.zooms.items():
        values[f"{view} files"] = np.array([file.relative_to(root).as_posix() for file in zooms])
        values[f"{view} zooms"] = np.array(list(zooms.values()), np.float64)
        values[f"{view} mean"] = calibration.means[view]
    data = io.BytesIO()
    np.savez_compressed(data, **values)
    write_atomic(root / FOLDER / NAME, data.getvalue())


def link_other_roles(folder: Path) -> None:
    """Give the pictures or descriptors of each role the other role as well."""
    for name, other in SAME.items():
        write_atomic(folder / other, f"{name}\n".encode())


if __name__ == "__main__":
    main()
