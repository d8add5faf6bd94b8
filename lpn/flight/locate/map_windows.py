"""Describe windows of a map into a store, for an index or for locating a flight."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lpn.core.arrays import Float32Array
from lpn.core.views import View
from lpn.descriptors.partial_store import PartialStore
from lpn.descriptors.store import Manifest, Precision, Row, Store
from lpn.descriptors.transforms import UNCHANGED
from lpn.descriptors.writer import fill_store, write_store
from lpn.flight.maps import Map, Window
from lpn.flight.maps.named_window import WindowCut
from lpn.models.base import Model


def describe_windows(
    model: Model,
    basemap: Map,
    windows: Sequence[Window],
    out: str | Path,
    view: View = "satellite",
    precision: Precision = "float32",
    names: Sequence[str] | None = None,
) -> Store:
    """Describe windows of a map, mirror included, into a store.

    A window is cut when it is described, so memory holds only the batches in progress. After a kill, the next call resumes. Rows
    of an existing store are reused while the map's files are unchanged.

    Args:
        windows: the windows, in the order of the rows.
        out: the store's folder.
        view: the branch that describes them.
        precision: precision of the numbers on disk; the computation is in float32.
        names: of the rows, such as those of `lpn.flight.maps.named_window`; by default the numbers of each window.

    Raises:
        PictureError: if a file of the map is damaged where a window lies.
        InputError: if the model lacks the view.
        StoreError: if `out` cannot be written, or holds other descriptors.
    """
    model.check_view(view)
    side = max(model.input_size)
    if names is None:
        names = [f"{window.x!r},{window.y!r},{window.size!r},{window.heading!r}" for window in windows]
    # A row identifies its picture by name, size, and time: here the side in pixels stands for the size, and a digest of the map
    # for the time.
    version = int(basemap.digest()[:15], 16)
    rows = tuple(Row(name, side, version) for name in names)
    manifest = Manifest.for_model(model, view, UNCHANGED, rows, precision)

    def prepare(row: int) -> Float32Array:
        return model.prepare(WindowCut(basemap, windows[row], side)(), view)

    def fill(partial: PartialStore) -> None:
        fill_store(model, partial, prepare, view, "Describing windows")

    return write_store(Path(out), manifest, fill)
