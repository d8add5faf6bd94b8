"""Describing pictures into a store: nothing is computed twice, and a kill costs about a second's work."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lpn.core import images
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.errors import DataError, StoreError
from lpn.core.files import exclusive_lock, printable, write_atomic
from lpn.core.views import View
from lpn.datasets import files_below
from lpn.datasets.integrity import check_whole
from lpn.descriptors.parallel_inference import describe_each
from lpn.descriptors.partial_store import PartialStore, renamed_only, usable
from lpn.descriptors.store import Box, Manifest, Precision, Row, Store, open_store, row_of
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.models.base import Model


def describe(
    model: Model,
    files: Sequence[Path],
    view: View,
    out: str | Path,
    root: Path | None = None,
    change: Change = UNCHANGED,
    boxes: Sequence[Box | None] | None = None,
    title: str = "Describing",
    precision: Precision = "float32",
) -> Store:
    """Describe picture files into a store, mirror included; what is there already is not computed again.

    Killed at any moment, the next call goes on where it stood. A complete store in `out` of the same model, view,
    change, and precision hands over the rows of files that did not change.

    Args:
        files: the pictures, in the order of the rows.
        out: the store's folder.
        root: folder that the file names in the manifest are relative to.
        change: what is done to each picture first.
        boxes: what each picture is cropped to before anything else, None for the whole of it; one for each file.
        title: shown beside the progress bar.
        precision: of the numbers on disk; they are computed in float32.

    Raises:
        PictureError: naming the files that are no whole pictures (see `lpn.datasets.integrity`), before anything is computed.
        InputError: when the model has no such view, or the change would leave nothing of a picture.
        StoreError: when `out` cannot be written, or holds descriptors of another model, view, change, or precision.
    """
    model.check_view(view)
    change.check(model.input_size)
    out = Path(out)
    rows = tuple(row_of(file, root, box) for file, box in zip(files, boxes or [None] * len(files), strict=True))
    manifest = Manifest.for_model(model, view, change, rows, precision)
    before = usable(out, manifest)
    if before is not None and before.manifest == manifest:
        return before
    check_whole(files, "pictures")
    return write_store(out, manifest, lambda unfinished: _fill(model, files, manifest, unfinished, title))


def write_store(out: Path, manifest: Manifest, fill: Callable[[PartialStore], None]) -> Store:
    """Write a store, or open the one that is there already.

    Args:
        out: its folder.
        manifest: what it shall hold.
        fill: puts all rows that are not there yet.

    Raises:
        StoreError: when `out` cannot be written, or holds descriptors of another model, view, change, or precision, or `fill`
            left rows out.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with exclusive_lock(out, wait=True):
            # Another process may have described the same pictures while this one waited.
            before = usable(out, manifest)
            if before is None or before.manifest != manifest:
                if renamed_only(out):
                    os.replace(out / "descriptors.npy", out / "descriptors.part")
                unfinished = PartialStore(out, manifest, before)
                try:
                    fill(unfinished)
                finally:
                    unfinished.save()
                if not unfinished.good.all():
                    raise StoreError(
                        f"{int((~unfinished.good).sum())} of {len(manifest.rows)} rows of the store {out} were not written; run "
                        "this again, which goes on there."
                    )
                _finish(out, manifest)
    except OSError as error:
        raise StoreError(
            f"The store {out} cannot be written ({error.strerror or error}); free space or choose another folder."
        ) from error
    return open_store(out)


def _finish(out: Path, manifest: Manifest) -> None:
    checked = manifest.checked(out / "descriptors.part")
    # The old manifest must never lie beside the new rows, even when killed between these lines.
    (out / "manifest.json").unlink(missing_ok=True)
    os.replace(out / "descriptors.part", out / "descriptors.npy")
    write_atomic(out / "manifest.json", checked.to_json())
    for name in ("progress.json", "planned.json"):
        (out / name).unlink(missing_ok=True)


def _fill(model: Model, files: Sequence[Path], manifest: Manifest, unfinished: PartialStore, title: str) -> None:
    """Compute the rows that are not there yet."""
    missing = [i for i, good in enumerate(unfinished.good) if not good]
    view = cast(View, manifest.view)

    def prepare(i: int) -> Float32Array:
        return prepared(model, images.load_picture(files[i]), manifest.rows[i], manifest.change, view)

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns) as bar:
        task = bar.add_task(title, total=len(files), completed=len(files) - len(missing))
        for some in describe_each(model, missing, prepare, view):
            if some.items:
                unfinished.put([missing[i] for i in some.items], some.descriptors)
            for _, error in some.broken:
                raise error
            bar.advance(task, len(some.items))


def prepared(model: Model, picture: UInt8Array, row: Row, change: Change, view: View) -> Float32Array:
    """A picture (H, W, 3) as the model takes it, (3, H, W): cropped, turned and zoomed, brought to size, shifted, normalised."""
    cut = images.crop(picture, row.box, printable(row.file))
    return images.normalise(change.move(model.to_input_size(change.apply(cut), view)))


def pictures_below(folder: str | Path) -> list[Path]:
    """All picture files below a folder, in order of path.

    Raises:
        DataError: when there is no such folder or no picture in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"There is no folder of pictures at {folder}; check the path.")
    files = files_below(folder)
    if not files:
        raise DataError(f"{folder} holds no pictures; expected files ending in {', '.join(images.SUFFIXES)}.")
    return files
