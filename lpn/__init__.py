"""The Local Pattern Network (LPN) for cross-view geo-localization, as a library.

A folder of pictures is a gallery, and a picture of another view gets an answer with its reason:

    >>> import lpn
    >>> gallery = lpn.Gallery.of_folder("tiles", "city-lpn", view="satellite")
    >>> answer = gallery.search(lpn.load_picture("query.jpg"), view="drone")
    >>> for match in answer.top(1):
    ...     print(match.rank, match.name, 0 <= match.distance2 <= 4, match.contributions.shape)
    1 0007/0007.png True (4,)
    >>> answer.figure().save("why.png")
    >>> answer.paper_figure(true=1, wrong=2).save("figure.pdf")

The published protocol measures a model on a data set:

    >>> result = lpn.evaluate("city-lpn", "ROOT", "drone-to-satellite")
    >>> 0 <= result.recall["1"] <= 100
    True

A task has the outcome of each query. `explore` shows a task, or a model on a data set, in a notebook's cell or a browser:

    >>> task = lpn.open_task("ROOT", "drone-to-satellite", model="city-lpn")
    >>> task.evaluate().queries
    6

`Contract`, `ForwardPass`, `Heads`, and `Partition` turn any part-based network into a `Model`. Every error that a user can
correct derives from `LPNError`. docs/library.md has a line for each name. Nothing here needs a browser. Names are imported on
first use, so `import lpn` needs neither NumPy nor torch.
"""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from lpn.core.errors import InputError, LPNError, MissingPackageError
from lpn.core.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lpn.analysis.model_table import compare
    from lpn.core.consoles import progress_bars
    from lpn.core.images import load_picture
    from lpn.core.resources import ProviderName
    from lpn.core.served_page import ServedPage
    from lpn.core.views import TaskName
    from lpn.datasets import Dataset, open_dataset
    from lpn.descriptors.transforms import Change
    from lpn.library import Answer, Gallery
    from lpn.models.adapters import Kind
    from lpn.models.base import Model
    from lpn.models.contract import Contract, ForwardPass, Heads
    from lpn.models.partition import Partition
    from lpn.tasks.measure import Result
    from lpn.tasks.task import Task

# Without this, importing ONNX Runtime writes an identifier into the user's home folder, and reports its use to Microsoft.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__all__ = [
    "Answer",
    "Change",
    "Contract",
    "ForwardPass",
    "Gallery",
    "Heads",
    "LPNError",
    "Model",
    "Partition",
    "Task",
    "__version__",
    "compare",
    "evaluate",
    "explore",
    "load",
    "load_picture",
    "open_dataset",
    "open_task",
    "progress_bars",
]

_MODULE_OF = {
    "Answer": "lpn.library",
    "Change": "lpn.descriptors.transforms",
    "Contract": "lpn.models.contract",
    "ForwardPass": "lpn.models.contract",
    "Gallery": "lpn.library",
    "Heads": "lpn.models.contract",
    "Model": "lpn.models.base",
    "Partition": "lpn.models.partition",
    "Task": "lpn.tasks.task",
    "compare": "lpn.analysis.model_table",
    "load_picture": "lpn.core.images",
    "open_dataset": "lpn.datasets",
    "progress_bars": "lpn.core.consoles",
}

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name in _MODULE_OF:
            return getattr(import_module(_MODULE_OF[name]), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted(__all__)


def load(
    path: str | Path,
    provider: ProviderName = "auto",
    kind: Kind | None = None,
    pooling: str | None = None,
) -> Model:
    """Open a trained model: a shipped one, an `.onnx`, our `.safetensors`, a published state dict, or a model of a package.

    `lpn models` lists the names of shipped models; a file of that name in the working folder comes first. An `.onnx` is an
    exported model, or any graph with a contract in its metadata, and needs no torch. Other files need the extra `train`;
    methods other than LPN and SDPL need the extra `models`. "NAME" or "NAME:FILE" also opens a model that a package registers in
    the entry points `lpn.models` (docs/contract.md); it comes before a shipped model. "timm:NAME:FILE" is a network of timm with
    a file of its weights. A folder that transformers wrote opens as its network. Nothing is downloaded.

    Args:
        provider: "auto" (LPN_PROVIDER if that is set, else a GPU if one works, else the CPU), "cpu", "cuda", or, for an
            `.onnx`, another execution provider of ONNX Runtime, such as "coreml".
        kind: the method of a published state dict, such as "dac"; by default recognised by the names of its entries.
        pooling: how the tokens of a network of timm or transformers, or of an `.onnx` that returns tokens, become a
            descriptor: "mean", "gem", "cls", "cls+mean", or "rings:N", see `lpn.models.token_pooling`. By default the mean.

    Raises:
        ModelFileError: if there is no such file or name, or the file is not a model, is truncated, or lacks entries.
        InputError: if the named provider is missing or does not work.
        MissingPackageError: if torch is needed and not installed.
    """
    from lpn.models.registered import open_registered, timm_file
    from lpn.models.token_pooling import TokenPooling

    pooled = None if pooling is None else TokenPooling.parse(pooling)
    network = None
    if (timm := timm_file(path)) is not None:
        network, path = timm
    if not Path(path).is_file():
        from lpn.models.shipped import model_file

        registered = open_registered(str(path))
        if registered is not None:
            if pooled is not None:
                raise InputError(f"{path} is a package's model, which has its own parts; leave --pooling out.")
            return registered
        path = model_file(path)
    if Path(path).suffix == ".onnx":
        from lpn.models.onnx_engine import Engine

        if kind is not None:
            raise InputError(f"{Path(path).name} contains its kind; leave --kind out.")
        if network is not None:
            raise InputError(f"{Path(path).name} contains its network; leave timm:{network}: out.")
        if pooled is not None:
            from lpn.models.onnx_tokens import PooledEngine

            return PooledEngine(path, pooled, provider=provider)
        return Engine(path, provider=provider)
    try:
        from lpn.models.adapters.load import load_file
        from lpn.models.checkpoints import device_of
    except ModuleNotFoundError as error:
        from lpn.models.file_contents import check_trained_file

        check_trained_file(Path(path))
        raise MissingPackageError(
            f"Opening {Path(path).name} needs the package {error.name}; "
            "pip install 'lpn-explorer[train]', or export the model to .onnx where torch is installed."
        ) from error
    device = device_of(provider, Path(path).name)
    return load_file(path, device, kind, pooled, network)


def evaluate(
    model: Model | str | Path,
    data: Dataset | str | Path,
    task: TaskName | None = None,
    change: Change | None = None,
    parts: Sequence[int] | None = None,
    calibrate: bool | None = None,
    csls: int = 0,
) -> Result:
    """Measure recall and AP of a model on a data set by the published protocol, as the command `lpn evaluate` does.

    Args:
        model: a model, or an argument of `load`.
        data: a data set, or its folder.
        task: such as "drone-to-satellite"; by default the first that data set and model offer.
        change: a change of the queries, such as `Change(rotate=30)`.
        parts: numbers from 1 of the compared parts; None for all.
        calibrate, csls: see `open_task`.

    Raises:
        LPNError: when an argument is wrong, or model or data set cannot be used.
    """
    from lpn.descriptors.transforms import UNCHANGED, Change
    from lpn.tasks.changes import changed, with_parts
    from lpn.tasks.opening import choose_task, lazy_task, task_calibration

    if change is not None and not isinstance(change, Change):
        raise InputError(f"The change is of the type {type(change).__name__}; expected an lpn.Change.")
    (network, model_name), dataset = _opened_model(model), _opened_data(data)
    calibration, name = task_calibration(network, dataset, calibrate), choose_task(network, dataset, task)
    opened = lazy_task(network, dataset, name, model_name=model_name, calibration=calibration, neighbours=csls)
    return with_parts(changed(opened, change or UNCHANGED), parts).evaluate()


def open_task(
    data: Dataset | str | Path,
    task: TaskName | None = None,
    model: Model | str | Path = "city-lpn",
    calibrate: bool | None = None,
    csls: int = 0,
) -> Task:
    """Open a task of a data set under a model: its queries and gallery are described, or read from the cache.

    Args:
        data: a data set, or its folder in any layout of docs/data.md.
        task: such as "drone-to-satellite"; by default the first that data set and model offer.
        model: a model, or an argument of `load`.
        calibrate: True calibrates the model on the pictures of all tasks, without labels, or uses the calibration that ships
            with the data set; False does not; None does if one ships.
        csls: number of nearest queries of each tile by which CSLS re-ranks, such as 3; 0 for none.

    Raises:
        LPNError: when an argument is wrong, model or data set cannot be used, or they do not offer the task.
    """
    from lpn.sources.kinds.data import open_data

    return open_data(*_opened_model(model), _opened_data(data), task, calibrate, csls).task


def _opened_model(model: object) -> tuple[Model, str]:
    """Return a model with its name to display."""
    from lpn.core.files import printable
    from lpn.models.base import Model

    if isinstance(model, Model):
        return model, printable(model.contract.method)
    if isinstance(model, str | Path):
        return load(model), printable(Path(model).name)
    raise InputError(
        f"The model is of the type {type(model).__name__}; expected a model, its file, or a name of lpn models."
    )


def _opened_data(data: object) -> Dataset:
    from lpn.datasets import Dataset, open_dataset

    if isinstance(data, Dataset):
        return data
    if isinstance(data, str | Path):
        return open_dataset(Path(data))
    raise InputError(
        f"The data set is of the type {type(data).__name__}; expected its folder, or the result of lpn.open_dataset."
    )


def explore(
    model: Model | Task | str | Path | None = None,
    data: str | Path | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
    calibrate: bool | None = None,
    csls: int = 0,
) -> ServedPage:
    """Serve a model on a data set to a browser, as the command `lpn explore` does, while the program goes on.

        lpn.explore(model, "University-1652")               # in a notebook: the page, in the cell
        lpn.explore(model, "University-1652").wait()        # in a script: until Ctrl-C
        with lpn.explore() as page:                         # until the end of the block
            print(page.url)

    The server ends with the page's `close()`, or with the process, such as the notebook's kernel.

    Args:
        model: a model, an argument of `load`, or an opened task with its data and scoring; by default the shipped city-lpn.
        data: a data set in any layout of docs/data.md; by default the demo's.
        host, port: the address to listen on; 0 is any free port.
        calibrate, csls: how the page ranks when it opens, see `open_task`.

    Raises:
        LPNError: when model, data set, or address cannot be used.
        MissingPackageError: if the explorer is not installed.
    """
    from importlib.metadata import entry_points

    # The package explorer registers its command, because lpn imports no app.
    point = next(iter(entry_points(group="lpn.commands", name="explore")), None)
    if point is None:
        raise MissingPackageError("The explorer is not installed; pip install lpn-explorer.")
    source = Path(model) if isinstance(model, str) else model
    root = None if data is None else Path(data)
    page: ServedPage = point.load().in_background(source, root, host, port, calibrate, csls)
    return page
