"""Describe windows of a map into a store, for locating a flight."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lpn.core.arrays import Float32Array
from lpn.descriptors.store import DescriptorKind, Row, Store
from lpn.descriptors.writer import PartialStore, fill_store, write_store
from lpn.flight.maps import Map, Window
from lpn.flight.maps.named_window import WindowCut
from lpn.models.base import Model


def describe_windows(
    model: Model,
    basemap: Map,
    windows: Sequence[Window],
    out: str | Path,
) -> Store:
    """Describe windows of a map, mirror included, into a store.

    A window is cut when it is described, so memory holds only the batches in progress. After a kill, the next call resumes. Rows
    of an existing store are reused while the map's files are unchanged.

    Args:
        windows: the windows, in the order of the rows.
        out: the store's folder.

    Raises:
        PictureError: if a file of the map is damaged where a window lies.
        InputError: if the model has no satellite view.
        StoreError: if `out` cannot be written, or holds other descriptors.
    """
    model.check_view("satellite")
    side = max(model.input_size)
    # A row identifies its picture by name, size, and time: here the side in pixels stands for the size, and a digest of the map
    # for the time.
    version = int(basemap.digest()[:15], 16)
    rows = [Row(f"{one.x!r},{one.y!r},{one.size!r},{one.heading!r}", side, version) for one in windows]

    def prepare(row: int) -> Float32Array:
        return model.prepare(WindowCut(basemap, windows[row], side)(), "satellite")

    def fill(partial: PartialStore) -> None:
        fill_store(model, partial, prepare, "satellite", "Describing windows")

    return write_store(Path(out), DescriptorKind.of_model(model, "satellite"), rows, fill)
