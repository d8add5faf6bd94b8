"""Sources of tasks: a SOURCE is recognised by its files, and opens as tasks.

Each file of `lpn.sources.kinds` is one kind: a data set, a result of the published test code, plain arrays, an index. Other
packages add kinds by the entry points `lpn.sources`; a flight over a map is one of these (`lpn.flight.locate.source`).
Commands and the explorer import from here. The package imports `index`, `tasks`, and the packages below them.
"""

from __future__ import annotations

from lpn.sources.opened import OpenedSource as OpenedSource
from lpn.sources.options import SHIPPED_MODEL as SHIPPED_MODEL
from lpn.sources.options import Advanced as Advanced
from lpn.sources.options import CalibrateOption as CalibrateOption
from lpn.sources.options import CslsOption as CslsOption
from lpn.sources.options import KindOption as KindOption
from lpn.sources.options import ModelOptions as ModelOptions
from lpn.sources.options import PoolingOption as PoolingOption
from lpn.sources.options import ProviderOption as ProviderOption
from lpn.sources.options import SourceOptions as SourceOptions
from lpn.sources.options import model_names as model_names
from lpn.sources.options import of_each as of_each
from lpn.sources.options import shipped_model as shipped_model
from lpn.sources.recognise import GROUP as GROUP
from lpn.sources.recognise import TaskSource as TaskSource
from lpn.sources.recognise import kind_of as kind_of
from lpn.sources.recognise import known_kinds as known_kinds
from lpn.sources.recognise import open_source as open_source
from lpn.sources.recognise import source_of as source_of
