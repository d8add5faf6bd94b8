"""Makes `assets/demo` from a rendered world and a model: `python assets/pack.py WORLD MODEL.onnx OUT`.

The demo holds the test split's drone pictures as queries and its tiles as gallery, their positions, the model, and the
descriptors of all pictures, so that the explorer has nothing to compute before it shows its page.
"""

from __future__ import annotations

import csv
import json
import shutil
import sys
from pathlib import Path

import cv2

import lpn
from lpn import features, images
from lpn.datasets import open_dataset
from lpn.files import write_whole
from lpn.world.atlas import Settings, make_atlas
from lpn.world.model3d import city_model, test_window

VIEWS = (2, 4, 6)
"""Which of a place's drone pictures: from high up, from halfway down the spiral, and from straight above."""
TILE = 384
"""Side of a tile in pixels."""
QUALITY = 90


def main() -> None:
    """Copy, shrink, describe."""
    world, model, out = (Path(argument) for argument in sys.argv[1:4])
    if out.exists():
        sys.exit(f"{out} is there already; delete it or choose another place.")
    kept: set[str] = set()
    for role, view in (("query", "drone"), ("gallery", "satellite")):
        for source in sorted((world / "test" / f"{role}_{view}").glob("*/*.jpg")):
            if view == "drone" and int(source.stem.rpartition("-")[2]) not in VIEWS:
                continue
            kept.add(source.relative_to(world).as_posix())
            data = source.read_bytes()
            if view == "satellite":
                tile = cv2.cvtColor(images.resize(images.load_picture(source), TILE, TILE), cv2.COLOR_RGB2BGR)
                data = cv2.imencode(".jpg", tile, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
            write_whole(out / source.relative_to(world), data)
    with (world / "geo.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    lines = [header, *(row for row in rows if row[0] in kept)]
    write_whole(out / "geo.csv", ("\n".join(",".join(line) for line in lines) + "\n").encode())
    plan = json.loads((world / "world.json").read_bytes())
    plan["buildings"] = [building for building in plan["buildings"] if building["split"] == "test"]
    plan["pictures"] = [picture for picture in plan["pictures"] if picture["path"] in kept]
    write_whole(out / "world.json", json.dumps(plan, separators=(",", ":")).encode())
    atlas = make_atlas(Settings(**plan["settings"]))
    write_whole(out / "city.glb", city_model(atlas.city, atlas.site, test_window(atlas)))
    shutil.copy(model, out / "lpn.onnx")
    opened, dataset = lpn.load(out / "lpn.onnx"), open_dataset(out)
    for folder, view, pictures in (
        ("query_drone", "drone", dataset.queries("drone")),
        ("gallery_satellite", "satellite", dataset.gallery("satellite")),
    ):
        root = out / "test" / folder
        files = [picture.path for picture in pictures]
        features.describe(opened, files, view, out / "descriptors" / folder, root=root)


if __name__ == "__main__":
    main()
