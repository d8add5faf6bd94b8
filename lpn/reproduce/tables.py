"""The paper's tables, `tables.toml`: the network and measure of each row, the paper's values, and its claims."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.training import recipes
from lpn.training.recipe import Recipe
from lpn.training.recipes import RECIPES

DataRole = Literal["places", "panoramas", "landmarks"]
Measure = Literal["both ways", "ground", "landmarks", "centre"]
Values = tuple[float, ...]
# A row of the paper; None where it prints a dash.
PrintedValues = tuple[float | None, ...]

_DATA: dict[str, Any] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))


@dataclass(frozen=True)
class Training:
    """A network that rows need.

    Attributes:
        name: of its run, such as "lpn" or "instance".
        method: one of `lpn.training.recipes.METHODS`.
        role: the training data: places seen by satellite, drone, and from the street, or pairs of panorama and tile.
        changes: the settings that distinguish it from its method's other networks.
        recipe: the recipe in its row's name, at the scales of the paper and of the released code.
    """

    name: str
    method: str
    role: DataRole = "places"
    changes: Mapping[str, Any] = field(default_factory=dict)
    recipe: str | None = None


@dataclass(frozen=True)
class TableRow:
    """A network and its measure.

    Attributes:
        label: as in the paper's table; claims refer to the row by it.
        training: the network; None for the pretrained backbone's features without training.
        paper: the paper's values, empty if it has no such row.
        note: the difference from the paper's row, printed after the label.
        rotate: rotation of the queries in degrees counter-clockwise.
        parts: 1-based parts used, None for all.
        branch: the branch that describes landmarks.
        quoted: whether the paper quotes the row from other work; nothing is then trained or measured.
    """

    label: str
    training: Training | None
    paper: PrintedValues = ()
    note: str = ""
    rotate: float = 0.0
    parts: tuple[int, ...] | None = None
    branch: View | None = None
    quoted: bool = False


@dataclass(frozen=True)
class Claim:
    """A claim of the paper: in some columns, one row of each pair leads the other.

    Attributes:
        text: the claim in our words, with its place in the paper.
        pairs: labels of the row that should lead, and of the other one.
        columns: indices of the compared columns; None for every measured column.
        tolerance: None for a claim that the first row leads. For a claim that it does not lead, the points by which it may still
            lead, for each of `columns`.
    """

    text: str
    pairs: tuple[tuple[str, str], ...]
    columns: tuple[int, ...] | None = None
    tolerance: Values | None = None


@dataclass(frozen=True)
class PaperTable:
    """A table or measured figure of the paper.

    Attributes:
        key: such as "table1".
        title: the comparison, without the data set.
        measure: the measure of its columns.
        columns: their names.
        notes: sentences below the table.
        google: a further note if there are pictures of google.
        protocols: a further note by the protocol of the measurement.
    """

    key: str
    title: str
    measure: Measure
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...] = ()
    google: str = ""
    protocols: Mapping[str, str] = field(default_factory=dict)

    @property
    def trainings(self) -> list[Training]:
        """The networks it needs, each once."""
        return list({row.training.name: row.training for row in self.rows if row.training}.values())


@dataclass(frozen=True)
class Scale:
    """The recipes of a reproduction.

    Attributes:
        name: "paper", "released", or "reduced".
        recipes: the recipe of each role before a method's changes, and under "safa" a recipe for SAFA alone, if any.
        note: one sentence for the table's notes, with names of settings in braces.
        settings: the common replacements of the recipe's settings for all rows of a role; empty if each method has its published
            recipe.
        divisor: of Table III's input sizes.
        protocol: "released" turns queries and transfers to landmarks as the released code does.
        changes: the user's changes of every recipe.
    """

    name: str
    recipes: Mapping[str, str]
    note: str
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    divisor: int = 1
    protocol: Literal["ours", "released"] = "ours"
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def released(self) -> bool:
        """True if networks are measured as in the released test code."""
        return self.protocol == "released"

    @property
    def described(self) -> str:
        """The note with the settings of the recipe of places."""
        return self.note.format_map(asdict(self._role("places")))

    def recipe(self, training: Training, seed: int) -> Recipe:
        """Return the recipe of a training; the distinguishing settings of rows override the user's changes.

        Raises:
            InputError: if the user's changes do not fit the training.
        """
        kept = self.kept(training)
        changes = {name: value for name, value in self.changes.items() if name not in kept}
        changes |= {**training.changes, "seed": seed}
        if not str(changes.get("backbone", "vgg16")).startswith("vgg16"):
            # SAFA's recipe has a dropout in its VGG-16.
            changes.setdefault("backbone_dropout", 0.0)
        try:
            return replace(self._unchanged(training), **changes)
        except InputError as error:
            raise InputError(f"{training.name} cannot be trained with these flags: {error}") from None

    def kept(self, training: Training) -> tuple[str, ...]:
        """Name the user's changes that do not apply to a training, because its row or its own recipe sets them."""
        own, unchanged = set(training.changes), self._unchanged(training)
        if training.role == "panoramas" and unchanged.lr != self._role("places").lr:
            own.add("lr")  # each released script has its own rate
        if training.method.startswith("safa"):
            own |= {"size", "width", "lr", "optimizer"} if "safa" in self.recipes else {"size", "width"}
        if str(self.changes.get("backbone", unchanged.backbone)).startswith("vgg16"):
            own.add("last_layer")  # a VGG has none
        return tuple(name for name in self.changes if name in own)

    def _unchanged(self, training: Training) -> Recipe:
        if self.settings:
            return recipes.method(training.method, self._role(training.role))
        if training.method in recipes.METRIC_LOSSES:
            return recipes.find("metric-released", training.method)
        if training.recipe is not None:
            return RECIPES[training.recipe]
        role = "safa" if training.method.startswith("safa") else training.role
        return recipes.find(self.recipes[role], training.method)

    def _role(self, role: str) -> Recipe:
        return replace(RECIPES[self.recipes[role]], **self.settings.get(role, {}))

    @property
    def base(self) -> Recipe:
        """The recipe of places, with the user's changes of backbone and input size, for a network without training."""
        names = ("backbone", "last_layer", "size", "width")
        return replace(self._role("places"), **{name: self.changes[name] for name in names if name in self.changes})


# Settings that distinguish the rows of the tables; the user cannot change them for all rows.
ROW_SETTINGS = (
    *("n_parts", "layout", "pooling", "polar", "maps", "street", "google", "linear", "instance", "metric", "positives"),
    *("pool", "metric_per_part", "margin", "loss", "loss_weight", "seed"),
)
SCALES = {name: Scale(name, **values) for name, values in _DATA["scales"].items()}
_TRAININGS = {name: Training(name, **values) for name, values in _DATA["trainings"].items()}
# The networks of each drawn picture, by the name of its file.
SHOWN = {name: tuple(_TRAININGS[one] for one in names) for name, names in _DATA["figures"].items()}
# The pictures of each drawn figure.
DRAWN = {
    key: tuple(name for name in SHOWN if name.startswith(key)) for key in dict.fromkeys(name[:7] for name in SHOWN)
}
# All tables and figures that can be reproduced.
KEYS = tuple(dict.fromkeys((*_DATA["tables"], *DRAWN)))


def tables(scale: Scale) -> dict[str, PaperTable]:
    """Return all tables and measured figures by key."""
    made = {}
    for key, entry in _DATA["tables"].items():
        rows = tuple(_row(row, scale) for row in entry["rows"])
        more = {name: entry[name] for name in ("google", "protocols") if name in entry}
        columns, notes = tuple(_DATA["columns"][entry["measure"]]), tuple(entry.get("notes", ()))
        made[key] = PaperTable(key, entry["title"], entry["measure"], columns, rows, notes, **more)
    return made


def _row(entry: Mapping[str, Any], scale: Scale) -> TableRow:
    how = dict(entry)
    label, name, size = how.pop("label"), how.pop("training", None), how.pop("size", None)
    paper = tuple(None if math.isnan(value) else value for value in how.pop("paper", ()))
    training = _TRAININGS[name] if name else None
    if "parts" in how:
        how["parts"] = tuple(how["parts"])
    if training is not None and training.recipe and not scale.settings:
        how["note"] = f"recipe {training.recipe}"
    if size is not None:
        ours, lpn = size // scale.divisor, _TRAININGS["lpn"]
        resized = replace(lpn, name=f"lpn-{ours}-pixels", changes={**lpn.changes, "size": ours})
        training = lpn if ours == scale.base.size else resized
        how["note"] = "" if ours == size else f"here {ours}"
    return TableRow(label, training, paper, **how)


def claims(key: str) -> tuple[Claim, ...]:
    """Return the paper's claims about a table or figure."""
    made = []
    for entry in _DATA["tables"][key].get("claims", ()):
        rising = [(better, worse) for worse, better in pairwise(entry.get("rising", ()))]
        pairs = [*entry.get("pairs", ()), *((entry["ahead"], other) for other in entry.get("of", ())), *rising]
        columns, tolerance = (tuple(entry[name]) if name in entry else None for name in ("columns", "tolerance"))
        made.append(Claim(entry["text"], tuple((better, worse) for better, worse in pairs), columns, tolerance))
    return tuple(made)


def find(key: str, scale: Scale) -> PaperTable:
    """Return the table or measured figure of a key; InputError when there is none."""
    known = tables(scale)
    if key not in known:
        raise InputError(f"There is no {key!r} to reproduce; choose one of {', '.join(KEYS)}, or all.")
    return known[key]
