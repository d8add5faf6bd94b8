"""The command evaluate: retrieval on a test split."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import lpn
from lpn.core.errors import InputError

if TYPE_CHECKING:
    from lpn.retrieval.evaluate import Result
    from lpn.retrieval.protocol import Protocol

from lpn.core.resources import ProviderName
from lpn.core.views import TaskName, View
from lpn.models.adapters import Kind
from lpn.retrieval.published_results import check_n_parts

log = logging.getLogger(__name__)
# Options that change how a data set's pictures are described or ranked.
_NOT_OF_FLIGHTS = (
    "rotate", "shift", "scale", "parts", "branch", "average_queries", "whole", "compile", "n_parts", "query", "gallery", "paths",
)  # fmt: skip


@dataclass
class EvaluateCommand:
    """Measure recall and AP on a test split or a saved result, or the errors in metres of a located flight."""

    data: Path | None = None
    """Data set; see docs/evaluation.md for the kinds."""
    model: Path | None = None
    """Trained LPN: .onnx, .safetensors, or .pth."""
    kind: Kind | None = None
    """Method of a published .pth whose entries do not tell it, such as dac; see docs/models.md."""
    provider: ProviderName = "auto"
    """Provider: auto (LPN_PROVIDER, else a GPU if one works, else the CPU), cpu, cuda, or, for an .onnx, tensorrt."""
    compile: bool = False
    """Run a .safetensors or .pth by torch.compile; worth it from some hundred pictures on."""
    saved: Path | None = None
    """Result of the published test code, pytorch_result.mat, in place of --data and --model."""
    query: Path | None = None
    """Descriptors of the queries that any model made, as .npy, .npz, .mat, or .parquet; with --gallery and --paths."""
    gallery: Path | None = None
    """Descriptors of the gallery, as for --query."""
    paths: Path | None = None
    """List of the pictures of --query and --gallery, a .csv with file, side, label (docs/data.md)."""
    order: Literal["parts-first", "parts-last"] = "parts-first"
    """With --gallery: parts-first for arrays (N, n, D), parts-last for (N, D, n)."""
    n_parts: int | None = None
    """Number of parts of the descriptors in --saved, or in two-dimensional --query and --gallery; needed with --parts and
    --average-queries."""
    task: TaskName | None = None
    """Views of query and gallery; by default the first task of the data set."""
    rotate: float = 0.0
    """Degrees counter-clockwise by which each query is rotated first (Table IV)."""
    shift: int = 0
    """Pixels of the network's input to shift each query to the right; a negative number shifts it to the left. The side
    that is uncovered becomes black."""
    scale: float = 1.0
    """Zoom factor of each query about its centre; below 1 with a black border."""
    parts: str | None = None
    """Parts to use, numbered from 1 and separated by commas, such as 1,2 (Table V); by default all parts."""
    branch: View | None = None
    """Branch of the model that describes both queries and gallery (Table VI); by default the branch of each view."""
    average_queries: bool = False
    """Average all query pictures of a place into one query."""
    centre: bool = False
    """Subtract the mean descriptor of all queries from each query, and that of the gallery from each tile, part by part. It needs
    no labels, and makes up for places and cameras that differ from those of the training."""
    calibrate: bool = False
    """Choose the zoom at which drone pictures and tiles show the same ground, and subtract each view's mean. It needs no labels,
    and makes up for cameras, heights, and places that differ from those of the training; see docs/evaluation.md."""
    csls: int = 0
    """Re-rank by CSLS over this many nearest queries of each tile, such as 3: tiles that are near to all queries move away. It
    needs no labels, but all queries together; see docs/evaluation.md. 0 for none."""
    whole: bool = False
    """Describe whole query pictures even if the data set marks a region (Oxford5k, Paris6k)."""
    flight: Path | None = None
    """Flight, a folder of lpn flight or one of photos, to locate on --map; its tags and corrections by hand are the truth."""
    map: Path | None = None
    """Map of --flight: a folder of lpn map, or a georeferenced picture."""
    prior: float | None = None
    """Metres around each frame's own position that --flight is registered in without --model; by default the whole map."""
    map_error: float | None = None
    """1-sigma error of the map's places in metres, part of the radii of --flight; by default 3 pixels, at least 1 m."""
    register: bool = True
    """Lay each photo of --flight over the map; --no-register measures retrieval and sequence alone, in a fraction of the time."""
    corrections: bool = True
    """Take the truth of --flight from its corrections.csv where a person corrected a frame; --no-corrections takes tags alone."""
    json: Path | None = None
    """File to write the measures to, as JSON."""

    def run(self) -> None:
        from lpn.core.files import check_writable, write_json
        from lpn.descriptors.transforms import Change
        from lpn.retrieval.protocol import Protocol

        if self.json is not None:
            check_writable(self.json)
        if self.order != "parts-first" and (self.query is None or self.gallery is None):
            raise InputError(
                "An order belongs to plain arrays; give --order with --query and --gallery, or leave it out."
            )
        if self.kind is not None and self.model is None:
            raise InputError("A kind is that of a model; give --kind with --model, or leave it out.")
        if self.flight is not None or self.map is not None:
            if self.centre or self.calibrate or self.csls:
                raise InputError(
                    "The descriptors of a flight and of its map are always centred, and frames are cut to the ground of the "
                    "windows, each for itself; leave --centre, --calibrate, and --csls out."
                )
            self._evaluate_flight()
            return
        if self.prior is not None or self.map_error is not None or not self.register or not self.corrections:
            raise InputError(
                "Priors, errors of a map, registration, and corrections belong to a flight; give --flight and --map with "
                "--prior, --map-error, --no-register, and --no-corrections, or leave them out."
            )
        if self.csls < 0:
            raise InputError(f"--csls is {self.csls}; expected a number of nearest queries, such as 3, or 0.")
        parts = _numbers(self.parts)
        protocol = Protocol(
            Change(self.rotate, self.shift, self.scale),
            None if parts is None else tuple(parts),
            self.branch,
            self.average_queries,
            self.whole,
            self.centre,
            self.calibrate,
            self.csls,
        )
        if self.query is not None or self.gallery is not None or self.paths is not None:
            title, result = self._evaluate_arrays(protocol)
        else:
            title, result = self._evaluate_saved(self.saved, protocol) if self.saved else self._evaluate_model(protocol)
        _print_result(title, result)
        if self.json is not None:
            write_json(self.json, result.to_dict())

    def _evaluate_flight(self) -> None:
        from dataclasses import asdict

        from lpn.cli.locate import locate_files, print_summary
        from lpn.core.consoles import wide_console
        from lpn.core.files import write_json
        from lpn.locate.pipeline import LocateOptions

        if self.flight is None or self.map is None:
            raise InputError("A flight is evaluated on its map; give both --flight and --map.")
        if self.data is not None or self.saved is not None or self.task is not None:
            raise InputError("A flight has neither data set nor task; leave --data, --saved, and --task out.")
        given = [name for name in _NOT_OF_FLIGHTS if getattr(self, name) != getattr(type(self), name)]
        if given:
            raise InputError(f"A flight is evaluated as it is; leave --{given[0].replace('_', '-')} out.")
        console = wide_console()
        options = LocateOptions(register=self.register, prior=self.prior, map_error=self.map_error)
        located = locate_files(
            self.map, self.flight, self.model, self.kind, self.provider, options, None, self.corrections, console
        )
        print_summary(located, console)
        if self.json is not None:
            stages = {stage: asdict(found) for stage, found in located.summaries().items()}
            audit = None if located.audit is None else located.audit.sentence
            result = {
                "frames": len(located.frames),
                "corrected": sum(frame.by_hand is not None for frame in located.frames),
                "stages": stages,
                "retrieval": located.field_measures(),
                "tags": audit,
                "notes": located.notes,
            }
            # A stage without an answer has no median, which JSON cannot express as a number.
            write_json(self.json, _without_nan(result))

    def _evaluate_arrays(self, protocol: Protocol) -> tuple[str, Result]:
        from lpn.retrieval.evaluate import evaluate_saved
        from lpn.retrieval.plain_arrays import load_arrays

        if self.query is None or self.gallery is None or self.paths is None:
            raise InputError(
                "Plain arrays are evaluated with their list of pictures; give --query, --gallery, and --paths."
            )
        others = {"--model": self.model, "--saved": self.saved, "--task": self.task}
        if other := next((name for name, value in others.items() if value is not None), None):
            raise InputError(f"Plain arrays are evaluated without a model, by their rows alone; leave {other} out.")
        n_parts = None if self.n_parts is None else check_n_parts(self.n_parts)
        arrays = load_arrays(self.query, self.gallery, self.paths, n_parts, self.order, self.data)
        if not arrays.labelled.all():
            raise InputError(
                f"{int((~arrays.labelled).sum())} of {len(arrays.labelled)} queries have no label in {self.paths.name}, so "
                "nobody knows what is right; add their labels."
            )
        positions = [*arrays.query_positions, *arrays.positions]
        if 0 < (unknown := positions.count(None)) < len(positions):
            log.warning(
                "%d of %d pictures in %s have no position, so there are no errors in metres.",
                unknown,
                len(positions),
                self.paths.name,
            )
        result = evaluate_saved(arrays.result, protocol, arrays.all_positions)
        return f"{arrays.result.name} on {self.gallery.name}", result

    def _evaluate_saved(self, saved: Path, protocol: Protocol) -> tuple[str, Result]:
        from lpn.retrieval.evaluate import evaluate_saved
        from lpn.retrieval.published_results import load_saved

        if self.data is not None or self.model is not None or self.task is not None:
            raise InputError(
                "A saved result already fixes data set, model, and task; leave --data, --model, and --task out."
            )
        if self.provider != "auto" or self.compile:
            raise InputError("A saved result needs no network; leave --provider and --compile out.")
        if (protocol.average or protocol.centre) and self.n_parts is None:
            raise InputError(
                "Averaging and centring normalise each part, and a saved result does not contain the number of parts; give it "
                "with --n-parts (1 for a baseline)."
            )
        opened = load_saved(saved, check_n_parts(self.n_parts))
        return opened.name, evaluate_saved(opened, protocol)

    def _evaluate_model(self, protocol: Protocol) -> tuple[str, Result]:
        from lpn.datasets import open_dataset
        from lpn.descriptors import descriptor_reader
        from lpn.retrieval.evaluate import evaluate

        _reject_n_parts(self.n_parts)
        if self.data is None or self.model is None:
            raise InputError(
                "There is nothing to evaluate; give --data and --model, or a pytorch_result.mat with --saved."
            )
        model, dataset = lpn.load(self.model, self.provider, self.compile, self.kind), open_dataset(self.data)
        tasks = dataset.tasks()
        task = self.task or (tasks[0] if tasks else "drone-to-satellite")
        title = f"{self.model.name} ({model.describe()}) on {self.data.resolve().name}"
        return title, evaluate(model, dataset, task, protocol, descriptor_reader(dataset.root))


def _print_result(title: str, result: Result) -> None:
    """Print a table of recall and AP, and the protocol below it."""
    from rich.table import Table

    from lpn.core.consoles import wide_console
    from lpn.retrieval.evaluate import WITHOUT

    rows = [("all", result.galleries), *result.groups.items()]
    table = Table(title=title)
    names = [f"recall@{k}" for k in result.recall]
    for name in ("task", *([result.group_name] if result.groups else []), "queries", "gallery", *names, "ap"):
        table.add_column(name, justify="right", no_wrap=True)
    for group, galleries in rows:
        for figures in galleries:
            facts = (result.task, *([group] if result.groups else []), str(figures.queries), figures.name)
            table.add_row(*facts, *(f"{value:.2f}" for value in (*figures.recall.values(), figures.ap)))
    console = wide_console()
    console.print(table)
    console.print(result.sentence)
    if any(figures.gallery_name == WITHOUT for figures in result.galleries):
        console.print(
            f"The rows {WITHOUT} drop the gallery pictures of places that no query shows, as Sample4Geo, DAC, and CAMP do; LPN, "
            "FSRA, MCCG, and SDPL rank the full gallery. Figures of the two do not compare."
        )
    if result.measures:
        units = {"dis": " m", "ma": " %", "hit rate": " %"}
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


def _title(key: str) -> str:
    """Return a metric's name from its key, such as "SDM@3 (DenseUAV)" from "sdm_denseuav@3"."""
    name, _, depth = key.partition("@")
    titles = {"sdm_denseuav": "SDM@{} (DenseUAV)", "sdm_gta_uav": "SDM@{} (GTA-UAV)", "dis": "Dis@{}", "ma": "MA@{} m"}
    return titles.get(name, name).format(depth)


def _without_nan(value: object) -> object:
    if isinstance(value, dict):
        return {str(key): _without_nan(entry) for key, entry in value.items()}
    return None if isinstance(value, float) and value != value else value


def _numbers(text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        return [int(item) for item in text.split(",")]
    except ValueError as error:
        raise InputError(f"The parts are {text!r}; expected numbers from 1, such as 1,2.") from error


def _reject_n_parts(n_parts: int | None) -> None:
    if n_parts is not None:
        raise InputError(
            "A model file contains its number of parts; give --n-parts with --saved only. To choose parts, use --parts."
        )
