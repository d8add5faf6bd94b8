"""The command locate: where each picture of a flight was taken, on a map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from lpn.core.demo import own_file
from lpn.core.errors import InputError
from lpn.core.files import check_writable, printable
from lpn.core.numbers import SIGMA, upper_bound
from lpn.core.texts import counted
from lpn.flight.commands.live import LocateLive, MapError
from lpn.sources import Advanced, ModelOptions

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from lpn.core.consoles import Console
    from lpn.flight.files import Flight
    from lpn.flight.locate.errors import Errors
    from lpn.flight.locate.located import LocatedFlight
    from lpn.flight.locate.surveyed import MatchedSurvey, SurveyedPoint
    from lpn.flight.maps import Map

# Names of errors along axes, and their keys in `Errors.figures`.
_AXES = {"mean": "bias", "standard deviation": "spread", "RMSE": "rmse"}


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
    """Track to write: .geojson, .kml, or .csv."""
    model: Path | None = None
    """Trained LPN (.onnx, .safetensors, .pth) for retrieval and sequence; without one, registration alone."""
    index: Advanced[str | None] = None
    """Index of the map's windows by this model, so that they are not described again: a folder, or
    milvus://host:port/collection."""
    sequence: bool = True
    """Let neighbouring photos correct each other by a hidden Markov model."""
    register: bool = True
    """Lay each photo over the map by local features; --no-register measures the rest in a fraction of the time."""
    matcher: Advanced[Literal["auto", "xfeat", "sift"]] = "auto"
    """Local features: xfeat (extra register), sift, or auto: xfeat where it is installed, then sift for the remaining photos."""
    prior: float | None = None
    """Metres around each photo's own GPS tag that registration searches without a model; by default the whole map."""
    map_error: MapError = None
    size: Advanced[tuple[float, ...] | None] = None
    """Sides of the map's windows in metres; by default chosen from heights and fields of view."""
    corrections: bool = True
    """Take a photo's position from corrections.csv in the flight's folder where a person corrected it."""
    limit: int | None = None
    """Number of photos, the first ones of the flight; by default all."""
    best: bool = False
    """Write one point a photo, by the stage that counts, instead of one point for each stage."""
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
        from lpn.flight.locate.surveyed import compare_surveyed, summarise_surveyed, survey_remarks, write_residuals
        from lpn.flight.locate.tracks import best_track, check_suffix, full_track, write_track

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
            _say(console, *(f"{printable(frame.frame.name)}  {frame.sentence}" for frame in located.frames))
        print_summary(located, console)
        errors = None
        if survey is not None:
            rows = compare_surveyed(located, survey)
            errors = summarise_surveyed(rows)
            print_surveyed(errors, survey_remarks(rows, len(located.frames)), console)
            if self.residuals is not None:
                write_residuals(self.residuals, rows, located.basemap.frame)
                _say(console, f"The residuals are in {self.residuals}.")
        if self.json is not None:
            # A stage without an answer has no median, which JSON cannot express as a number.
            write_json(self.json, _measures(located, errors))
        if self.out is not None:
            written = f"The track is in {self.out}."
            if guesses := sum(row["state"] == "not verified" and row.get("latitude") is not None for row in track):
                of_track = f"{guesses} of its {len(track)} points, state 'not verified'"
                written += f" Best guesses that nothing has verified: {of_track}."
            _say(console, written)

    def resume_hint(self) -> str:
        """Return a sentence about resuming after a stop."""
        return "The finished photos are stored; give the same command again."

    def located(self, console: Console) -> tuple[MatchedSurvey | None, LocatedFlight]:
        """Match the surveyed positions, if there are any, and locate the flight.

        Raises:
            InputError: if the limit is below 1, a kind, a pooling, or an index comes without a model, or sizes beside an index.
        """
        from lpn.flight.files import open_flight
        from lpn.flight.locate import corrections
        from lpn.flight.locate.options import LocateOptions
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
        options = LocateOptions(self.sequence, self.register, self.matcher, self.prior, self.map_error, self.size)
        basemap, flight = open_map(self.map), open_flight(self.flight)
        flight = replace(flight, frames=flight.frames[: self.limit])
        survey = self._survey(basemap, flight, console)  # its errors come before the long work
        kept = corrections.read_corrections(own_file(self.flight, corrections.NAME)) if self.corrections else {}
        network = None if self.model is None else self.load()
        return survey, locate(basemap, flight, network, options, kept, self.index)

    def _survey(self, basemap: Map, flight: Flight, console: Console) -> MatchedSurvey | None:
        from lpn.flight.locate.surveyed import match_surveyed, read_surveyed

        if self.positions is None:
            return None
        positions = read_surveyed(self.positions, basemap.frame, self.crs)
        survey, sentence = match_surveyed([frame.name for frame in flight.frames], positions, basemap)
        if sentence:
            _say(console, sentence)
        return survey

    def _check_files_differ(self) -> None:
        seen: dict[Path, str] = {}
        for name in ("positions", "residuals", "json", "out"):
            file, option = getattr(self, name), f"--{name}"
            if file is not None and (other := seen.setdefault(file.resolve(), option)) != option:
                raise InputError(
                    f"{other} and {option} both name {printable(str(file))}; give {option} a file of its own."
                )


def _say(console: Console, *sentences: str) -> None:
    """Print sentences, a line each."""
    for sentence in sentences:
        console.print(printable(sentence), highlight=False, soft_wrap=True, markup=False)


def _measures(located: LocatedFlight, surveyed: Mapping[str, Mapping[SurveyedPoint, Errors]] | None) -> dict[str, Any]:
    def of_stages(flight: LocatedFlight) -> dict[str, Any]:
        return {stage: one.figures for stage, one in flight.errors().items()}

    of_survey = {
        stage: {point: one.figures for point, one in points.items()} for stage, points in (surveyed or {}).items()
    }
    return {
        "frames": len(located.frames),
        "corrected": sum(frame.by_hand is not None for frame in located.frames),
        "stages": of_stages(located),
        "stages_without_lag": None if located.tags_without_lag is None else of_stages(located.without_lag()),
        "retrieval": located.field_measures(),
        "tags": None if located.audit is None else located.audit.sentence,
        "notes": located.notes,
    } | ({} if surveyed is None else {"surveyed": of_survey})


def print_summary(located: LocatedFlight, console: Console) -> None:
    """Print a table of the stages against the tags, first against tags without their lag, and the findings below it."""
    from lpn.core.text_tables import TextTable

    errors = located.errors()
    named = {stage: (stage, one) for stage, one in errors.items()}
    rows = []
    if located.tags_without_lag is not None:
        moved = located.without_lag().errors()
        named = {f"{stage}, tags without their lag": (stage, one) for stage, one in moved.items()} | {
            f"{stage}, tags unchanged": told for stage, told in named.items()
        }
    for name, (stage, one) in named.items():
        accepted = sum(1 for frame in located.frames if stage in frame.stages and frame.stages[stage].accepted)
        rows.append((name, "not verified" if stage == "retrieval" else f"{accepted}", *_cells(one)))
    head = ("stage", "accepted", "median m", "p90 m", "p95 m", "<= 5 m", "<= 25 m", "<= 100 m", "within 1, 2, 3 radii")
    title = f"{printable(located.flight.name)} on {printable(located.basemap.name)}: {counted(len(located.frames), 'photo')}"
    TextTable(head, rows, title).print(console)
    findings = [_truth_sentence(located, any(one.known for one in errors.values()))]
    if posed := sum(any(answer.pose is not None for answer in frame.stages.values()) for frame in located.frames):
        flat = located.basemap.elevation is None
        ground = "flat ground, as the map has no elevation" if flat else "the map's elevation"
        findings.append(f"{posed} of {len(located.frames)} photos have a pose of the camera, over {ground}.")
    if measured := located.field_measures():
        findings.append("Retrieval: " + ", ".join(f"{name} {value:.3g}" for name, value in measured.items()))
    findings += [*located.flight.notes, *located.notes]
    if located.audit is not None:
        findings.append(located.audit.sentence)
    _say(console, *findings)


def _cells(errors: Errors) -> list[str]:
    """Return bounds and shares of a stage's errors."""
    from lpn.flight.locate.errors import percents

    bounds = ["-"] * 3
    if errors.photos:
        bounds = [f"{errors.median:.1f}", upper_bound(errors.ce90), upper_bound(errors.ce95)]
    shares = [f"{errors.within[metres]:.0f} %" if errors.known else "-" for metres in (5, 25, 100)]
    return [*bounds, *shares, percents(errors.calibration) or "-"]


def _truth_sentence(located: LocatedFlight, known: bool) -> str:
    """Name the truth of the errors, and the photos that the table's shares refer to; `known` if some frame has a truth."""
    from lpn.flight.locate.errors import RIGHT_CALIBRATION, percents

    if not known:
        return "No photo has a GPS tag on the map, or a correction by hand, so the errors of the places are unknown."
    corrected = sum(frame.by_hand is not None for frame in located.frames)
    tags = "the GPS tags of the flight"
    truth = f"corrections by hand ({corrected}), and the GPS tags of the other photos" if corrected else tags
    return (
        f"Errors are against {truth}; p90 and p95 are bounds, and so rounded up; shares in metres are of all photos with such a "
        f"truth. Right radii ({SIGMA}), against an exact truth, contain {percents(RIGHT_CALIBRATION)}."
    )


def print_surveyed(
    errors: Mapping[str, Mapping[SurveyedPoint, Errors]], remarks: Sequence[str], console: Console
) -> None:
    """Print a table of the errors, a column for each stage and point, and remarks below it."""
    from lpn.core.text_tables import TextTable
    from lpn.flight.locate.errors import RIGHT_CALIBRATION, percents

    columns = {f"{stage}, {point}": one for stage, points in errors.items() for point, one in points.items()}
    sentences = ["No surveyed photo has an accepted answer, so there is nothing to compare."]
    if columns:
        names = {
            **{f"{name} {axis}": f"{key}_{axis}" for name, key in _AXES.items() for axis in ("east", "north")},
            **{"RMSE in the plane": "rmse", "median": "median", "CE90": "ce90", "CE95": "ce95", "largest": "largest"},
        }
        rows = [("photos", *(f"{one.photos}" for one in columns.values()))]
        rows += [
            (name, *("-" if math.isnan(value := one.figures[key]) else f"{value:.2f}" for one in columns.values()))
            for name, key in names.items()
        ]
        rows.append(("within 1, 2, 3 radii", *(percents(one.calibration) or "-" for one in columns.values())))
        title = "Against surveyed positions: answer minus survey, in metres"
        TextTable(("", *columns), rows, title, align="l").print(console)
        sentences = [
            "Each photo counts with its accepted answer of the stage that counts, a contradicted one, too. CE90 and CE95 are "
            "the distances within which 90 and 95 % of them lie, interpolated between photos, so they are vague for few. "
            f"Right radii ({SIGMA}, with the map's error) contain {percents(RIGHT_CALIBRATION)}."
        ]
        told = {title: one.bias_sentence for title, one in columns.items()}
        sentences += [f"{title.capitalize()}: {sentence}" for title, sentence in told.items() if sentence]
    _say(console, *sentences, *remarks)
