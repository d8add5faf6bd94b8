"""The command reproduce: the paper's tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import tyro

from lpn.cli.parsing import parse
from lpn.cli.train import flag_value
from lpn.core.errors import InputError
from lpn.sources import Advanced
from lpn.training.recipe import Recipe
from lpn.training.recipes import RECIPES

if TYPE_CHECKING:
    from lpn.reproduce.tables import Scale

_Scale = Literal["auto", "paper", "released", "reduced"]


@dataclass(frozen=True)
class RecipeChanges(Recipe):
    """Settings for several recipes; each recipe checks them together with its own."""

    def check_conflicts(self) -> None:
        """Check nothing: a conflict in one recipe may be valid in another."""


@dataclass
class ReproduceCommand:
    """Reproduce the paper's tables and figures; resumable."""

    what: Annotated[tuple[str, ...], tyro.conf.Positional]
    """table1 to table6, figure1, figure3, figure4, figure5, figure7, figure8, or all. A row of `all` that cannot
    be made says why."""
    data: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A data set's folder (University-1652, CVUSA, Oxford5k, Paris6k, or a rendered world); once for each data set."""
    out: Path = Path("runs/reproduce")
    """Folder for trainings, measurements, and the tables."""
    recipe: _Scale = "auto"
    """Recipes: paper (as the papers state), released (as the released scripts train), or reduced (ResNet-18, 30 epochs); auto is
    reduced for a rendered world and paper for everything else."""
    model: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A network to use instead of training one: FILE for the LPN, or NAME=FILE, such as instance=net_119.pth; once for each."""
    init: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """ImageNet weights a backbone starts from (.safetensors or .pth, torchvision's names); once for each backbone."""
    from_scratch: bool = False
    """Start from random weights instead of --init."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds: one training for each, and the mean is reported."""
    protocol: Literal["ours", "released"] | None = None
    """Protocol for turned queries and for the transfer to landmarks: the authors' released one (the default with --recipe
    released), or ours."""
    train: bool = True
    """Train missing models; otherwise their rows are left out."""
    queries: tuple[str, ...] = ()
    """Queries shown in figures 7 (a) and 8, by name; Figures 1, 3, and 4 show the first."""
    settings: Advanced[tyro.conf.OmitArgPrefixes[RecipeChanges]] = field(default_factory=RecipeChanges)
    changed: tyro.conf.Suppress[tuple[str, ...]] = ()

    def run(self) -> None:
        import_module("torch")
        from lpn.reproduce.run import Reproduction
        from lpn.reproduce.tables import KEYS, ROW_SETTINGS

        if not self.what or not self.data:
            raise InputError(
                f"Say what to reproduce ({', '.join(KEYS)}, or all) and on which data: lpn reproduce table1 --data FOLDER."
            )
        if not self.seeds:
            raise InputError("--seeds is empty; give at least one seed.")
        if fixed := [name for name in self.changed if name in ROW_SETTINGS]:
            other = (
                "give --seeds" if fixed[0] == "seed" else "train that network with lpn train and give it with --model"
            )
            raise InputError(
                f"--{fixed[0].replace('_', '-')} distinguishes the rows of the tables, so it cannot be changed for all of them; "
                f"leave it out, or {other}."
            )
        everything = self.what == ("all",)
        keys = KEYS if everything else tuple(dict.fromkeys(self.what))
        named = _scale(self.recipe, self.data)
        changes = {name: getattr(self.settings, name) for name in self.changed}
        scale = replace(named, protocol=self.protocol or named.protocol, changes=changes)
        made = Reproduction(
            self.data,
            self.out,
            _by_name(self.model),
            self.init,
            self.seeds,
            scale,
            self.train,
            self.queries,
            self.from_scratch,
            everything,
        ).run(keys)
        print(f"Wrote {', '.join(file.name for file in made)} to {self.out}.")

    @classmethod
    def parse(cls, arguments: list[str], program: str) -> ReproduceCommand:
        """Parse the options of a reproduction, and put the names of given recipe settings into `changed`.

        Raises:
            InputError: if the recipe is unknown.
        """
        name = flag_value(arguments, "--recipe") or "auto"
        if name not in get_args(_Scale):
            raise InputError(
                f"There is no recipe {name!r} to reproduce with; choose one of {', '.join(get_args(_Scale))}."
            )
        settings = RecipeChanges(**asdict(RECIPES["released" if name == "released" else "paper"]))
        command: ReproduceCommand = parse(cls, arguments, program, cls(tyro.MISSING, settings=settings))
        flags = {argument.partition("=")[0] for argument in arguments if argument.startswith("--")}
        names = {flag.removeprefix("--").replace("-", "_").removeprefix("no_") for flag in flags}
        return replace(command, changed=tuple(field.name for field in fields(Recipe) if field.name in names))

    def resume_hint(self) -> str:
        """Return how to resume after a stop."""
        return f"Whole epochs and measurements in {self.out} are kept; the same command goes on."


def _scale(recipe: _Scale, data: Sequence[str]) -> Scale:
    """Return the scale of a recipe; for auto, the data select it."""
    from lpn.datasets.rendered import is_rendered
    from lpn.reproduce.tables import SCALES

    if recipe != "auto":
        return SCALES[recipe]
    rendered = {is_rendered(Path(folder)) for folder in data}
    if len(rendered) > 1:
        raise InputError(
            "A rendered world and other data sets are given; say with --recipe of lpn reproduce whether it is paper, released, "
            "or reduced."
        )
    return SCALES["reduced" if True in rendered else "paper"]


def _by_name(texts: Sequence[str]) -> dict[str, Path]:
    """Return the files of --model by the network that they replace."""
    files: dict[str, Path] = {}
    for text in texts:
        name, _, file = text.partition("=")
        name, file = (name, file) if file else ("lpn", name)
        if name in files:
            raise InputError(f"--model gives two files as {name}, {files[name]} and {file}; give one of them.")
        files[name] = Path(file)
    return files
