"""Windows of a map into an index, block by block: neither windows nor descriptors of a whole county are ever in memory.

A store of descriptors (`lpn.flight.locate.map_windows`) lists all windows in its manifest. Here a window is known by its name in
the index only. So 10^7 windows need no more memory than 10^4.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.progress import report_progress
from lpn.descriptors.parallel_inference import describe_each
from lpn.flight.maps import Map, NamedWindow, Window
from lpn.flight.maps.named_window import WindowCut
from lpn.index.base import DegreeBox, Index, WindowsRecord, within
from lpn.models.base import Model

# Returns the descriptors (B, n, D) of windows.
DescribeWindows = Callable[[Sequence[Window]], Float32Array]

# Windows that are described and added together; a killed run repeats at most so many.
BLOCK = 1024


def windows_record(basemap: Map, sizes: Sequence[float], overlap: float = 0.5, turns: int = 1) -> WindowsRecord:
    """Return what an index of a map's windows holds, which it is made with.

    Args:
        sizes, overlap: see `Map.pyramid`.
        turns: headings at which each window is described, evenly spaced from north on. With 8 a photo of unknown heading
            needs one description in place of eight, see `lpn.flight.locate.index_windows`.
    """
    ascending = tuple(sorted(float(size) for size in sizes))
    return WindowsRecord(basemap.identity(), ascending, overlap, turns, basemap.count_pyramid(ascending, overlap))


def index_windows(
    index: Index,
    basemap: Map,
    describe: DescribeWindows,
    block: int = BLOCK,
    replace: bool = False,
    box: DegreeBox | None = None,
) -> int:
    """Describe the windows of a map that an index was made for and lacks, and add them under their names, with positions.

    It reports its progress, in which windows outside a box count as done. A killed run resumes, as windows whose names are in
    the index are left out.

    Args:
        describe: see `window_describer`.
        block: windows that are described and added together.
        replace: describe all windows, also those that the index holds.
        box: describe the windows whose centres lie in it only, so that several machines share a map.

    Returns:
        The number of windows that were added.

    Raises:
        PictureError: if a file of the map is damaged where a window lies.
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
        for start in range(0, len(windows), -(-block // turns)):
            some = [
                Window(window.x, window.y, window.size, 360 / turns * k)
                for window in windows[start : start + -(-block // turns)]
                for k in range(turns)
            ]
            named = NamedWindow.all_of(some, basemap.frame)
            names = [one.name for one in named]
            missing = np.arange(len(named)) if replace else np.flatnonzero(~index.holds(names))
            if len(missing):
                chosen = [named[i] for i in missing.tolist()]
                degrees = np.array([(one.latitude, one.longitude) for one in chosen])
                # The windows of the names, which are rounded, so that they are cut alike later.
                rounded = NamedWindow.all_on(chosen, basemap.frame)
                index.add([one.name for one in chosen], describe(rounded), degrees)
            added += len(missing)
            done += len(some)
            report_progress("Describing windows", done, total)
    return added


def window_describer(model: Model, basemap: Map) -> DescribeWindows:
    """Return what describes windows of a map by a model, mirror included; it raises PictureError where a file is damaged."""
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
