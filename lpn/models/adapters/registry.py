"""The adapters of published models, and the choice of one for a checkpoint."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pkgutil import iter_modules

from torch import Tensor

from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import first_few, printable
from lpn.models.adapters import methods
from lpn.models.adapters.published import PublishedParts
from lpn.models.entries import Entries

GROUP = "lpn.adapters"
# Prefixes of all names after training with DataParallel, torch.compile, or a class with the network as `model` or `net`.
_WRAPPERS = ("module.", "_orig_mod.", "model.", "net.", "network.")
_SHOWN = 4


@dataclass(frozen=True)
class Adapter:
    """The reader of one method's checkpoints.

    Attributes:
        kind: the method's name for `--kind`; several adapters may have the same name.
        needs: patterns that must each match the beginning of some entry's name. An option of opts.yaml is an entry
            `opts.yaml:NAME`.
        build: builds the model from all entries; None for LPN, which `lpn.models.checkpoints` opens. It raises ModelFileError for
            entries that are missing, have wrong shapes, contradict the options, or belong to another form of the method, and
            InputError if timm is needed and missing.
        unused: a pattern of entries for training alone.
    """

    kind: str
    needs: tuple[str, ...]
    build: Callable[[Entries], PublishedParts] | None
    unused: str = r"(?!)"

    def fits(self, names: Collection[str]) -> bool:
        """Return whether all needed entries exist."""
        return all(any(re.match(pattern, name) for name in names) for pattern in self.needs)


_HEAD = r"classifier\d*\.add_block\."
LPN = Adapter("lpn", (r"model_\d\.model\.", f"{_HEAD}0.weight", f"{_HEAD}1.weight", f"{_HEAD}1.running_mean"), None)


@cache
def adapters() -> tuple[Adapter, ...]:
    """Return the adapters of this package and of others, LPN's first."""
    modules = [import_module(f"{methods.__name__}.{module.name}") for module in iter_modules(methods.__path__)]
    others = [adapter for point in entry_points(group=GROUP) for adapter in point.load()]
    return (LPN, *(adapter for module in modules for adapter in module.ADAPTERS), *others)


def choose(
    kind: str | None, state: Mapping[str, Tensor], options: Collection[str], name: str
) -> tuple[Adapter, dict[str, Tensor]]:
    """Return the adapter of a state dict, and its entries without a prefix that training added to all names.

    The adapter with the most needed entries wins.

    Args:
        kind: the method that a user named; None to recognise it.
        options: names of the options beside the file.

    Raises:
        ModelFileError: if no adapter fits, or two fit equally.
        InputError: if there is no such kind.
    """
    known = [adapter for adapter in adapters() if kind in (None, adapter.kind)]
    if not known:
        kinds = dict.fromkeys(adapter.kind for adapter in adapters())
        raise InputError(
            f"There is no kind of model {printable(str(kind))[:60]!r}; expected one of {', '.join(kinds)}."
        )
    stated = [f"opts.yaml:{option}" for option in options]
    inner = dict(state)
    while True:
        fitting = [adapter for adapter in known if adapter.fits([*inner, *stated])]
        most = max((len(adapter.needs) for adapter in fitting), default=0)
        best = {adapter.kind: adapter for adapter in fitting if len(adapter.needs) == most}
        if len(best) == 1:
            return next(iter(best.values())), inner
        if best:
            raise ModelFileError(
                f"{name} has the entries of {' and of '.join(best)}, and nothing decides between them; choose one with --kind, "
                "or for a second model with --beside-kind."
            )
        prefix = next((prefix for prefix in _WRAPPERS if inner and all(key.startswith(prefix) for key in inner)), None)
        if prefix is None:
            break
        inner = {key.removeprefix(prefix): value for key, value in inner.items()}
    if kind is not None:
        # A named method need not be recognised; the builder reports a missing entry.
        return known[0], inner
    entries = first_few([printable(key)[:80] for key in inner], _SHOWN) or "nothing"
    raise ModelFileError(
        f"{name} is not a checkpoint of a known model: it holds {entries}. Name its method with --kind "
        f"({', '.join(dict.fromkeys(adapter.kind for adapter in known))}); a network of timm opens as timm:NAME:FILE, one of "
        "transformers as its folder, and the weights of a backbone go to lpn train --init."
    )
