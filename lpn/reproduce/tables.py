"""The paper's tables as data: the network of each row, and how it is measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.reproduce import paper_values
from lpn.training import recipes
from lpn.training.recipe import Recipe
from lpn.training.recipes import RECIPES

DataRole = Literal["places", "panoramas"]
Measure = Literal["both ways", "ground", "landmarks", "centre"]


@dataclass(frozen=True)
class Training:
    """A network that rows need.

    Attributes:
        name: of its run, such as "lpn" or "instance".
        method: one of `lpn.training.recipes.METHODS`.
        role: the training data: places seen by satellite, drone, and from the street, or pairs of panorama and tile.
        changes: the settings of the recipe that tell it from its method's other networks.
        recipe: the recipe that its row is named after, at the scales of the paper and of the released code.
    """

    name: str
    method: str
    role: DataRole = "places"
    changes: Mapping[str, Any] = field(default_factory=dict)
    recipe: str | None = None


@dataclass(frozen=True)
class TableRow:
    """A network, and how it is measured.

    Attributes:
        label: as in the paper's table; claims refer to the row by it.
        training: the network; None for the pretrained backbone's features without training.
        paper: the paper's values, empty if it has no such row.
        note: what differs here, printed after the label.
        rotate: rotation of the queries in degrees counter-clockwise.
        parts: 1-based parts used, None for all.
        branch: the branch that describes landmarks.
        quoted: the paper quotes the row from other work; nothing is trained or measured.
    """

    label: str
    training: Training | None
    paper: paper_values.PrintedValues = ()
    note: str = ""
    rotate: float = 0.0
    parts: tuple[int, ...] | None = None
    branch: View | None = None
    quoted: bool = False


@dataclass(frozen=True)
class PaperTable:
    """A table or figure of the paper.

    Attributes:
        key: such as "table1".
        title: the comparison, without the data set.
        measure: the measure of its columns.
        columns: their names.
    """

    key: str
    title: str
    measure: Measure
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]

    @property
    def trainings(self) -> list[Training]:
        """The networks it needs, each once."""
        return list({row.training.name: row.training for row in self.rows if row.training}.values())


@dataclass(frozen=True)
class Scale:
    """The recipes of a reproduction.

    Attributes:
        name: "paper", "released", or "reduced".
        places, panoramas: the recipe of each role before a method's changes, or its name.
        safa: SAFA's own recipe, if it has one.
        sizes: input size used for each of Table III's.
        note: one sentence for the table's notes.
        changes: the user's changes of every recipe.
        protocol: "released" for turned queries and the transfer to landmarks as their authors released them.
    """

    name: str
    places: Recipe | str
    panoramas: Recipe | str
    safa: str | None
    sizes: Mapping[int, int]
    note: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    protocol: Literal["ours", "released"] = "ours"

    @property
    def released(self) -> bool:
        """True if networks are measured as the released test code does."""
        return self.protocol == "released"

    def recipe(self, training: Training, seed: int) -> Recipe:
        """Return the recipe of a training. What tells the rows apart comes after the user's changes.

        Raises:
            InputError: if the user's changes do not fit the training.
        """
        named, kept = self._unchanged(training), self.kept(training)
        changes = {name: value for name, value in self.changes.items() if name not in kept}
        changes |= {**training.changes, "seed": seed}
        if not str(changes.get("backbone", "vgg16")).startswith("vgg16"):
            # SAFA's recipe has a dropout in its VGG-16.
            changes.setdefault("backbone_dropout", 0.0)
        try:
            return replace(named, **changes)
        except InputError as error:
            raise InputError(f"{training.name} cannot be trained with these flags: {error}") from None

    def kept(self, training: Training) -> tuple[str, ...]:
        """Name the user's changes that a training does not take, because its row or its own recipe sets them."""
        own = set(training.changes)
        if training.role == "panoramas" and self._unchanged(training).lr != self._places.lr:
            own.add("lr")  # each released script has its own, ten times apart
        if training.method.startswith("safa"):
            own |= {"size", "width"} if self.safa is None else {"size", "width", "lr", "optimizer"}
        if str(self.changes.get("backbone", self._unchanged(training).backbone)).startswith("vgg16"):
            # A VGG has no such layer.
            own.add("last_layer")
        return tuple(name for name in self.changes if name in own)

    def _unchanged(self, training: Training) -> Recipe:
        if training.method in recipes.METRIC_LOSSES and isinstance(self.places, str):
            return recipes.find("metric-released", training.method)
        if training.recipe is not None and isinstance(self.panoramas, str):
            return RECIPES[training.recipe]
        base = self.places if training.role == "places" else self.panoramas
        if training.method.startswith("safa") and self.safa is not None:
            base = self.safa
        return recipes.find(base, training.method) if isinstance(base, str) else recipes.method(training.method, base)

    @property
    def base(self) -> Recipe:
        """The recipe of places, with the user's changes of backbone and input size."""
        changes = {name: value for name, value in self.changes.items() if name in _NETWORK}
        return replace(self._places, **changes)

    @property
    def _places(self) -> Recipe:
        return RECIPES[self.places] if isinstance(self.places, str) else self.places


# Settings of a network without training.
_NETWORK = ("backbone", "last_layer", "size", "width")
# Settings that tell the rows of the tables apart; the user cannot change them for all rows.
ROW_SETTINGS = (
    "n_parts", "layout", "pooling", "polar", "maps", "street", "google", "linear", "instance", "metric", "positives", "pool",
    "metric_per_part", "margin", "seed",
)  # fmt: skip

_REDUCED = replace(RECIPES["world"], epochs=30, infonce=0.0)

SCALES: dict[str, Scale] = {
    "paper": Scale(
        "paper",
        "paper",
        "cvusa-paper",
        "safa-released",
        {size: size for size in paper_values.TABLE3},
        "Recipes paper, cvusa-paper, and safa-paper: what the papers state. Metric losses: metric-released, as released.",
    ),
    "released": Scale(
        "released",
        "released",
        "cvusa-released",
        "safa-released",
        {size: size for size in paper_values.TABLE3},
        "Recipes released, cvusa-released, safa-released, and metric-released: as the released scripts train.",
        protocol="released",
    ),
    "reduced": Scale(
        "reduced",
        _REDUCED,
        replace(_REDUCED, satellite_rotation=0.0, place_rotation=180.0, rotation=0.0),
        None,
        {size: size // 2 for size in paper_values.TABLE3},
        "Reduced scale, the same budget for every row: ResNet-18 cut after layer3, 30 epochs, 32 places a step, AdamW at 0.0005 "
        "with a cosine; label smoothing 0.1; a moving average of the weights (0.99); one BatchNorm over views that share "
        "weights; losses averaged over parts and views; pictures of 256 x 256 pixels, and of 112 x 616 where tiles are unrolled. "
        "Satellites "
        "are turned at random over the full circle in training, panoramas and their tiles together.",
    ),
}

_UNROLLED = {"shared": False, "polar": True, "size": 112, "width": 616}
_LPN = Training("lpn", "lpn", changes={"n_parts": 4})
_LPN_ONLY = Training("lpn-without-google", "lpn", changes={"n_parts": 4, "google": False})
_BASELINE = Training("instance", "instance")
_SEQUENTIAL = Training("panorama-lpn-sequential", "lpn-sequential", "panoramas", recipe="cvusa-paper")
_PANORAMA_LPN = Training("panorama-lpn", "lpn-cvusa", "panoramas", recipe="cvusa-released")
_SAFA = Training("panorama-safa", "safa", "panoramas")
_SAFA_LPN = Training("panorama-safa-lpn", "safa-lpn", "panoramas")

# The networks that each drawn picture shows, by name of the file. The first is Figure 8's.
SHOWN: dict[str, tuple[Training, ...]] = {
    "figure1": (_BASELINE, _LPN),
    "figure7a": (_BASELINE, _LPN),
    "figure7b": (_SAFA, _SAFA_LPN),
    "figure8": (_LPN,),
    "figure8-panoramas": (_SAFA_LPN,),
}
# The pictures of each drawn figure.
DRAWN = {"figure1": ("figure1",), "figure7": ("figure7a", "figure7b"), "figure8": ("figure8", "figure8-panoramas")}


def _of_parts(n: int) -> Training:
    if n == 1:
        return _BASELINE
    return _LPN if n == 4 else Training(f"lpn-{n}-parts", "lpn", changes={"n_parts": n})


def tables(scale: Scale) -> dict[str, PaperTable]:
    """Return all tables and measured figures by key."""
    by_loss = {"contrastive": "Contrastive loss", "triplet-0.3": "Triplet loss, margin 0.3"}
    by_loss |= {"triplet-0.5": "Triplet loss, margin 0.5", "soft-margin": "Weighted soft-margin triplet loss"}
    of_table1 = [("Instance loss (baseline)", _BASELINE)]
    of_table1 += [(label, Training(name, name)) for name, label in by_loss.items()]
    of_table1 += [("LPN without google", _LPN_ONLY), ("LPN", _LPN)]
    of_table2 = [
        ("Instance loss (baseline)", Training("panorama-instance", "instance", "panoramas", {"shared": False})),
        ("LPN, sequential partition", _SEQUENTIAL),
        ("LPN, rings and rows", _PANORAMA_LPN),
        ("Instance loss, unrolled tiles", Training("panorama-instance-unrolled", "instance", "panoramas", _UNROLLED)),
        ("LPN, strips of unrolled tiles", Training("panorama-lpn-strips", "lpn-strips", "panoramas", _UNROLLED)),
        ("SAFA", _SAFA),
        ("SAFA + LPN", _SAFA_LPN),
    ]
    both_ways = {
        "table1": (
            "Table I: losses and LPN",
            [TableRow(label, training, paper_values.TABLE1[label]) for label, training in of_table1],
        ),
        "table3": (
            "Table III: input size",
            [_of_size(size, scale, values) for size, values in paper_values.TABLE3.items()],
        ),
        "table4": (
            "Table IV: turned queries",
            [TableRow(f"LPN, {angle}°", _LPN, values, rotate=angle) for angle, values in paper_values.TABLE4.items()]
            + [TableRow(f"Baseline, {angle}°", _BASELINE, rotate=angle) for angle in paper_values.TABLE4],
        ),
        "table5": (
            "Table V: parts used",
            [
                TableRow(label, _LPN, values, parts=tuple(int(part) for part in label.split("+")))
                for label, values in paper_values.TABLE5.items()
            ],
        ),
        "figure5": (
            "Figure 5: number of parts",
            [TableRow(f"n = {n}", _of_parts(n), paper_values.FIGURE5.get(n, ())) for n in (1, 2, 4, 6, 8)],
        ),
    }
    by_name = {
        key: PaperTable(key, title, "both ways", paper_values.BOTH_WAYS, tuple(rows))
        for key, (title, rows) in both_ways.items()
    }
    by_name["table2"] = PaperTable(
        "table2",
        "Table II: ground to satellite",
        "ground",
        paper_values.GROUND,
        tuple(TableRow(label, None, values, quoted=True) for label, values in paper_values.TABLE2_QUOTED.items())
        + tuple(
            TableRow(label, training, paper_values.TABLE2.get(label, ()), _own_recipe(training, scale))
            for label, training in of_table2
        ),
    )
    by_name["table6"] = PaperTable(
        "table6", "Table VI: features carried over to landmarks", "landmarks", paper_values.LANDMARKS, _carried()
    )
    by_name["figure7"] = PaperTable(
        "figure7",
        "Figure 7: activation in the centre",
        "centre",
        paper_values.CENTRE,
        (TableRow("Baseline, n = 1", _BASELINE), TableRow("LPN, n = 4", _LPN)),
    )
    return dict(sorted(by_name.items(), key=lambda item: (item[0].startswith("figure"), item[0])))


def _own_recipe(training: Training, scale: Scale) -> str:
    return f"recipe {training.recipe}" if training.recipe and isinstance(scale.panoramas, str) else ""


def _of_size(size: int, scale: Scale, values: paper_values.Values) -> TableRow:
    ours = scale.sizes[size]
    same = ours == scale.base.size
    training = _LPN if same else Training(f"lpn-{ours}-pixels", "lpn", changes={"n_parts": 4, "size": ours})
    return TableRow(str(size), training, values, "" if ours == size else f"here {ours}")


def _carried() -> tuple[TableRow, ...]:
    labels = list(paper_values.TABLE6)
    branches: tuple[View, View] = ("satellite", "street")
    rows = [TableRow(labels[0], None, paper_values.TABLE6[labels[0]], branch="street")]
    of_branch = [(training, branch) for training in (_BASELINE, _LPN) for branch in branches]
    for label, (training, branch) in zip(labels[1:], of_branch, strict=True):
        rows.append(TableRow(label, training, paper_values.TABLE6[label], branch=branch))
    return tuple(rows)


def find(key: str, scale: Scale) -> PaperTable:
    """Return the table or measured figure of a key.

    Raises:
        InputError: when there is none.
    """
    known = tables(scale)
    if key not in known:
        raise InputError(
            f"There is no {key!r} to reproduce; choose one of {', '.join(known)}, figure1, figure8, or all."
        )
    return known[key]
