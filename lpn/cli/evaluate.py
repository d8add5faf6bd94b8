"""The command evaluate: retrieval on a test split."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from lpn.cli.locate import MapError
from lpn.core.errors import InputError
from lpn.descriptors.weather import WeatherName
from lpn.sources import Arrays, CslsOption, Data, Flown, Indexed, KindOption, PoolingOption, ProviderOption, Published
from lpn.sources.opened import open_first_task

if TYPE_CHECKING:
    from lpn.core.consoles import Console
    from lpn.datasets import Dataset
    from lpn.flights import Flight
    from lpn.locate.surveyed import MatchedSurvey, SurveyedErrors, SurveyedPoint
    from lpn.maps import Map
    from lpn.models.base import Model
    from lpn.retrieval.calibration import Calibration
    from lpn.retrieval.evaluate import Result
    from lpn.retrieval.protocol import Protocol
    from lpn.retrieval.weathers import WeatherResult

log = logging.getLogger(__name__)

# Tiles that --per-query lists.
_LISTED = 10


@dataclass(kw_only=True)
class ChangeOptions:
    """Changes of the queries."""

    rotate: float = 0.0
    """Degrees counter-clockwise by which each query is rotated first (Table IV)."""
    shift: int = 0
    """Pixels of the network's input to shift each query to the right; a negative number shifts it to the left. The side
    that is uncovered becomes black."""
    scale: float = 1.0
    """Zoom factor of each query about its centre; below 1 with a black border."""
    weather: WeatherName | Literal["all"] = "normal"
    """Weather of University-WX in drone or street pictures, whichever side they are; all measures the ten of them in both
    directions and prints the leaderboard's table."""


@dataclass(kw_only=True)
class RankingOptions:
    """The descriptors that are compared."""

    parts: str | None = None
    """Parts to use, numbered from 1 and separated by commas, such as 1,2 (Table V); by default all parts."""

    def protocol(self, csls: int, changes: ChangeOptions | None = None) -> Protocol:
        """Return the protocol of these options.

        Raises:
            InputError: if one of them is out of range.
        """
        from lpn.descriptors.transforms import Change
        from lpn.descriptors.weather import Weather
        from lpn.retrieval.protocol import Protocol

        parts, changed = _numbers(self.parts), changes or ChangeOptions()
        name: WeatherName = "normal" if changed.weather == "all" else changed.weather
        change = Change(changed.rotate, changed.shift, changed.scale, weather=Weather(name))
        return Protocol(change, None if parts is None else tuple(parts), csls=csls)


@dataclass(kw_only=True)
class DescriptorOptions(RankingOptions):
    """The descriptors that are compared."""

    centre: bool = False
    """Subtract the mean descriptor of all queries from each query, and that of the gallery from each tile, part by part. It needs
    no labels, and makes up for places and cameras that differ from those of the training."""
    csls: CslsOption = 0

    def saved_protocol(self) -> Protocol:
        """Return the protocol of these options, see `protocol`."""
        return replace(self.protocol(self.csls), centre=self.centre)


@dataclass(kw_only=True)
class EvaluationOfSource(ABC):
    """Measure recall and AP, and print them."""

    json: Path | None = None
    """File to write the measures to, as JSON."""

    def run(self) -> None:
        from lpn.core.files import check_outputs, write_json

        check_outputs((self.json, ".json"))
        title, result = self._evaluate()
        _print_result(title, result)
        if self.json is not None:
            write_json(self.json, result.to_dict())

    @abstractmethod
    def _evaluate(self) -> tuple[str, Result]:
        """Return the table's title and the result."""


@dataclass(kw_only=True)
class EvaluationOfPublished(EvaluationOfSource):
    """Measure recall and AP of a result of the published test code."""

    saved: Path
    """Result of the published test code, pytorch_result.mat."""
    n_parts: int | None = None
    """Number of parts of its descriptors; needed with --parts and --centre."""
    ranking: DescriptorOptions = field(default_factory=DescriptorOptions)

    def _evaluate(self) -> tuple[str, Result]:
        from lpn.retrieval.evaluate import evaluate_saved
        from lpn.retrieval.saved import check_n_parts, load_saved

        protocol = self.ranking.saved_protocol()
        if protocol.centre and self.n_parts is None:
            raise InputError(
                "Centring normalises each part, and a saved result does not contain the number of parts; give it with --n-parts "
                "(1 for a baseline)."
            )
        saved = load_saved(self.saved, check_n_parts(self.n_parts))
        return saved.name, evaluate_saved(saved, protocol)


@dataclass(kw_only=True)
class EvaluationOfArrays(EvaluationOfSource):
    """Measure recall and AP of descriptors that any model made."""

    source: Arrays
    ranking: DescriptorOptions = field(default_factory=DescriptorOptions)

    def _evaluate(self) -> tuple[str, Result]:
        from lpn.retrieval.evaluate import evaluate_descriptors

        source, protocol = self.source, self.ranking.saved_protocol()
        if source.paths is None:
            raise InputError("Plain arrays are evaluated with their list of pictures; give it as --paths.")
        arrays = source.load()
        by_metres = not arrays.labelled.any() and arrays.all_positions is not None
        if not (by_metres or arrays.labelled.all()):
            raise InputError(
                f"{int((~arrays.labelled).sum())} of {len(arrays.labelled)} queries have no label in {source.paths.name} that "
                "tells what is right; add their labels."
            )
        positions = [*arrays.query_positions, *arrays.positions]
        if 0 < (unknown := positions.count(None)) < len(positions):
            log.warning(
                "%d of %d pictures in %s have no position, so there are no errors in metres.",
                unknown,
                len(positions),
                source.paths.name,
            )
        saved = arrays.result
        result = evaluate_descriptors(
            (saved.query, saved.gallery),
            (saved.query_labels, saved.gallery_labels),
            arrays.truth(),
            saved.task,
            protocol,
            arrays.all_positions,
        )
        return f"{saved.name} on {source.gallery.name}", result


@dataclass(kw_only=True)
class EvaluationOfIndex(EvaluationOfSource):
    """Measure recall of the searches of an index; AP needs all ranks, and a search returns only the first."""

    source: Indexed

    def _evaluate(self) -> tuple[str, Result]:
        from lpn.tasks.evaluation import evaluate_task

        task = open_first_task(self.source)
        return f"{task.model_name} on {task.data_name}, {task.gallery_description}", evaluate_task(task)


@dataclass(kw_only=True)
class EvaluationOfFlight:
    """Measure the errors in metres of a flight that is located on a map; its tags and corrections by hand are the truth."""

    map: Path
    """Map under the flight: a folder of lpn map, or a georeferenced picture."""
    flight: Path
    """Flight to locate: a folder of lpn flight, or one of photos."""
    model: Path | None = None
    """Trained model for retrieval and sequence, as for lpn evaluate; without one, registration alone."""
    kind: KindOption = None
    pooling: PoolingOption = None
    provider: ProviderOption = "auto"
    prior: float | None = None
    """Metres around each photo's own GPS tag that it is registered in without --model; by default the whole map."""
    map_error: MapError = None
    tags: Literal["told", "corrected"] = "told"
    """GPS tags that errors are measured against: told, or corrected by the constant lag that the registration finds. The lag
    comes from the answers that are measured, so corrected errors may hide a bias that these share."""
    register: bool = True
    """Lay each photo over the map; --no-register measures retrieval and sequence alone, in a fraction of the time."""
    corrections: bool = True
    """Take the truth from corrections.csv where a person corrected a photo; --no-corrections takes GPS tags alone."""
    positions: Path | None = None
    """Table (CSV) of surveyed positions of photos, which the accepted answers are compared with: photo and latitude,longitude or
    easting,northing,epsg, and point, which is camera (by default) or ground, the ground at the photo's middle."""
    crs: str | None = None
    """Coordinate reference system of the coordinates in --positions, such as EPSG:32614, instead of a column; latitudes and
    longitudes are of WGS 84 (EPSG:4326) by default."""
    residuals: Path | None = None
    """Table (CSV) to write: answer minus surveyed position, photo by photo."""
    json: Path | None = None
    """File to write the measures to, as JSON."""

    def run(self) -> None:
        from lpn.cli.locate import locate_files, print_summary
        from lpn.core.consoles import wide_console
        from lpn.core.files import check_outputs, printable, write_json
        from lpn.locate.options import LocateOptions
        from lpn.locate.surveyed import compare_surveyed, summarise_surveyed, survey_remarks, write_residuals

        for option, given in (("--crs", self.crs), ("--residuals", self.residuals)):
            if given is not None and self.positions is None:
                raise InputError(f"{option} belongs to --positions; give both, or leave it out.")
        self._check_files_differ()
        check_outputs((self.json, ".json"), (self.residuals, ".csv"))
        console = wide_console()
        options = LocateOptions(register=self.register, prior=self.prior, map_error=self.map_error, tags=self.tags)
        survey: list[MatchedSurvey] = []
        located = locate_files(
            self.map,
            self.flight,
            self.model,
            self.kind,
            self.provider,
            options,
            None,
            self.corrections,
            pooling=self.pooling,
            on_opened=lambda basemap, flight: survey.extend(self._survey(basemap, flight, console)),
        )
        print_summary(located, console)
        errors = None
        if survey:
            rows = compare_surveyed(located, survey[0])
            errors = summarise_surveyed(rows)
            _print_surveyed(errors, survey_remarks(rows, len(located.frames)), console)
            if self.residuals is not None:
                write_residuals(self.residuals, rows, located.basemap.frame)
                console.print(f"The residuals are in {printable(str(self.residuals))}.", soft_wrap=True, markup=False)
        if self.json is not None:
            stages = {stage: asdict(summary) for stage, summary in located.summaries().items()}
            audit = None if located.audit is None else located.audit.sentence
            result = {
                "frames": len(located.frames),
                "corrected": sum(frame.by_hand is not None for frame in located.frames),
                "stages": stages,
                "stages_without_lag": {
                    stage: asdict(summary) for stage, summary in located.without_lag().summaries().items()
                }
                if located.tags_without_lag is not None
                else None,
                "retrieval": located.field_measures(),
                "tags": audit,
                "notes": located.notes,
            }
            if errors is not None:
                result["surveyed"] = {
                    stage: {point: asdict(summary) for point, summary in points.items()}
                    for stage, points in errors.items()
                }
            # A stage without an answer has no median, which JSON cannot express as a number.
            write_json(self.json, result)

    def _survey(self, basemap: Map, flight: Flight, console: Console) -> list[MatchedSurvey]:
        """Return the surveyed positions, none without a table; what is wrong with them is told before the flight is located."""
        from lpn.locate.surveyed import match_surveyed, read_surveyed, strangers_sentence

        if self.positions is None:
            return []
        positions = read_surveyed(self.positions, basemap.frame, self.crs)
        survey = match_surveyed([frame.name for frame in flight.frames], positions, basemap)
        if sentence := strangers_sentence(survey):
            console.print(sentence, highlight=False, soft_wrap=True, markup=False)
        return [survey]

    def _check_files_differ(self) -> None:
        """Raise InputError if two of the options name one file."""
        from lpn.core.files import printable

        seen: dict[Path, str] = {}
        for option, file in (("--positions", self.positions), ("--residuals", self.residuals), ("--json", self.json)):
            if file is not None and (other := seen.setdefault(file.resolve(), option)) != option:
                raise InputError(
                    f"{other} and {option} both name {printable(str(file))}; give {option} a file of its own."
                )


@dataclass(kw_only=True)
class EvaluateCommand(EvaluationOfSource):
    """Measure recall and AP on a test split or a saved result, or the errors of a located flight."""

    SOURCES: ClassVar[dict[str, type[EvaluationOfSource | EvaluationOfFlight]]] = {
        Published.WORD: EvaluationOfPublished,
        Arrays.WORD: EvaluationOfArrays,
        Indexed.WORD: EvaluationOfIndex,
        Flown.WORD: EvaluationOfFlight,
    }

    source: Data
    changes: ChangeOptions = field(default_factory=ChangeOptions)
    ranking: RankingOptions = field(default_factory=RankingOptions)
    per_query: Path | None = None
    """File to write a line for each query to, as CSV: its rank, AP, and the names and scores of the ten nearest tiles."""

    def run(self) -> None:
        from lpn.core.files import check_outputs

        check_outputs((self.json, ".json"), (self.per_query, ".csv"))
        if self.changes.weather != "all":
            super().run()
        elif self.per_query is None:
            self._run_weathers()
        else:
            raise InputError(
                "--per-query lists the queries in one weather; choose one with --weather, or leave it out."
            )

    def _run_weathers(self) -> None:
        from lpn.core.files import write_json
        from lpn.retrieval.weathers import evaluate_weathers

        model, dataset, tasks, title, protocol, calibration = self._opened()
        result = evaluate_weathers(model, dataset, tasks, protocol, calibration)
        _print_weathers(title, result)
        if self.json is not None:
            write_json(self.json, result.to_dict())

    def _evaluate(self) -> tuple[str, Result]:
        from lpn.core.files import write_atomic
        from lpn.core.views import views_of
        from lpn.descriptors import descriptor_reader
        from lpn.retrieval.evaluate import evaluate

        model, dataset, (task, *_), title, protocol, calibration = self._opened()
        depth = 0 if self.per_query is None else _LISTED
        result = evaluate(model, dataset, task, protocol, descriptor_reader(dataset.root), calibration, depth)
        if self.per_query is not None and result.per_query is not None:
            sides = dataset.queries(views_of(task)[0]), dataset.gallery(views_of(task)[1])
            names = ([picture.name for picture in side] for side in sides)
            write_atomic(self.per_query, result.per_query.to_csv(*names))
        return title, result

    def _opened(self) -> tuple[Model, Dataset, list[str], str, Protocol, Calibration | None]:
        """Open model and data set.

        Returns:
            Both, the task and, unless one is given, its reverse if offered, the title, the protocol, and the calibration.
        """
        from lpn.core.views import views_of
        from lpn.datasets import open_dataset
        from lpn.tasks.evaluation import protocol_calibration
        from lpn.tasks.opening import no_task_error, offered_tasks

        source = self.source
        protocol = self.ranking.protocol(source.csls, self.changes)
        model, dataset = source.model.load(), open_dataset(source.data)
        tasks = offered_tasks(model, dataset)
        if source.task is None and not tasks:
            raise no_task_error(model, dataset)
        task = source.task or tasks[0]
        title = f"{source.model.name} ({model.describe()}) on {source.data.resolve().name}"
        reverse = [
            name for name in tasks if source.task is None and views_of(name) == views_of(task)[::-1] != views_of(task)
        ]
        calibration = protocol_calibration(model, dataset, protocol, source.calibrate)
        return model, dataset, [task, *reverse], title, protocol, calibration


def _print_result(title: str, result: Result) -> None:
    """Print a table of recall and AP, and the protocol below it."""
    from rich.table import Table

    from lpn.core.consoles import wide_console
    from lpn.retrieval.evaluate import WITHOUT

    table, of_group = Table(title=title), [result.group_name] if result.groups else []
    for name in ("task", *of_group, "queries", "gallery", *(f"recall@{k}" for k in result.recall), "ap"):
        table.add_column(name, justify="right", no_wrap=True)
    for group, galleries in [("all", result.galleries), *result.groups.items()]:
        for figures in galleries:
            values = map(_figure, (*figures.recall.values(), figures.ap))
            names = (result.task, *([group] if of_group else []))
            table.add_row(*names, str(figures.queries), figures.name, *values)
    console = wide_console()
    console.print(table)
    console.print(result.sentence)
    if any(figures.gallery_name == WITHOUT for figures in result.galleries):
        console.print(
            f"The rows {WITHOUT} drop the gallery pictures of places that no query shows, as Sample4Geo, DAC, and CAMP do; LPN, "
            "FSRA, MCCG, and SDPL rank the full gallery. Figures of the two do not compare."
        )
    if result.measures:
        units = {"dis": " m", "ma": " %", "hit rate": " %", "region_recall": " %", "flight_recall": " %"}
        named = (
            f"{_title(key)} {value:.4g}{units.get(key.split('@')[0], '')}" for key, value in result.measures.items()
        )
        console.print(f"Metrics of the field: {', '.join(named)}.")
    if near := result.distances():
        shares = ", ".join(f"{value:.1f} % {key}" for key, value in near.items() if key.startswith("within"))
        median = f"{near['median error m']:.1f} m"
        console.print(
            f"By the positions, the median error of the top match is {median}; the shares of queries are {shares}."
        )


def _print_weathers(title: str, result: WeatherResult) -> None:
    """Print University-WX's table: a row for each weather, and their mean."""
    from rich.table import Table

    from lpn.core.consoles import wide_console

    table = Table(title=title)
    table.add_column("weather", no_wrap=True)
    for task in result.tasks:
        table.add_column(f"{task}\nR@1", justify="right")
        table.add_column("\nAP", justify="right")
    for name, figures in result.rows():
        if name == result.MEAN:
            table.add_section()
        table.add_row(name, *(_figure(value) for pair in figures for value in pair))
    console = wide_console()
    console.print(table)
    console.print(result.sentence)


def _print_surveyed(
    errors: Mapping[str, Mapping[SurveyedPoint, SurveyedErrors]], remarks: Sequence[str], console: Console
) -> None:
    """Print the errors of each stage and point, a column each, and sentences on them."""
    from rich.table import Table

    from lpn.core.numbers import SIGMA
    from lpn.locate.measures import RIGHT_CALIBRATION

    columns = {f"{stage}, {point}": one for stage, points in errors.items() for point, one in points.items()}
    sentences = ["No surveyed photo has an accepted answer, so there is nothing to compare."]
    if columns:
        table = Table("", *columns, title="Against surveyed positions: answer minus survey, in metres")
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
        table.add_row("photos", *(f"{one.photos}" for one in columns.values()))
        for name, key in figures.items():
            table.add_row(name, *(_figure(getattr(one, key)) for one in columns.values()))
        table.add_row("photos with a radius", *(f"{one.radii}" for one in columns.values()))
        for k in RIGHT_CALIBRATION:
            shares = [f"{one.within[k]:.0f} %" if k in one.within else "-" for one in columns.values()]
            table.add_row(f"within {k} {'radius' if k == 1 else 'radii'}", *shares)
        console.print(table)
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


def _figure(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"


def _title(key: str) -> str:
    """Return a metric's name from its key, such as "SDM@3 (DenseUAV)" from "sdm_denseuav@3"."""
    name, _, depth = key.partition("@")
    titles = {
        **{"sdm_denseuav": "SDM@{} (DenseUAV)", "sdm_gta_uav": "SDM@{} (GTA-UAV)", "dis": "Dis@{}", "ma": "MA@{} m"},
        **{f"{group}_recall": f"mean R@{{}} of {group}s" for group in ("region", "flight")},
    }
    return titles.get(name, name).format(depth)


def _numbers(text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        return [int(item) for item in text.split(",")]
    except ValueError as error:
        raise InputError(f"The parts are {text!r}; expected numbers from 1, such as 1,2.") from error
