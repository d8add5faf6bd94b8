"""The source of every setting of the published recipes: the paper, a line of the released code, or ours.

Line numbers are those of wtyhub/LPN at c4f521a, wtyhub/SAFA_LPN at 631b186, layumi/University1652-Baseline at de38d35, and
layumi/University1652-triplet-loss at a3e2d26.
"""

from __future__ import annotations

import io
import shutil
from dataclasses import asdict
from typing import cast

from rich import box
from rich.table import Table

from lpn.core.consoles import Console
from lpn.training.recipes import OF_BASELINE, find

# Pairs of a recipe of a paper's text and the recipe of its released code.
PAIRS = (("paper", "released"), ("cvusa-paper", "cvusa-released"), ("safa-paper", "safa-released"))
_RELEASED = dict(PAIRS)

# Marks a setting on which this paper is silent although `paper` states it.
_SILENT = ""

_STATED = "paper, section IV-B"
_LPN = "wtyhub/LPN"
_SAFA = "wtyhub/SAFA_LPN script"
_METRIC = "layumi/University1652-triplet-loss"
_NOT_USED = "ours: not used"
_OFF = "ours: off, in neither the paper nor the code"

# By setting: its source by recipe; "*" for all others. Where the text of a paper is silent, its recipe has the source of the
# released code.
_SOURCES: dict[str, dict[str, str]] = {
    "backbone": {
        "paper": f"{_STATED}: ResNet-50, the stride of conv5_1 changed from 2 to 1",
        "released": f"{_LPN} run.sh:8, model.py:435-439",
        "cvusa-paper": f"paper, section IV-C, Table II: VGG16; with BatchNorm as in {_LPN} model.py:165",
        "cvusa-released": f"{_LPN} run_cvusa.sh:9, model.py:165",
        "safa-paper": "paper, section IV-C, Table II: VGG16",
        "safa-released": f"{_SAFA}/VGG.py:63",
        "cvusa-released-resnet50": f"{_LPN} run_cvusa.sh:22-33 (commented out): no --use_vgg16; model.py:131-133",
        "cvact-released": f"{_LPN} run_cvact.sh:22-33: no --use_vgg16; model.py:131-133",
        "metric-released": f"{_METRIC} model.py:61",
    },
    "last_layer": {
        "paper": "paper, section III-A: conv1 to conv5",
        "released": f"{_LPN} model.py:450-457",
        "cvusa-released": f"{_LPN} model.py:180",
        "safa-released": f"{_SAFA}/VGG.py:63",
        "cvusa-released-resnet50": f"{_LPN} model.py:265-272",
        "cvact-released": f"{_LPN} model.py:265-272",
        "metric-released": f"{_METRIC} model.py:71-78",
    },
    "last_stride": {
        "paper": f"{_STATED}: the strides of conv5_1 are 1",
        "released": f"{_LPN} run.sh:8, model.py:435-439",
        "metric-released": f"{_METRIC} model.py:68-69: the lines that would change the stride are commented out",
        "cvusa-released-resnet50": f"{_LPN} run_cvusa.sh:33 (commented out), model.py:241-260",
        "cvact-released": f"{_LPN} run_cvact.sh:33, model.py:241-260",
        "*": "ours: not used, as a VGG-16 has no such layer",
    },
    "n_parts": {
        "paper": "paper, section IV-D: n = 4 by default",
        "released": f"{_LPN} run.sh:14",
        "cvusa-released": f"{_LPN} run_cvusa.sh:13",
        "safa-released": f"{_SAFA}/spatial_net.py:33: SAFA alone has one part",
        "cvusa-released-resnet50": f"{_LPN} run_cvusa.sh:32 (commented out)",
        "cvact-released": f"{_LPN} run_cvact.sh:32",
        "metric-released": f"{_METRIC} model.py:63: global average pooling",
    },
    "weighting": {
        "paper": "paper, section III-A, equation 3: the mean over the ring itself",
        "released": f"{_LPN} model.py:492-497: the box around the ring is averaged, its inside set to zero",
        "cvusa-released": f"{_LPN} model.py:217-222: as for University-1652",
        "cvusa-released-resnet50": f"{_LPN} model.py:353-358: as for University-1652",
        "cvact-released": f"{_LPN} model.py:353-358: as for University-1652",
        "*": _NOT_USED,
    },
    "activation": {
        "paper": "paper, section III-A: a ReLU between BatchNorm and dropout",
        "released": f"{_LPN} model.py:37, 660: no activation, the default",
        "cvusa-released": f"{_LPN} model.py:37, 562: no activation, the default",
        "cvusa-released-resnet50": f"{_LPN} model.py:37, 571: no activation, the default",
        "cvact-released": f"{_LPN} model.py:37, 571: no activation, the default",
        "metric-released": f"{_METRIC} model.py:35-36, 66: none, the default",
        "*": _NOT_USED,
    },
    "linear": {
        "paper": "paper, section III-A: a fully connected layer, then BatchNorm",
        "released": f"{_LPN} model.py:37-42",
        "cvusa-released": f"{_LPN} model.py:37-42",
        "cvact-released": f"{_LPN} model.py:37-42",
        "metric-released": f"{_METRIC} model.py:33-35: BatchNorm alone, on 2,048 numbers",
        "*": _NOT_USED,
    },
    "shared": {
        "paper": "paper, section III-A: the satellite and the drone branch share weights",
        "released": f"{_LPN} run.sh:7, model.py:643-644",
        "cvusa-paper": "paper, section III-A: satellite and drone share weights alone, and CVUSA has no drone pictures",
        "cvusa-released": f"{_LPN} run_cvusa.sh has no --share, model.py:545",
        "safa-released": f"{_SAFA}/spatial_net.py:35, 47",
        "cvact-released": f"{_LPN} run_cvact.sh:22-34 has no --share, model.py:552",
        "cvusa-released-resnet50": f"{_LPN} run_cvusa.sh:22-34 (commented out) has no --share, model.py:552",
        "metric-released": f"{_METRIC} train.py:201-202: one network for satellites and drone pictures",
    },
    "layout": {
        "paper": "paper, section III-A: square rings in every view",
        "released": f"{_LPN} model.py:473-513",
        "cvusa-paper": (
            "paper, sections III-B, IV-C, Figure 4: the sequential partition; for the tile, on which the text is silent, as "
            f"{_LPN} model.py:521 has it with sqr = False: columns, too"
        ),
        "cvusa-released": f"{_LPN} model.py:521, 527, 545: rings of the tile, outermost first, and rows of the panorama",
        "cvusa-released-resnet50": f"{_LPN} model.py:521, 537, 552: rings of the tile, outermost first, and rows of the panorama",
        "cvact-released": f"{_LPN} model.py:521, 537, 552: rings of the tile, outermost first, and rows of the panorama",
        "*": _NOT_USED,
    },
    "pooling": {
        "paper": "paper, section III-A, equation 3: the mean",
        "released": f"{_LPN} train.py:41, model.py:476",
        "cvusa-released": f"{_LPN} train_cvusa.py:40, model.py:201",
        "safa-released": f"{_SAFA}/spatial_net.py:5-30",
        "cvact-released": f"{_LPN} train_cvact.py:41, model.py:324, 337",
        "metric-released": f"{_METRIC} model.py:63",
    },
    "maps": {
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:14, 134: the last digit of the network's name",
        "*": _NOT_USED,
    },
    "polar": {"safa-released": f"{_SAFA}/train_cvusa_lpn.py:15", "*": _OFF},
    "street": {
        "paper": "paper, section III-A: three branches",
        "released": f"{_LPN} run.sh:5",
        "cvusa-released": f"{_LPN} train_cvusa.py:142",
        "safa-released": f"{_SAFA}/spatial_net.py:35",
        "metric-released": f"{_METRIC} tripletfolder.py:10-25: satellites and drone pictures alone",
        "cvact-released": f"{_LPN} train_cvact.py:143",
    },
    "google": {
        "paper": "paper, section IV-C, Table I: LPN is trained with google, LPN without Google has a row of its own",
        "released": f"{_LPN} run.sh:13, model.py:689: google goes through the street branch",
        "cvusa-paper": "ours: CVUSA has no such set",
        "metric-released": f"{_METRIC} tripletfolder.py:10-25: satellites and drone pictures alone",
        "*": "ours: CVUSA has no such set",
    },
    "size": {
        "paper": f"{_STATED}: 256",
        "released": f"{_LPN} run.sh:9",
        "cvusa-released": f"{_LPN} run_cvusa.sh:7",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:124",
        "cvusa-released-resnet50": f"{_LPN} run_cvusa.sh:27 (commented out)",
        "cvact-released": f"{_LPN} run_cvact.sh:27",
        "metric-released": f"{_METRIC} train.py:79",
    },
    "width": {
        "paper": f"{_STATED}: 256",
        "released": f"{_LPN} run.sh:10",
        "cvusa-released": f"{_LPN} run_cvusa.sh:8",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:124",
        "cvusa-released-resnet50": f"{_LPN} run_cvusa.sh:28 (commented out)",
        "cvact-released": f"{_LPN} run_cvact.sh:28",
        "metric-released": f"{_METRIC} train.py:79",
    },
    "dropout": {
        "released": f"{_LPN} run.sh:6",
        "cvusa-released": f"{_LPN} train_cvusa.py:57, the default",
        "cvact-released": f"{_LPN} train_cvact.py:58, the default",
        "metric-released": f"{_METRIC} model.py:66",
        "*": "ours: not used, as SAFA has no heads",
    },
    "backbone_dropout": {
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:44, VGG.py:92-110: each value is kept with probability 0.8",
        "*": _OFF,
    },
    "class_init": {
        "paper": f"{_STATED}: the classifier module, of which Cls is a layer (section III-A), by kaiming initialisation",
        "released": f"{_LPN} model.py:23-27, 54-57: N(0, 0.001)",
        "cvusa-released": f"{_LPN} model.py:23-27, 54-57: N(0, 0.001)",
        "cvact-released": f"{_LPN} model.py:23-27, 54-57: N(0, 0.001)",
        "metric-released": f"{_METRIC} model.py:20-24, 45: N(0, 0.001), and not trained",
        "*": "ours: not used, as SAFA has no heads",
    },
    "windows": {"*": _OFF},
    "sampling": {
        "released": f"{_LPN} train.py:149-151, 217: one shuffled loader for each set, over its pictures",
        "cvusa-released": f"{_LPN} train_cvusa.py:145-147, 211: one shuffled loader for each set",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:204: pairs",
        "cvact-released": f"{_LPN} train_cvact.py:146-148, 212: one shuffled loader for each set",
        "metric-released": f"{_METRIC} tripletfolder.py:27-35, 43-69: each satellite with drone pictures of its place",
    },
    "epochs": {
        "paper": f"{_STATED}: 120",
        "released": f"{_LPN} train.py:438",
        "cvusa-released": f"{_LPN} train_cvusa.py:438",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:34",
        "cvact-released": f"{_LPN} train_cvact.py:443",
        "metric-released": f"{_METRIC} train.py:429",
    },
    "batch": {
        "paper": f"{_STATED}: 32; the text does not say whether of each set or of all four, which 8 of each would be",
        "released": f"{_LPN} train.py:45, the default, of each of the four loaders",
        "cvusa-paper": f"{_STATED}: 32, without an exception for CVUSA",
        "cvusa-released": f"{_LPN} run_cvusa.sh:6",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:31",
        "cvusa-released-resnet50": f"{_LPN} run_cvusa.sh:26 (commented out)",
        "cvact-released": f"{_LPN} run_cvact.sh:26",
        "metric-released": f"{_METRIC} train.py:45, README.md:59",
    },
    "optimizer": {
        "paper": f"{_STATED}: SGD, momentum 0.9; Nesterov from {_LPN} train.py:405",
        "released": f"{_LPN} train.py:405",
        "cvusa-released": f"{_LPN} train_cvusa.py:404",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:159",
        "cvact-released": f"{_LPN} train_cvact.py:408",
        "metric-released": f"{_METRIC} train.py:380",
    },
    "lr": {
        "paper": f"{_STATED}: 0.01 for new layers",
        "released": f"{_LPN} run.sh:15, train.py:403",
        "cvusa-released": f"{_LPN} run_cvusa.sh:12, train_cvusa.py:402",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:43",
        "cvusa-released-resnet50": f"{_LPN} run_cvusa.sh:31 (commented out), train_cvusa.py:402",
        "cvact-released": f"{_LPN} run_cvact.sh:31, train_cvact.py:406",
        "metric-released": f"{_METRIC} train.py:48",
    },
    "backbone_ratio": {
        "paper": f"{_STATED}: 0.001 for the backbone",
        "released": f"{_LPN} train.py:399",
        "cvusa-released": f"{_LPN} train_cvusa.py:398",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:159: one rate",
        "cvact-released": f"{_LPN} train_cvact.py:402",
        "metric-released": f"{_METRIC} train.py:377",
    },
    "schedule": {
        "paper": f"{_STATED}: decay by 0.1 after 80 epochs",
        "released": f"{_LPN} train.py:408",
        "cvusa-released": f"{_LPN} train_cvusa.py:406",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:43: no decay without --lr_decay",
        "cvact-released": f"{_LPN} train_cvact.py:410",
        "metric-released": f"{_METRIC} train.py:406",
    },
    "decay_epoch": {
        "paper": f"{_STATED}: 80",
        "released": f"{_LPN} train.py:408: step_size=80",
        "cvusa-released": f"{_LPN} train_cvusa.py:406: step_size=80",
        "cvact-released": f"{_LPN} train_cvact.py:410: step_size=80",
        "metric-released": f"{_METRIC} train.py:406: milestones=[40,60]",
        "*": _NOT_USED,
    },
    "second_decay_epoch": {
        "metric-released": f"{_METRIC} train.py:406: milestones=[40,60]",
        "*": _OFF,
    },
    "warmup_epochs": {
        "released": f"{_LPN} train.py:54, the default: none",
        "cvusa-released": f"{_LPN} run_cvusa.sh:5",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:43: none",
        "cvusa-released-resnet50": f"{_LPN} run_cvusa.sh:25 (commented out)",
        "cvact-released": f"{_LPN} run_cvact.sh:25",
        "metric-released": f"{_METRIC} train.py:163-170: none",
    },
    "warmup": {
        "cvusa-released": f"{_LPN} train_cvusa.py:268-270: the factor multiplies the loss",
        "cvact-released": f"{_LPN} train_cvact.py:269-271: the factor multiplies the loss",
        "*": _NOT_USED,
    },
    "warmup_start": {
        "cvusa-released": f"{_LPN} train_cvusa.py:190",
        "cvact-released": f"{_LPN} train_cvact.py:191",
        "*": _NOT_USED,
    },
    "weight_decay": {
        "paper": f"{_STATED}: 0.0005",
        "released": f"{_LPN} train.py:405",
        "cvusa-released": f"{_LPN} train_cvusa.py:404",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:152, 159: the regularisers' terms are never added to the loss",
        "cvact-released": f"{_LPN} train_cvact.py:408",
        "metric-released": f"{_METRIC} train.py:380",
    },
    "ema": {
        "released": f"{_LPN} train.py:56, the default: none",
        "cvusa-released": f"{_LPN} train_cvusa.py:56, the default: none",
        "cvact-released": f"{_LPN} train_cvact.py:57, the default: none",
        "*": _OFF,
    },
    "joint_views": {
        "released": f"{_LPN} model.py:667-692: one pass for each set",
        "cvusa-released": f"{_LPN} model.py:583-594: one pass for each set",
        "safa-released": f"{_SAFA}/spatial_net.py:36, 48: one pass for each view",
        "cvact-released": f"{_LPN} model.py:583-594: one pass for each set",
        "metric-released": f"{_METRIC} train.py:201-202: one pass for each set",
    },
    "instance": {
        "paper": "paper, section III-A, equations 5 and 6",
        "released": f"{_LPN} train.py:186",
        "cvusa-released": f"{_LPN} train_cvusa.py:181",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:152: no class layer",
        "cvact-released": f"{_LPN} train_cvact.py:182",
        "metric-released": f"{_METRIC} train.py:247: commented out",
    },
    "reduction": {
        "paper": "paper, section III-A, equation 6: the sum over parts and views",
        "released": f"{_LPN} train.py:186, 274, 277: parts and views are summed",
        "cvusa-released": f"{_LPN} train_cvusa.py:181, 260: parts and views are summed",
        "cvact-released": f"{_LPN} train_cvact.py:182, 261: parts and views are summed",
        "*": _NOT_USED,
    },
    "label_smoothing": {
        "released": f"{_LPN} train.py:432: CrossEntropyLoss()",
        "cvusa-released": f"{_LPN} train_cvusa.py:432: CrossEntropyLoss()",
        "cvact-released": f"{_LPN} train_cvact.py:437: CrossEntropyLoss()",
        "*": _OFF,
    },
    "infonce": {"*": _OFF},
    "temperature": {"*": _NOT_USED},
    "metric": {
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:67-107",
        "metric-released": f"{_METRIC} train.py:204-251",
        "*": _OFF,
    },
    "positives": {"metric-released": f"{_METRIC} tripletfolder.py:27-35", "*": _NOT_USED},
    "pool": {"metric-released": f"{_METRIC} train.py:46, 209-211", "*": _NOT_USED},
    "metric_per_part": {
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:141-152: SAFA + LPN with --multi_loss has one loss for each strip",
        "*": _NOT_USED,
    },
    "margin": {
        "metric-released": f"{_METRIC} train.py:47, the default",
        "*": _NOT_USED,
    },
    "alpha": {
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:33",
        "metric-released": f"{_METRIC} train-soft-margin.py:251: no factor",
        "*": _NOT_USED,
    },
    "rotation": {"*": _OFF},
    "satellite_rotation": {
        "paper": (
            "paper, section IV-D: drone pictures are not rotated in training; that satellites are, and by which angle, as "
            f"{_LPN} train.py:105"
        ),
        "cvusa-paper": _SILENT,
        "released": f"{_LPN} train.py:105: RandomAffine(90)",
        "cvusa-released": f"{_LPN} train_cvusa.py:105: RandomAffine(90)",
        "safa-released": f"{_SAFA}/input_data_cvusa.py: no augmentation",
        "cvact-released": f"{_LPN} train_cvact.py:106: RandomAffine(90)",
        "metric-released": f"{_METRIC} train.py:77-84: no rotation",
    },
    "place_rotation": {"*": _OFF},
    "black_corners": {
        "released": f"{_LPN} train.py:105: RandomAffine fills with black",
        "cvusa-released": f"{_LPN} train_cvusa.py:105: RandomAffine fills with black",
        "cvact-released": f"{_LPN} train_cvact.py:106: RandomAffine fills with black",
        "*": _NOT_USED,
    },
    "own_canvas": {
        "released": f"{_LPN} train.py:103-105: rotated after resizing and padding",
        "cvusa-released": f"{_LPN} train_cvusa.py:103-105: rotated after resizing and padding",
        "cvact-released": f"{_LPN} train_cvact.py:104-106: rotated after resizing and padding",
        "*": _NOT_USED,
    },
    "interpolation": {
        "released": f"{_LPN} train.py:105: RandomAffine's default, nearest",
        "cvusa-released": f"{_LPN} train_cvusa.py:105: RandomAffine's default, nearest",
        "cvact-released": f"{_LPN} train_cvact.py:106: RandomAffine's default, nearest",
        "*": _NOT_USED,
    },
    "padding": {
        "paper": f"{_STATED}: random crop; the 10 pixels are those of {_LPN} train.py:47, 95-96",
        "released": f"{_LPN} train.py:47, 95-96, 104-106",
        "cvusa-released": f"{_LPN} train_cvusa.py:46, 95-96, 104-106",
        "safa-released": f"{_SAFA}/input_data_cvusa.py: no augmentation",
        "cvact-released": f"{_LPN} train_cvact.py:47, 96-97, 105-107",
        "metric-released": f"{_METRIC} train.py:77-84: no crop",
    },
    "shift": {"*": _OFF},
    "scale": {"*": _OFF},
    "colour": {
        "released": f"{_LPN} train.py:121: no --color_jitter",
        "cvusa-released": f"{_LPN} train_cvusa.py:121: no --color_jitter",
        "cvact-released": f"{_LPN} train_cvact.py:122: no --color_jitter",
        "metric-released": f"{_METRIC} train.py:96: no --color_jitter",
        "*": _OFF,
    },
    "compression": {"*": _OFF},
    "weather": {"*": _OFF},
    "flip": {
        "paper": f"{_STATED}: random flipping; horizontal, and each picture on its own, as {_LPN} train.py:97, 107",
        "released": f"{_LPN} train.py:97, 107: each picture on its own",
        "cvusa-released": f"{_LPN} train_cvusa.py:97, 107: each picture on its own",
        "safa-released": f"{_SAFA}/input_data_cvusa.py: no augmentation",
        "cvact-released": f"{_LPN} train_cvact.py:98, 108: each picture on its own",
        "metric-released": f"{_METRIC} train.py:81: each picture on its own",
    },
    **{
        name: {"*": _OFF}
        for name in ("ground_ratio", "tilt", "season", "bands", "shadows", "occlusion", "blur", "noise")
    },
    "precision": {
        "released": f"{_LPN} run.sh:11, train.py:430: Apex O1",
        "cvusa-released": f"{_LPN} run_cvusa.sh:10, train_cvusa.py:430: Apex O1",
        "safa-released": f"{_SAFA}/train_cvusa_lpn.py:124: tf.float32",
        "cvusa-released-resnet50": f"{_LPN} run_cvusa.sh:29 (commented out), train_cvusa.py:430: Apex O1",
        "cvact-released": f"{_LPN} run_cvact.sh:29, train_cvact.py:435: Apex O1",
        "metric-released": f"{_METRIC} train.py:53, README.md:59: no --fp16",
    },
    "seed": {"*": "ours: the released code sets no seed"},
}

# Sources of the settings that another method of `METHODS` replaces, see `recipes.find`.
_OF_METHOD = {
    ("released", "instance", "lr"): f"{_LPN} run.sh:36, the baseline",
    ("cvusa-released", "instance", "lr"): "layumi/University1652-Baseline README.md:225, the baseline",
}
_OF_METHOD |= {
    (recipe, method, "lr"): "ours: the rate of the released baseline"
    for recipe in ("released", "cvusa-released")
    for method in OF_BASELINE
    if method != "instance"
}


# Recipes whose sources are tried in turn, before those of the released code that belongs to a paper.
_CHAINS: dict[str, tuple[str, ...]] = {
    "paper": ("paper",),
    "released": ("released",),
    "cvusa-paper": ("cvusa-paper", "paper"),
    "cvusa-released": ("cvusa-released",),
    "cvusa-released-resnet50": ("cvusa-released-resnet50", "cvusa-released"),
    "cvact-released": ("cvact-released",),
    "metric-released": ("metric-released",),
    "safa-paper": ("safa-paper",),
    "safa-released": ("safa-released",),
}


def source(recipe: str, setting: str, method: str | None = None) -> str:
    """Return the source of a setting: "paper, ...", a file and line of released code, or "ours: ...".

    Args:
        recipe: one of `lpn.training.recipes.RECIPES`; those that are not published are ours.
        method: one of `lpn.training.recipes.METHODS`, for which the released code may have another value.
    """
    if recipe not in _CHAINS:
        return "ours"
    if method is not None and (recipe, method, setting) in _OF_METHOD:
        return _OF_METHOD[recipe, method, setting]
    of = _SOURCES[setting]
    stated = next((of[name] for name in _CHAINS[recipe] if name in of), _SILENT)
    if stated:
        return stated
    if recipe in _RELEASED and _RELEASED[recipe] in of:
        return f"{of[_RELEASED[recipe]]}; the paper is silent"
    return of["*"]


def difference(first: str, second: str) -> str:
    """Return the settings in which two recipes differ, each with its value and source, as text.

    Raises:
        InputError: if there is no such recipe.
    """
    recipes = {name: asdict(find(name)) for name in (first, second)}
    differs = [setting for setting in recipes[first] if recipes[first][setting] != recipes[second][setting]]
    if not differs:
        return f"The recipes {first} and {second} have the same settings."
    table = Table("setting", first, second, box=box.SIMPLE_HEAD)
    for setting in differs:
        cells = (f"{_cell(setting, of[setting])}\n{source(name, setting)}\n" for name, of in recipes.items())
        table.add_row(setting, *cells)
    console = Console(width=max(100, shutil.get_terminal_size().columns), file=io.StringIO(), markup=False)
    console.print(table)
    return cast(io.StringIO, console.file).getvalue().rstrip()


def _cell(setting: str, value: object) -> str:
    return "0 (as the height)" if setting == "width" and value == 0 else f"{value}"


def table(first: str, second: str = "") -> str:
    """Return a Markdown table of one or two recipes, with the source of each setting; those without effect stand below it.

    The table of two recipes that are ours has the settings in which they differ. Settings that they share stand below it.
    """
    recipes = {name: asdict(find(name)) for name in (first, second) if name}
    if not {first, second} & set(_CHAINS):
        return _own_table(recipes)
    titles = " | ".join(f"`{name}` | source" for name in recipes)
    rows, unused = [f"| setting | {titles} |", "|---" * (1 + 2 * len(recipes)) + "|"], []
    for setting in recipes[first]:
        sources = {name: source(name, setting) for name in recipes}
        if all(of in (_OFF, _NOT_USED) for of in sources.values()):
            unused.append(f"`{setting}`")
            continue
        if second and sources[first] == f"{sources[second]}; the paper is silent":
            sources[first] = "silent: as released"
        cells = (cell for name, of in recipes.items() for cell in (_cell(setting, of[setting]), sources[name]))
        rows.append(f"| `{setting}` | {' | '.join(cells)} |")
    return "\n".join([*rows, "", f"Off{' in both' if second else ''}, or without effect: {', '.join(unused)}."])


def _own_table(recipes: dict[str, dict[str, object]]) -> str:
    """Return the Markdown table of two recipes that are ours."""
    first, second = recipes.values()
    rows = [f"| setting | {' | '.join(f'`{name}`' for name in recipes)} |", "|---|---|---|"]
    rows += [f"| `{key}` | {value} | {second[key]} |" for key, value in first.items() if value != second[key]]
    shared = ", ".join(f"`{key}` {_cell(key, value)}" for key, value in first.items() if value == second[key])
    return "\n".join([*rows, "", f"The same in both: {shared}."])
