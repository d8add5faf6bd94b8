"""The command train."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import tyro

import lpn
from lpn.cli.parsing import parse
from lpn.core.errors import InputError, LPNError
from lpn.sources import Advanced
from lpn.training import recipes
from lpn.training.recipe import Recipe


@dataclass
class TrainCommand:
    """Train an LPN by a named recipe; every number of the recipe is a flag."""

    out: Path
    """Folder of the run: last.safetensors, best.safetensors, log.csv, run.json, and the state for --resume."""
    data: Path | None = None
    """Data set with pictures to train on, in any layout of docs/data.md."""
    map: Path | None = None
    """Map to train on alone, in place of --data: a folder of lpn map, or a georeferenced picture."""
    window_sizes: Advanced[tuple[float, float] | None] = None
    """Smallest and largest side in metres of the windows of --map, about as large as the ground on the flight's photos; by
    default half to twice the ground of the network's input at the map's resolution."""
    recipe: str = recipes.DEFAULT
    """Recipe: as the paper states (paper, cvusa-paper), as the released code does (released, cvusa-released, cvact-released,
    safa-released, and metric-released), for some hundred places (small), the same for all headings (world), or for a map alone
    (map, the default with --map); see docs/recipes.md."""
    method: Advanced[str | None] = None
    """One of the methods that the paper compares, by default the recipe's: lpn, instance (the baseline), the baseline with
    another loss (contrastive, triplet-0.3, triplet-0.5, soft-margin), lpn-sequential, lpn-cvusa, lpn-strips, safa, or
    safa-lpn."""
    compare_recipes: Advanced[tuple[str, str] | None] = None
    """Print the settings in which two recipes differ, each with its source, and train nothing."""
    init: Path | None = None
    """Weights of the backbone trained on ImageNet (.safetensors or .pth, torchvision's names), or a model, such as a name of lpn
    models, of which fitting weights are loaded; auto looks for the backbone's in the folders of torch and timm."""
    from_scratch: bool = False
    """Start from random weights instead of --init."""
    calibrate: bool = False
    """Measure ground_ratio first, on the training pictures without their labels, by the trained model of --init."""
    resume: bool = False
    """Resume the run in --out; its data and settings need not be given again."""
    evaluate_every: int = 0
    """Epochs from one evaluation to the next; the best evaluated model is kept. 0 evaluates only at the end."""
    validate: float = 0.0
    """Share of the training places held out to select the best epoch; at 0 the test split selects it."""
    workers: Advanced[int] = 0
    """Threads that prepare pictures; 0 chooses by the machine. They do not affect the result."""
    settings: Advanced[tyro.conf.OmitArgPrefixes[Recipe]] = field(default_factory=Recipe)

    def run(self) -> None:
        if self.compare_recipes is not None:
            print(recipes.difference(*self.compare_recipes))
            return
        trainer = import_module("lpn.training.trainer").Trainer
        source = self._source()
        settings = self.settings
        # A resumed run has the ratio among its settings.
        if self.calibrate and not (self.resume and settings.ground_ratio != 1):
            settings = replace(settings, ground_ratio=self._ground_ratio(source))
        run = trainer(
            source,
            self.out,
            settings,
            self.init,
            self.resume,
            self.evaluate_every,
            workers=self.workers,
            validate=self.validate,
            from_scratch=self.from_scratch,
            window_sizes=self.window_sizes,
            given={name: _plain(getattr(self, name)) for name in _KEPT},
        )
        run.console.print(f"Recipe {self.recipe}: {settings.to_json()}")
        print(f"The model is in {run.run()}.")

    def _ground_ratio(self, dataset: Any) -> float:
        if self.init is None or self.map is not None or self.settings.ground_ratio != 1:
            raise InputError(
                "--calibrate measures ground_ratio by a trained model on the pictures of a data set; give --data and a model "
                "with --init, and leave --ground-ratio out."
            )
        try:
            model = lpn.load(self.init)
        except LPNError as error:
            raise InputError(
                f"--calibrate measures ground_ratio by a trained model, such as city-lpn, and --init {self.init} is not one; "
                "give another --init, or --ground-ratio in place of --calibrate."
            ) from error
        measure = import_module("lpn.retrieval.calibration").ground_ratio
        return round(float(measure(model, dataset.train("drone"), dataset.train("satellite"))), 2)

    def _source(self) -> Any:
        if (self.data is None) == (self.map is None):
            raise InputError("A training needs a data set or a map; give either --data or --map.")
        if self.map is not None:
            return import_module("lpn.flight.maps").open_map(self.map)
        if self.window_sizes is not None:
            raise InputError("A data set has no windows; give --window-sizes with --map only.")
        return import_module("lpn.datasets").open_dataset(self.data)

    @classmethod
    def parse(cls, arguments: list[str], program: str) -> TrainCommand:
        """Parse the options of a training; recipe and method, or the resumed run, set the defaults of the other options.

        Raises:
            InputError: if the recipe or the method is unknown, or they do not fit each other.
        """
        default = recipes.DEFAULT if flag_value(arguments, "--map") is None else "map"
        name, chosen = flag_value(arguments, "--recipe"), flag_value(arguments, "--method")
        # A comparison of recipes needs no folder.
        folder = Path() if flag_value(arguments, "--compare-recipes") else tyro.MISSING
        named = _resumed(arguments, name, chosen)
        if named is None:
            name = name or default
            named = {"recipe": name, "method": chosen, "settings": recipes.find(name, chosen)}
        return cast(TrainCommand, parse(cls, arguments, program, cls(folder, **named)))

    def resume_hint(self) -> str:
        """Return a sentence on the remedy after a stop."""
        if not (self.out / "state.pt").is_file():
            return "No epoch was finished yet, so nothing is kept; give the same command again."
        return f"The finished epochs in {self.out} are kept; go on with lpn train --out {self.out} --resume."


# The options that run.json records beside the settings.
_KEPT = ("data", "map", "window_sizes", "recipe", "method", "init", "from_scratch", "evaluate_every", "validate")


def _plain(value: object) -> object:
    """Return an option as JSON; an existing path becomes absolute."""
    return str(value.resolve() if value.exists() else value) if isinstance(value, Path) else value


def _resumed(arguments: Sequence[str], name: str | None, method: str | None) -> dict[str, Any] | None:
    """Return the options of the resumed run; None without one, or if another recipe or method is named."""
    out = flag_value(arguments, "--out")
    file = import_module("lpn.training.run_folder").read_run(Path(out)) if out and "--resume" in arguments else None
    if file is None:
        return None
    given = file.given
    if name not in (None, given.get("recipe")) or method not in (None, given.get("method")):
        return None
    try:
        options: dict[str, Any] = {"settings": Recipe(**file.recipe)}
    except TypeError as error:
        raise InputError(
            f"{out}/run.json has settings of another version of lpn; start anew in another --out."
        ) from error
    for option, value in given.items():
        is_path = option in ("data", "map", "init") and value is not None
        options[option] = Path(value) if is_path else tuple(value) if isinstance(value, list) else value
    return options


def flag_value(arguments: Sequence[str], flag: str) -> str | None:
    """Return the value of a flag, written with hyphens or underscores, before the other flags are parsed."""
    value = None
    for position, argument in enumerate(arguments):
        name, equals, after = argument.partition("=")
        if name.replace("_", "-") != flag:
            continue
        if equals:
            value = after
        elif position + 1 < len(arguments):
            value = arguments[position + 1]
    return value
