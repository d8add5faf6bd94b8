"""The paper's tables as data: the network of each row, and how it is measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.reproduce import paper_values
from lpn.training.recipes import RECIPES, Recipe, method

Role = Literal["places", "panoramas"]
Measure = Literal["both ways", "ground", "landmarks"]


@dataclass(frozen=True)
class Training:
    """A network that rows need.

    Attributes:
        name: of its run, such as "lpn" or "instance".
        method: one of `lpn.training.recipes.METHODS`.
        role: the training data: places seen by satellite, drone, and from the street, or pairs of panorama and tile.
        changes: further changes of the recipe.
    """

    name: str
    method: str
    role: Role = "places"
    changes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class TableRow:
    """A network, and how it is measured.

    Attributes:
        label: as in the table.
        training: the network; None for the pretrained backbone's features without training.
        paper: the paper's values, empty if it has no such row.
        rotate: rotation of the queries in degrees counter-clockwise.
        parts: 1-based parts used, None for all.
        branch: the branch that describes landmarks.
    """

    label: str
    training: Training | None
    paper: paper_values.Values = ()
    rotate: float = 0.0
    parts: tuple[int, ...] | None = None
    branch: View | None = None


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
    """The scale of a reproduction.

    Attributes:
        name: "paper" or "reduced".
        places, panoramas: the recipe of each role, before a method's changes.
        safa: SAFA's own recipe, if it has one.
        sizes: input size used for each of Table III's.
        note: one sentence for the table's notes.
    """

    name: str
    places: Recipe
    panoramas: Recipe
    safa: Recipe | None
    sizes: Mapping[int, int]
    note: str

    def recipe(self, training: Training, seed: int, changes: Mapping[str, Any]) -> Recipe:
        """Return the recipe of a training; `changes` are the user's and are applied last."""
        base = self.places if training.role == "places" else self.panoramas
        if training.method.startswith("safa") and self.safa is not None:
            base = self.safa
        return replace(method(training.method, base), **{**training.changes, "seed": seed, **changes})


_REDUCED = replace(RECIPES["world"], epochs=30, infonce=0.0)

SCALES: dict[str, Scale] = {
    "paper": Scale(
        "paper",
        RECIPES["paper"],
        RECIPES["cvusa-paper"],
        RECIPES["safa-paper"],
        {size: size for size in paper_values.TABLE3},
        "The paper's scale: ResNet-50 on places and VGG-16 on panoramas, 120 epochs; SAFA by its own recipe, 100 epochs of Adam.",
    ),
    "reduced": Scale(
        "reduced",
        _REDUCED,
        replace(_REDUCED, satellite_rotation=0.0, place_rotation=180.0, rotation=0.0),
        None,
        {size: size // 2 for size in paper_values.TABLE3},
        "Reduced scale, the same budget for every row: ResNet-18 cut after layer3, 30 epochs, 32 places a step, AdamW at 0.0005 "
        "with a cosine; pictures of 256 x 256 pixels, and of 112 x 616 where tiles are unrolled. Satellites "
        "are turned at random over the full circle in training, panoramas and their tiles together.",
    ),
}

_UNROLLED = {"shared": False, "polar": True, "size": 112, "width": 616}
_LPN = Training("lpn", "lpn", changes={"n_parts": 4})
_LPN_ONLY = Training("lpn-without-google", "lpn", changes={"n_parts": 4, "google": False})
_BASELINE = Training("instance", "instance", changes={"google": False})


def _of_parts(n: int) -> Training:
    if n == 1:
        return _BASELINE
    return _LPN_ONLY if n == 4 else Training(f"lpn-{n}-parts", "lpn", changes={"n_parts": n, "google": False})


def tables(scale: Scale) -> dict[str, PaperTable]:
    """Return all tables and figures by key."""
    by_loss = {"contrastive": "Contrastive loss", "triplet-0.3": "Triplet loss, margin 0.3"}
    by_loss |= {"triplet-0.5": "Triplet loss, margin 0.5", "soft-margin": "Weighted soft-margin triplet loss"}
    of_table1 = [("Instance loss (baseline)", _BASELINE)]
    of_table1 += [(label, Training(name, name, changes={"google": False})) for name, label in by_loss.items()]
    of_table1 += [("LPN without google", _LPN_ONLY), ("LPN", _LPN)]
    of_table2 = [
        ("Instance loss (baseline)", Training("panorama-instance", "instance", "panoramas", {"shared": False})),
        ("LPN, rings and rows", Training("panorama-lpn", "lpn-cvusa", "panoramas")),
        ("Instance loss, unrolled tiles", Training("panorama-instance-unrolled", "instance", "panoramas", _UNROLLED)),
        ("LPN, strips of unrolled tiles", Training("panorama-lpn-strips", "lpn-strips", "panoramas", _UNROLLED)),
        ("SAFA", Training("panorama-safa", "safa", "panoramas")),
        ("SAFA + LPN", Training("panorama-safa-lpn", "safa-lpn", "panoramas")),
    ]
    return {
        table.key: table
        for table in (
            PaperTable(
                "table1",
                "Table I: losses and LPN",
                "both ways",
                paper_values.BOTH_WAYS,
                tuple(TableRow(label, training, paper_values.TABLE1[label]) for label, training in of_table1),
            ),
            PaperTable(
                "table2",
                "Table II: ground to satellite",
                "ground",
                paper_values.GROUND,
                tuple(TableRow(label, training, paper_values.TABLE2.get(label, ())) for label, training in of_table2),
            ),
            PaperTable(
                "table3",
                "Table III: input size",
                "both ways",
                paper_values.BOTH_WAYS,
                tuple(_of_size(size, scale, values) for size, values in paper_values.TABLE3.items()),
            ),
            PaperTable(
                "table4",
                "Table IV: turned queries",
                "both ways",
                paper_values.BOTH_WAYS,
                tuple(
                    TableRow(str(angle), _LPN, values, rotate=angle) for angle, values in paper_values.TABLE4.items()
                ),
            ),
            PaperTable(
                "table5",
                "Table V: parts used",
                "both ways",
                paper_values.BOTH_WAYS,
                tuple(
                    TableRow(label, _LPN, values, parts=tuple(int(part) for part in label.split("+")))
                    for label, values in paper_values.TABLE5.items()
                ),
            ),
            PaperTable(
                "table6",
                "Table VI: features carried over to landmarks",
                "landmarks",
                paper_values.LANDMARKS,
                _carried(),
            ),
            PaperTable(
                "figure5",
                "Figure 5: number of parts",
                "both ways",
                paper_values.BOTH_WAYS,
                tuple(TableRow(f"n = {n}", _of_parts(n)) for n in (1, 2, 4, 6, 8)),
            ),
        )
    }


def _of_size(size: int, scale: Scale, values: paper_values.Values) -> TableRow:
    ours = scale.sizes[size]
    same = ours == scale.places.size
    label = str(size) if ours == size else f"{size} (here {ours})"
    return TableRow(
        label, _LPN if same else Training(f"lpn-{ours}-pixels", "lpn", changes={"n_parts": 4, "size": ours}), values
    )


def _carried() -> tuple[TableRow, ...]:
    labels = list(paper_values.TABLE6)
    branches: tuple[View, View] = ("satellite", "street")
    rows = [TableRow(labels[0], None, paper_values.TABLE6[labels[0]], branch="street")]
    of_branch = [(training, branch) for training in (_BASELINE, _LPN_ONLY) for branch in branches]
    for label, (training, branch) in zip(labels[1:], of_branch, strict=True):
        rows.append(TableRow(label, training, paper_values.TABLE6[label], branch=branch))
    return tuple(rows)


def find(key: str, scale: Scale) -> PaperTable:
    """Return the table or figure of a key.

    Raises:
        InputError: when there is none.
    """
    known = tables(scale)
    if key not in known:
        raise InputError(
            f"There is no {key!r} to reproduce; choose one of {', '.join(known)}, figure7, figure8, or all."
        )
    return known[key]
