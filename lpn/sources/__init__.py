"""Where tasks come from: five kinds of source, each of which opens as tasks that every command takes.

`Data` is a data set under a model, `Published` a result of the published test code, `Arrays` descriptors that any model made,
`Indexed` an index of tiles, and `Flown` a flight over a map. Commands and the explorer import from here; this room imports
everything below it.
"""

from __future__ import annotations

from lpn.sources.opened import OpenedSource
from lpn.sources.sources import (
    Arrays,
    CalibrateOption,
    CslsOption,
    Data,
    Flown,
    Indexed,
    KindOption,
    ModelOptions,
    PoolingOption,
    ProviderOption,
    Published,
    TaskSource,
    model_names,
    of_each,
    open_data,
    shipped_model,
)

# The sources that a word behind a command names; without a word, it is a data set.
NAMED = (Published, Arrays, Indexed, Flown)

__all__ = [
    "NAMED",
    "Arrays",
    "CalibrateOption",
    "CslsOption",
    "Data",
    "Flown",
    "Indexed",
    "KindOption",
    "ModelOptions",
    "OpenedSource",
    "PoolingOption",
    "ProviderOption",
    "Published",
    "TaskSource",
    "model_names",
    "of_each",
    "open_data",
    "shipped_model",
]
