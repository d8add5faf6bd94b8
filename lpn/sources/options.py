"""The options of a model and of a source, as dataclass fields for the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import tyro

from lpn.core.errors import InputError
from lpn.core.files import distinct_names
from lpn.core.resources import ProviderName
from lpn.core.texts import counted
from lpn.core.views import TaskName
from lpn.models.adapters import Kind

if TYPE_CHECKING:
    from lpn.models.base import Model

_Type = TypeVar("_Type")
# The mark of an option in `--help-all` but not in `--help`.
ADVANCED = "advanced"
Advanced = Annotated[_Type, ADVANCED]

# Options of a model in many commands.
KindOption = Annotated[
    Kind | None,
    ADVANCED,
    tyro.conf.arg(
        metavar="KIND",
        help="Method of a published .pth, such as dac, if its entries do not identify it; see docs/models.md.",
    ),
]
PoolingOption = Annotated[
    str | None,
    ADVANCED,
    tyro.conf.arg(
        help="Pooling of tokens, of timm:NAME:FILE, a folder of transformers, or an .onnx of tokens: mean, gem, cls, cls+mean, "
        "or rings:N; see docs/models.md."
    ),
]
ProviderOption = Annotated[
    ProviderName,
    ADVANCED,
    tyro.conf.arg(
        help="Provider: auto (LPN_PROVIDER, else a GPU if one works, else the CPU), cpu, cuda, or, for an .onnx, any of ONNX "
        "Runtime's, such as coreml."
    ),
]
CalibrateOption = Annotated[
    bool | None,
    tyro.conf.arg(
        help="Calibrate the model on the pictures of all tasks, without labels: choose the zoom at which drone pictures and "
        "tiles show the same ground, and subtract each view's mean (docs/evaluation.md). By default only where a calibration "
        "ships with the data set.",
        help_behavior_hint="",
    ),
]
CslsOption = Annotated[
    int,
    tyro.conf.arg(
        help="Re-rank by CSLS over this many nearest queries of each tile, such as 3: tiles that are near to all queries move "
        "away. It needs no labels, but all queries together (docs/evaluation.md). 0 for none."
    ),
]
# The default model of commands.
SHIPPED_MODEL = Path("city-lpn")


def shipped_model() -> Path:
    """Return the default model of commands, and print its name on the terminal."""
    from lpn.core.consoles import terminal

    sentence = f"The model is {SHIPPED_MODEL}, which is shipped and knows only a rendered city; --model takes another."
    terminal().print(sentence, highlight=False, markup=False, soft_wrap=True)
    return SHIPPED_MODEL


def model_names(
    files: Sequence[Path], poolings: Sequence[str | None], kinds: Sequence[str | None] | None = None
) -> list[str]:
    """Return distinct printable names of models.

    They consist of file, pooling of tokens, and, if these are equal, the kind.
    """
    distinct = list(dict.fromkeys(files))
    names = dict(zip(distinct, distinct_names(distinct), strict=True))
    named = [names[file] + (f", {pooling}" if pooling else "") for file, pooling in zip(files, poolings, strict=True)]
    return [
        f"{name}, {kind}" if kind and named.count(name) > 1 else name
        for name, kind in zip(named, kinds or [None] * len(named), strict=True)
    ]


def of_each(option: str, values: Sequence[str], count: int, models: str) -> list[str | None]:
    """Return an option's value for each of several models in their order, None for "auto"; None for all without values.

    Args:
        option: its name, such as "--beside-kind".
        models: the models that take the option, for the message: "models of --beside".

    Raises:
        InputError: if there are more or fewer values than models.
    """
    if values and len(values) != count:
        found = counted(len(values), option.rpartition("-")[2])
        raise InputError(f"Found {found} for {count} {models}; give one for each in their order, or auto.")
    return [None if value == "auto" else value for value in values] or [None] * count


@dataclass(kw_only=True)
class ModelOptions:
    """A trained model."""

    model: Path | None = None
    """Trained model: .onnx (needs no torch), .safetensors, .pth, or a name of lpn models; by default the shipped city-lpn."""
    kind: KindOption = None
    pooling: PoolingOption = None
    provider: ProviderOption = "auto"

    @property
    def name(self) -> str:
        """The displayed name: the file's name and the pooling of its tokens."""
        return model_names([self.file], [self.pooling])[0]

    @property
    def file(self) -> Path:
        """The named model, or the shipped default."""
        return self.model or SHIPPED_MODEL

    def load(self) -> Model:
        """Open the model, see `lpn.load` for the errors."""
        import lpn

        return lpn.load(self.model or shipped_model(), self.provider, kind=self.kind, pooling=self.pooling)


@dataclass(kw_only=True)
class SourceOptions(ModelOptions):
    """A source, and how it is opened. Each kind of source takes some of the options."""

    source: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = None
    """Data set in any layout of docs/data.md; pytorch_result.mat of the published test code; arrays of query descriptors (.npy,
    .npz, .mat); index of tiles, a folder or milvus://host:port/collection; or flight, a folder of lpn flight or of photos."""
    data: Path | None = None
    """Data set of a .mat's pictures, or of an index's queries; folder that the paths of --paths, or tiles' names beside
    --pictures, are relative to."""
    map: Path | None = None
    """Map under a flight, or of an index's windows: a folder of lpn map, or a georeferenced picture."""
    task: Annotated[TaskName | None, tyro.conf.arg(metavar="TASK")] = None
    """Views of query and gallery, by default the first task of the data set that the model supports."""
    calibrate: CalibrateOption = None
    csls: CslsOption = 0
    gallery: Advanced[Path | None] = None
    """Of arrays: descriptors of the gallery, in a file like that of the queries."""
    paths: Advanced[Path | None] = None
    """Of arrays: list of the pictures, a .csv with file, side, label, latitude, longitude (docs/data.md); without it rows are
    numbered, and the truth is unknown."""
    order: Advanced[Literal["parts-first", "parts-last"]] = "parts-first"
    """Of arrays: order of the axes, parts-first for (N, n, D), parts-last for (N, D, n)."""
    n_parts: Advanced[int | None] = None
    """Number of parts of a .mat, or of two-dimensional arrays; 1 by default."""
    pictures: Advanced[Path | None] = None
    """Of an index: folder of pictures of unknown places, which are the queries in place of --data."""
    index: Advanced[str | None] = None
    """Of a flight: index of the map's windows by this model, in place of windows that are described."""

    @property
    def path(self) -> Path:
        """The path of the source."""
        return Path(self.source or "")

    def of_source(self) -> list[str]:
        """Return the given options of a source as users write them, such as "--data"; without those of a model."""
        own = {one.name for one in fields(ModelOptions)}
        return [
            f"--{one.name.replace('_', '-')}"
            for one in fields(SourceOptions)
            if one.name not in own and getattr(self, one.name) != one.default
        ]
