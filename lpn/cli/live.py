"""The command locate --live: where the newest picture of a flight was taken, while it flies."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Literal

import lpn
from lpn.cli.locate import MapError
from lpn.core.errors import InputError
from lpn.core.files import check_outputs, printable
from lpn.sources import KindOption, ProviderOption

if TYPE_CHECKING:
    from lpn.core.progress import CountProgress, Progress
    from lpn.live.frames import Say
    from lpn.live.locator import LiveOptions
    from lpn.live.run import FixOutput, LiveRun
    from lpn.live.telemetry import LiveTelemetry

# Seconds between two sentences about the windows that are described.
_SAID = 5.0


@dataclass(kw_only=True)
class LiveInput:
    """The map, the model, and what arrives."""

    live: str
    """Pictures: a folder that fills, a video, the number of a camera, or the address of a stream (rtsp://, udp://, http://)."""
    map: Path
    """Map: a folder of lpn map, or a georeferenced picture."""
    model: Path
    """Trained LPN (.onnx, .safetensors, .pth); an .onnx of lpn export --compute int8 is the quickest on a CPU."""
    kind: KindOption = None
    provider: ProviderOption = "auto"
    telemetry: str | None = None
    """Heading and height: a MAVLink address such as udp:127.0.0.1:14550, or a log or track; by default the photos' own."""
    system: int | None = None
    """MAVLink id of the vehicle; by default the first that sends a position."""
    register: bool = True
    """Lay each photo over the map near the prediction."""
    matcher: Literal["auto", "xfeat", "sift"] = "auto"
    """Local features: xfeat (extra register), sift, or auto: xfeat where it is installed."""
    size: tuple[float, ...] | None = None
    """Sides of the map's windows in metres; by default the ground that the first frame of known height shows."""
    speed: float = 10.0
    """Metres a second that the flight moves, one standard deviation."""
    map_error: MapError = None
    fov: float | None = None
    """Horizontal field of view in degrees, for frames of videos, cameras, and streams."""
    idle: float | None = None
    """Seconds without a frame after which the flight counts as ended; by default it is waited for."""
    belief: Path | None = None
    """File that keeps the belief, so that a run that starts again in flight goes on; by default beside --out."""

    def options(self) -> LiveOptions:
        """Return how frames are located."""
        from lpn.live.locator import LiveOptions

        return LiveOptions(self.register, self.matcher, self.size, speed=self.speed, map_error=self.map_error)

    def open_run(
        self,
        say: Say,
        outputs: Sequence[FixOutput],
        stack: ExitStack,
        on_windows: Sequence[CountProgress] = (),
    ) -> LiveRun:
        """Open map, model, pictures, and telemetry.

        Args:
            outputs: beside those that need the telemetry.
            on_windows: are called while the map's windows are described.
            stack: closes what was opened, if something later fails.

        Raises:
            InputError: if an option is out of range, or a source cannot be opened.
        """
        from lpn.core.resources import one_thread_a_library
        from lpn.live.frames import open_source
        from lpn.live.locator import LiveLocator
        from lpn.live.run import LiveRun, LiveSettings
        from lpn.live.telemetry import open_telemetry
        from lpn.maps import open_map

        for name, low, high in (("fov", 0.1, 170.0), ("idle", 0.1, 1e6), ("system", 1, 255)):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"--{name} is {value:g}; expected a number from {low:g} to {high:g}.")
        options = self.options()
        network = lpn.load(self.model, self.provider, kind=self.kind)
        basemap = stack.enter_context(closing(open_map(self.map)))
        telemetry = open_telemetry(self.telemetry, say, self.system)
        stack.callback(telemetry.close)
        source = open_source(self.live, say, self.fov)
        stack.callback(source.close)
        locator = LiveLocator(basemap, network, options, _progress([_windows_said(), *on_windows]))
        if options.sizes is not None:
            locator.prepare(options.sizes)
        more = self.more_outputs(say, telemetry, stack)
        if not stack.enter_context(one_thread_a_library()):
            say(
                "The package threadpoolctl is not installed, so NumPy computes by several threads, and a frame may take twice as "
                "long; pip install 'lpn-explorer[live]', or set OMP_NUM_THREADS=1."
            )
        return LiveRun(source, telemetry, locator, [*outputs, *more], say, LiveSettings(self.idle, self.belief))

    def more_outputs(self, say: Say, telemetry: LiveTelemetry, stack: ExitStack) -> list[FixOutput]:
        """Return the outputs that options ask for."""
        del say, telemetry, stack
        return []


@dataclass(kw_only=True)
class LiveCommand(LiveInput):
    """Find where the newest picture of a flight was taken, while it flies: answers as GeoJSON lines, MAVLink, and a websocket.

    A frame that comes while another is located waits, and a newer one replaces it.
    """

    out: Path | None = None
    """File of GeoJSON lines, ending in .jsonl, .geojsonl, or .ndjson, which are appended; by default they are printed."""
    send: str | None = None
    """MAVLink address that accepted places are sent to, such as udpout:127.0.0.1:14551."""
    send_as: Literal["gps", "vision"] = "gps"
    """Message to send: GPS_INPUT, or VISION_POSITION_ESTIMATE, which needs the vehicle's origin by --telemetry."""
    serve: int | None = None
    """Port of a websocket that sends the lines."""
    host: str = "127.0.0.1"
    """Address for the websocket to listen on; any other than 127.0.0.1 shows the flight to other machines, without a password."""

    def run(self) -> None:
        with ExitStack() as stack:
            if self.out is None:
                lines: IO[str] = sys.stdout
            else:
                check_outputs((self.out, ".jsonl", ".geojsonl", ".ndjson"))
                lines = stack.enter_context(self.out.open("a", encoding="utf-8"))
                self.belief = self.belief or self.out.with_name(self.out.name + ".belief")
            from lpn.live.outputs import LineOutput

            run = self.open_run(_say, [LineOutput(lines)], stack)
            count = run.run()
        _say(f"{count} frames were located.")

    def resume_hint(self) -> str:
        """Return how to go on after a stop."""
        return "The same command goes on from the belief that is kept." if self.belief else "Nothing was kept."

    def more_outputs(self, say: Say, telemetry: LiveTelemetry, stack: ExitStack) -> list[FixOutput]:
        from lpn.core.resources import is_loopback
        from lpn.live.outputs import MavlinkOutput, WebsocketOutput
        from lpn.live.telemetry import MavlinkLink

        outputs: list[FixOutput] = []
        if self.send is not None:
            link = telemetry if isinstance(telemetry, MavlinkLink) else None
            if self.send_as == "vision" and link is None:
                raise InputError(
                    "VISION_POSITION_ESTIMATE is told from the vehicle's origin; give its MAVLink address with --telemetry."
                )
            sender = MavlinkOutput(
                self.send,
                self.send_as,
                say,
                lambda: None if link is None else link.origin,
                lambda: self.system if link is None else link.system,
            )
            stack.callback(sender.close)
            outputs.append(sender)
        if self.serve is not None:
            server = WebsocketOutput(self.host, self.serve)
            stack.callback(server.close)
            if not is_loopback(self.host):
                say(f"Other machines can read the flight at port {server.port}, without a password.")
            say(f"The websocket is ws://{printable(self.host)}:{server.port}.")
            outputs.append(server)
        return outputs


def _progress(receivers: Sequence[CountProgress]) -> Progress:
    """Return what hands the number of described windows on."""

    def report(_stage: str, done: int, total: int) -> None:
        for receiver in receivers:
            receiver(done, total)

    return report


def _windows_said() -> CountProgress:
    """Return what says every five seconds how many windows are described, as that may take minutes."""
    from lpn.core.progress import at_intervals

    once = " This is done once for a map, a model, and a size; --size does it before the flight."

    def say(done: int, total: int) -> None:
        nonlocal once
        _say(f"{done:,} of {total:,} windows of the map are described.{once}")
        once = ""

    now_and_then = at_intervals(_SAID, say, at_once=True)

    def report(done: int, total: int) -> None:
        if done < total:
            now_and_then(done, total)

    return report


def _say(sentence: str) -> None:
    print(printable(sentence), file=sys.stderr, flush=True)
