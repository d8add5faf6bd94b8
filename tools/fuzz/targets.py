"""The readers, the real files that damaged ones are made from, and the properties of accepted input.

A reader gets the contents of one file and may raise LPNError and nothing else. In formats with checksums of their own, some
seeds are the contents, which the reader packs into a whole file again; otherwise no damage would get past the checksums.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import os
import pickle
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core.errors import LPNError

Read = Callable[[bytes], object]


@dataclass(frozen=True)
class FuzzCase:
    """One file: seeds that its damaged ones are made from, and how it is read."""

    seeds: list[bytes]
    read: Read


def pictures(folder: Path) -> list[FuzzCase]:
    """Uploads and picture files, in every format that is accepted, with 8 and 16 bits, transparent, animated, and turned."""
    from PIL import Image

    from lpn.core import images
    from lpn.datasets.integrity import stream_error
    from tools.fixtures import small_worlds

    del folder
    shown = Image.fromarray(small_worlds.place(1)[:40, :48])
    exif = shown.getexif()
    exif[0x0112] = 6
    more = {"save_all": True, "append_images": [shown.rotate(90)]}
    kinds = [("JPEG", {}), ("JPEG", {"exif": exif, "progressive": True}), ("PNG", {}), ("PNG", more), ("WEBP", {})]
    kinds += [
        ("WEBP", more | {"lossless": True, "exif": exif}),
        ("GIF", more),
        ("BMP", {}),
        ("TIFF", {"compression": "tiff_lzw"}),
    ]
    seeds = [_saved(shown, kind, **given) for kind, given in kinds]
    seeds += [
        _saved(shown.convert("CMYK"), "JPEG"),
        _saved(shown.convert("RGBA"), "PNG"),
        _saved(shown.convert("P"), "PNG"),
    ]
    seeds.append(_saved(Image.fromarray(np.asarray(shown.convert("L")).astype(np.uint16) * 257), "PNG"))

    def read(data: bytes) -> None:
        stream_error(io.BytesIO(data), decode=True)
        picture = images.decode_picture(data, "picture")
        assert picture.ndim == 3
        assert picture.shape[2] == 3
        assert picture.dtype == np.uint8
        assert 0 < picture[..., 0].size <= images.MAX_PIXELS
        assert images.decode_picture(data, "picture", side=4)[..., 0].size <= picture[..., 0].size

    png = [seed for seed in seeds if seed.startswith(b"\x89PNG")]
    return [FuzzCase(seeds, read), FuzzCase(png, lambda data: read(_with_png_checksums(data)))]


def stores(folder: Path) -> list[FuzzCase]:
    """Manifest, array, and progress of a store of descriptors."""
    from lpn import descriptors
    from lpn.descriptors.partial_store import PartialStore
    from lpn.descriptors.transforms import UNCHANGED
    from lpn.descriptors.writer import write_store
    from lpn.models.base import normalise

    rows = tuple(descriptors.Row(f"{i % 3}/{i:02d}.png", 100 + i, 10**18 + i, (0.0, 1.0, 9.5, 9.0)) for i in range(12))
    plain = descriptors.Manifest("0" * 16, "drone", UNCHANGED.rotate, 2, 8, rows)
    raw = normalise(np.random.default_rng(0).standard_normal((12, 2, 8)).astype(np.float32))
    write_store(folder, plain, lambda unfinished: unfinished.put(range(12), raw))
    whole = {name: (folder / name).read_bytes() for name in ("manifest.json", "descriptors.npy")}

    def opened(name: str) -> Read:
        def read(data: bytes) -> None:
            (folder / name).write_bytes(data)
            try:
                store = descriptors.open_store(folder)
                assert store.float32.shape == (
                    len(store.manifest.rows),
                    store.manifest.n_parts,
                    store.manifest.embedding,
                )
                _ = store.damaged(), store.manifest.damaged, store.manifest.change.describe()
            finally:
                (folder / name).write_bytes(whole[name])

        return read

    part = folder / "part"
    part.mkdir()
    left = {"descriptors.part": whole["descriptors.npy"], "planned.json": plain.to_json()}
    left["progress.json"] = b'{"done": [[0, 5], [7, 12]]}'

    def gone_on(name: str) -> Read:
        def read(data: bytes) -> None:
            for other, content in left.items():
                (part / other).write_bytes(data if other == name else content)
            assert len(PartialStore(part, plain, None).good) == 12

        return read

    cases = [FuzzCase([whole["manifest.json"], plain.to_json()], opened("manifest.json"))]
    cases.append(FuzzCase([whole["descriptors.npy"]], opened("descriptors.npy")))
    return cases + [FuzzCase([content], gone_on(name)) for name, content in left.items()]


def tables(folder: Path) -> list[FuzzCase]:
    """geo.csv, pairs.csv, metadata.csv, and the lists of the published data sets."""
    from lpn.datasets import open_dataset
    from lpn.datasets.geo import find_positions, match, read_positions
    from lpn.datasets.metadata import columns
    from tools.fixtures import layouts, small_worlds

    world = small_worlds.map_dataset(small_worlds.make_dataset(folder / "world", train=1, test=3))
    queries = [f"test/query_drone/{i:04d}/image-01.png" for i in (2, 3, 4)]
    metadata = "path,weather,wind\n" + "".join(f"{q},sun,{i}.5\n" for i, q in enumerate(queries))
    pairs = folder / "pairs"
    for name in ("a", "b", "c"):
        small_worlds.write(pairs / "tiles" / f"{name}.png", small_worlds.place(1))
    listed = b"satellite,drone,split,place\ntiles/a.png,tiles/b.png,train,\ntiles/b.png,tiles/c.png,test,7\n,tiles/a.png,,8\n"
    ground = small_worlds.make_cvusa(folder / "cvusa", 3, 8, 32)
    oxford = layouts.oxford(folder / "oxford")
    lists = sorted(oxford.rglob("all_souls_1_*.txt"))

    of_queries = "path,latitude,longitude\n" + "".join(f"C:\\x\\{q},30.{i},120.5\n" for i, q in enumerate(queries))
    foreign = "satellite,drone\n/home/x/tiles/a.png,D:\\tiles\\B.PNG  \n"

    def placed(data: bytes) -> None:
        found = read_positions(data)
        _ = match(found, queries), find_positions(found, queries)

    def own(data: bytes) -> None:
        (world / "metadata.csv").write_bytes(data)
        columns(world, queries)

    def dataset(root: Path, file: Path) -> Read:
        whole = file.read_bytes()

        def read(data: bytes) -> None:
            file.write_bytes(data)
            try:
                found = open_dataset(root)
                _ = found.lists(), [found.truth(task) for task in found.tasks()], found.positions()
            finally:
                file.write_bytes(whole)

        return read

    (pairs / "pairs.csv").write_bytes(listed)
    split = ground / "splits" / "val-19zl.csv"
    cases = [
        FuzzCase([(world / "geo.csv").read_bytes()], read_positions),
        # Tables of other systems, and positions by the names of known pictures.
        FuzzCase([of_queries.encode("utf-16"), of_queries.replace(",", ";").encode()], placed),
        FuzzCase([metadata.encode(), metadata.replace("/", "\\").encode("utf-16-le")], own),
        FuzzCase(
            [listed, listed.replace(b",", b";"), foreign.encode("utf-16"), foreign.encode()],
            dataset(pairs, pairs / "pairs.csv"),
        ),
        FuzzCase([split.read_bytes()], dataset(ground, split)),
    ]
    cases += [FuzzCase([file.read_bytes()], dataset(oxford, file)) for file in lists]
    for root, names in (
        (layouts.sues_raw(folder / "sues"), ("indexs.yaml",)),
        (layouts.denseuav(folder / "denseuav"), ("Dense_GPS_ALL.txt",)),
        (layouts.gta(folder / "gta"), ("cross-area-drone2sate-test.json",)),
        (layouts.gta(folder / "visloc", degrees=True), ("cross-area-drone2sate-test.json",)),
        (
            layouts.vigor(folder / "vigor"),
            ("splits/Seattle/satellite_list.txt", "splits/Seattle/same_area_balanced_test.txt"),
        ),
    ):
        cases += [FuzzCase([(root / name).read_bytes()], dataset(root, root / name)) for name in names]
    return cases


def arrays(folder: Path) -> list[FuzzCase]:
    """Plain arrays in each form, and the list of their pictures."""
    from lpn.retrieval.plain_arrays import load_arrays
    from lpn.tasks.array_task import array_task

    rng = np.random.default_rng(0)
    query, gallery = (rng.standard_normal((count, 2, 3)).astype(np.float32) for count in (3, 4))
    np.save(folder / "q.npy", query)
    np.save(folder / "g.npy", gallery)
    np.savez(folder / "q.npz", query=query, gallery=gallery)
    lines = ["file,side,label,latitude,longitude"]
    lines += [f"q{i}.png,query,{i},46.{i},7" for i in range(3)] + [f"g{i}.png,gallery,{i},46.{i},7" for i in range(4)]
    (folder / "paths.csv").write_text("\n".join(lines))

    def reader(name: str) -> Read:
        def read(data: bytes) -> None:
            (folder / f"damaged{Path(name).suffix}").write_bytes(data)
            damaged = folder / f"damaged{Path(name).suffix}"
            of_query, paths = (folder / "q.npy", damaged) if name == "paths.csv" else (damaged, folder / "paths.csv")
            _ = array_task(load_arrays(of_query, folder / "g.npy", paths), "q").metrics

        return read

    return [FuzzCase([(folder / name).read_bytes()], reader(name)) for name in ("q.npy", "q.npz", "paths.csv")]


def matlab(folder: Path) -> list[FuzzCase]:
    """CVACT's lists and saved results, packed and not."""
    from scipy.io import savemat

    from lpn.datasets import open_dataset
    from lpn.retrieval.published_results import load_saved
    from tools.fixtures import layouts

    def packings(values: dict[str, object]) -> list[bytes]:
        found = []
        for packed in (False, True):
            whole = io.BytesIO()
            savemat(whole, values, do_compression=packed)
            found.append(whole.getvalue())
        return found

    rng = np.random.default_rng(0)
    of_side = {
        side: rng.standard_normal((count, 8)).astype(np.float32) for side, count in (("query_f", 3), ("gallery_f", 4))
    }
    labels = {"query_label": np.array([[1, 2, 3]]), "gallery_label": np.array([[1, 2, 3, 4]])}
    paths = {"query_path": ["/a/1/1.jpg", "/a/2/2.jpg", "/a/3/3.jpg"]}
    saved = packings({**of_side, **labels, **paths})
    root = layouts.cvact(folder / "cvact", "")
    lists = root / "ACT_data.mat"

    def result(data: bytes) -> None:
        (folder / "result.mat").write_bytes(data)
        load_saved(folder / "result.mat", 2)

    def dataset(data: bytes) -> None:
        lists.write_bytes(data)
        open_dataset(root).lists()

    cases = [FuzzCase(saved, result), FuzzCase([lists.read_bytes()], dataset)]
    # The contents of a packed variable, packed again.
    body = saved[0][128:]
    return [*cases, FuzzCase([body], lambda data: result(saved[0][:128] + _packed(data)))]


def onnx(folder: Path) -> list[FuzzCase]:
    """Exported models, sealed and as before there were seals."""
    from lpn.models.onnx_engine import Engine
    from tools.fixtures.small_models import SPEC, onnx_file

    blank = np.ones((1, 3, *SPEC.input_size), np.float32)

    def read(data: bytes) -> None:
        (folder / "model.onnx").write_bytes(data)
        model = Engine(folder / "model.onnx", threads=1)
        for view in model.views:
            images = blank if model.input_size == SPEC.input_size else np.ones((1, 3, *model.input_size), np.float32)
            found = model.descriptors(images, view)
            assert found.shape == (1, model.n_parts, model.embedding)
            assert np.isfinite(found).all()
            model.heads(view)
            model.map_size(view)

    return [FuzzCase([onnx_file(sealed=True)], read), *[FuzzCase([onnx_file(sealed=False)], read)] * 3]


def safetensors(folder: Path) -> list[FuzzCase]:
    """Our checkpoints."""
    from safetensors.torch import save

    from lpn.core.checksums import SEAL, UNSEALED, with_seal
    from lpn.models.checkpoints import FORMAT, load_torch
    from tools.fixtures.small_models import SPEC, state_dict

    metadata = {"format": FORMAT, "spec": SPEC.to_json(), "recipe": "{}", "epochs": "3"}
    plain = save(state_dict(), metadata)
    whole = with_seal(save(state_dict(), metadata | {SEAL: UNSEALED}))

    def read(data: bytes) -> None:
        (folder / "model.safetensors").write_bytes(data)
        load_torch(folder / "model.safetensors")

    def header(data: bytes) -> None:
        read(len(data).to_bytes(8, "little") + data + plain[8 + size :])

    size = int.from_bytes(plain[:8], "little")
    return [FuzzCase([whole, plain], read), FuzzCase([plain[8 : 8 + size]], header)]


def pth(folder: Path) -> list[FuzzCase]:
    """Published checkpoints, the options beside them, and the state of a training."""

    from lpn.models.checkpoints import load_torch
    from lpn.models.file_contents import check_trained_file
    from lpn.training.recipes import RECIPES
    from lpn.training.resume_state import ResumeState, read_state
    from tools.fixtures.small_models import pth_file, state_dict

    file, options = folder / "net.pth", folder / "opts.yaml"
    whole = pth_file(state_dict())
    recipe = RECIPES["small"]
    ResumeState(
        [{"epoch": 1, "loss": 1.0}],
        2.0,
        {key: {} for key in ("network", "average", "optimizer", "scaler")},
    ).write(folder / "state.pt", recipe, "0" * 16)
    state = (folder / "state.pt").read_bytes()
    text = (
        b"h: 64\nw: 64\nstride: 1\npool: avg\ndroprate: 0.5\nLPN: true\nblock: 2\nviews: 2\nuse_vgg16: false\nname: x\n"
    )

    def model(data: bytes, told: bytes = b"") -> None:
        file.write_bytes(data)
        options.write_bytes(told)
        load_torch(file)

    def training(data: bytes) -> None:
        (folder / "state.pt").write_bytes(data)
        read_state(folder / "state.pt", recipe, "0" * 16)

    pickled = [
        pth_file({"epoch": 3, "state_dict": state_dict(), "best": best}) for best in (np.float64(0.5), np.ones(2))
    ]
    named = pth_file({"state_dict": state_dict(), "args": argparse.Namespace(lr=0.1), "out": Path("runs")})
    foreign = [
        b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n",
        b"<!DOCTYPE html><html><head><title>Virus scan warning</title></head></html>",
        b'{"error": "Entry not found"}',
        b"\x81\xa6params\x83\xa7encoder",
        whole[:4096],
        pickle.dumps({"args": argparse.Namespace(lr=0.1)}),
    ]
    tagged = b"!!python/object:argparse.Namespace\nh: '64'\nw: 64\nb: !!python/tuple [0.9, 0.999]\nn: \"a\\q\"\n"

    def contents(data: bytes) -> None:
        file.write_bytes(data)
        check_trained_file(file)

    return [
        FuzzCase([whole], model),
        FuzzCase([_entry(whole, "data.pkl")], lambda data: model(_with_entry(whole, "data.pkl", data))),
        FuzzCase(
            [_entry(one, "data.pkl") for one in (*pickled, named)],
            lambda data: model(_with_entry(pickled[0], "data.pkl", data)),
        ),
        FuzzCase(foreign, contents),
        FuzzCase([tagged], lambda data: model(whole, data)),
        FuzzCase([text], lambda data: model(whole, data)),
        FuzzCase([state], training),
        FuzzCase([_entry(state, "data.pkl")], lambda data: training(_with_entry(state, "data.pkl", data))),
    ]


def notes(folder: Path) -> list[FuzzCase]:
    """A person's notes."""
    from lpn.tasks.notes import read_notes, set_note

    file = folder / "notes.csv"
    for path, tags, text in (
        ("a/1.png", "night blur", "one,\ntwo"),
        ("b/2.png", "twin", 'a "b"'),
        ("c/3.png", "", "x"),
    ):
        set_note(file, path, tags, text)
    seed = file.read_bytes()

    def read(data: bytes) -> None:
        file.write_bytes(data)
        before = read_notes(file)
        after = set_note(file, "d/4.png", "new", "said")
        assert read_notes(file) == after
        assert {path: after[path] for path in before if path != "d/4.png"} == {
            path: note for path, note in before.items() if path != "d/4.png"
        }

    return [FuzzCase([seed], read)]


def rankings(folder: Path) -> list[FuzzCase]:
    """A ranking kept between runs."""
    from lpn.models.base import normalise
    from lpn.retrieval import metrics
    from lpn.tasks import ranking_cache
    from tools.fixtures.tasks import descriptor_task

    os.environ["LPN_CACHE"] = str(folder)
    rng = np.random.default_rng(0)
    asked, tiles = (normalise(rng.standard_normal((count, 2, 8)).astype(np.float32)) for count in (10, 7))
    labels = rng.integers(0, 4, 10), rng.integers(-1, 3, 7)
    task = descriptor_task(asked, tiles, *labels, identity="these")
    ranking_cache.save(task, metrics.retrieve(asked, labels[0], tiles, labels[1]))
    file = ranking_cache.cache_file(task)
    assert file is not None
    whole = file.read_bytes()

    def read(data: bytes) -> None:
        file.write_bytes(data)
        found = ranking_cache.load(task)
        assert found is None or found.metrics()["gallery"] == 7

    def inner(name: str) -> FuzzCase:
        return FuzzCase([_entry(whole, name)], lambda data: read(_with_entry(whole, name, data)))

    return [FuzzCase([whole], read), inner("first.npy"), inner("precision.npy"), inner("gallery.npy")]


def shards(folder: Path) -> list[FuzzCase]:
    """Parquet files of descriptors, and their plan."""
    from lpn.cluster.gather import open_shards
    from lpn.cluster.shards import Plan, ShardItem, contents, read_notes, shard_name, write_shard
    from lpn.cluster.storage import Storage
    from lpn.descriptors import Row
    from lpn.models.base import normalise

    storage = Storage(folder)
    plan = Plan("0" * 16, "drone", 2, 8, "float32", 1)
    items = [ShardItem(Row(f"{i}.png", 100 + i, 10**18, None), (46.0, 7.0) if i % 2 else None) for i in range(9)]
    raw = normalise(np.random.default_rng(0).standard_normal((9, 2, 8)).astype(np.float32))
    write_shard(storage, plan, 0, items, raw)
    written = contents([notes for notes in read_notes(storage, plan, [0]) if notes is not None])
    storage.write("plan.json", replace(plan, finished=True, contents=written).to_json())
    whole = {name: (folder / name).read_bytes() for name in ("plan.json", shard_name(0))}

    def read(name: str) -> Read:
        def of(data: bytes) -> None:
            (folder / name).write_bytes(data)
            try:
                found = open_shards(folder)
                for partition in range(found.plan.partitions):
                    tiles = found.tiles(partition)
                    assert tiles.positions.shape == (len(tiles.names), 2)
                    assert [item.row.file for item in found.items(partition)] == tiles.names
                    shape = found.descriptors(partition, tiles.names).shape
                    assert shape == (len(tiles.names), found.plan.n_parts, found.plan.embedding)
            finally:
                (folder / name).write_bytes(whole[name])

        return of

    return [FuzzCase([content], read(name)) for name, content in whole.items()]


def links(folder: Path) -> list[FuzzCase]:
    """The address of a page."""
    from explorer.opening import open_model
    from explorer.session_state import SessionState
    from explorer.url_state import UrlState
    from tools.fixtures import small_worlds
    from tools.fixtures.small_models import onnx_file

    os.environ["LPN_CACHE"] = str(folder / "cache")
    (folder / "model.onnx").write_bytes(onnx_file(sealed=True))
    data = small_worlds.make_dataset(folder / "places", train=1, test=3)
    workspace = open_model(data, folder / "model.onnx")
    made = UrlState(workspace)
    start = SessionState(next(iter(workspace.tasks)), workspace.contract.n_parts)
    seeds = [
        b"?task=drone-to-satellite&query=0003&with=0002&angle=-30.5&shift=3&down=-4&zoom=2&weights=1,0.5&off=1&region=0-1,3",
        b"query=~1&with=truth&why=1&lab=1&apart=1&rings=0&heat=0&shows=evidence&part=2&opacity=0.3&theme=dark&map=1&city=0",
        b"query=own&region=0-9999999&weights=1e-9,1e9&off=1,2,3&angle=nan&task=%00%ff%0a",
    ]

    def read(data: bytes) -> None:
        state, said = made.read(data.decode("utf-8", "replace"), start)
        again, complaints = made.read(made.write(state), start)
        assert not complaints
        assert again == state
        assert all("\n" not in text for text in said)

    return [FuzzCase(seeds, read)]


def indexes(folder: Path) -> list[FuzzCase]:
    """The manifest and the segments of an index in a folder."""
    from lpn import index
    from lpn.models.base import normalise

    rng = np.random.default_rng(0)
    made = index.create_index(folder / "index", index.DescriptorKind("0" * 16, 2, 8))
    raw = normalise(rng.standard_normal((6, 2, 8)).astype(np.float32))
    made.add([f"{i}.png" for i in range(6)], raw)
    files = sorted(file for file in (folder / "index").rglob("*") if file.is_file())

    def read(file: Path) -> Read:
        whole = file.read_bytes()

        def of(data: bytes) -> None:
            file.write_bytes(data)
            try:
                index.open_index(folder / "index").search(raw[0], None, 3)
            finally:
                file.write_bytes(whole)

        return of

    return [FuzzCase([file.read_bytes()], read(file)) for file in files if file.stat().st_size]


def cities(folder: Path) -> list[FuzzCase]:
    """The 3-D model that a browser gets."""
    from lpn.datasets.city_model import city_model
    from tools.fixtures import small_worlds

    def read(data: bytes) -> None:
        (folder / "city.glb").write_bytes(data)
        city_model(folder)

    def read_packed(data: bytes) -> None:
        (folder / "city.glb").unlink(missing_ok=True)
        (folder / "city.glb.gz").write_bytes(data)
        city_model(folder)

    whole = small_worlds.city()
    size = int.from_bytes(whole[12:16], "little")

    def header(data: bytes) -> None:
        text = data + b" " * (-len(data) % 4)
        rest = whole[20 + size :]
        total = 20 + len(text) + len(rest)
        read(whole[:8] + total.to_bytes(4, "little") + len(text).to_bytes(4, "little") + whole[16:20] + text + rest)

    return [
        FuzzCase([whole], read),
        FuzzCase([whole[20 : 20 + size]], header),
        FuzzCase([gzip.compress(whole)], read_packed),
    ]


def flights(folder: Path) -> list[FuzzCase]:
    """Metadata of photos, subtitles, logs, tracks, and the folder of a flight."""
    from PIL import ExifTags

    from lpn.core.images import header_error
    from lpn.flights import Frame, footprint, open_flight, write_flight
    from lpn.flights.clock_fit import fit_clocks
    from lpn.flights.logs import Log, for_video, moments, read_log, rows_by_name
    from lpn.flights.makers import XmpValues
    from lpn.flights.photos import Photo, photo_of
    from lpn.flights.subtitles import blocks_of, parse_subtitles
    from lpn.flights.telemetry import Telemetry
    from lpn.flights.track_files import parse_track
    from lpn.flights.xmp import read_xmp
    from tools.fixtures.field_photos import FIELD
    from tools.fixtures.photos import dji_xmp, exif, photo_bytes, sensefly_xmp, write_photo, xmp_packet

    base, gps = ExifTags.Base, ExifTags.GPS
    camera: dict[int, Any] = {
        base.DateTimeOriginal: "2024:05:01 14:00:00",
        base.FocalLength: 4.5,
        base.FocalLengthIn35mmFilm: 24,
    }
    camera |= {base.FocalPlaneXResolution: 16393.4, base.ExifImageWidth: 4000, base.OffsetTimeOriginal: "+02:00"}
    clock: dict[int, Any] = {gps.GPSDateStamp: "2024:05:01", gps.GPSTimeStamp: (12.0, 0.0, 4.0), gps.GPSAltitude: 12.5}
    packets = [
        dji_xmp(GpsLatitude="+46.8", GimbalYawDegree="-45.00", GimbalPitchDegree="-89.90", RelativeAltitude="+39.80"),
        sensefly_xmp(Heading=70.06, Height=66.1, RollAngle=-2.9, PitchAngle=2.5, UTCTime="2013-06-04T17:38:03"),
        xmp_packet(
            '<s:CameraOrientationNED rdf:parseType="Resource"><s:Yaw>1</s:Yaw></s:CameraOrientationNED>', {"s": "a:b"}
        ),
    ]
    field = [data for data, _, _ in FIELD.values()]
    whole = [photo_bytes(exif(46.8, -91.9, {base.Orientation: 6}, camera, clock), packet, (8, 6)) for packet in packets]
    directories = exif(46.8, -91.9, {base.Orientation: 8}, camera, clock).tobytes()

    def photo(data: bytes) -> None:
        if header_error(io.BytesIO(data)) is None:
            taken = photo_of(data, Path("a.jpg"))
            frame = taken.frame
            assert frame.latitude is None or abs(frame.latitude) <= 90
            assert frame.heading is None or 0 <= frame.heading < 360
            assert frame.roll is None or abs(frame.roll) <= 180
            assert frame.pitch is None or abs(frame.pitch) <= 360
            assert all(len(oddity) < 2000 and oddity.isprintable() for oddity in taken.oddities)
            footprint(frame, 50.0)

    def packed(data: bytes) -> None:
        """A photo with damaged EXIF of the right length, which the whole file's damage seldom makes."""
        plain = photo_bytes(size=(8, 6))
        photo(plain[:2] + b"\xff\xe1" + min(len(data) + 2, 65_535).to_bytes(2, "big") + data[:65_533] + plain[2:])

    def packet(data: bytes) -> None:
        said = ""
        try:
            XmpValues(read_xmp(data)[0])
        except ValueError as error:
            said = str(error)
        assert not said or said.isprintable()

    lines = (
        "1\n00:00:00,000 --> 00:00:01,000\n2024-05-01 14:00:00.000\n[focal_len: 24.00] [latitude: 47.1] [longitude: 8.1] "
        "[rel_alt: 1.0 abs_alt: 2.0] [gb_yaw: 1.0 gb_pitch: -80.0 gb_roll: 2.0]\n\n2\n00:00:01,000 --> 00:00:02,000\n"
        "GPS (-58.85, -34.23, 15), HOME (-58.84, -34.23, -57.98m), D 698.70m, H 85.80m, F.PRY (2.7°, -7.0°, 110.1°), "
        "G.PRY (-24.4°, 0.0°, 110.4°)\n\n3\n00:00:02,000 --> 00:00:03,000\nGPS(36.6,-6.1,0.0M) BAROMETER:0.3M\n"
    )

    autel = (
        "1\n00:00:00,000 --> 00:00:01,000\nHOME(E: 8.5, N: 47.3) 2024-05-01 14:00:00\nGPS(E: 8.501, N: 47.301, 574.2m) ReH:1\n\n"
        "2\n00:00:01,000 --> 00:00:02,000\nRTK (8,501, 47,301, 28), D 252,06m, H 76,19m\n\n3\n00:00:02,000 --> 00:00:03,000\n"
        "N 47°18'04.44\" E 8°30'04.44\" lat=47.3 lon=8.5 47.30123, 8.50123\n"
    )
    ass = "[Script Info]\nDialogue: 0,0:00:00.00,0:00:01.00,Default,,0,0,0,,GPS(W: 70.5, S: 33.4, 161)\\NISO:105\n"

    def subtitles(data: bytes) -> None:
        found = parse_subtitles(blocks_of(data), "a.SRT")
        telemetry = Telemetry(found.entries)
        for time in (0.5, 1.5):
            latitude = telemetry.at(time)["latitude"]
            assert latitude is None or abs(float(latitude)) <= 90
        telemetry.times_by_distance(1000.0)

    rows = (
        "filename,time(ms),datetime(utc),lat,lon,rel_alt(feet),gimbal_yaw,gimbal_pitch,isVideo\n"
        "a.jpg,0,2024-05-01 12:00:00,47,8,10,20,-90,1\nb.jpg,1000,2024-05-01T12:00:01+02:00,47.1,8,10,20,-90,1\n"
    )
    logs = [
        rows,
        "#Label;X/Longitude;Y/Latitude;Z/Altitude;Yaw;Pitch;Roll\na.JPG;8,501;47,301;512,5;30;2;-1\n# Total error;1\n",
        'SourceFile,GPSPosition,GPSDateTime\na.jpg,"47 deg 18\' 4.44"" N, 8 deg 30\' 4.44"" E",2024:05:01 12:00:00Z\n',
        "filename,lat,lon\na.jpg,47,301,8,501\nb.jpg,47,302,8,502\n",
        "EPSG:4326\na.jpg 8.5 47.3 512 30 0 0\n",
        "Date,Time,lat,lon,alt\n5/1/2024,1:00:00.5 PM,473010000,85010000,512000\n",
        "%  GPST  latitude(deg) longitude(deg) height(m)\n2024/05/01 12:00:18.0 47.3 8.5 512.5\n",
    ]
    photos = [
        Photo(Frame(f"{i}.jpg", Path(f"{i}.jpg"), 4, 3, latitude=47.0 + i, longitude=8.0), 1714564800.0 + i)
        for i in range(3)
    ]

    def log(data: bytes) -> None:
        (folder / "log.csv").write_bytes(data)
        fitted(read_log(folder / "log.csv"))

    def fitted(found: Log) -> None:
        rows_by_name(found)
        telemetry = Telemetry(moments(found)[0])
        assert all(entry.latitude is None or abs(entry.latitude) <= 90 for entry in telemetry.entries)
        fit_clocks(photos, telemetry, found.utc)
        Telemetry(for_video(found, 0)[0]).at(0.5)

    place = "<Placemark><name>a.jpg</name><TimeStamp><when>2024-05-01T12:00:00Z</when></TimeStamp>"
    tracks = [
        '<gpx version="1.1"><wpt lat="47.3" lon="8.5"><name>a.jpg</name></wpt><trk><trkseg><trkpt lat="47.3" lon="8.5">'
        '<ele>5</ele><time>2024-05-01T12:00:00Z</time></trkpt><trkpt lat="47.4" lon="8.5">'
        "<time>2024-05-01T12:00:09+02:00</time></trkpt>"
        "</trkseg></trk></gpx>",
        f"<kml>{place}<Point><coordinates>8.5,47.3,512</coordinates></Point></Placemark><Track><when>2024-05-01T12:00:00Z</when>"
        "<coord>8.5 47.3 512</coord></Track></kml>",
    ]

    def track(data: bytes) -> None:
        fitted(parse_track(data, "a.gpx"))

    write_photo(folder / "photos" / "a.jpg", exif(46.8, -91.9, {}, camera, clock), packets[0])
    write_flight(open_flight(folder / "photos"), folder / "flight")

    def written(name: str) -> FuzzCase:
        file = folder / "flight" / name
        seed = file.read_bytes()

        def read(data: bytes) -> None:
            file.write_bytes(data)
            try:
                _ = open_flight(folder / "flight").degrees
            finally:
                file.write_bytes(seed)

        return FuzzCase([seed], read)

    return [
        FuzzCase(whole, photo),
        FuzzCase(field, photo),
        FuzzCase([directories], packed),
        FuzzCase(packets, packet),
        FuzzCase([text.encode() for text in (lines, autel, ass)], subtitles),
        FuzzCase([text.encode() for text in logs], log),
        FuzzCase([text.encode() for text in tracks], track),
        written("flight.csv"),
        written("flight.json"),
    ]


def maps(folder: Path) -> list[FuzzCase]:
    """GeoTIFFs, side files, lists of corners, databases and folders of tiles, and map.json."""
    import rasterio
    from PIL import Image

    from lpn.maps import MapOptions, Window, open_map
    from lpn.maps.folder import build_map
    from tools.fixtures import small_tiles, small_worlds

    picture = small_worlds.place(1)[:64, :64]
    tiles = small_worlds.place(2)[:64, :64]
    corners = MapOptions(corners=(48.0, 9.0, 47.999, 9.0014))

    def shown(path: Path, options: MapOptions | None = None) -> None:
        town = open_map(path, options)
        try:
            cut, valid = town.read(Window(0, 0, 50, 20), 24)
            assert cut.shape == (24, 24, 3)
            assert cut.dtype == np.uint8
            assert valid.shape == (24, 24)
            assert abs(town.frame.latitude) <= 90
        finally:
            town.close()

    def file(name: str, seed: bytes, opened: str | None = None, options: MapOptions | None = None) -> FuzzCase:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(seed)

        def read(data: bytes) -> None:
            path.write_bytes(data)
            try:
                shown(folder / (opened or name), options)
            finally:
                path.write_bytes(seed)

        return FuzzCase([seed], read)

    def geotiff(name: str, bands: int, kind: str, **options: Any) -> bytes:
        profile = {"driver": "GTiff", "height": 64, "width": 64, "count": bands, "dtype": kind, "crs": "EPSG:32632"}
        transform = rasterio.Affine(2, 0, 500_000, 0, -2, 5_316_000)
        with rasterio.open(folder / name, "w", transform=transform, **profile, **options) as opened:
            for band in range(bands):
                opened.write(picture[:, :, band % 3].astype(kind), band + 1)
        return (folder / name).read_bytes()

    world = b"2\n0\n0\n-2\n500001\n5315999\n"
    Image.fromarray(picture).save(folder / "world.png")
    (folder / "world.prj").write_text("EPSG:32632")
    (folder / "world.pgw").write_bytes(world)
    Image.fromarray(picture).save(folder / "listed.png")
    header = "Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_lon\n"
    notes = b'<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">/vsicurl/http://127.0.0.1:9/a.tif</MDI></Metadata></PAMDataset>'
    geotiff("beside.tif", 1, "uint8")
    geotiff("beside.tif.ovr", 1, "uint8")
    (folder / "beside.tif.aux.xml").write_bytes(b"<PAMDataset></PAMDataset>")
    metadata = {"bounds": small_tiles.bounds_text(), "scheme": "tms", "minzoom": "18"}
    databases = [
        small_tiles.write_mbtiles(folder / "a.mbtiles", tiles, metadata, side=32).read_bytes(),
        small_tiles.write_mbtiles(folder / "a.mbtiles", tiles, {}, side=32, schema="view").read_bytes(),
    ]
    small_tiles.write_folder(folder / "tiles", tiles, side=32)
    first = next(path for path in sorted((folder / "tiles").rglob("*.png")))
    build_map([folder / "tiles"], folder / "map")
    cases = [
        file("alpha.tif", geotiff("alpha.tif", 4, "uint16", photometric="RGB", alpha="yes", compress="deflate")),
        file("nodata.tif", geotiff("nodata.tif", 1, "float32", nodata=7, tiled=True, blockxsize=32, blockysize=32)),
        file("jpeg.tif", geotiff("jpeg.tif", 3, "uint8", photometric="YCBCR", compress="jpeg")),
        file("plain.png", (folder / "world.png").read_bytes(), options=corners),
        file("world.pgw", world, "world.png"),
        file("world.prj", b"EPSG:32632", "world.png"),
        file("map.csv", (header + "listed.png,48.0,9.0,47.999,9.0014\n").encode(), "map.csv"),
        file("beside.tif.ovr", (folder / "beside.tif.ovr").read_bytes(), "beside.tif"),
        file("beside.tif.aux.xml", notes, "beside.tif"),
        file("named.tif", b'<VRTDataset rasterXSize="64" rasterYSize="64"></VRTDataset>'),
        file("tiles/" + first.relative_to(folder / "tiles").as_posix(), first.read_bytes(), "tiles"),
        file("tiles/metadata.json", json.dumps(metadata).encode(), "tiles"),
        file("map/map.json", (folder / "map" / "map.json").read_bytes(), "map"),
    ]
    cases += [file("a.mbtiles", seed) for seed in databases]
    cases.append(
        file("a.sqlitedb", small_tiles.write_sqlitedb(folder / "a.sqlitedb", small_worlds.place(3)).read_bytes())
    )
    small_tiles.write_folder(folder / "south", tiles, side=32)
    cases.append(file("south/tilemapresource.xml", b"<TileMap><SRS>EPSG:3857</SRS></TileMap>", "south"))
    return cases


TARGETS: dict[str, Callable[[Path], list[FuzzCase]]] = {
    made.__name__: made
    for made in (
        pictures,
        stores,
        tables,
        matlab,
        arrays,
        onnx,
        safetensors,
        pth,
        notes,
        rankings,
        shards,
        links,
        indexes,
        cities,
        flights,
        maps,
    )
}


def complaint(read: Read, data: bytes) -> BaseException | None:
    """Return the exception that a reader must not raise, or None."""
    try:
        read(data)
    except LPNError as error:
        text = str(error)
        # One sentence, or two: what a person reads, and no traceback.
        return AssertionError(f"several lines: {text!r}") if "\n" in text or not text else None
    except Exception as error:
        return error
    return None


def _saved(picture: object, kind: str, **given: object) -> bytes:
    whole = io.BytesIO()
    picture.save(whole, kind, **given)  # type: ignore[attr-defined]
    return whole.getvalue()


def _with_png_checksums(data: bytes) -> bytes:
    """A PNG whose chunks have the checksums of what is in them now."""
    found, position = bytearray(data[:8]), 8
    while position + 12 <= len(data):
        size = int.from_bytes(data[position : position + 4], "big")
        body = data[position + 4 : position + 8 + size]
        found += data[position : position + 4] + body + zlib.crc32(body).to_bytes(4, "big")
        position += 12 + size
    return bytes(found + data[position:])


def _packed(data: bytes) -> bytes:
    body = zlib.compress(data)
    return (15).to_bytes(4, "little") + len(body).to_bytes(4, "little") + body


def _entry(archive: bytes, name: str) -> bytes:
    with zipfile.ZipFile(io.BytesIO(archive)) as opened:
        return opened.read(next(entry for entry in opened.namelist() if entry.endswith(name)))


def _with_entry(archive: bytes, name: str, data: bytes) -> bytes:
    """An archive with other contents of one entry, and the checksum of those."""
    whole = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as opened, zipfile.ZipFile(whole, "w") as made:
        for entry in opened.namelist():
            made.writestr(entry, data if entry.endswith(name) else opened.read(entry))
    return whole.getvalue()


def described(error: BaseException) -> str:
    """An error in one line, with the place it came from."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = "" if trace is None else f" ({Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno})"
    return f"{type(error).__name__}: {json.dumps(str(error))[:200]}{where}"
