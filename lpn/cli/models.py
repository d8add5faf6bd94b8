"""The command models: the shipped models."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from lpn.core.consoles import Console, wide_console
from lpn.core.files import check_outputs, write_json
from lpn.core.text_tables import TextTable
from lpn.core.texts import counted

if TYPE_CHECKING:
    from lpn.models.shipped import ModelCard


@dataclass
class ModelsCommand:
    """List the models that ship, by the names that --model takes, or show the card of one."""

    name: Annotated[str | None, tyro.conf.Positional] = None
    """Model whose card is shown: training, figures with intervals and their source, limits."""
    json: Path | None = None
    """File to write the cards to, as JSON."""

    def run(self) -> None:
        import msgspec

        from lpn.models.shipped import model_card, model_cards

        check_outputs((self.json, ".json"))
        cards = model_cards() if self.name is None else (model_card(self.name),)
        console = wide_console()
        if self.name is None:
            _list(cards, console)
        else:
            _show(cards[0], console)
        if self.json is not None:
            values = [
                {**msgspec.to_builtins(card), "bytes": card.size, "file": str(card.file().resolve())} for card in cards
            ]
            write_json(self.json, values, ensure_ascii=False)


def _list(cards: tuple[ModelCard, ...], console: Console) -> None:
    rows = []
    for card in cards:
        first = [one for one in card.figures if one.task == card.figures[0].task]
        figures = "\n".join(f"{one.data}: {_interval(one.percent['R@1'])}" for one in first)
        rows.append((card.name, card.network, card.trained_on, figures, f"{card.size / 1e6:.1f}", card.licence))
    title = "Models that ship: --model NAME, or lpn.load(NAME); lpn models NAME shows the card"
    head = ("name", "network", "trained on", "R@1 with its 95 % interval", "MB", "licence")
    TextTable(head, rows, title, align="llllrl", ruled=range(1, len(rows))).print(console)


def _show(card: ModelCard, console: Console) -> None:
    console.print(f"{card.name}: {card.summary}", markup=False, highlight=False)
    for what, lines in (
        ("network", (card.network,)),
        ("trained on", (card.trained_on,)),
        ("made by", card.commands),
        ("seeds", (", ".join(map(str, card.seeds)),)),
        ("limits", card.limits),
        ("licence", (card.licence,)),
        ("file", (f"{card.file().resolve()}, {card.size / 1e6:.1f} MB",)),
        ("to train from", (str(card.file(trained=True).resolve()),) if card.trained else ()),
    ):
        for number, line in enumerate(lines):
            console.print(f"  {what if number == 0 else '':14}{line}", markup=False, highlight=False, soft_wrap=True)
    rows = []
    for one in card.figures:
        where = f"{one.data}, {one.task}, {counted(one.queries, 'query')} in {counted(one.gallery, 'picture')}"
        rows.append((where, *map(_interval, one.percent.values())))
    head = ("data and task", *card.figures[0].percent)
    TextTable(head, rows, "Figures in %, each with its 95 % interval", align="l").print(console)
    for command, commit in dict.fromkeys((one.command, one.commit) for one in card.figures):
        console.print(f"  Measured by: {command} (commit {commit})", markup=False, highlight=False, soft_wrap=True)


def _interval(values: tuple[float, float, float]) -> str:
    value, low, high = values
    return f"{value:.1f} ({low:.1f}–{high:.1f})"
