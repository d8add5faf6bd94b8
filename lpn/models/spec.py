"""What an LPN is made of, as plain data: shared by training, checkpoints, export, and the engine (no torch here)."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, cast

from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import printable
from lpn.core.formats import UPGRADE
from lpn.core.views import VIEWS, View
from lpn.models.partition import WEIGHTINGS, Partition, Weighting

Activation = Literal["none", "leaky_relu"]
Layout = Literal["university", "cvusa", "strips"]
Pooling = Literal["average", "safa"]

_ALLOWED: dict[str, tuple[Any, ...]] = {
    "backbone": ("resnet18", "resnet50", "vgg16_bn"),
    "last_layer": ("layer3", "layer4"),
    "shared": (True, False),
    "layout": ("university", "cvusa", "strips"),
    "pooling": ("average", "safa"),
    "polar": (True, False),
    "weighting": WEIGHTINGS,
    "activation": ("none", "leaky_relu"),
}

_MOST = {
    "n_parts": 256,
    "embedding": 1 << 17,
    "classes": 1 << 24,
    "last_stride": 8,
    "maps": 256,
    "input_size": 4096,
}
"""Far beyond any network that makes sense: a file that claims more would take all memory, or forever."""


@dataclass(frozen=True)
class ModelSpec:
    """The architecture of an LPN.

    Attributes:
        backbone: "resnet18", "resnet50", or "vgg16_bn".
        last_layer: where a ResNet ends, "layer3" or "layer4".
        last_stride: stride of a ResNet's layer4, 1 (published) or 2.
        views: the views with a branch, in the order satellite, street, drone.
        shared: satellite and drone (or, without a drone, satellite and street) use the same weights.
        n_parts: parts per descriptor; 1 is the baseline.
        layout: "university" (square rings for every view), "cvusa" (rings outside in for the satellite, rows for
            the street), or "strips" (columns for every view, the paper's Figure 4).
        pooling: what becomes of a part. "average" pools it and embeds the mean by the part's head (LPN); "safa" describes it
            by `maps` sums over its cells, weighted by spatial-aware layers (Shi et al. 2019), without a head; its parts
            are columns, overlapping where n does not divide the map.
        maps: weighted sums per part with "safa"; the embedding then has maps x channels numbers.
        polar: satellite tiles are unrolled around their centre first, as `images.polar` does.
        weighting: how a ring is averaged, see `Partition`.
        activation: between BatchNorm and Dropout in the head; "none" as released.
        embedding: dimension D of a part's embedding.
        classes: size of the class layer used in training.
        dropout: probability in the head, in training only.
        input_size: (height, width) in pixels of the picture the network is fed.
    """

    backbone: str = "resnet50"
    last_layer: str = "layer4"
    last_stride: int = 1
    views: tuple[View, ...] = ("satellite", "street", "drone")
    shared: bool = True
    n_parts: int = 4
    layout: Layout = "university"
    weighting: Weighting = "published"
    activation: Activation = "none"
    embedding: int = 512
    classes: int = 701
    dropout: float = 0.5
    input_size: tuple[int, int] = (256, 256)
    pooling: Pooling = "average"
    maps: int = 8
    polar: bool = False

    def __post_init__(self) -> None:
        if not self.views or any(view not in VIEWS for view in self.views):
            raise InputError(f"The views are {self.views}; expected one to three of {', '.join(VIEWS)}.")
        object.__setattr__(self, "views", tuple(v for v in VIEWS if v in self.views))
        for name, most in _MOST.items():
            if name != "input_size":
                _check_count(name, getattr(self, name), most)
        if len(self.input_size) != 2:
            raise InputError(f"The input size is {self.input_size}; expected height and width.")
        for side in self.input_size:
            _check_count("input_size", side, _MOST["input_size"])
        for name, allowed in _ALLOWED.items():
            if getattr(self, name) not in allowed:
                raise InputError(
                    f"The model's {name} is {getattr(self, name)!r}; expected one of {', '.join(map(str, allowed))}."
                )
        if not isinstance(self.dropout, int | float) or not 0 <= self.dropout < 1:
            raise InputError(f"The model's dropout is {self.dropout!r}; expected a number from 0 up to 1.")

    def partition(self, view: View) -> Partition:
        """How the feature map of `view` is cut."""
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
        """The view whose branch holds the weights used for `view`."""
        if not self.shared or view == "satellite" or "satellite" not in self.views:
            return view
        return "satellite" if view == "drone" or "drone" not in self.views else view

    def groups(self) -> list[tuple[View, ...]]:
        """Views that share weights and partition, and therefore one exported graph."""
        keys = {view: (self.owner(view), self.partition(view)) for view in self.views}
        ordered = list(dict.fromkeys(keys.values()))
        return [tuple(view for view in self.views if keys[view] == key) for key in ordered]

    @property
    def mirrored(self) -> bool:
        """Whether a descriptor adds the mirrored picture's, as published for LPN; SAFA's layers know left from right."""
        return self.pooling == "average"

    def unrolled(self, view: View) -> bool:
        """Whether pictures of `view` are unrolled around their centre before the network sees them."""
        return self.polar and view == "satellite"

    def to_json(self) -> str:
        """One line of JSON, read back by `from_json`."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> ModelSpec:
        """Read what `to_json` wrote.

        Raises:
            ModelFileError: when the text is not such a description.
        """
        try:
            values: Any = json.loads(text)
            known = {field.name for field in fields(cls)}
            if not isinstance(values, dict):
                raise ValueError("no entries")
            if further := sorted(set(cast("dict[str, Any]", values)) - known):
                raise ModelFileError(
                    f"The model's description has an entry {printable(further[0])[:40]!r}, which this version of lpn does not "
                    f"know; {UPGRADE}, or export or train it again."
                )
            values["views"] = tuple(values["views"])
            values["input_size"] = tuple(values["input_size"])
            return cls(**values)
        except (ValueError, KeyError, TypeError, InputError) as error:
            raise ModelFileError(
                f"The model's description cannot be read ({error}); export or train it again."
            ) from error

    def describe(self) -> str:
        """One line for a header or a log: "LPN resnet18/layer3, n = 4, 256 x 256"."""
        backbone = self.backbone if self.last_layer == "layer4" else f"{self.backbone}/{self.last_layer}"
        name = "Baseline" if self.n_parts == 1 else "LPN"
        if self.pooling == "safa":
            name = "SAFA" if self.n_parts == 1 else "SAFA + LPN"
        return f"{name} {backbone}, n = {self.n_parts}, {self.input_size[0]} x {self.input_size[1]}"


def _check_count(name: str, value: Any, most: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= most:
        raise InputError(f"The model's {name} is {value!r}; expected a whole number from 1 to {most}.")
