"""The command locate: where each picture of a flight was taken, on a map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

import lpn
from lpn.core.demo import own_file
from lpn.core.errors import InputError
from lpn.core.files import check_writable, printable
from lpn.core.numbers import upper_bound
from lpn.core.resources import ProviderName
from lpn.models.adapters import Kind
from lpn.sources import KindOption, PoolingOption, ProviderOption

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from lpn.core.consoles import Console
    from lpn.flights import Flight
    from lpn.locate.located import LocatedFlight
    from lpn.locate.measures import ErrorSummary
    from lpn.locate.options import LocateOptions
    from lpn.locate.tracks import TrackPoint
    from lpn.maps import Map

MapError = Annotated[
    float | None,
    tyro.conf.arg(
        help="Error of the map's places in metres, 1 sigma along each axis, which is part of each registration's radius in this "
        "run. By default it is what lpn map --error keeps in the map. A map without that has the root of the sum of two squares: "
        "3 pixels, at least 1 m, and the error that the map tells of itself."
    ),
]


@dataclass
class LocateCommand:
    """Find where each picture of a flight was taken on a map: retrieval, sequence, registration; resumable.

    While a flight goes on: lpn locate --live SOURCE --map MAP, see lpn locate --live --help.
    """

    map: Path
    """Map: a folder of lpn map, or a georeferenced picture."""
    flight: Path
    """Flight: a folder of lpn flight, or one of photos."""
    out: Path
    """Track to write: .geojson, .gpx, .kml, or .csv."""
    model: Path | None = None
    """Trained LPN (.onnx, .safetensors, .pth) for retrieval and sequence; without one, registration alone."""
    kind: KindOption = None
    pooling: PoolingOption = None
    index: str | None = None
    """Index of the map's windows by this model, which are not described again then: a folder, or milvus://host:port/collection."""
    provider: ProviderOption = "auto"
    sequence: bool = True
    """Let neighbouring photos correct each other by a hidden Markov model."""
    register: bool = True
    """Lay each photo over the map by local features."""
    matcher: Literal["auto", "xfeat", "sift"] = "auto"
    """Local features: xfeat (extra register), sift, or auto: xfeat where it is installed, and sift for what it cannot place."""
    prior: float | None = None
    """Metres around each photo's own GPS tag that registration searches without a model; by default the whole map."""
    map_error: MapError = None
    size: tuple[float, ...] | None = None
    """Sides of the map's windows in metres; by default chosen from heights and fields of view."""
    speed: float | None = None
    """Metres a second that the flight moves, one standard deviation; by default the one at which its scores are most probable."""
    centre: bool = True
    """Subtract the mean descriptor of each view, and whiten, which helps a model that has not seen the place."""
    corrections: bool = True
    """Take a photo's position from corrections.csv in the flight's folder where a person corrected it."""
    tags: Literal["told", "corrected"] = "told"
    """GPS tags that errors are measured against: told, or corrected by the constant lag that the registration finds. The lag
    comes from the answers that are measured, so corrected errors may hide a bias that these share."""
    limit: int | None = None
    """Number of photos, the first ones of the flight; by default all."""
    best: bool = False
    """Write one point a photo, that of the stage that counts, in place of each stage's."""

    def run(self) -> None:
        from lpn.core.consoles import wide_console
        from lpn.locate.belief import best_track, full_track
        from lpn.locate.tracks import check_suffix, write_track

        check_suffix(self.out)
        check_writable(self.out)
        console = wide_console()
        options = self._options()
        located = locate_files(
            self.map,
            self.flight,
            self.model,
            self.kind,
            self.provider,
            options,
            self.limit,
            self.corrections,
            self.index,
            self.pooling,
        )
        track = best_track(located) if self.best else full_track(located)
        write_track(self.out, located.flight.name, track)
        for frame in located.frames:
            console.print(
                f"{printable(frame.frame.name)}  {frame.sentence}", highlight=False, soft_wrap=True, markup=False
            )
        print_summary(located, console)
        written = f"The track is in {printable(str(self.out))}. {unverified_sentence(track, self.out)}"
        console.print(written.rstrip(), soft_wrap=True, markup=False)

    def resume_hint(self) -> str:
        """Return how to go on after a stop."""
        return "Photos that are done are kept; give the same command again."

    def _options(self) -> LocateOptions:
        from lpn.locate.options import LocateOptions

        return LocateOptions(
            self.sequence,
            self.register,
            self.matcher,
            self.prior,
            self.map_error,
            self.size,
            centre=self.centre,
            speed=self.speed,
            tags=self.tags,
        )


def locate_files(
    map_path: Path,
    flight_path: Path,
    model: Path | None,
    kind: Kind | None,
    provider: ProviderName,
    options: LocateOptions,
    limit: int | None,
    corrected: bool,
    index: str | None = None,
    pooling: str | None = None,
    on_opened: Callable[[Map, Flight], None] | None = None,
) -> LocatedFlight:
    """Open map, flight, model, and, if `corrected`, a person's corrections; locate the flight.

    Args:
        index: of the map's windows, see `WindowIndex`.
        kind, pooling: of the model, see `lpn.load`.
        on_opened: called with map and flight before anything is computed; an exception that it raises stops the run.

    Raises:
        InputError: if the limit is below 1, a kind, a pooling, or an index is given without a model, or sizes are given beside
            an index.
    """
    from lpn.flights import open_flight
    from lpn.locate import corrections
    from lpn.locate.index_windows import WindowIndex
    from lpn.locate.pipeline import locate
    from lpn.maps import open_map

    if limit is not None and limit < 1:
        raise InputError(f"The limit is {limit} photos; expected 1 or more.")
    for option, given in (("--kind", kind), ("--pooling", pooling)):
        if given is not None and model is None:
            raise InputError(f"{option} needs --model; give both, or leave it out.")
    if index is not None and (model is None or options.sizes is not None):
        raise InputError(
            "An index has the windows that the retrieval ranks, and their sizes; give --index with --model and without --size."
        )
    basemap, flight = open_map(map_path), open_flight(flight_path)
    flight = replace(flight, frames=flight.frames[:limit])
    if on_opened is not None:
        on_opened(basemap, flight)
    kept = corrections.read_corrections(own_file(flight_path, corrections.NAME)) if corrected else {}
    network = None if model is None else lpn.load(model, provider, kind=kind, pooling=pooling)
    indexed = None if index is None or network is None else WindowIndex(index, network, basemap)
    return locate(basemap, flight, network, options, kept, indexed)


def _share(percent: float) -> str:
    return "-" if math.isnan(percent) else f"{percent:.0f} %"


def _in_words(summary: ErrorSummary) -> str:
    """Return median, 90th and 95th percentile, and shares within radii in words."""
    return (
        f"a median of {summary.median:.1f} m, 90 % within {upper_bound(summary.p90)} m, 95 % within "
        f"{upper_bound(summary.p95)} m, and {summary.calibration_shares} of its errors within 1, 2, and 3 radii, of "
        f"{summary.frames} photos whose tags can be moved"
    )


def _truth_sentence(located: LocatedFlight, known: bool) -> str:
    """Say what errors are against, and what the shares of the table are of.

    Args:
        known: whether some frame has a truth.
    """
    if not known:
        return "No photo has a GPS tag on the map, or a correction by hand, so how far off the places are is not known."
    corrected = sum(frame.by_hand is not None for frame in located.frames)
    truth = (
        f"corrections by hand ({corrected}), and the GPS tags of the other photos"
        if corrected
        else "the GPS tags of the flight"
    )
    if located.audit is not None and located.audit.has_lag:
        lag = "a lag in them" + (f" (or {located.audit.looks_ahead})" if located.audit.looks_ahead else "")
        truth += (
            ", moved by their lag"
            if located.tags_corrected
            else f", which are no exact truth, as the registration finds {lag}"
        )
    return (
        f"Errors are against {truth}; p90 and p95 are bounds, and so rounded up; shares are of all photos with such a truth; "
        "'no false' is the share that can be accepted before one is more than 50 m off, smallest radius first, for the retrieval "
        "greatest score first. The retrieval ranks windows and verifies none."
    )


def unverified_sentence(track: Sequence[TrackPoint], file: Path) -> str:
    """Say how many points of a file have a coordinate that nothing has verified; "" if none. GPX leaves out what is refused."""
    if file.suffix.lower() == ".gpx":
        track = [point for point in track if point.state != "refused" and point.latitude is not None]
    guesses = sum(point.state == "not verified" and point.latitude is not None for point in track)
    if not guesses:
        return ""
    of = f"{guesses} of its {len(track)} point{'s' if len(track) > 1 else ''}"
    if guesses == 1:
        return (
            f"{of} is a best guess: it has a coordinate, but nothing has verified it, and its state is 'not verified'."
        )
    return f"{of} are best guesses: they have a coordinate, but nothing has verified it, and their state is 'not verified'."


def print_summary(located: LocatedFlight, console: Console) -> None:
    """Print a table of the stages against the tags, and the findings below it."""
    from rich.table import Table

    from lpn.locate.pose_errors import pose_errors

    summaries = located.summaries()
    table = Table(
        title=f"{printable(located.flight.name)} on {printable(located.basemap.name)}: {len(located.frames)} photos"
    )
    columns = (
        "stage",
        "accepted",
        "median m",
        "p90 m",
        "p95 m",
        "<= 5 m",
        "<= 10 m",
        "<= 25 m",
        "<= 50 m",
        "<= 100 m",
        "no false",
    )
    for name in columns:
        table.add_column(name, justify="left" if name == "stage" else "right")
    for stage, summary in summaries.items():
        accepted = sum(1 for frame in located.frames if stage in frame.stages and frame.stages[stage].accepted)
        shares = [_share(summary.within[m]) for m in sorted(summary.within)]
        numbers = ["-"] * 3
        if summary.answered:
            numbers = [f"{summary.median:.1f}", upper_bound(summary.p90), upper_bound(summary.p95)]
        table.add_row(
            stage,
            "not verified" if stage == "retrieval" else f"{accepted}",
            *numbers,
            *shares,
            _share(summary.coverage_at_zero),
        )
    console.print(table)
    console.print(_truth_sentence(located, any(summary.frames for summary in summaries.values())), soft_wrap=True)
    for stage, summary in summaries.items():
        if (sentence := summary.calibration_sentence(stage)) is not None:
            console.print(sentence, soft_wrap=True)
    if located.tags_without_lag is not None and not located.tags_corrected:
        summary = located.without_lag().summaries()["registration"]
        console.print(
            f"Against the GPS tags moved by that lag (a constant offset stays), the registration has {_in_words(summary)}.",
            soft_wrap=True,
        )
    posed = sum(frame.stages[stage].pose is not None for frame in located.frames for stage in frame.stages)
    if posed:
        ground = (
            "flat ground, as the map has no elevation" if located.basemap.elevation is None else "the map's elevation"
        )
        console.print(
            f"{posed} of {len(located.frames)} photos have a pose of the camera, over {ground}.", soft_wrap=True
        )
    if (errors := pose_errors(located)) is not None:
        console.print(errors.sentence, soft_wrap=True)
    if measured := located.field_measures():
        console.print(
            "Retrieval: " + ", ".join(f"{name} {value:.3g}" for name, value in measured.items()), soft_wrap=True
        )
    findings = [*located.flight.notes, *located.notes]
    if located.audit is not None:
        findings.append(located.audit.sentence)
    for line in findings:
        console.print(printable(line), highlight=False, soft_wrap=True, markup=False)
