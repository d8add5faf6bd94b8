"""The architecture of an LPN as plain data, shared by training, checkpoints, export, and the engine; no torch here."""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, dataclass, fields
from functools import cache
from typing import Annotated, Any, Literal, cast, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import printable
from lpn.core.formats import UPGRADE
from lpn.core.views import VIEWS, View
from lpn.models.contract import Contract
from lpn.models.partition import Partition, Weighting

BACKBONES = ("resnet18", "resnet50", "vgg16", "vgg16_bn")
Activation = Literal["none", "relu", "leaky_relu"]
Layout = Literal["university", "cvusa", "strips"]
Pooling = Literal["average", "safa"]

# The slope of each activation below zero.
SLOPES: dict[Activation, float] = {"none": 1.0, "relu": 0.0, "leaky_relu": 0.1}

# The methods that `ModelSpec` describes.
METHODS = ("LPN", "Baseline", "SAFA", "SAFA + LPN")
# Prefix of timm's networks. They are our backbones, not the paper's.
TIMM = "timm:"
_TIMM_NAME = re.compile(r"timm:[A-Za-z0-9_]{1,80}")

# Far beyond any sensible network; a larger claim in a file would take all memory.
_Few = Annotated[int, Meta(ge=1, le=256)]
_Side = Annotated[int, Meta(ge=1, le=4096)]
_Rate = Annotated[float, Meta(ge=0, lt=1)]
# msgspec's error terms in words.
_WORDS = {
    "`float`": "a number",
    "`int`": "a whole number",
    "`str`": "a text",
    "`bool`": "true or false",
    "`array`": "a list",
    ">=": "of at least",
    "<=": "of at most",
    ">": "above",
    "<": "below",
}


@dataclass(frozen=True)
class ModelSpec:
    """The architecture of an LPN.

    Attributes:
        backbone: one of `BACKBONES`, or "timm:" and the name of a network of timm, whose last map is taken.
        last_layer: of a ResNet: "layer4" for the whole network, or "layer3" for its stages of stride 16.
        last_stride: stride of a ResNet's layer4: 1 (published, the map stays at 1/16) or 2 (as ImageNet's weights were trained,
            1/32).
        views: the views with a branch, in the order satellite, street, drone.
        shared: whether satellite and drone (without a drone, satellite and street) share weights.
        n_parts: parts per descriptor; 1 is the baseline.
        layout: "university" (square rings for every view), "cvusa" (rings from the outside in for the satellite, rows for
            the street), or "strips" (columns for every view, the paper's Figure 4).
        pooling: "average" embeds the mean of each part by its head (LPN). "safa" describes each part by `maps` sums over its
            cells, weighted by spatial-aware layers (Shi et al. 2019), without a head. Its parts are columns, which
            overlap if n does not divide the map. A VGG-16 then keeps the last row and column of odd maps.
        maps: weighted sums per part with "safa" (released: 8 for SAFA, 1 for SAFA + LPN); the embedding then has
            maps x channels numbers.
        polar: whether satellite tiles are first unrolled around their centre, by `images.polar`.
        weighting: the average over a ring, see `Partition`.
        activation: between BatchNorm and Dropout in the head: "none" as released, "relu" as the paper draws it, or
            "leaky_relu", an option of the released code.
        embedding: dimension D of a part's embedding.
        classes: size of the class layer used in training.
        dropout: its probability in the head, in training only.
        backbone_dropout: its probability after conv4_1 to conv5_3 of a VGG-16, in training only.
        input_size: (height, width) of the network input in pixels.
    """

    backbone: str = "resnet50"
    last_layer: Literal["layer3", "layer4"] = "layer4"
    last_stride: Annotated[int, Meta(ge=1, le=8)] = 1
    views: tuple[View, ...] = ("satellite", "street", "drone")
    shared: bool = True
    n_parts: _Few = 4
    layout: Layout = "university"
    weighting: Weighting = "published"
    activation: Activation = "none"
    embedding: Annotated[int, Meta(ge=1, le=1 << 17)] = 512
    classes: Annotated[int, Meta(ge=1, le=1 << 24)] = 701
    dropout: _Rate = 0.5
    input_size: tuple[_Side, _Side] = (256, 256)
    pooling: Pooling = "average"
    maps: _Few = 8
    polar: bool = False
    backbone_dropout: _Rate = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.views, list | tuple) or not self.views or any(view not in VIEWS for view in self.views):
            raise InputError(f"The views are {self.views}; expected one to three of {', '.join(VIEWS)}.")
        check_fields(self, "model")
        object.__setattr__(self, "views", tuple(v for v in VIEWS if v in self.views))
        if self.backbone not in BACKBONES and not is_timm(self.backbone):
            raise InputError(
                f"The model has backbone = {self.backbone!r}; expected one of {', '.join(BACKBONES)}, timm:NAME."
            )
        if self.backbone_dropout and not self.backbone.startswith("vgg16"):
            raise InputError(
                f"The model has backbone_dropout = {self.backbone_dropout} with {self.backbone}, which has no dropout; set it "
                "to 0, or use vgg16."
            )

    def partition(self, view: View) -> Partition:
        """Return the partition of the feature map of `view`."""
        if self.pooling == "safa":
            return Partition("windows", self.n_parts)
        if self.n_parts == 1:
            return Partition("whole", 1)
        if self.layout == "strips":
            return Partition("columns", self.n_parts)
        if self.layout == "cvusa":
            if view == "street":
                return Partition("rows", self.n_parts)
            return Partition("rings", self.n_parts, self.weighting, outside_in=True, align_corners=False)
        return Partition("rings", self.n_parts, self.weighting)

    def owner(self, view: View) -> View:
        """Return the view whose branch owns the weights for `view`."""
        if not self.shared or view == "satellite" or "satellite" not in self.views:
            return view
        return "satellite" if view == "drone" or "drone" not in self.views else view

    def groups(self) -> list[tuple[View, ...]]:
        """Return the groups of views that share weights and partition, and so one exported graph."""
        keys = {view: (self.owner(view), self.partition(view)) for view in self.views}
        ordered = list(dict.fromkeys(keys.values()))
        return [tuple(view for view in self.views if keys[view] == key) for key in ordered]

    @property
    def method(self) -> str:
        """The method's name, one of `METHODS`."""
        if self.pooling == "safa":
            return "SAFA" if self.n_parts == 1 else "SAFA + LPN"
        return "Baseline" if self.n_parts == 1 else "LPN"

    def contract(self) -> Contract:
        """Return the contract of a model of this architecture."""
        held = "the slopes of the activation" if self.activation != "none" else ""
        held = "the weights of each picture's cells" if self.pooling == "safa" else held
        return Contract(
            method=self.method,
            title=self.describe(),
            views=self.views,
            input_size=self.input_size,
            n_parts=self.n_parts,
            embedding=self.embedding,
            level="exact, with held" if held else "exact",
            held=held,
            groups=tuple(self.groups()),
            # SAFA distinguishes left from right.
            mirror="none" if self.pooling == "safa" else "sum",
            partitions={view: self.partition(view) for view in self.views},
            polar=("satellite",) if self.polar else (),
        )

    def to_json(self) -> str:
        """Return one line of JSON for `from_json`."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> ModelSpec:
        """Read the output of `to_json`; ModelFileError if the text is not such a description."""
        try:
            values = msgspec.json.decode(text, type=dict[str, Any])
            if unknown := sorted(set(values) - {field.name for field in fields(cls)}):
                raise ModelFileError(
                    f"The model's description has an entry {printable(unknown[0])[:40]!r}, which this version of lpn does not "
                    f"know; {UPGRADE}, or export or train it again."
                )
            return msgspec.convert(values, cls)
        except (msgspec.MsgspecError, ValueError, RecursionError, InputError) as error:
            raise ModelFileError(
                f"The model's description cannot be read ({error}); export or train it again."
            ) from error

    def describe(self) -> str:
        """Return one line for a header or a log: "LPN resnet18/layer3, n = 4, 256 x 256"."""
        backbone = self.backbone if self.last_layer == "layer4" else f"{self.backbone}/{self.last_layer}"
        return f"{self.method} {backbone}, n = {self.n_parts}, {self.input_size[0]} x {self.input_size[1]}"


def is_timm(backbone: Any) -> bool:
    """Return whether a backbone has the name of a network of timm; only timm knows whether it exists."""
    return isinstance(backbone, str) and _TIMM_NAME.fullmatch(backbone) is not None


def check_fields(record: Any, what: str) -> None:
    """Raise InputError for a value of a dataclass outside the range in its field's annotation.

    Args:
        what: the record in the message, such as "recipe".
    """
    for name, hint in _hints(cast(Any, type(record))).items():
        value = getattr(record, name)
        try:
            msgspec.convert(value, hint)
            expected = "" if not isinstance(value, float) or math.isfinite(value) else "a finite number"
        except msgspec.ValidationError as error:
            expected = str(error).removeprefix("Expected ").partition(" - at")[0]
            for term, words in _WORDS.items():
                expected = expected.replace(term, words)
            if get_origin(hint) is Literal:
                expected = f"one of {', '.join(map(str, get_args(hint)))}"
        if expected:
            shown = printable(str(value)[:120])
            raise InputError(f"The {what} has {name} = {shown}; expected {expected}.")


@cache
def _hints(record: Any) -> dict[str, Any]:
    return get_type_hints(record, include_extras=True)
