"""Training recipes by name, each with all settings of a training, and the methods that the paper compares."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.views import View
from lpn.models.partition import Weighting
from lpn.models.spec import BACKBONES, Activation, Layout, Pooling, is_timm

_ABOVE_ZERO = math.ulp(0.0)
_BELOW_ONE = math.nextafter(1.0, 0.0)
_MAX = sys.float_info.max
# Lowest and highest value of each number, and the range in words. NaN and infinity are never allowed.
_RANGES: dict[str, tuple[float, float, str]] = {
    # BatchNorm in the heads needs at least two samples.
    **dict.fromkeys(("batch",), (2, _MAX, "2 or more")),
    **dict.fromkeys(("n_parts", "epochs", "maps", "positives", "pool"), (1, _MAX, "1 or more")),
    "windows": (0, _MAX, "0 or more"),
    # The five pooling layers of VGG divide the size by 32.
    "size": (32, _MAX, "32 or more"),
    **dict.fromkeys(("scale", "margin"), (0, 2, "a number from 0 to 2")),
    **dict.fromkeys(("lr", "temperature", "alpha"), (_ABOVE_ZERO, _MAX, "a number above 0")),
    **dict.fromkeys(
        ("dropout", "backbone_dropout", "ema"),
        (0, _BELOW_ONE, "a number from 0 up to, not including, 1"),
    ),
    **dict.fromkeys(
        (
            "label_smoothing",
            "warmup_start",
            "black_corners",
            "own_canvas",
            "shift",
            "colour",
            "compression",
            "weather",
            "season",
            "bands",
            "shadows",
            "occlusion",
            "blur",
        ),
        (0, 1, "a number from 0 to 1"),
    ),
    **dict.fromkeys(
        (
            "backbone_ratio",
            "decay_epoch",
            "second_decay_epoch",
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
    # A photo of a wide field of view shows the horizon above 45 degrees.
    "tilt": (0, 30, "a number from 0 to 30"),
    # The range that a calibration searches.
    "ground_ratio": (0.25, 4, "a number from 0.25 to 4"),
    "noise": (0, 255, "a number from 0 to 255"),
    # The networks take inputs of at most 4096 pixels.
    "padding": (0, 4096, "a whole number from 0 to 4096"),
    "seed": (0, 2**32 - 1, "a whole number from 0 to 4294967295"),
}


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
    n_parts: int = 4
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
    maps: int = 8
    """Number of weighted sums per part with safa pooling (released: 8 with SAFA, 1 with SAFA + LPN)."""
    polar: bool = False
    """Unroll satellite tiles around their centre into the shape of a panorama."""
    street: bool = True
    """Train the street branch, if there are street pictures."""
    google: bool = True
    """Train the street branch also on the pictures in train/google, if that folder exists."""
    size: int = 256
    """Height of the network's input in pixels."""
    width: int = 0
    """Width of the network's input in pixels; 0 means the height."""
    dropout: float = 0.75
    """Probability of dropout in the heads."""
    backbone_dropout: float = 0.0
    """Dropout after conv4_1 to conv5_3 of a VGG-16 (0.2 in released SAFA)."""
    class_init: Literal["kaiming", "normal"] = "kaiming"
    """Initialisation of the class layers: kaiming (as the other layers of the classifier module, section IV-B) or normal
    (N(0, 0.001), as released)."""

    windows: int = 0
    """Windows of a map in an epoch, each a place of its own that is drawn anew; 0 trains on the pictures of a data set."""
    sampling: Literal["places", "pictures"] = "pictures"
    """Sampling of a batch: places (one picture of every set of each place of the batch) or pictures (each set is shuffled on
    its own, over its pictures, with its own labels; an epoch ends with the shortest set)."""
    epochs: int = 120
    """Passes over all places, or over the pictures of the shortest set."""
    batch: int = 32
    """Pictures of each set (satellite, drone, street, google) per step."""
    optimizer: Literal["sgd", "adam", "adamw"] = "sgd"
    """Optimizer; sgd has Nesterov momentum 0.9."""
    lr: float = 0.01
    """Learning rate of the heads."""
    backbone_ratio: float = 0.1
    """Learning rate of the backbone relative to the heads'."""
    schedule: Literal["step", "cosine", "constant"] = "step"
    """Learning rate schedule: step (x 0.1 after `decay_epoch` and `second_decay_epoch`), cosine (down to 0 at the end), or
    constant."""
    decay_epoch: int = 80
    """Epoch after which the step schedule decays."""
    second_decay_epoch: int = 0
    """Epoch after which the step schedule decays once more; 0 for never."""
    warmup_epochs: int = 0
    """Epochs of linear warm-up."""
    warmup: Literal["rate", "loss"] = "rate"
    """Factor that rises step by step to 1 during the warm-up: that of the learning rate, or that of the loss."""
    warmup_start: float = 0.0
    """Factor from which the warm-up rises."""
    weight_decay: float = 5e-4
    """Weight decay."""
    ema: float = 0.0
    """Decay of an exponential moving average of the weights, which is saved and tested instead of them; 0 for none."""

    joint_views: bool = False
    """Put views that share weights into one batch, so that they share BatchNorm statistics; the released code does not."""
    instance: float = 1.0
    """Weight of the instance loss: cross-entropy over places, for each part and view (equations 5 and 6 of the paper)."""
    reduction: Literal["sum", "mean"] = "sum"
    """Reduction of the instance losses over parts and views: sum (paper) or mean (independent of their number)."""
    label_smoothing: float = 0.0
    """Label smoothing of the instance and the InfoNCE loss."""
    infonce: float = 0.0
    """Weight of a symmetric InfoNCE loss between each view's descriptors and the satellite's, over the batch."""
    temperature: float = 0.07
    """Temperature of the InfoNCE loss."""
    metric: Literal["none", "contrastive", "triplet", "soft_margin"] = "none"
    """Metric loss: contrastive, triplet, or soft-margin triplet, on the cosines of satellites with the hardest of their drone
    pictures and of a pool of others' (layumi/University1652-triplet-loss). With safa pooling soft_margin, on the distances within
    the batch."""
    positives: int = 1
    """Drone pictures of each place in a step, among which a metric loss seeks the hardest."""
    pool: int = 96
    """Drone pictures, drawn anew each step, among which a metric loss seeks the hardest negative."""
    metric_per_part: bool = False
    """Compute the metric loss on each part alone and average over the parts, instead of once on the whole descriptor."""
    margin: float = 0.3
    """Margin of the triplet loss, in cosine (0 to 2)."""
    alpha: float = 10.0
    """Factor inside the exponent of the soft-margin triplet loss."""

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
    interpolation: Literal["nearest", "cubic"] = "nearest"
    """Interpolation of rotated, shifted, and scaled pictures."""
    padding: int = 10
    """Pixels by which a resized picture is padded on each side with its edge; after any rotation it is cropped to the input
    size at random whole pixels."""
    shift: float = 0.0
    """Random shift by any fraction of a pixel, up to this share of the size either way."""
    scale: float = 0.0
    """Random scale, from exp(-scale) to exp(scale)."""
    ground_ratio: float = 1.0
    """How much more ground a drone picture shows, side by side, than its tile. Drone pictures are zoomed by it, or tiles by its
    inverse below 1, so that both show the same ground; lpn evaluate --calibrate finds the ratio of other pictures."""
    colour: float = 0.0
    """Strength, from 0 to 1, of random brightness, contrast, colour cast, and grey."""
    compression: float = 0.0
    """Probability that a picture is first compressed as JPEG, with a quality from 40 to 95."""
    weather: float = 0.0
    """Probability that a picture from a drone or the street has one of the nine weathers of lpn evaluate --weather, each as
    often; MuseNet's training has 0.9. Satellite tiles have none."""
    flip: Literal["none", "picture", "place"] = "picture"
    """Random mirroring: none, each picture on its own (published), or all views of a place together."""

    tilt: float = 0.0
    """Pitch and roll, up to this many degrees either way, of the camera that looks at a window of a map."""
    season: float = 0.0
    """Probability that all of one hue has another colour in pictures of places, or in the drone view of a window of a map."""
    bands: float = 0.0
    """Probability that the bands of these pictures are mixed at random, as those of near infrared are."""
    shadows: float = 0.0
    """Probability of shadows in pictures of places, or in the drone view of a window of a map."""
    occlusion: float = 0.0
    """Probability that areas are hidden in pictures of places, or in the drone view of a window of a map."""
    blur: float = 0.0
    """Probability that pictures of places, or the drone view of a window of a map, are out of focus or blurred by motion."""
    noise: float = 0.0
    """Largest standard deviation of the noise in these pictures, in grey levels."""

    precision: Literal["auto", "float32", "bfloat16", "float16"] = "float16"
    """Arithmetic of the forward pass; auto is bfloat16 where the hardware has it, else float16 on CUDA and float32 elsewhere.
    float16 is for CUDA; on a CPU it is what auto chooses."""
    seed: int = 0
    """Random seed of initialisation, order, and augmentation."""

    def __post_init__(self) -> None:
        self.check_ranges()
        self.check_together()

    def check_ranges(self) -> None:
        """Raise InputError for a number outside of its range."""
        for name, (low, high, expected) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"The recipe has {name} = {value}; expected {expected}.")

    def check_together(self) -> None:
        """Raise InputError for settings that exclude each other."""
        if self.backbone not in BACKBONES and not is_timm(self.backbone):
            raise InputError(
                f"The recipe has backbone = {printable(self.backbone[:80])}; expected one of {', '.join(BACKBONES)}, or timm: "
                "and the name of a network of timm."
            )
        if is_timm(self.backbone) and not self.linear:
            raise InputError(
                f"The recipe has linear = False with {self.backbone}, whose channels are known only once it is built; leave "
                "--no-linear out, or use another backbone."
            )
        if is_timm(self.backbone) and self.pooling == "safa":
            raise InputError(
                f"The recipe has pooling = safa with {self.backbone}; SAFA is made for vgg16, so leave --backbone out, or use "
                "the pooling average."
            )
        vgg = self.backbone.startswith("vgg16")
        if vgg and self.last_layer != "layer4":
            raise InputError(
                f"The recipe has last_layer = layer3 with {self.backbone}, which has no such layer; use layer4."
            )
        if self.backbone_dropout and not vgg:
            raise InputError(
                f"The recipe has backbone_dropout = {self.backbone_dropout} with {self.backbone}, which has no dropout; set "
                "it to 0, or use vgg16."
            )
        if self.instance <= 0 and self.infonce <= 0 and self.metric == "none":
            raise InputError(
                "The recipe has no loss, as instance and infonce are 0 and metric is none; set one of them."
            )
        if self.pooling == "safa" and self.instance > 0:
            raise InputError(
                f"The recipe has instance = {self.instance} with safa, which has no class layer; set it to 0 and choose a metric."
            )
        if self.positives != 1 and not self.compares_drones:
            raise InputError(
                f"The recipe has positives = {self.positives} without a metric loss on drone pictures; set it to 1, or choose "
                "one with --method."
            )
        if self.polar and self.ground_ratio != 1:
            raise InputError(
                f"The recipe has ground_ratio = {self.ground_ratio:g} with polar, but an unrolled tile has no zoom; set it to 1."
            )
        if self.sampling == "pictures":
            self._check_independent()
        if self.windows:
            self._check_windows()
        if self.compares_drones:
            self._check_metric()
        elif self.metric not in ("none", "soft_margin"):
            raise InputError(f"The recipe has metric = {self.metric} with safa; SAFA has soft_margin alone.")

    @property
    def compares_drones(self) -> bool:
        """True with a metric loss of Table I, which compares satellites with drone pictures; SAFA has its own."""
        return self.metric != "none" and self.pooling != "safa"

    def _check_metric(self) -> None:
        """Refuse settings that the metric losses of Table I do not allow: they compare satellites with drone pictures alone."""
        needed: dict[str, tuple[object, object]] = {
            "infonce": (self.infonce, 0.0),
            "street": (self.street, False),
            "google": (self.google, False),
            "metric_per_part": (self.metric_per_part, False),
        }
        for name, (value, expected) in needed.items():
            if value != expected:
                raise InputError(
                    f"The recipe has metric = {self.metric} with {name} = {value}; expected {name} = {expected}, as the loss "
                    "compares satellites with drone pictures alone."
                )

    def _check_windows(self) -> None:
        """Refuse settings that windows of a map do not allow: they have no classes, and are squares seen from above."""
        needed: dict[str, tuple[object, object]] = {
            "instance": (self.instance, 0.0),
            "metric": (self.metric, "none"),
            "sampling": (self.sampling, "places"),
            "pooling": (self.pooling, "average"),
            "polar": (self.polar, False),
            "width": (self.width or self.size, self.size),
            "ground_ratio": (self.ground_ratio, 1.0),
        }
        for name, (value, expected) in needed.items():
            if value != expected:
                raise InputError(
                    f"The recipe has windows = {self.windows} of a map with {name} = {value}; expected {name} = {expected}."
                )

    def _check_independent(self) -> None:
        """Refuse settings that need the pictures of a place side by side, which sets shuffled on their own are not."""
        paired = {
            "infonce": self.infonce > 0,
            "metric": self.metric != "none",
            "flip = place": self.flip == "place",
            "place_rotation": self.place_rotation > 0,
        }
        needs = [name for name, wanted in paired.items() if wanted]
        if needs:
            raise InputError(
                f"The recipe has sampling = pictures, which shuffles each set on its own, with {', '.join(needs)}, which "
                "needs the same places in every set; use sampling = places."
            )

    @property
    def input_size(self) -> tuple[int, int]:
        """Height and width of the network's input in pixels."""
        return self.size, self.width or self.size

    @property
    def sets(self) -> tuple[str, ...]:
        """Names of the picture sets that are trained on, where there are such pictures."""
        return ("satellite", "drone", *(["street"] if self.street else []), *(["google"] if self.google else []))

    def zoom(self, view: View) -> float:
        """Return the zoom of a view's pictures, by which drone pictures and tiles show the same ground; see `ground_ratio`."""
        ratio = {"drone": self.ground_ratio, "satellite": 1 / self.ground_ratio}.get(view, 1.0)
        return max(ratio, 1.0)

    def to_json(self) -> str:
        """Return one line of JSON."""
        return json.dumps(asdict(self))


# All released run scripts and training scripts of LPN share these settings.
_AS_RELEASED: dict[str, Any] = {
    "weighting": "published",
    "activation": "none",
    "class_init": "normal",
}
_CVUSA: dict[str, Any] = {
    "backbone": "vgg16_bn",
    "shared": False,
    "dropout": 0.5,
    "warmup_epochs": 5,
    "warmup": "loss",
    "warmup_start": 0.1,
}
_CVUSA_RELEASED = {**_CVUSA, **_AS_RELEASED, "layout": "cvusa", "n_parts": 8, "batch": 16, "lr": 0.1}
_CVUSA_RESNET = {**_CVUSA_RELEASED, "backbone": "resnet50", "lr": 0.05}
_SAFA: dict[str, Any] = {
    "layout": "university",
    "sampling": "places",
    "pooling": "safa",
    "polar": True,
    "shared": False,
    "instance": 0.0,
    "infonce": 0.0,
    "metric": "soft_margin",
    "size": 112,
    "width": 616,
}
_SAFA_RECIPE = Recipe(
    **_SAFA,
    backbone="vgg16",
    backbone_dropout=0.2,
    n_parts=1,
    activation="none",
    epochs=100,
    optimizer="adam",
    lr=1e-5,
    backbone_ratio=1.0,
    schedule="constant",
    weight_decay=0.0,
    satellite_rotation=0.0,
    flip="none",
    padding=0,
    precision="float32",
)
_SMALL = Recipe(
    backbone="resnet18",
    last_layer="layer3",
    weighting="published",
    activation="none",
    dropout=0.3,
    class_init="normal",
    sampling="places",
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
    interpolation="cubic",
    padding=0,
    shift=0.06,
    scale=0.15,
    colour=1.0,
    flip="place",
    precision="auto",
)

# The triplet loss of the released metric losses, with which its README trains; `method` makes the others of it.
_METRIC_RELEASED = Recipe(
    last_stride=2,
    n_parts=1,
    activation="none",
    linear=False,
    street=False,
    google=False,
    dropout=0.0,
    class_init="normal",
    sampling="places",
    epochs=70,
    decay_epoch=40,
    second_decay_epoch=60,
    instance=0.0,
    metric="triplet",
    positives=4,
    alpha=1.0,
    satellite_rotation=0.0,
    padding=0,
    precision="float32",
)

# paper: what the paper states for University-1652; where it is silent, the released code.
# released: the released code for University-1652 (wtyhub/LPN run.sh and train.py).
# cvusa-paper, cvusa-released: the same for CVUSA (wtyhub/LPN run_cvusa.sh and train_cvusa.py).
# cvusa-released-resnet50: the block of run_cvusa.sh that is commented out.
# cvact-released: the released code for CVACT (wtyhub/LPN run_cvact.sh and train_cvact.py).
# metric-released: the baseline with a metric loss of Table I (layumi/University1652-triplet-loss).
# safa-paper, safa-released: SAFA (Shi et al. 2019), with panoramas of 112 x 616 pixels (wtyhub/SAFA_LPN).
# small: fine-tuning an ImageNet backbone on a few hundred places. All drone pictures have the same heading.
# world: fine-tuning as in small. Drone pictures have any heading, as in a rendered world.
# map: fine-tuning on the windows of a map alone.
# `recipe_sources` has the source of each setting of the published recipes.
RECIPES: dict[str, Recipe] = {
    "paper": Recipe(),
    "released": Recipe(batch=8, lr=0.001, **_AS_RELEASED),
    "cvusa-paper": Recipe(**_CVUSA, layout="strips", n_parts=4),
    "cvusa-released": Recipe(**_CVUSA_RELEASED),
    "cvusa-released-resnet50": Recipe(**_CVUSA_RESNET),
    "cvact-released": Recipe(**_CVUSA_RESNET),
    "metric-released": _METRIC_RELEASED,
    "safa-paper": _SAFA_RECIPE,
    "safa-released": _SAFA_RECIPE,
    "small": _SMALL,
    "world": replace(_SMALL, epochs=60, satellite_rotation=180.0, place_rotation=0.0, compression=0.5),
    "map": replace(
        _SMALL,
        dropout=0.0,
        windows=512,
        epochs=12,
        warmup_epochs=1,
        instance=0.0,
        label_smoothing=0.0,
        place_rotation=180.0,
        rotation=15.0,
        shift=0.1,
        scale=0.25,
        tilt=12.0,
        season=0.5,
        bands=0.3,
        shadows=0.4,
        occlusion=0.4,
        blur=0.5,
        noise=12.0,
        compression=0.5,
    ),
}
RecipeName = Literal[
    "paper",
    "released",
    "cvusa-paper",
    "cvusa-released",
    "cvusa-released-resnet50",
    "cvact-released",
    "metric-released",
    "safa-paper",
    "safa-released",
    "small",
    "world",
    "map",
]
DEFAULT: RecipeName = "paper"

_INSTANCE_LOSS: dict[str, Any] = {
    "pooling": "average",
    "polar": False,
    "instance": 1.0,
    "infonce": 0.0,
    "metric": "none",
}
_BASELINE: dict[str, Any] = {**_INSTANCE_LOSS, "n_parts": 1, "layout": "university"}
# The settings of the metric losses of Table I, in any recipe.
RELEASED_METRIC: dict[str, Any] = {
    name: getattr(_METRIC_RELEASED, name) for name in ("positives", "pool", "alpha", "street", "google")
}
_METRIC_LOSS: dict[str, Any] = {**_BASELINE, "instance": 0.0, "sampling": "places", **RELEASED_METRIC}

# The methods that the paper compares. Each replaces the settings of a recipe that select the loss, and some others.
# lpn: LPN with square rings.
# instance: the baseline, global average pooling with the instance loss.
# contrastive, triplet-*, soft-margin: the baseline with a metric loss in place of the instance loss.
# lpn-sequential: LPN with columns of the panorama and of the tile, as the paper's text has it.
# lpn-cvusa: LPN with rings of the tile and rows of the panorama, as released.
# lpn-strips: LPN with columns of the panorama and of the unrolled tile; ours.
# safa, safa-lpn: SAFA, alone and with strips.
METHODS: dict[str, dict[str, Any]] = {
    "lpn": {**_INSTANCE_LOSS, "layout": "university"},
    "instance": _BASELINE,
    "contrastive": {**_METRIC_LOSS, "metric": "contrastive"},
    "triplet-0.3": {**_METRIC_LOSS, "metric": "triplet", "margin": 0.3},
    "triplet-0.5": {**_METRIC_LOSS, "metric": "triplet", "margin": 0.5},
    "soft-margin": {**_METRIC_LOSS, "metric": "soft_margin"},
    "lpn-sequential": {**_INSTANCE_LOSS, "layout": "strips", "n_parts": 4, "shared": False},
    "lpn-cvusa": {**_INSTANCE_LOSS, "layout": "cvusa", "n_parts": 8, "shared": False},
    "lpn-strips": {**_INSTANCE_LOSS, "layout": "strips", "n_parts": 8, "shared": False, "polar": True},
    "safa": {**_SAFA, "n_parts": 1, "maps": 8},
    "safa-lpn": {**_SAFA, "n_parts": 8, "maps": 1, "metric_per_part": True},
}


# The methods with a loss on distances or cosines.
METRIC_LOSSES = ("contrastive", "triplet-0.3", "triplet-0.5", "soft-margin")
# Methods of the baseline's network; they differ in their loss only.
OF_BASELINE = ("instance", *METRIC_LOSSES)
# Settings that replace those of a recipe's run script of LPN, by recipe and method.
_OF_METHOD: dict[tuple[str, str], dict[str, Any]] = {
    (recipe, name): {"lr": lr} for recipe, lr in (("released", 0.01), ("cvusa-released", 0.02)) for name in OF_BASELINE
}


def method(name: str, recipe: Recipe) -> Recipe:
    """Apply a method of `METHODS` to a recipe.

    Raises:
        InputError: if there is no such method, or the recipe trains on a map.
    """
    if name not in METHODS:
        raise InputError(f"There is no method {name!r}; choose one of {', '.join(METHODS)}.")
    if recipe.windows:
        raise InputError(f"A map is trained on with the loss of its recipe; leave --method {name} out.")
    if recipe.compares_drones and name not in METRIC_LOSSES:
        raise InputError(
            f"The recipe is for the metric losses {', '.join(METRIC_LOSSES)}; choose one of them with --method in place of "
            f"{name}, or another --recipe."
        )
    return replace(recipe, **METHODS[name])


def find(recipe: str, method_name: str | None = None) -> Recipe:
    """Return a recipe of `RECIPES`, for its own method or for one of `METHODS` with the rates of that method's script.

    Raises:
        InputError: if there is no such recipe or method, or the recipe has no methods.
    """
    if recipe not in RECIPES:
        raise InputError(f"There is no recipe {recipe!r}; choose one of {', '.join(RECIPES)}.")
    if method_name is None:
        return RECIPES[recipe]
    return replace(method(method_name, RECIPES[recipe]), **_OF_METHOD.get((recipe, method_name), {}))
