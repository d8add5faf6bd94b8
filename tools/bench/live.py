"""Frames a second and latency of `lpn locate --live` over the demo's rendered flight: `python -m tools.bench.live`.

The flight is flown twice, with and without registration: once as fast as frames are located, for frames a second, and once with
a frame each 1 / RATE seconds through the queue of one, for ages and dropped frames. Windows and the map's features are described
before, as in a second flight over a map. Seconds of the CPU are those of all threads,
and hardly depend on the machine's load. `--model` takes another model, such as one of `lpn quantize`.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import lpn
from lpn.core import images
from lpn.core.arrays import Float64Array
from lpn.core.demo import DEMO_FLIGHT, DEMO_MODEL
from lpn.core.resources import one_thread_a_library
from lpn.flights import Flight, open_flight
from lpn.live.frames import ArrivedPicture, LiveSource
from lpn.live.locator import LiveLocator, LiveOptions
from lpn.live.outputs import LiveFix
from lpn.live.run import LiveRun, live_answer
from lpn.live.telemetry import LiveTelemetry
from lpn.locate.located import LocatedFrame
from lpn.locate.matchers import MatcherName
from lpn.locate.retrieval import pyramid_sizes
from lpn.maps import Map, open_map
from lpn.models.base import Model


class PacedFlight(LiveSource):
    """Puts a flight's photos into the queue at a rate, whether or not somebody takes them."""

    def __init__(self, flight: Flight, rate: float) -> None:
        super().__init__(print)
        self._flight, self._rate = flight, rate

    def _read(self) -> None:
        for frame in self._flight.frames:
            self.newest.put(ArrivedPicture(frame, time.monotonic()))
            self._stop.wait(1 / self._rate)


class FixList:
    """Keeps all fixes."""

    def __init__(self) -> None:
        self.fixes: list[LiveFix] = []

    def send(self, fix: LiveFix) -> None:
        """Take a fix."""
        self.fixes.append(fix)

    def close(self) -> None:
        """Keep what there is."""


def main() -> None:
    """Print a row for each way of locating."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, default=DEMO_MODEL)
    parser.add_argument("--matcher", choices=("auto", "xfeat", "sift"), default="auto")
    parser.add_argument("--rates", type=float, nargs=2, default=(2.0, 20.0), help="with and without registration")
    given = parser.parse_args()
    with one_thread_a_library() as limited:  # as in the command
        print("each library computes by one thread" if limited else "threads are not limited: no threadpoolctl")
        _measure(given.model, given.matcher, given.rates)


def _measure(model_file: Path, matcher: MatcherName, rates: Sequence[float]) -> None:
    basemap, flight, model = open_map(DEMO_FLIGHT[0]), open_flight(DEMO_FLIGHT[1]), lpn.load(model_file)
    print(f"load average {os.getloadavg()[0]:.1f} at the start; {os.cpu_count()} cores")
    for register, rate in zip((True, False), rates, strict=True):
        options = LiveOptions(register, matcher)
        _flown(basemap, flight, model, options)
        began = time.process_time()
        located, seconds = _flown(basemap, flight, model, options)
        cpu = time.process_time() - began
        source, kept = PacedFlight(flight, rate), FixList()
        locator = LiveLocator(basemap, model, options)
        locator.prepare(_sizes(basemap, flight))
        LiveRun(source, LiveTelemetry(), locator, [kept], print).run()
        ages = np.array([fix.age for fix in kept.fixes])
        answers = [live_answer(one) for one in located]
        errors = [one.error_of(best.answer) for one, best in zip(located, answers, strict=True) if best.usable]
        known = np.array([error for error in errors if error is not None])
        far = f"median {np.median(known):.1f} m, most {known.max():.1f} m" if len(known) else "none accepted"
        print(
            f"{'with' if register else 'without'} registration: {len(located) / seconds.sum():.1f} frames/s, "
            f"median {np.median(seconds):.3f} s, p95 {np.quantile(seconds, 0.95):.3f} s, "
            f"{cpu / len(located):.3f} s of the CPU a frame; "
            f"{len(errors)} of {len(located)} may be used, {far}; "
            f"at {rate:g} frames/s p95 of ages {np.quantile(ages, 0.95):.3f} s, {source.newest.dropped} dropped"
        )
    print(f"load average {os.getloadavg()[0]:.1f} at the end")


def _sizes(basemap: Map, flight: Flight) -> list[float]:
    return pyramid_sizes(basemap, flight.frames[:1])


def _flown(basemap: Map, flight: Flight, model: Model, options: LiveOptions) -> tuple[list[LocatedFrame], Float64Array]:
    """Return the frames of a flight, located one after another, and the seconds of each; windows are described before."""
    locator = LiveLocator(basemap, model, options)
    locator.prepare(_sizes(basemap, flight))
    located, seconds = [], []
    for frame in flight.frames:
        began = time.perf_counter()
        located.append(locator.locate(frame, images.load_picture(frame.file)))
        seconds.append(time.perf_counter() - began)
    return located, np.array(seconds)


if __name__ == "__main__":
    main()
