"""The settings of a training: their defaults, their ranges, and their conflicts."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Literal, NamedTuple

from msgspec import Meta

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.views import View
from lpn.models.partition import Weighting
from lpn.models.spec import BACKBONES, Activation, Layout, Pooling, check_fields, is_timm

_Amount = Annotated[float, Meta(ge=0)]
_Share = Annotated[float, Meta(ge=0, le=1)]
_Count = Annotated[int, Meta(ge=0)]
_Number = Annotated[int, Meta(ge=1)]


@dataclass(frozen=True)
class Recipe:
    """Every setting of a training. The defaults are the recipe `paper`."""

    backbone: str = "resnet50"
    """The backbone network: resnet18, resnet50, vgg16, vgg16_bn, or, beyond the paper, timm:NAME with a network of timm,
    such as timm:convnext_tiny or timm:vit_small_patch16_224."""
    last_layer: Literal["layer3", "layer4"] = "layer4"
    """Last layer of a ResNet: layer4 for the whole network, or layer3 for its first part, which takes
    about half the time. The map of both has 1/16 of the size."""
    last_stride: Literal[1, 2] = 1
    """Stride of a ResNet's layer4: 1 (the paper, the map keeps 1/16) or 2 (as ImageNet's weights were trained, 1/32)."""
    n_parts: _Number = 4
    """Parts of a descriptor; 1 is the baseline with global average pooling."""
    weighting: Weighting = "area"
    """Average over a ring: area (mean over the ring, equation 3 of the paper) or published (sum over the ring / area of its
    bounding box, as in the released code)."""
    activation: Activation = "relu"
    """Activation of the heads between BatchNorm and dropout: relu (as the paper draws it), none (as released), or leaky_relu
    (an option of the released code, with slope 0.1)."""
    linear: bool = True
    """Begin each head with a linear layer to 512 numbers; without it a part has as many numbers as the map has channels."""
    shared: bool = True
    """Share weights between the satellite and the drone branch."""
    layout: Layout = "university"
    """Partition of the maps: university (rings in every view), cvusa (rings of the satellite tile, outermost first, and rows
    of the panorama), or strips (columns in every view, the sequential partition of Figure 4)."""
    pooling: Pooling = "average"
    """Pooling of a part: average (mean, then a head) or safa (sums weighted by spatial-aware layers)."""
    maps: _Number = 8
    """Number of weighted sums per part with safa pooling (released: 8 with SAFA, 1 with SAFA + LPN)."""
    polar: bool = False
    """Unroll satellite tiles around their centre into the shape of a panorama."""
    street: bool = True
    """Train the street branch, if there are street pictures."""
    google: bool = True
    """Train the street branch also on the pictures in train/google, if that folder exists."""
    size: Annotated[int, Meta(ge=32)] = 256
    """Height of the network's input in pixels."""
    width: _Count = 0
    """Width of the network's input in pixels; 0 means the height."""
    dropout: Annotated[float, Meta(ge=0, lt=1)] = 0.75
    """Probability of dropout in the heads."""
    backbone_dropout: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    """Dropout after conv4_1 to conv5_3 of a VGG-16 (0.2 in released SAFA)."""
    class_init: Literal["kaiming", "normal"] = "kaiming"
    """Initialisation of the class layers: kaiming (as the other layers of the classifier module, section IV-B) or normal
    (N(0, 0.001), as released)."""

    windows: _Count = 0
    """Windows of a map in an epoch, each a place of its own that is drawn anew; 0 trains on the pictures of a data set."""
    sampling: Literal["places", "pictures"] = "pictures"
    """Sampling of a batch: places (one picture of every set of each place of the batch) or pictures (each set is shuffled on
    its own, over its pictures, with its own labels; an epoch ends with the shortest set)."""
    epochs: _Number = 120
    """Passes over all places, or over the pictures of the shortest set."""
    batch: Annotated[int, Meta(ge=2)] = 32
    """Pictures of each set (satellite, drone, street, google) per step."""
    optimizer: Literal["sgd", "adam", "adamw"] = "sgd"
    """Optimizer; sgd has Nesterov momentum 0.9."""
    lr: Annotated[float, Meta(gt=0)] = 0.01
    """Learning rate of the heads."""
    backbone_ratio: _Amount = 0.1
    """Learning rate of the backbone relative to the heads'."""
    schedule: Literal["step", "cosine", "constant"] = "step"
    """Learning rate schedule: step (x 0.1 after `decay_epoch` and `second_decay_epoch`), cosine (down to 0 at the end), or
    constant."""
    decay_epoch: _Count = 80
    """Epoch after which the step schedule decays."""
    second_decay_epoch: _Count = 0
    """Epoch after which the step schedule decays once more; 0 for never."""
    warmup_epochs: _Count = 0
    """Epochs of linear warm-up."""
    warmup: Literal["rate", "loss"] = "rate"
    """Quantity whose factor rises step by step to 1 during the warm-up: the learning rate, or the loss."""
    warmup_start: _Share = 0.0
    """Factor from which the warm-up rises."""
    weight_decay: _Amount = 5e-4
    """Weight decay."""
    ema: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    """Decay of an exponential moving average of the weights, which is saved and tested instead of them; 0 for none."""

    joint_views: bool = False
    """Put views that share weights into one batch, so that they share BatchNorm statistics; the released code does not."""
    instance: _Amount = 1.0
    """Weight of the instance loss: cross-entropy over places, for each part and view (equations 5 and 6 of the paper)."""
    reduction: Literal["sum", "mean"] = "sum"
    """Reduction of the instance losses over parts and views: sum (paper) or mean (independent of their number)."""
    label_smoothing: _Share = 0.0
    """Label smoothing of the instance and the InfoNCE loss."""
    infonce: _Amount = 0.0
    """Weight of a symmetric InfoNCE loss between each view's descriptors and the satellite's, over the batch."""
    temperature: Annotated[float, Meta(gt=0)] = 0.07
    """Temperature of the InfoNCE loss."""
    metric: Literal["none", "contrastive", "triplet", "soft_margin"] = "none"
    """Metric loss: contrastive, triplet, or soft-margin triplet, on the cosines of satellites with the hardest drone picture
    of the same place, and the hardest of a pool of other places (layumi/University1652-triplet-loss). With safa pooling
    soft_margin, on the distances within the batch."""
    positives: _Number = 1
    """Drone pictures of each place in a step, among which a metric loss seeks the hardest."""
    pool: _Number = 96
    """Drone pictures, drawn anew each step, among which a metric loss seeks the hardest negative."""
    metric_per_part: bool = False
    """Compute the metric loss on each part alone and average over the parts, instead of once on the whole descriptor."""
    margin: Annotated[float, Meta(ge=0, le=2)] = 0.3
    """Margin of the triplet loss, in cosine (0 to 2)."""
    alpha: Annotated[float, Meta(gt=0)] = 10.0
    """Factor inside the exponent of the soft-margin triplet loss."""
    loss: str = ""
    """A loss of another package, by the name of its entry point in the group `lpn.losses`; it is added to the others."""
    loss_weight: _Amount = 1.0
    """Weight of `loss`."""

    rotation: _Amount = 0.0
    """Random rotation of each picture on its own, up to this many degrees either way."""
    satellite_rotation: _Amount = 90.0
    """Further random rotation of satellite tiles, up to this many degrees either way."""
    place_rotation: _Amount = 0.0
    """Random rotation of all views of a place together, up to this many degrees either way."""
    black_corners: _Share = 1.0
    """Probability that the corners of a rotated picture are black, as in rotated queries, instead of reflected."""
    own_canvas: _Share = 0.0
    """Probability that a picture is rotated before it is resized, as rotated queries are, rather than after."""
    interpolation: Literal["nearest", "cubic"] = "nearest"
    """Interpolation of rotated, shifted, and scaled pictures."""
    padding: Annotated[int, Meta(ge=0, le=4096)] = 10
    """Pixels by which a resized picture is padded on each side with its edge; after any rotation it is cropped to the input
    size at random whole pixels."""
    shift: _Share = 0.0
    """Random shift by any fraction of a pixel, up to this share of the size either way."""
    scale: Annotated[float, Meta(ge=0, le=2)] = 0.0
    """Random scale, from exp(-scale) to exp(scale)."""
    ground_ratio: Annotated[float, Meta(ge=0.25, le=4)] = 1.0
    """How much more ground a drone picture shows, side by side, than its tile. Drone pictures are zoomed by it, or tiles by its
    inverse below 1, so that both show the same ground; lpn evaluate --calibrate finds the ratio of other pictures."""
    colour: _Share = 0.0
    """Strength, from 0 to 1, of random brightness, contrast, colour cast, and grey."""
    compression: _Share = 0.0
    """Probability that a picture is first compressed as JPEG, with a quality from 40 to 95."""
    weather: _Share = 0.0
    """Probability that a picture from a drone or the street has one of the nine weathers of lpn evaluate --weather, each as
    often; MuseNet's training has 0.9. Satellite tiles have none."""
    flip: Literal["none", "picture", "place"] = "picture"
    """Random mirroring: none, each picture on its own (published), or all views of a place together."""

    tilt: Annotated[float, Meta(ge=0, le=30)] = 0.0
    """Pitch and roll, up to this many degrees either way, of the camera that looks at a window of a map."""
    season: _Share = 0.0
    """Probability that a hue, such as that of leaves, is shifted in pictures of places or in drone views of a map's windows."""
    bands: _Share = 0.0
    """Probability that bands are mixed at random, as in near infrared, in the same pictures as with `season`."""
    shadows: _Share = 0.0
    """Probability of shadows in pictures of places, or in the drone view of a window of a map."""
    occlusion: _Share = 0.0
    """Probability that areas are hidden in pictures of places, or in the drone view of a window of a map."""
    blur: _Share = 0.0
    """Probability that pictures of places, or the drone view of a window of a map, are out of focus or blurred by motion."""
    noise: Annotated[float, Meta(ge=0, le=255)] = 0.0
    """Largest standard deviation of noise, in grey levels, in the same pictures as with `season`."""

    precision: Literal["auto", "float32", "bfloat16", "float16"] = "float16"
    """Arithmetic of the forward pass; auto is bfloat16 where the hardware has it, else float16 on CUDA and float32 elsewhere.
    float16 is for CUDA; on a CPU it is what auto chooses."""
    seed: Annotated[int, Meta(ge=0, le=2**32 - 1)] = 0
    """Random seed of initialisation, order, and augmentation."""

    def __post_init__(self) -> None:
        check_fields(self, "recipe")
        self.check_conflicts()

    def check_conflicts(self) -> None:
        """Raise InputError for settings that exclude each other."""
        if self.backbone not in BACKBONES and not is_timm(self.backbone):
            raise InputError(
                f"The recipe has backbone = {_shown(self.backbone)}; expected one of {', '.join(BACKBONES)}, or timm: and the "
                "name of a network of timm."
            )
        if self.instance <= 0 and self.infonce <= 0 and self.metric == "none" and not self.loss:
            raise InputError(
                "The recipe has no loss, as instance and infonce are 0 and metric is none; set one of them."
            )
        for conflict in _CONFLICTS:
            for name, allowed in conflict.allowed.items() if conflict.applies(self) else ():
                if (value := getattr(self, name)) not in allowed:
                    expected = " or ".join(f"{name} = {one}" for one in allowed)
                    reason = _shown(conflict.reason.format_map(asdict(self)))
                    raise InputError(
                        f"The recipe has {name} = {_shown(value)} with {reason}; expected {expected}{conflict.otherwise}."
                    )

    @property
    def compares_drones(self) -> bool:
        """True with a metric loss of Table I, which compares satellites with drone pictures; SAFA's loss does not."""
        return self.metric != "none" and self.pooling != "safa"

    @property
    def input_size(self) -> tuple[int, int]:
        """Height and width of the network's input in pixels."""
        return self.size, self.width or self.size

    @property
    def sets(self) -> tuple[str, ...]:
        """Names of the picture sets to train on, if they exist."""
        return ("satellite", "drone", *(["street"] if self.street else []), *(["google"] if self.google else []))

    def zoom(self, view: View) -> float:
        """Return the zoom of a view's pictures for equal ground of drone pictures and tiles; see `ground_ratio`."""
        ratio = {"drone": self.ground_ratio, "satellite": 1 / self.ground_ratio}.get(view, 1.0)
        return max(ratio, 1.0)

    def to_json(self) -> str:
        """Return one line of JSON."""
        return json.dumps(asdict(self))


class _Conflict(NamedTuple):
    """Settings with a limited choice of values in the recipes that `applies` selects.

    Attributes:
        reason: the reason against other values; it may name settings.
        otherwise: another remedy.
    """

    applies: Callable[[Recipe], bool]
    allowed: Mapping[str, tuple[object, ...]]
    reason: str
    otherwise: str = ""


_CONFLICTS = (
    _Conflict(
        lambda recipe: is_timm(recipe.backbone),
        {"linear": (True,), "pooling": ("average",)},
        "{backbone}, whose channels are known only once it is built",
    ),
    _Conflict(
        lambda recipe: recipe.backbone.startswith("vgg16"),
        {"last_layer": ("layer4",)},
        "{backbone}, which has no other",
    ),
    _Conflict(
        lambda recipe: not recipe.backbone.startswith("vgg16"),
        {"backbone_dropout": (0,)},
        "{backbone}, which has no dropout",
    ),
    _Conflict(
        lambda recipe: recipe.pooling == "safa",
        {"instance": (0,), "metric": ("soft_margin", "none")},
        "pooling = safa, which has no class layer",
    ),
    _Conflict(lambda recipe: recipe.polar, {"ground_ratio": (1,)}, "polar, as an unrolled tile has no zoom"),
    _Conflict(
        lambda recipe: recipe.sampling == "pictures",
        {"infonce": (0,), "metric": ("none",), "flip": ("picture", "none"), "place_rotation": (0,)},
        "sampling = pictures, which shuffles each set on its own",
        ", or sampling = places",
    ),
    _Conflict(
        lambda recipe: recipe.windows > 0,
        {
            "instance": (0,),
            "metric": ("none",),
            "sampling": ("places",),
            "pooling": ("average",),
            "polar": (False,),
            "ground_ratio": (1,),
        },
        "windows of a map, which have no classes and are seen from above",
    ),
    _Conflict(
        lambda recipe: recipe.windows > 0 and recipe.width != recipe.size,
        {"width": (0,)},
        "windows of a map, which are square",
    ),
    _Conflict(
        lambda recipe: recipe.compares_drones,
        {"infonce": (0,), "street": (False,), "google": (False,), "metric_per_part": (False,)},
        "metric = {metric}, which compares satellites with drone pictures alone",
    ),
    _Conflict(
        lambda recipe: not recipe.compares_drones,
        {"positives": (1,)},
        "no metric loss on drone pictures",
        ", or a metric",
    ),
)


def _shown(value: object) -> str:
    return printable(str(value)[:120])
