"""Where tasks come from: a SOURCE, which says by what lies on the disk what it is, and opens as tasks.

Each file of `lpn.sources.kinds` is one kind: a data set, a result of the published test code, plain arrays, an index. Other
packages bring kinds by the entry points `lpn.sources`; a flight over a map is one of these (`lpn.flight.locate.source`). Commands
and the explorer import from here; this room imports `index`, `tasks`, and what lies below them.
"""

from __future__ import annotations

from lpn.sources.opened import OpenedSource
from lpn.sources.options import (
    SHIPPED_MODEL,
    Advanced,
    CalibrateOption,
    CslsOption,
    KindOption,
    ModelOptions,
    PoolingOption,
    ProviderOption,
    SourceOptions,
    model_names,
    of_each,
    shipped_model,
)
from lpn.sources.recognise import GROUP, TaskSource, kind_of, known_kinds, open_source, source_of

__all__ = [
    "GROUP",
    "SHIPPED_MODEL",
    "Advanced",
    "CalibrateOption",
    "CslsOption",
    "KindOption",
    "ModelOptions",
    "OpenedSource",
    "PoolingOption",
    "ProviderOption",
    "SourceOptions",
    "TaskSource",
    "kind_of",
    "known_kinds",
    "model_names",
    "of_each",
    "open_source",
    "shipped_model",
    "source_of",
]
