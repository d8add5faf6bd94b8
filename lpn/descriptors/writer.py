"""Describe pictures into a store. Existing rows are reused, and a kill loses about one second of work."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from lpn.core import images
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.errors import DataError, PictureError, StoreError
from lpn.core.files import exclusive_lock, first_few, printable, space_remedy, write_atomic
from lpn.core.progress import report_progress
from lpn.core.views import View
from lpn.datasets import files_below, unread_below, warn_left_out
from lpn.datasets.integrity import check_whole
from lpn.descriptors.parallel_inference import describe_each
from lpn.descriptors.partial_store import LOG, PartialStore, reusable_store
from lpn.descriptors.store import CropBox, Manifest, Precision, Row, Store, open_store, row_of
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.models.base import Model


def describe(
    model: Model,
    files: Sequence[Path],
    view: View,
    out: str | Path,
    root: Path | None = None,
    change: Change = UNCHANGED,
    boxes: Sequence[CropBox | None] | None = None,
    precision: Precision = "float32",
) -> Store:
    """Describe picture files, mirror included, into a store; existing rows are not computed again.

    It reports its progress (`lpn.core.progress`). After a kill, the next call resumes. If `out` holds a complete store of the
    same model, view, transform, and precision, the rows of unchanged files are copied from it.

    Args:
        files: the pictures, in the order of the rows.
        out: the store's folder.
        root: file names in the manifest are relative to this folder.
        change: the transform of each picture.
        boxes: the crop of each picture, applied first; None for a whole picture.
        precision: precision of the numbers on disk; the computation is in float32.

    Raises:
        PictureError: if files are broken; it names the first few. Damage of header or end is reported before any computation
            (see `lpn.datasets.integrity`), other damage after all other files are described.
        InputError: if the model lacks the view, or the transform leaves nothing of a picture.
        StoreError: if `out` cannot be written, or holds other descriptors.
    """
    model.check_view(view)
    change.check(model.input_size)
    out = Path(out)
    rows = tuple(row_of(file, root, box) for file, box in zip(files, boxes or [None] * len(files), strict=True))
    manifest = Manifest.for_model(model, view, change, rows, precision)
    before = reusable_store(out, manifest)
    if before is not None and before.manifest == manifest and not (out / LOG).exists():
        return before
    check_whole(files, "pictures")

    def prepare(row: int) -> Float32Array:
        picture = images.load_picture(files[row], upright=not change.released)
        return prepare_row(model, picture, rows[row], change, view)

    def fill(partial: PartialStore) -> None:
        broken: dict[int, PictureError] = {}
        fill_store(model, partial, prepare, view, stage, broken)
        if broken:
            raise _broken([(rows[row].file, broken[row]) for row in sorted(broken)], len(rows))

    stage = ", ".join(filter(None, (f"Describing {view} pictures", change.describe())))
    return write_store(out, manifest, fill)


def _broken(errors: Sequence[tuple[str, PictureError]], total: int) -> PictureError:
    """Return the error about all pictures that could not be described."""
    if len(errors) == 1:
        return errors[0][1]
    names = first_few([printable(name) for name, _ in errors], 5)
    return PictureError(f"{len(errors)} of {total} pictures cannot be described: {names}. The first: {errors[0][1]}")


def write_store(out: Path, manifest: Manifest, fill: Callable[[PartialStore], None], whole: bool = True) -> Store:
    """Write a store, or open the existing one.

    Args:
        out: the store's folder.
        manifest: the store's contents.
        fill: called to put every missing row.
        whole: refuse a store with missing rows; otherwise these are 0, and rows on disk are final only in a complete store.

    Raises:
        StoreError: if `out` cannot be written or holds other descriptors, or if `fill` leaves rows of a whole store out.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with exclusive_lock(out, wait=True):
            # Another process may have described the same pictures while this one waited.
            before = reusable_store(out, manifest)
            if before is None or before.manifest != manifest:
                partial = PartialStore(out, manifest, before)
                try:
                    fill(partial)
                    if not partial.good.all():
                        if not whole:
                            return Store(manifest, partial.rows())
                        raise StoreError(
                            f"{int((~partial.good).sum())} of {len(manifest.rows)} rows of the store {out} were not written; "
                            "run this again to resume."
                        )
                    _finish(out, manifest, partial)
                finally:
                    partial.close()
            (out / LOG).unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(
            f"The store {out} cannot be written ({error.strerror or error}); {space_remedy(error)}choose another folder."
        ) from error
    return open_store(out)


def _finish(out: Path, manifest: Manifest, partial: PartialStore) -> None:
    array = out / "descriptors.part"
    partial.write(array)
    final = manifest.with_checksums(array)
    # Remove the old manifest first, so that it never describes the new rows, even after a kill.
    (out / "manifest.json").unlink(missing_ok=True)
    os.replace(array, out / "descriptors.npy")
    write_atomic(out / "manifest.json", final.to_json())


def fill_store(
    model: Model,
    partial: PartialStore,
    prepare: Callable[[int], Float32Array],
    view: View,
    stage: str,
    broken: dict[int, PictureError] | None = None,
) -> None:
    """Describe the missing rows of a store.

    Args:
        prepare: returns the model's input (3, H, W) of a row.
        stage: name of the work in its progress.
        broken: takes the error of each unreadable row; without it, the first error is raised.

    Raises:
        PictureError: the first that `prepare` raises.
    """
    missing = [row for row, good in enumerate(partial.good) if not good]
    total = len(partial.good)
    done = total - len(missing)
    report_progress(stage, done, total)
    for batch in describe_each(model, missing, prepare, view):
        if batch.items:
            partial.put([missing[i] for i in batch.items], batch.descriptors)
        for i, error in batch.broken:
            if broken is None:
                raise error
            broken[missing[i]] = error
        done += len(batch.items) + len(batch.broken)
        report_progress(stage, done, total)


def prepare_row(model: Model, picture: UInt8Array, row: Row, change: Change, view: View) -> Float32Array:
    """Convert a picture (H, W, 3) to the model's input (3, H, W): crop, rotate and zoom, resize, shift, normalise."""
    cropped = images.crop(picture, row.box, printable(row.file))
    return model.normalise(change.move(model.to_input_size(change.apply(cropped), view)))


def pictures_below(folder: str | Path) -> list[Path]:
    """Return all picture files below a folder, in order of path.

    Raises:
        DataError: if the folder does not exist or holds no picture.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"There is no folder of pictures at {folder}; check the path.")
    files = files_below(folder)
    warn_left_out(folder.name, unread_below(folder), "pictures are not read", "they are left out")
    if not files:
        raise DataError(f"{folder} holds no pictures; expected files ending in {', '.join(images.SUFFIXES)}.")
    return files
