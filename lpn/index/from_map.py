"""Describe the windows of a map into an index, block by block, so that a whole county's descriptors need not fit in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.progress import report_progress
from lpn.descriptors.parallel_inference import describe_each
from lpn.descriptors.store import DescriptorKind, WindowsRecord
from lpn.flight.maps import Map, NamedWindow, Window
from lpn.flight.maps.named_window import WindowCut
from lpn.index.base import DegreeBox, Index, within
from lpn.models.base import Model

# Returns the descriptors (B, n, D) of windows.
DescribeWindows = Callable[[Sequence[Window]], Float32Array]

# Windows that are described and added together; a killed run repeats at most this many.
BLOCK = 1024


def windows_kind(
    model: Model, basemap: Map, sizes: Sequence[float], overlap: float = 0.5, turns: int = 1
) -> DescriptorKind:
    """Return the kind of an index of a map's windows.

    Args:
        sizes, overlap: see `Map.pyramid`.
        turns: headings at which each window is described, evenly spaced from north on. With 8, a photo of unknown heading
            needs one description instead of eight, see `lpn.flight.locate.retrieval`.
    """
    ascending = tuple(sorted(float(size) for size in sizes))
    count = basemap.count_pyramid(ascending, overlap)
    record = WindowsRecord(basemap.identity(), ascending, overlap, turns, count)
    return replace(DescriptorKind.of_model(model, "satellite"), windows=record)


def index_windows(
    index: Index, basemap: Map, describe: DescribeWindows, again: bool = False, box: DegreeBox | None = None
) -> int:
    """Describe the windows that an index of the map lacks, and add them by name, with positions.

    It reports its progress; windows outside a box count as done. A killed run resumes, because windows whose names are in the
    index are skipped.

    Args:
        describe: see `window_describer`.
        again: describe all windows, also those that the index holds.
        box: describe only the windows with centres in it, so that several machines share a map.

    Returns:
        The number of added windows.

    Raises:
        PictureError: if a file of the map is damaged within a window.
        StoreError: if the index cannot be written.
    """
    record = index.kind.windows
    assert record is not None
    turns, total = record.turns, record.count * record.turns
    done = added = 0
    report_progress("Describing windows", 0, total)
    for windows in basemap.pyramid_blocks(record.sizes, record.overlap):
        if box is not None:
            inside = within(basemap.frame.degrees([(window.x, window.y) for window in windows]), box)
            done += turns * (len(windows) - int(inside.sum()))
            windows = [windows[i] for i in np.flatnonzero(inside).tolist()]
        step = -(-BLOCK // turns)
        for start in range(0, len(windows), step):
            some = [
                Window(window.x, window.y, window.size, 360 / turns * k)
                for window in windows[start : start + step]
                for k in range(turns)
            ]
            named = NamedWindow.all_of(some, basemap.frame)
            names = [one.name for one in named]
            missing = np.arange(len(named)) if again else np.flatnonzero(~index.holds(names))
            if len(missing):
                chosen = [named[i] for i in missing.tolist()]
                degrees = np.array([(one.latitude, one.longitude) for one in chosen])
                # A name rounds its window. The rounded window is described, so that later cuts by name are equal.
                rounded = NamedWindow.all_on(chosen, basemap.frame)
                index.add([one.name for one in chosen], describe(rounded), degrees)
            added += len(missing)
            done += len(some)
            report_progress("Describing windows", done, total)
    return added


def window_describer(model: Model, basemap: Map) -> DescribeWindows:
    """Return a function that describes windows of a map, mirror included; PictureError if a file is damaged."""
    side = max(model.input_size)
    model.check_view("satellite")
    parallel = model.for_parallel_inference()

    def describe(windows: Sequence[Window]) -> Float32Array:
        described = np.empty((len(windows), model.n_parts, model.embedding), np.float32)
        cuts = [WindowCut(basemap, window, side) for window in windows]
        for batch in describe_each(parallel, cuts, lambda cut: model.prepare(cut(), "satellite"), "satellite"):
            for _, error in batch.broken:
                raise error
            described[batch.items] = batch.descriptors
        return described

    return describe
