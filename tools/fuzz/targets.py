"""The readers, and the real files for damaged ones.

A reader gets the contents of one file, and may raise only LPNError. In formats with checksums, some seeds are the contents, which
are packed into a whole file after the damage; otherwise the checksums would catch all damage.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import pickle
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

Read = Callable[[], object]
Pack = Callable[[bytes], bytes]


@dataclass(frozen=True)
class FuzzCase:
    """One file: the seeds of its damaged versions, and its reader."""

    seeds: list[bytes]
    read: Callable[[bytes], object]


def in_file(file: Path, read: Read, *seeds: bytes, pack: Pack = bytes) -> FuzzCase:
    """A file among others: damaged ones, packed, stand in its place while `read()` runs. By default it is the only seed."""
    whole = file.read_bytes() if file.exists() else pack(seeds[0])

    def of(data: bytes) -> None:
        file.write_bytes(pack(data))
        try:
            read()
        finally:
            file.write_bytes(whole)

    return FuzzCase([*seeds] or [whole], of)


def in_archive(file: Path, read: Read, name: str, *archives: bytes) -> FuzzCase:
    """One entry of a ZIP file: damaged ones, made from those of all archives, stand in the first with a right checksum."""

    def pack(data: bytes) -> bytes:
        whole = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(archives[0])) as opened, zipfile.ZipFile(whole, "w") as made:
            for entry in opened.namelist():
                made.writestr(entry, data if entry.endswith(name) else opened.read(entry))
        return whole.getvalue()

    seeds = []
    for archive in archives:
        with zipfile.ZipFile(io.BytesIO(archive)) as opened:
            seeds.append(opened.read(next(entry for entry in opened.namelist() if entry.endswith(name))))
    return in_file(file, read, *seeds, pack=pack)


def pictures(_: Path) -> list[FuzzCase]:
    """Uploads and picture files, in every format that is accepted, with 8 and 16 bits, transparent, animated, and turned."""
    from PIL import Image

    from lpn.core import images
    from tools.fixtures import small_worlds

    shown = Image.fromarray(small_worlds.place(1)[:40, :48])
    exif = shown.getexif()
    exif[0x0112] = 6
    seeds: list[bytes] = []

    def add(picture: Image.Image, kind: str, **given: object) -> None:
        whole = io.BytesIO()
        picture.save(whole, kind, **given)
        seeds.append(whole.getvalue())

    for kind in ("JPEG", "PNG", "WEBP", "BMP"):
        add(shown, kind)
    for kind, mode in (("JPEG", "CMYK"), ("PNG", "RGBA"), ("PNG", "P")):
        add(shown.convert(mode), kind)
    for kind in ("PNG", "GIF", "WEBP"):
        add(shown, kind, save_all=True, append_images=[shown.rotate(90)], lossless=True, exif=exif)
    add(shown, "JPEG", exif=exif, progressive=True)
    add(shown, "TIFF", compression="tiff_lzw")
    add(Image.fromarray(np.asarray(shown.convert("L")).astype(np.uint16) * 257), "PNG")

    def read(data: bytes) -> None:
        picture = images.decode_picture(data, "picture")
        assert 0 < picture[..., 0].size <= images.MAX_PIXELS
        images.decode_picture(data, "picture", side=4)

    def read_png(data: bytes) -> None:
        """A PNG whose chunks have the checksums of what is in them now."""
        found, at = data[:8], 8
        while at + 12 <= len(data):
            end = at + 8 + int.from_bytes(data[at : at + 4], "big")
            found += data[at:end] + zlib.crc32(data[at + 4 : end]).to_bytes(4, "big")
            at = end + 4
        read(found + data[at:])

    return [FuzzCase(seeds, read), FuzzCase([seed for seed in seeds if seed.startswith(b"\x89PNG")], read_png)]


def stores(folder: Path) -> list[FuzzCase]:
    """Descriptors: a store, one that was interrupted, and an index with positions."""
    from lpn import descriptors, index
    from lpn.models.base import normalise

    rows = [descriptors.Row(f"{i % 3}/{i:02d}.png", 100 + i, 10**18 + i, (0.0, 1.0, 9.5, 9.0)) for i in range(12)]
    kind = descriptors.DescriptorKind("0" * 16, 2, 8, view="drone")
    raw = normalise(np.random.default_rng(0).standard_normal((12, 2, 8)).astype(np.float32))
    descriptors.write_store(folder / "store", kind, rows, lambda partial: partial.put(range(12), raw))
    (folder / "part").mkdir()
    unfinished = descriptors.PartialStore(folder / "part", kind, rows)
    unfinished.put(range(7), raw[:7])
    unfinished.save()
    index.create_index(folder / "index", kind).add([row.file for row in rows], raw, np.full((12, 2), 46.0))

    def interrupted() -> None:
        partial = descriptors.PartialStore(folder / "part", kind, rows)
        _ = [len(block) for block in partial.blocks()]

    def opened() -> None:
        store = descriptors.open_store(folder / "store")
        _ = store.float32, store.rows, store.positions, store.kind.change.describe(), store.check()

    def searched() -> None:
        index.open_index(folder / "index").search(raw[0], None, 3, (40, 40, 50, 50))

    return [
        in_file(file, read)
        for name, read in (("store", opened), ("part", interrupted), ("index", searched))
        for file in sorted((folder / name).rglob("*"))
        if file.is_file()
    ]


def tables(folder: Path) -> list[FuzzCase]:
    """geo.csv, pairs.csv, metadata.csv, a person's notes, and the lists of the published data sets."""
    from lpn.core.lists import decoded
    from lpn.datasets import open_dataset
    from lpn.datasets.geo import Positions, read_positions
    from lpn.datasets.metadata import columns
    from lpn.tasks.notes import read_notes, set_note
    from tools.fixtures import layouts, small_worlds

    world = small_worlds.map_dataset(small_worlds.make_dataset(folder / "world", train=1, test=3))
    queries = [f"test/query_drone/{i:04d}/image-01.png" for i in (2, 3, 4)]
    metadata = "path,weather,wind\n" + "".join(f"{q},sun,{i}.5\n" for i, q in enumerate(queries))
    metadata_seeds = metadata.encode(), metadata.replace("/", "\\").encode("utf-16-le")
    for name in ("a", "b", "c"):
        small_worlds.write(folder / "pairs" / "tiles" / f"{name}.png", small_worlds.place(1))
    listed = b"satellite,drone,split,place\ntiles/a.png,tiles/b.png,train,\ntiles/b.png,tiles/c.png,test,7\n,tiles/a.png,,8\n"
    of_queries = "path,latitude,longitude\n" + "".join(f"C:\\x\\{q},30.{i},120.5\n" for i, q in enumerate(queries))
    geo, foreign = (world / "geo.csv").read_bytes(), "satellite,drone\n/home/x/tiles/a.png,D:\\tiles\\B.PNG  \n"
    notes = folder / "notes.csv"
    set_note(notes, "a/1.png", "night blur", "one,\ntwo")
    set_note(notes, "b/2.png", "twin", 'a "b"')

    def noted() -> None:
        before, after = read_notes(notes), set_note(notes, "d/4.png", "new", "said")
        assert read_notes(notes) == after == before | {"d/4.png": after["d/4.png"]}

    def placed(data: bytes) -> None:
        found = Positions(folder, read_positions(decoded(data, "geo.csv")))
        _ = found.match(queries), found.below(queries)

    def dataset(root: Path, name: str, *seeds: bytes) -> FuzzCase:
        def read() -> None:
            found = open_dataset(root)
            _ = found.lists(), [found.truth(task) for task in found.tasks()], found.positions()

        return in_file(root / name, read, *seeds)

    oxford, vigor = layouts.oxford(folder / "oxford"), layouts.vigor(folder / "vigor")
    return [
        in_file(notes, noted),
        # Tables of other systems, too.
        FuzzCase([geo, of_queries.encode("utf-16"), of_queries.replace(",", ";").encode()], placed),
        in_file(world / "metadata.csv", lambda: columns(world, queries), *metadata_seeds),
        dataset(folder / "pairs", "pairs.csv", listed, listed.replace(b",", b";"), foreign.encode("utf-16")),
        dataset(small_worlds.make_cvusa(folder / "cvusa", 3, 8, 32), "splits/val-19zl.csv"),
        dataset(layouts.sues_raw(folder / "sues"), "indexs.yaml"),
        dataset(layouts.denseuav(folder / "denseuav"), "Dense_GPS_ALL.txt"),
        dataset(layouts.gta(folder / "gta"), "cross-area-drone2sate-test.json"),
        dataset(layouts.gta(folder / "visloc", degrees=True), "cross-area-drone2sate-test.json"),
        dataset(layouts.cvact(folder / "cvact", ""), "ACT_data.mat"),
        *(dataset(oxford, str(file.relative_to(oxford))) for file in sorted(oxford.rglob("all_souls_1_*.txt"))),
        dataset(vigor, "splits/Seattle/satellite_list.txt"),
        dataset(vigor, "splits/Seattle/same_area_balanced_test.txt"),
    ]


def results(folder: Path) -> list[FuzzCase]:
    """Results of other programs: arrays in each form with the list of their pictures, and MATLAB's files, packed and not."""
    from scipy.io import savemat

    from lpn.models.base import normalise
    from lpn.retrieval.saved import load_saved
    from lpn.tasks.saved import array_task

    rng = np.random.default_rng(0)
    query, gallery = (normalise(rng.standard_normal((count, 2, 3)).astype(np.float32)) for count in (3, 4))
    q, npz, g, paths, mat = (folder / name for name in ("q.npy", "q.npz", "g.npy", "paths.csv", "result.mat"))
    np.save(q, query)
    np.save(g, gallery)
    np.savez(npz, query=query, gallery=gallery)
    lines = [f"q{i}.png,query,{i},46.{i},7" for i in range(3)] + [f"g{i}.png,gallery,{i},46.{i},7" for i in range(4)]
    paths.write_text("\n".join(["file,side,label,latitude,longitude", *lines]))
    values: dict[str, object] = {"query_f": query.swapaxes(1, 2).reshape(3, 6)}
    values["gallery_f"] = gallery.swapaxes(1, 2).reshape(4, 6)
    values |= {"query_label": [[1, 2, 3]], "gallery_label": [[1, 2, 3, 4]], "query_path": ["/a/1/1.jpg"] * 3}
    saved = []
    for packed in (True, False):
        savemat(mat, values, do_compression=packed)
        saved.append(mat.read_bytes())

    def compared(query: Path) -> None:
        _ = array_task(query, g, paths).metrics

    def pack(data: bytes) -> bytes:
        """A MATLAB file with a variable in packed form."""
        body = zlib.compress(data)
        return saved[1][:128] + (15).to_bytes(4, "little") + len(body).to_bytes(4, "little") + body

    return [
        *(in_file(file, lambda: compared(q)) for file in (q, paths)),
        in_file(npz, lambda: compared(npz)),
        in_file(mat, lambda: load_saved(mat, 2), *saved),
        in_file(mat, lambda: load_saved(mat, 2), saved[1][128:], pack=pack),
    ]


def onnx(folder: Path) -> list[FuzzCase]:
    """Exported models, sealed and as before there were seals."""
    from lpn.models.onnx_engine import Engine
    from tools.fixtures.small_models import onnx_file

    def read() -> None:
        model = Engine(folder / "model.onnx", threads=1)
        for view in model.views:
            found = model.descriptors(np.ones((1, 3, *model.input_size), np.float32), view)
            assert np.isfinite(found).all()
            _ = model.heads(view), model.map_size(view)

    return [in_file(folder / "model.onnx", read, onnx_file(sealed=sealed)) for sealed in (True, False, False, False)]


def checkpoints(folder: Path) -> list[FuzzCase]:
    """Our checkpoints, published ones with the options beside them, and the state of a training."""
    from safetensors.torch import save

    from lpn.core.checksums import SEAL, UNSEALED, with_seal
    from lpn.models.checkpoints import FORMAT, load_torch
    from lpn.models.file_contents import check_trained_file
    from lpn.training.recipes import RECIPES
    from lpn.training.run_folder import ResumeState, read_state
    from tools.fixtures.small_models import SPEC, pth_file, state_dict

    own, net, options, state = (folder / name for name in ("own.safetensors", "net.pth", "opts.yaml", "state.pt"))
    metadata = {"format": FORMAT, "spec": SPEC.to_json(), "recipe": "{}", "epochs": "3"}
    plain = save(state_dict(), metadata)
    size = int.from_bytes(plain[:8], "little")
    whole, sealed = pth_file(state_dict()), with_seal(save(state_dict(), metadata | {SEAL: UNSEALED}))
    net.write_bytes(whole)
    options.write_bytes(b"")
    parts: dict[str, dict[str, object]] = {key: {} for key in ("network", "average", "optimizer", "scaler")}
    ResumeState([{"epoch": 1, "loss": 1.0}], 2.0, parts).write(state, RECIPES["small"], "0" * 16)
    args = argparse.Namespace(lr=0.1)
    pickled = [pth_file({"epoch": 3, "state_dict": state_dict(), "best": one}) for one in (np.float64(0.5), np.ones(2))]
    pickled.append(pth_file({"state_dict": state_dict(), "args": args, "out": Path("runs")}))
    foreign = [
        b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n",
        b"<!DOCTYPE html><html><head><title>Virus scan warning</title></head></html>",
        whole[:4096],
        pickle.dumps({"args": args}),
    ]
    text = (
        b"h: 64\nw: 64\nstride: 1\npool: avg\ndroprate: 0.5\nLPN: true\nblock: 2\nviews: 2\nuse_vgg16: false\nname: x\n"
    )
    tagged = b"!!python/object:argparse.Namespace\nh: '64'\nw: 64\nb: !!python/tuple [0.9, 0.999]\nn: \"a\\q\"\n"

    def load() -> object:
        return load_torch(net)

    def resumed() -> object:
        return read_state(state, RECIPES["small"], "0" * 16)

    def with_size(data: bytes) -> bytes:
        return len(data).to_bytes(8, "little") + data + plain[8 + size :]

    return [
        in_file(own, lambda: load_torch(own), sealed, plain),
        in_file(own, lambda: load_torch(own), plain[8 : 8 + size], pack=with_size),
        in_file(net, load),
        in_archive(net, load, "data.pkl", whole),
        in_archive(net, load, "data.pkl", *pickled),
        in_file(net, lambda: check_trained_file(net), *foreign),
        *(in_file(options, load, seed) for seed in (tagged, text)),
        in_file(state, resumed),
        in_archive(state, resumed, "data.pkl", state.read_bytes()),
    ]


def links(folder: Path) -> list[FuzzCase]:
    """The address of a page, and the messages of its channel."""
    from explorer.opening import open_model
    from explorer.screen import fields
    from explorer.screen.session import Screens, ScreenSession
    from tools.fixtures import small_worlds
    from tools.fixtures.small_models import onnx_file

    os.environ["LPN_CACHE"] = str(folder / "cache")
    (folder / "model.onnx").write_bytes(onnx_file(sealed=True))
    workspace = open_model(small_worlds.make_dataset(folder / "places", train=1, test=3), folder / "model.onnx")
    session = ScreenSession(Screens(lambda _: workspace, workspace.key, {workspace.key: "data"}), lambda _: None)
    addresses = [
        b"?task=drone-to-satellite&query=0003&with=0002&angle=-30.5&weights=1,0.5&scoring=plain&shows=evidence&panel=lab",
        b"query=~1&with=~2&model=0&only=missed&find=00&view=apart&theme=dark&show=data&lab_order=rank",
        b"query=own&weights=1e-9,1e9&angle=nan&task=%00%ff%0a&panel=nothing&show=../../etc",
    ]
    messages = [
        b'{"set":{"angle":30.5,"query":1,"weights":[1,0.5],"heat":"occlusion","theme":"light","panel":"lab"}}',
        b'{"do":"open","args":{"search":"?query=0003&angle=15"}}',
        b'{"do":"upload","args":{"name":"a.png","size":5}}',
        b'{"do":"hover","args":{"part":1}}',
        b'{"do":"pick","args":{"x":0.5,"y":0.1}}',
        b'{"do":"step","args":{"by":-1}}',
    ]

    def read_address(data: bytes) -> None:
        state, said = fields.from_values(fields.parsed(data.decode("utf-8", "replace")), workspace)
        assert fields.from_values(fields.parsed(fields.to_address(state, workspace)), workspace) == (state, [])
        assert all("\n" not in text for text in said)

    def read_message(data: bytes) -> None:
        with suppress(ValueError, RecursionError):  # as the channel drops what is no JSON
            session.receive(json.loads(data.decode("utf-8", "replace")))
        session.receive_bytes(data)

    session.receive(json.loads(messages[1]))
    return [FuzzCase(addresses, read_address), FuzzCase(messages, read_message)]


TARGETS: dict[str, Callable[[Path], list[FuzzCase]]] = {
    made.__name__: made for made in (pictures, stores, tables, results, onnx, checkpoints, links)
}
