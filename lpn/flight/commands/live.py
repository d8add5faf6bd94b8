"""The command locate --live: where the newest picture of a flight was taken, while it flies."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Literal

import tyro

from lpn.core.errors import InputError
from lpn.core.files import check_outputs, printable
from lpn.core.texts import counted
from lpn.sources import Advanced, ModelOptions
from lpn.sources.options import ADVANCED

if TYPE_CHECKING:
    from lpn.core.progress import CountProgress
    from lpn.flight.live.frames import Say
    from lpn.flight.live.run import FixOutput

# Seconds between two sentences about the progress of describing windows.
_SAID = 5.0

MapError = Annotated[
    float | None,
    ADVANCED,
    tyro.conf.arg(
        help="Error of the map's places in metres, 1 sigma along each axis, which is part of each registration's radius in this "
        "run. By default it is the error that lpn map --error put into the map. Without one, it is the root of the sum of two "
        "squares: 3 pixels, at least 1 m, and the error by the map's own data."
    ),
]


@dataclass(kw_only=True)
class LiveInput(ModelOptions):
    """The map, the model, and the sources of a live flight."""

    live: str
    """Pictures: a folder that receives photos, a video, or the address of a stream (rtsp://, udp://, http://)."""
    map: Path
    """Map: a folder of lpn map, or a georeferenced picture."""
    model: Path | None = None
    """Trained LPN (.onnx, .safetensors, .pth); an .onnx of lpn export --compute int8 is the quickest on a CPU."""
    telemetry: str | None = None
    """Heading and height: a MAVLink address such as udp:127.0.0.1:14550, or a log or track; by default those in the photos."""
    register: bool = True
    """Lay each photo over the map near the prediction."""
    matcher: Advanced[Literal["auto", "xfeat", "sift"]] = "auto"
    """Local features: xfeat (extra register), sift, or auto: xfeat where it is installed."""
    size: Advanced[tuple[float, ...] | None] = None
    """Sides of the map's windows in metres; by default the ground that the first frame of known height shows."""
    speed: Advanced[float] = 10.0
    """Speed of the flight in metres a second, as one standard deviation."""
    map_error: MapError = None
    fov: Advanced[float | None] = None
    """Horizontal field of view in degrees, for frames of videos and streams."""
    idle: Advanced[float | None] = None
    """Seconds without a frame after which the flight counts as ended; by default there is no limit."""

    def open_run(
        self, say: Say, outputs: Sequence[FixOutput], stack: ExitStack, on_windows: Sequence[CountProgress] = ()
    ) -> Callable[[], int]:
        """Open map, model, pictures, and telemetry; return a function that locates the frames, and returns their number.

        Args:
            outputs: receivers of each fix.
            stack: closes the opened sources if a later step fails.
            on_windows: called while the map's windows are described, in addition to the printed progress.

        Raises:
            InputError: if an option is out of range, or a source cannot be opened.
        """
        from lpn.core.progress import at_intervals
        from lpn.core.resources import one_thread_a_library
        from lpn.flight.live.frames import open_source
        from lpn.flight.live.locator import LiveLocator
        from lpn.flight.live.run import locate_live
        from lpn.flight.live.telemetry import open_telemetry
        from lpn.flight.locate.options import LocateOptions
        from lpn.flight.maps import open_map

        for name, low, high in (("fov", 0.1, 170.0), ("idle", 0.1, 1e6)):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"--{name} is {value:g}; expected a number from {low:g} to {high:g}.")
        options = LocateOptions(
            register=self.register, matcher=self.matcher, map_error=self.map_error, sizes=self.size, speed=self.speed
        )
        network = self.load()
        basemap = stack.enter_context(closing(open_map(self.map)))
        telemetry = open_telemetry(self.telemetry, say)
        stack.callback(telemetry.close)
        source = open_source(self.live, say, self.fov)
        stack.callback(source.close)
        hint = " This is done once for a map, a model, and a size; --size does it before the flight."

        def print_windows(done: int, total: int) -> None:
            nonlocal hint
            _say(f"{done:,} of {total:,} windows of the map are described.{hint}")
            hint = ""

        printed = at_intervals(_SAID, print_windows, at_once=True)

        def described(_stage: str, done: int, total: int) -> None:
            for receive in (printed, *on_windows) if done < total else on_windows:
                receive(done, total)

        locator = LiveLocator(basemap, network, options, described, say)
        if options.sizes is not None:
            locator.prepare(options.sizes)
        if not stack.enter_context(one_thread_a_library()):
            say(
                "The package threadpoolctl is not installed, so NumPy computes by several threads, and a frame may take twice as "
                "long; pip install 'lpn-explorer[live]', or set OMP_NUM_THREADS=1."
            )
        return partial(locate_live, source, telemetry, locator, outputs, say, self.idle)


@dataclass(kw_only=True)
class LocateLive(LiveInput):
    """Find where the newest picture of a flight was taken, while it flies: answers as lines of GeoJSON.

    A frame that comes while another is located waits, and a newer one replaces it.
    """

    out: Path | None = None
    """File of GeoJSON lines, ending in .jsonl, .geojsonl, or .ndjson, which are appended; by default they are printed."""

    def run(self) -> None:
        with ExitStack() as stack:
            lines: IO[str] = sys.stdout
            if self.out is not None:
                check_outputs((self.out, ".jsonl", ".geojsonl", ".ndjson"))
                lines = stack.enter_context(self.out.open("a", encoding="utf-8"))
            run = self.open_run(_say, [lambda fix: print(fix.line(), file=lines, flush=True)], stack)
            count = run()
        _say(f"Located {counted(count, 'frame')}.")


def _say(sentence: str) -> None:
    print(printable(sentence), file=sys.stderr, flush=True)
