"""The command locate: where each picture of a flight was taken, on a map."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from lpn.cli.live import LocateLive, MapError
from lpn.core.demo import own_file
from lpn.core.errors import InputError
from lpn.core.files import check_writable, printable
from lpn.core.numbers import upper_bound
from lpn.sources import Advanced, ModelOptions

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from lpn.core.consoles import Console
    from lpn.flight.files import Flight
    from lpn.flight.locate.located import LocatedFlight
    from lpn.flight.locate.measures import ErrorSummary
    from lpn.flight.locate.options import LocateOptions
    from lpn.flight.locate.surveyed import MatchedSurvey, SurveyedErrors, SurveyedPoint
    from lpn.flight.locate.tracks import TrackPoint
    from lpn.flight.maps import Map


@dataclass(kw_only=True)
class LocateCommand(ModelOptions):
    """Find where each picture of a flight was taken on a map: retrieval, sequence, registration; resumable.

    It prints the errors against the flight's tags, corrections by hand, or surveyed positions. While a flight goes on: lpn locate
    --live SOURCE --map MAP, see lpn locate --live --help.
    """

    MODES: ClassVar[dict[str, type[LocateLive]]] = {"--live": LocateLive}

    map: Path
    """Map: a folder of lpn map, or a georeferenced picture."""
    flight: Path
    """Flight: a folder of lpn flight, or one of photos."""
    out: Path | None = None
    """Track to write: .geojson, .gpx, .kml, or .csv."""
    model: Path | None = None
    """Trained LPN (.onnx, .safetensors, .pth) for retrieval and sequence; without one, registration alone."""
    index: Advanced[str | None] = None
    """Index of the map's windows by this model, which are not described again then: a folder, or milvus://host:port/collection."""
    sequence: bool = True
    """Let neighbouring photos correct each other by a hidden Markov model."""
    register: bool = True
    """Lay each photo over the map by local features; --no-register measures the rest in a fraction of the time."""
    matcher: Advanced[Literal["auto", "xfeat", "sift"]] = "auto"
    """Local features: xfeat (extra register), sift, or auto: xfeat where it is installed, and sift for what it cannot place."""
    prior: float | None = None
    """Metres around each photo's own GPS tag that registration searches without a model; by default the whole map."""
    map_error: MapError = None
    size: Advanced[tuple[float, ...] | None] = None
    """Sides of the map's windows in metres; by default chosen from heights and fields of view."""
    speed: Advanced[float | None] = None
    """Metres a second that the flight moves, one standard deviation; by default the one at which its scores are most probable."""
    centre: Advanced[bool] = True
    """Subtract the mean descriptor of each view, and whiten, which helps a model that has not seen the place."""
    corrections: bool = True
    """Take a photo's position from corrections.csv in the flight's folder where a person corrected it."""
    tags: Advanced[Literal["told", "corrected"]] = "told"
    """GPS tags that errors are measured against: told, or corrected by the constant lag that the registration finds. The lag
    comes from the answers that are measured, so corrected errors may hide a bias that these share."""
    limit: int | None = None
    """Number of photos, the first ones of the flight; by default all."""
    best: bool = False
    """Write one point a photo, that of the stage that counts, in place of each stage's."""
    positions: Path | None = None
    """Table (CSV) of surveyed positions of photos, which the accepted answers are compared with: photo and latitude,longitude or
    easting,northing,epsg, and point, which is camera (by default) or ground, the ground at the photo's middle."""
    crs: Advanced[str | None] = None
    """Coordinate reference system of the coordinates in --positions, such as EPSG:32614, instead of a column; latitudes and
    longitudes are of WGS 84 (EPSG:4326) by default."""
    residuals: Path | None = None
    """Table (CSV) to write: answer minus surveyed position, photo by photo."""
    json: Path | None = None
    """File to write the errors to, as JSON."""

    def run(self) -> None:
        from lpn.core.consoles import wide_console
        from lpn.core.files import check_outputs, write_json
        from lpn.flight.locate.belief import best_track, full_track
        from lpn.flight.locate.surveyed import compare_surveyed, summarise_surveyed, survey_remarks, write_residuals
        from lpn.flight.locate.tracks import check_suffix, write_track

        for option, given in (("--crs", self.crs), ("--residuals", self.residuals)):
            if given is not None and self.positions is None:
                raise InputError(f"{option} belongs to --positions; give both, or leave it out.")
        self._check_files_differ()
        check_outputs((self.json, ".json"), (self.residuals, ".csv"))
        if self.out is not None:
            check_suffix(self.out)
            check_writable(self.out)
        console = wide_console()
        survey, located = self.located(console)
        track = best_track(located) if self.best else full_track(located)
        if self.out is not None:
            write_track(self.out, located.flight.name, track)
            for frame in located.frames:
                sentence = f"{printable(frame.frame.name)}  {frame.sentence}"
                console.print(sentence, highlight=False, soft_wrap=True, markup=False)
        print_summary(located, console)
        errors = None
        if survey is not None:
            rows = compare_surveyed(located, survey)
            errors = summarise_surveyed(rows)
            _print_surveyed(errors, survey_remarks(rows, len(located.frames)), console)
            if self.residuals is not None:
                write_residuals(self.residuals, rows, located.basemap.frame)
                console.print(f"The residuals are in {printable(str(self.residuals))}.", soft_wrap=True, markup=False)
        if self.json is not None:
            # A stage without an answer has no median, which JSON cannot express as a number.
            write_json(self.json, _measures(located, errors))
        if self.out is not None:
            written = f"The track is in {printable(str(self.out))}. {unverified_sentence(track, self.out)}"
            console.print(written.rstrip(), soft_wrap=True, markup=False)

    def resume_hint(self) -> str:
        """Return how to go on after a stop."""
        return "Photos that are done are kept; give the same command again."

    def located(self, console: Console) -> tuple[MatchedSurvey | None, LocatedFlight]:
        """Match the surveyed positions, if there are any, and locate the flight.

        Raises:
            InputError: if the limit is below 1, a kind, a pooling, or an index comes without a model, or sizes beside an index.
        """
        from lpn.flight.files import open_flight
        from lpn.flight.locate import corrections
        from lpn.flight.locate.index_windows import WindowIndex
        from lpn.flight.locate.pipeline import locate
        from lpn.flight.maps import open_map

        if self.limit is not None and self.limit < 1:
            raise InputError(f"The limit is {self.limit} photos; expected 1 or more.")
        for option, given in (("--kind", self.kind), ("--pooling", self.pooling)):
            if given is not None and self.model is None:
                raise InputError(f"{option} needs --model; give both, or leave it out.")
        if self.index is not None and (self.model is None or self.size is not None):
            raise InputError(
                "An index has the windows that the retrieval ranks, and their sizes; give --index with --model and without "
                "--size."
            )
        options, basemap, flight = self._options(), open_map(self.map), open_flight(self.flight)
        flight = replace(flight, frames=flight.frames[: self.limit])
        survey = self._survey(basemap, flight, console)  # what is wrong with it is told before the flight is located
        kept = corrections.read_corrections(own_file(self.flight, corrections.NAME)) if self.corrections else {}
        network = None if self.model is None else self.load()
        indexed = None if self.index is None or network is None else WindowIndex(self.index, network, basemap)
        return survey, locate(basemap, flight, network, options, kept, indexed)

    def _survey(self, basemap: Map, flight: Flight, console: Console) -> MatchedSurvey | None:
        """Return the surveyed positions; None without a table."""
        from lpn.flight.locate.surveyed import match_surveyed, read_surveyed, strangers_sentence

        if self.positions is None:
            return None
        positions = read_surveyed(self.positions, basemap.frame, self.crs)
        survey = match_surveyed([frame.name for frame in flight.frames], positions, basemap)
        if sentence := strangers_sentence(survey):
            console.print(sentence, highlight=False, soft_wrap=True, markup=False)
        return survey

    def _check_files_differ(self) -> None:
        """Raise InputError if two of the options name one file."""
        seen: dict[Path, str] = {}
        for option, file in (
            ("--positions", self.positions),
            ("--residuals", self.residuals),
            ("--json", self.json),
            ("--out", self.out),
        ):
            if file is not None and (other := seen.setdefault(file.resolve(), option)) != option:
                raise InputError(
                    f"{other} and {option} both name {printable(str(file))}; give {option} a file of its own."
                )

    def _options(self) -> LocateOptions:
        from lpn.flight.locate.options import LocateOptions

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


def _measures(
    located: LocatedFlight, surveyed: Mapping[str, Mapping[SurveyedPoint, SurveyedErrors]] | None
) -> dict[str, Any]:
    """Return the errors of a flight as JSON values."""
    without_lag = located.without_lag() if located.tags_without_lag is not None else None
    of_stages = [
        one and {stage: asdict(summary) for stage, summary in one.summaries().items()} for one in (located, without_lag)
    ]
    result: dict[str, Any] = {
        "frames": len(located.frames),
        "corrected": sum(frame.by_hand is not None for frame in located.frames),
        "stages": of_stages[0],
        "stages_without_lag": of_stages[1],
        "retrieval": located.field_measures(),
        "tags": None if located.audit is None else located.audit.sentence,
        "notes": located.notes,
    }
    if surveyed is not None:
        result["surveyed"] = {
            stage: {point: asdict(summary) for point, summary in points.items()} for stage, points in surveyed.items()
        }
    return result


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
    from lpn.core.text_tables import TextTable
    from lpn.flight.locate.pose_errors import pose_errors

    summaries = located.summaries()
    rows = []
    for stage, summary in summaries.items():
        accepted = sum(1 for frame in located.frames if stage in frame.stages and frame.stages[stage].accepted)
        shares = [_share(summary.within[m]) for m in sorted(summary.within)]
        numbers = ["-"] * 3
        if summary.answered:
            numbers = [f"{summary.median:.1f}", upper_bound(summary.p90), upper_bound(summary.p95)]
        number = "not verified" if stage == "retrieval" else f"{accepted}"
        rows.append((stage, number, *numbers, *shares, _share(summary.coverage_at_zero)))
    within = (f"<= {metres} m" for metres in (5, 10, 25, 50, 100))
    head = ("stage", "accepted", "median m", "p90 m", "p95 m", *within, "no false")
    title = f"{printable(located.flight.name)} on {printable(located.basemap.name)}: {len(located.frames)} photos"
    TextTable(head, rows, title).print(console)
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


def _print_surveyed(
    errors: Mapping[str, Mapping[SurveyedPoint, SurveyedErrors]], remarks: Sequence[str], console: Console
) -> None:
    """Print the errors of each stage and point, a column each, and sentences on them."""
    from lpn.core.numbers import SIGMA
    from lpn.core.text_tables import TextTable
    from lpn.flight.locate.measures import RIGHT_CALIBRATION

    columns = {f"{stage}, {point}": one for stage, points in errors.items() for point, one in points.items()}
    sentences = ["No surveyed photo has an accepted answer, so there is nothing to compare."]
    if columns:
        figures = {
            "mean east": "bias_east",
            "mean north": "bias_north",
            "standard deviation east": "sd_east",
            "standard deviation north": "sd_north",
            "RMSE east": "rmse_east",
            "RMSE north": "rmse_north",
            "RMSE in the plane": "rmse",
            "median": "median",
            "CE90": "ce90",
            "CE95": "ce95",
            "largest": "largest",
        }
        rows = [("photos", *(f"{one.photos}" for one in columns.values()))]
        rows += [(name, *(_metres(getattr(one, key)) for one in columns.values())) for name, key in figures.items()]
        rows.append(("photos with a radius", *(f"{one.radii}" for one in columns.values())))
        for k in RIGHT_CALIBRATION:
            shares = [f"{one.within[k]:.0f} %" if k in one.within else "-" for one in columns.values()]
            rows.append((f"within {k} {'radius' if k == 1 else 'radii'}", *shares))
        title = "Against surveyed positions: answer minus survey, in metres"
        TextTable(("", *columns), rows, title, align="l").print(console)
        right = ", ".join(f"{share:.0f} %" for share in RIGHT_CALIBRATION.values())
        sentences = [
            "Each photo counts with its accepted answer of the stage that counts, a contradicted one, too. CE90 and CE95 are "
            "the distances that hold 90 and 95 % of them, interpolated between photos, so that few tell little."
        ]
        if any(one.radii for one in columns.values()):
            sentences.append(f"Right radii ({SIGMA}, with the map's error) hold {right} within 1, 2, and 3.")
        told = {title: one.bias_sentence for title, one in columns.items()}
        sentences += [f"{title.capitalize()}: {sentence}" for title, sentence in told.items() if sentence]
    for line in (*sentences, *remarks):
        console.print(line, highlight=False, soft_wrap=True, markup=False)


def _metres(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"
