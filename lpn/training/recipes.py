"""Training recipes by name, each with all settings of a training, and the methods that the paper compares."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from lpn.core.errors import InputError
from lpn.models.partition import Weighting
from lpn.models.spec import Layout, Pooling

_ABOVE_ZERO = math.ulp(0.0)
_BELOW_ONE = math.nextafter(1.0, 0.0)
_MAX = sys.float_info.max
# Lowest and highest value of each number, and the range in words. NaN and infinity are never allowed.
_RANGES: dict[str, tuple[float, float, str]] = {
    # BatchNorm in the heads needs at least two samples.
    **dict.fromkeys(("batch",), (2, _MAX, "2 or more")),
    **dict.fromkeys(("n_parts", "epochs", "maps"), (1, _MAX, "1 or more")),
    # The five pooling layers of VGG divide the size by 32.
    "size": (32, _MAX, "32 or more"),
    **dict.fromkeys(("scale", "margin"), (0, 2, "a number from 0 to 2")),
    **dict.fromkeys(("lr", "temperature", "alpha"), (_ABOVE_ZERO, _MAX, "a number above 0")),
    **dict.fromkeys(("dropout", "ema"), (0, _BELOW_ONE, "a number from 0 up to, not including, 1")),
    **dict.fromkeys(
        ("label_smoothing", "black_corners", "own_canvas", "shift", "colour", "compression"),
        (0, 1, "a number from 0 to 1"),
    ),
    **dict.fromkeys(
        (
            "backbone_ratio",
            "decay_epoch",
            "warmup_epochs",
            "weight_decay",
            "instance",
            "infonce",
            "width",
            "rotation",
            "satellite_rotation",
            "place_rotation",
        ),
        (0, _MAX, "a number of 0 or more"),
    ),
    "seed": (0, 2**32 - 1, "a whole number from 0 to 4294967295"),
}


@dataclass(frozen=True)
class Recipe:
    """Every setting of a training. The defaults are the paper's recipe for University-1652."""

    backbone: Literal["resnet18", "resnet50", "vgg16_bn"] = "resnet50"
    """The backbone network."""
    last_layer: Literal["layer3", "layer4"] = "layer4"
    """Last layer of a ResNet; layer3 takes about half the time, and its map has the same resolution."""
    n_parts: int = 4
    """Parts of a descriptor; 1 is the baseline with global average pooling."""
    weighting: Weighting = "published"
    """Average over a ring: published (sum over the ring / area of its bounding box) or area (mean over the ring)."""
    shared: bool = True
    """Share weights between the satellite and the drone branch."""
    layout: Layout = "university"
    """Partition of the maps: university (rings in every view), cvusa (rings of the satellite tile, outermost first, and rows
    of the panorama), or strips (columns in every view, Figure 4)."""
    pooling: Pooling = "average"
    """Pooling of a part: average (mean, then a head) or safa (sums weighted by spatial-aware layers)."""
    maps: int = 8
    """Number of weighted sums per part with safa pooling."""
    polar: bool = False
    """Unroll satellite tiles around their centre into the shape of a panorama."""
    google: bool = True
    """Train the street branch also on the pictures in train/google, if that folder exists."""
    size: int = 256
    """Height of the network's input in pixels."""
    width: int = 0
    """Width of the network's input in pixels; 0 means the height."""
    dropout: float = 0.5
    """Dropout in the heads (0.5 in the paper; the released script passes 0.75)."""

    epochs: int = 120
    """Passes over all places, one picture of each view per place."""
    batch: int = 32
    """Places per step; a step has one picture of every view of each place."""
    optimizer: Literal["sgd", "adam", "adamw"] = "sgd"
    """Optimizer; sgd has Nesterov momentum 0.9."""
    lr: float = 0.01
    """Learning rate of the heads."""
    backbone_ratio: float = 0.1
    """Learning rate of the backbone relative to the heads'."""
    schedule: Literal["step", "cosine"] = "step"
    """Learning rate schedule: step (x 0.1 after `decay_epoch`) or cosine (down to 0 at the end)."""
    decay_epoch: int = 80
    """Epoch after which the step schedule decays."""
    warmup_epochs: int = 0
    """Epochs of linear warm-up of the learning rate from 0."""
    weight_decay: float = 5e-4
    """Weight decay."""
    ema: float = 0.0
    """Decay of an exponential moving average of the weights, which is saved and tested instead of them; 0 for none."""

    joint_views: bool = False
    """Put views that share weights into one batch, so that they share BatchNorm statistics; the released code does not."""
    instance: float = 1.0
    """Weight of the instance loss: cross-entropy over places, for each part and view (equation 4 of the paper)."""
    reduction: Literal["sum", "mean"] = "sum"
    """Reduction of the instance losses over parts and views: sum (paper) or mean (independent of their number)."""
    label_smoothing: float = 0.0
    """Label smoothing of the instance and the InfoNCE loss."""
    infonce: float = 0.0
    """Weight of a symmetric InfoNCE loss between each view's descriptors and the satellite's, over the batch."""
    temperature: float = 0.07
    """Temperature of the InfoNCE loss."""
    metric: Literal["none", "contrastive", "triplet", "soft_margin"] = "none"
    """Metric loss between each view's descriptors and the satellite's, over the batch: contrastive, triplet, or weighted
    soft-margin triplet."""
    margin: float = 0.3
    """Margin of the contrastive and the triplet loss, in Euclidean distance (0 to 2)."""
    alpha: float = 10.0
    """Factor inside the exponent of the soft-margin triplet loss."""
    mining: Literal["all", "hardest"] = "all"
    """Negatives of the metric loss: all other places of the batch, or only the hardest negative of each picture."""

    rotation: float = 0.0
    """Random rotation of each picture on its own, up to this many degrees either way."""
    satellite_rotation: float = 90.0
    """Further random rotation of satellite tiles, up to this many degrees either way."""
    place_rotation: float = 0.0
    """Random rotation of all views of a place together, up to this many degrees either way."""
    black_corners: float = 1.0
    """Probability that the corners of a rotated picture are black, as in rotated queries, instead of reflected."""
    own_canvas: float = 0.0
    """Probability that a picture is rotated before it is resized, as rotated queries are, rather than after."""
    shift: float = 10 / 256
    """Random shift as a fraction of the size; the default equals padding a 256-pixel picture by 10 pixels and cropping."""
    scale: float = 0.0
    """Random scale, from exp(-scale) to exp(scale)."""
    colour: float = 0.0
    """Strength, from 0 to 1, of random brightness, contrast, colour cast, and grey."""
    compression: float = 0.0
    """Probability that a picture is first compressed as JPEG, with a quality from 40 to 95."""
    flip: Literal["none", "picture", "place"] = "picture"
    """Random mirroring: none, each picture on its own (published), or all views of a place together."""

    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Arithmetic of the forward pass; auto is bfloat16 where the hardware has it, else float16 on CUDA and float32 elsewhere."""
    seed: int = 0
    """Random seed of initialisation, order, and augmentation."""

    def __post_init__(self) -> None:
        for name, (low, high, expected) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"The recipe has {name} = {value}; expected {expected}.")
        if self.backbone == "vgg16_bn" and self.last_layer != "layer4":
            raise InputError("The recipe has last_layer = layer3 with vgg16_bn, which has no such layer; use layer4.")
        if self.instance <= 0 and self.infonce <= 0 and self.metric == "none":
            raise InputError(
                "The recipe has no loss, as instance and infonce are 0 and metric is none; set one of them."
            )
        if self.pooling == "safa" and self.instance > 0:
            raise InputError(
                f"The recipe has instance = {self.instance} with safa, which has no class layer; set it to 0 and choose a metric."
            )

    @property
    def input_size(self) -> tuple[int, int]:
        """Height and width of the network's input in pixels."""
        return self.size, self.width or self.size

    def to_json(self) -> str:
        """Return one line of JSON."""
        return json.dumps(asdict(self))


_SMALL = Recipe(
    backbone="resnet18",
    last_layer="layer3",
    dropout=0.3,
    epochs=30,
    batch=32,
    optimizer="adamw",
    lr=5e-4,
    backbone_ratio=1.0,
    schedule="cosine",
    warmup_epochs=2,
    weight_decay=0.01,
    ema=0.99,
    joint_views=True,
    reduction="mean",
    label_smoothing=0.1,
    infonce=1.0,
    rotation=10.0,
    satellite_rotation=0.0,
    place_rotation=15.0,
    black_corners=0.5,
    own_canvas=0.5,
    shift=0.06,
    scale=0.15,
    colour=1.0,
    flip="place",
)

_CVUSA = Recipe(
    backbone="vgg16_bn",
    layout="cvusa",
    n_parts=8,
    shared=False,
    batch=16,
    lr=0.1,
    warmup_epochs=5,
    satellite_rotation=0.0,
    flip="place",
)

# university1652, cvusa: the recipes of the paper.
# safa: the recipe of SAFA (Shi et al. 2019), with panoramas of 112 x 616 pixels.
# small: fine-tuning an ImageNet backbone on a few hundred places. All drone pictures have the same heading.
# world: fine-tuning as in small. Drone pictures have any heading, as in a rendered world.
RECIPES: dict[str, Recipe] = {
    "university1652": Recipe(),
    "cvusa": _CVUSA,
    "safa": replace(
        _CVUSA,
        layout="university",
        n_parts=1,
        pooling="safa",
        polar=True,
        instance=0.0,
        metric="soft_margin",
        size=112,
        width=616,
        epochs=100,
        batch=32,
        optimizer="adam",
        lr=1e-5,
        backbone_ratio=1.0,
        decay_epoch=100,
        warmup_epochs=0,
        weight_decay=0.0,
        shift=0.0,
    ),
    "small": _SMALL,
    "world": replace(_SMALL, epochs=60, satellite_rotation=180.0, place_rotation=0.0, compression=0.5),
}

_INSTANCE_LOSS: dict[str, Any] = {
    "pooling": "average",
    "polar": False,
    "instance": 1.0,
    "infonce": 0.0,
    "metric": "none",
}
_BASELINE: dict[str, Any] = {**_INSTANCE_LOSS, "n_parts": 1, "layout": "university"}
_METRIC_LOSS: dict[str, Any] = {**_BASELINE, "instance": 0.0}
_SAFA: dict[str, Any] = {
    "layout": "university",
    "pooling": "safa",
    "polar": True,
    "shared": False,
    "instance": 0.0,
    "infonce": 0.0,
    "metric": "soft_margin",
    "size": 112,
    "width": 616,
}

# The methods that the paper compares. Each replaces the settings of a recipe that select the loss, and some others.
# lpn: LPN with square rings.
# instance: the baseline, global average pooling with the instance loss.
# contrastive, triplet-*, soft-margin: the baseline with a metric loss in place of the instance loss.
# lpn-cvusa: LPN with rings of the tile and rows of the panorama, as released.
# lpn-strips: LPN with columns of the panorama and of the unrolled tile.
# safa, safa-lpn: SAFA, alone and with strips.
METHODS: dict[str, dict[str, Any]] = {
    "lpn": {**_INSTANCE_LOSS, "layout": "university"},
    "instance": _BASELINE,
    "contrastive": {**_METRIC_LOSS, "metric": "contrastive", "margin": 1.0},
    "triplet-0.3": {**_METRIC_LOSS, "metric": "triplet", "margin": 0.3},
    "triplet-0.5": {**_METRIC_LOSS, "metric": "triplet", "margin": 0.5},
    "soft-margin": {**_METRIC_LOSS, "metric": "soft_margin"},
    "lpn-cvusa": {**_INSTANCE_LOSS, "layout": "cvusa", "n_parts": 8, "shared": False},
    "lpn-strips": {**_INSTANCE_LOSS, "layout": "strips", "n_parts": 8, "shared": False, "polar": True},
    "safa": {**_SAFA, "n_parts": 1},
    "safa-lpn": {**_SAFA, "n_parts": 8},
}


def method(name: str, recipe: Recipe) -> Recipe:
    """Apply a method of `METHODS` to a recipe.

    Raises:
        InputError: if there is no such method.
    """
    if name not in METHODS:
        raise InputError(f"There is no method {name!r}; choose one of {', '.join(METHODS)}.")
    return replace(recipe, **METHODS[name])
