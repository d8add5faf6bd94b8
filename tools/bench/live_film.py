"""Film a live run against the simulated vehicle: `python -m tools.bench.live_film docs/live.webp`.

A simulated vehicle flies the demo's rendered flight again at its own pace. Telemetry goes by MAVLink over loopback, and photos,
whose files tell lens and time alone, come into a folder. `lpn explore live` locates them, and its page is photographed after each
answer. Nothing is drawn for the film, which runs eight times as fast as the flight.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import ExifTags, Image
from playwright.sync_api import Page, TimeoutError, sync_playwright

from explorer.stories.film import Take, write
from lpn.core.arrays import UInt8Array
from lpn.core.demo import DEMO_FLIGHT, DEMO_MODEL
from lpn.flights import Flight, Frame, open_flight
from tools.bench.page import ServerProcess
from tools.fixtures.chromium import launch
from tools.fixtures.photos import exif
from tools.fixtures.processes import free_port
from tools.fixtures.simulated_vehicle import SimulatedVehicle

# Seconds that the first answer may take, as the map's windows are described, another one, and the last.
_FIRST, _PAUSE, _LAST = 600.0, 60.0, 8.0
# Seconds of the flight in one of the film, seconds that its last picture stands, and the largest file in bytes.
_FASTER, _END, _LARGEST = 8.0, 3.0, 300_000
# The number of the answer that the page shows, once it is another one than before and its photo, if it is laid, has come.
_ANSWER = """before => {
  const root = document.getElementById("lpn-flight");
  if (!root || !lpn.flight.whole() || !lpn.flight.total() || root.dataset.seq === before) return false;
  const photo = root.querySelector(".laid img"), wanted = lpn.flight.data.address + "photo/" + lpn.flight.chosen;
  const laid = root.querySelector(".laid").style.display !== "none";
  return (!laid || (photo.getAttribute("src") === wanted && photo.complete)) && root.dataset.seq;
}"""


def main() -> None:
    """Fly, film, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--page", type=int, nargs=2, default=(1100, 700), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--width", type=int, default=800, help="of the film in pixels")
    parser.add_argument("--frames", type=int, default=40, help="of the flight that are flown")
    parser.add_argument("--every", type=int, default=2, help="of so many answers the film shows one")
    given = parser.parse_args()
    with ExitStack() as stack:
        temporary = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        flight = _without_telemetry(open_flight(DEMO_FLIGHT[1]), given.frames, temporary / "camera")
        (temporary / "card").mkdir()
        telemetry = free_port()
        vehicle = SimulatedVehicle(flight, temporary / "card", telemetry)
        stack.callback(vehicle.close)
        command = [sys.executable, "-m", "lpn", "explore", "live", "--live", str(temporary / "card")]
        command += ["--map", str(DEMO_FLIGHT[0]), "--model", str(DEMO_MODEL), "--port", str(free_port())]
        command += ["--telemetry", f"udp:127.0.0.1:{telemetry}"]
        app = stack.enter_context(ServerProcess(command, dict(os.environ)))
        browser = launch(stack.enter_context(sync_playwright()))
        page = browser.new_page(viewport={"width": given.page[0], "height": given.page[1]}, color_scheme="dark")
        page.goto(app.url)
        page.wait_for_selector("#lpn-flight", timeout=60_000)
        shots = _film(page, vehicle, flight.frames)
    size = given.width, round(given.width * given.page[1] / given.page[0]) // 2 * 2
    shots = shots[(len(shots) - 1) % given.every :: given.every]
    ends = [*(moment for moment, _ in shots[1:]), shots[-1][0] + _FASTER * _END]
    takes = [
        Take(cv2.resize(shot, size, interpolation=cv2.INTER_AREA).astype(np.uint8), (end - moment) / _FASTER)
        for (moment, shot), end in zip(shots, ends, strict=True)
    ]
    for quality in range(74, 20, -4):
        write(takes, given.out, fade=1, quality=quality)
        if (length := given.out.stat().st_size) <= _LARGEST:
            break
    print(
        f"{given.out}: {length:,} bytes, quality {quality}, {len(takes)} pictures, {_FASTER:g} times as fast as the flight"
    )


def _without_telemetry(flight: Flight, count: int, folder: Path) -> Flight:
    """Return the flight with copies of its photos that tell lens and time alone, so that the rest comes by MAVLink."""
    folder.mkdir()
    frames = []
    for frame in flight.frames[:count]:
        assert frame.time is not None
        at = datetime.fromtimestamp(frame.time, UTC)
        tags: dict[int, Any] = {
            ExifTags.Base.DateTimeOriginal: f"{at:%Y:%m:%d %H:%M:%S}",
            ExifTags.Base.SubsecTimeOriginal: f"{at.microsecond // 1000:03d}",
            ExifTags.Base.OffsetTimeOriginal: "+00:00",
            ExifTags.Base.FocalLengthIn35mmFilm: 24,
        }
        file = folder / f"{frame.file.stem}.jpg"
        Image.open(frame.file).convert("RGB").save(file, quality=92, exif=exif(camera=tags))
        frames.append(replace(frame, name=file.name, file=file))
    return replace(flight, frames=tuple(frames))


def _film(page: Page, vehicle: SimulatedVehicle, frames: Sequence[Frame]) -> list[tuple[float, UInt8Array]]:
    """Fly at the flight's own pace; return the page after each answer, and the seconds since the second photo was taken."""
    began = time.monotonic()
    _fly(vehicle, frames[0])
    newest = _answered(page, "", _FIRST)
    vehicle.boot += time.monotonic() - began
    flown = threading.Thread(target=_fly_on, args=(vehicle, frames[1:]))
    flown.start()
    shots, began = list[tuple[float, UInt8Array]](), time.monotonic()
    while newest is not None:
        shots.append((time.monotonic() - began, _shot(page)))
        newest = _answered(page, newest, _PAUSE if flown.is_alive() else _LAST)
    flown.join()
    return shots


def _fly_on(vehicle: SimulatedVehicle, frames: Sequence[Frame]) -> None:
    for frame, after in pairwise([*frames, None]):
        assert frame is not None
        _fly(vehicle, frame)
        if after is not None and frame.time is not None and after.time is not None:
            pause = after.time - frame.time
            time.sleep(pause)
            vehicle.boot += pause


def _fly(vehicle: SimulatedVehicle, frame: Frame) -> None:
    vehicle.tell(frame)
    vehicle.photograph(frame)


def _answered(page: Page, before: str, seconds: float) -> str | None:
    """Wait until the page shows an answer that comes after another one, with its photo; return its number, None without one."""
    with suppress(TimeoutError):
        return str(page.wait_for_function(_ANSWER, arg=before, timeout=1000 * seconds).json_value())
    return None


def _shot(page: Page) -> UInt8Array:
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


if __name__ == "__main__":
    main()
