"""Describe windows of a map into a store, whose rows are named by where the windows are (`lpn.maps.named_window`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lpn.core.arrays import Float32Array
from lpn.core.views import View
from lpn.descriptors.partial_store import reusable_store
from lpn.descriptors.store import Manifest, Precision, Row, Store
from lpn.descriptors.transforms import UNCHANGED
from lpn.descriptors.writer import fill_store, write_store
from lpn.maps import Map
from lpn.maps.named_window import NamedWindow, WindowCut
from lpn.models.base import Model


def describe_windows(
    model: Model,
    basemap: Map,
    windows: Sequence[NamedWindow],
    out: str | Path,
    view: View = "satellite",
    precision: Precision = "float32",
) -> Store:
    """Describe windows of a map, mirror included, into a store; existing rows are not computed again.

    A window is cut when it is described, so memory holds the pictures of the batches in progress only. After a kill, the next
    call resumes. Rows of an existing store are copied while the map's files are unchanged.

    Args:
        windows: the windows, in the order of the rows.
        out: the store's folder.
        view: the branch that describes them.
        precision: precision of the numbers on disk; the computation is in float32.

    Raises:
        PictureError: if a file of the map is damaged where a window lies.
        InputError: if the model lacks the view.
        StoreError: if `out` cannot be written, or holds other descriptors.
    """
    model.check_view(view)
    side = max(model.input_size)
    # A row tells its picture by name, size, and time: here the side in pixels, and a digest of the map in place of the time.
    version = int(basemap.digest()[:15], 16)
    rows = tuple(Row(window.name, side, version) for window in windows)
    manifest = Manifest.for_model(model, view, UNCHANGED, rows, precision)
    before = reusable_store(Path(out), manifest)
    if before is not None and before.manifest == manifest:
        return before

    def prepare(row: int) -> Float32Array:
        return model.prepare(WindowCut(basemap, windows[row].on(basemap.frame), side)(), view)

    return write_store(
        Path(out), manifest, lambda partial: fill_store(model, partial, prepare, view, "Describing windows")
    )
