"""The panels: each folder here whose `__init__.py` has a `PANEL`, and the panels of the entry points `lpn.panels`."""

from __future__ import annotations

import pkgutil
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

from explorer.screen import fields
from explorer.screen.panel import Panel

GROUP = "lpn.panels"


def _found() -> dict[str, Panel]:
    names = [module.name for module in pkgutil.iter_modules(__path__)]
    panels = [import_module(f"{__name__}.{name}").PANEL for name in sorted(names)]
    panels += [point.load() for point in entry_points(group=GROUP)]
    keys = [one.key for panel in panels for one in (panel, *panel.commands) if one.key]
    assert len(set(keys)) == len(keys), keys
    for panel in panels:
        fields.add_panel(panel.name, panel.fields, None if panel.part is None else panel.offered)
    return {panel.name: panel for panel in panels}


PANELS: dict[str, Panel] = _found()


def folder(name: str) -> Path | None:
    """Return the folder of a panel's module and style sheet; None if it is unknown, or never opens."""
    panel = PANELS.get(name)
    if panel is None or panel.part is None:
        return None
    source = import_module(panel.part.__module__).__file__
    assert source is not None
    return Path(source).parent


def scripted(name: str) -> bool:
    """Return whether a panel has a script of its own."""
    found = folder(name)
    return found is not None and (found / f"{name}.js").is_file()
