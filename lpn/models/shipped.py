"""The shipped models by name, with one card for each, `models/NAME.json` in the assets.

A card has its model's training data, commands, figures with their sources, limits, and licence.
"""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache
from pathlib import Path

import msgspec

from lpn.core.demo import ASSETS
from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import printable
from lpn.core.formats import decode_json
from lpn.models.model_folders import file_in

CARDS = ASSETS / "models"
FORMAT = "lpn-model-card/1"


class CardFigures(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Figures of a model on one task of a data set.

    Attributes:
        data: the data set.
        task: such as "drone-to-satellite".
        queries, gallery: numbers of pictures.
        percent: each measure in percent, as the value, and the lower and upper end of its 95 % interval.
        command, commit: the source of the figures.
    """

    data: str
    task: str
    queries: int
    gallery: int
    percent: dict[str, tuple[float, float, float]]
    command: str
    commit: str


class ModelCard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The card of a shipped model.

    Attributes:
        name: for `--model` and `lpn.load`.
        summary: one sentence.
        network: backbone and number of parts.
        exported, trained: its files below the assets: an `.onnx`, and a `.safetensors` to train from, empty without one.
        trained_on: the training pictures.
        commands: the commands of its training and export, in order.
        seeds: of the trainings.
        figures: measured, each with its source.
        limits: its weaknesses.
        licence: of the weights.
    """

    format: str
    name: str
    summary: str
    network: str
    exported: str
    trained: str
    trained_on: str
    commands: tuple[str, ...]
    seeds: tuple[int, ...]
    figures: tuple[CardFigures, ...]
    limits: tuple[str, ...]
    licence: str

    def file(self, trained: bool = False) -> Path:
        """Return the path of the `.onnx`, or of the `.safetensors`.

        Raises:
            ModelFileError: if the model ships without a `.safetensors`.
        """
        if trained and not self.trained:
            able = " or ".join(card.name for card in model_cards() if card.trained)
            raise ModelFileError(f"{self.name} ships as an .onnx alone, which is not trained or exported; give {able}.")
        return ASSETS / (self.trained if trained else self.exported)

    @property
    def size(self) -> int:
        """The size of the `.onnx` in bytes."""
        return self.file().stat().st_size


@cache
def model_cards() -> tuple[ModelCard, ...]:
    """Return the cards of all shipped models, in order of their names; ModelFileError if a card is damaged."""
    return tuple(_card(file) for file in sorted(CARDS.glob("*.json")))


def model_card(name: str) -> ModelCard:
    """Return the card of a model.

    Raises:
        InputError: if no such model ships; the message has the nearest name.
    """
    for card in model_cards():
        if card.name == name:
            return card
    raise InputError(f"No model of the name {printable(name)[:80]} ships; {_nearest(name)}.")


def model_file(model: str | Path, trained: bool = False) -> Path:
    """Return the file of a path, or of a shipped model's name; an existing file comes first.

    A folder stands for the model in it, see `file_in`. A shipped model's name comes before a folder of that name; write
    `./NAME` for the folder.

    Args:
        trained: whether to return a shipped model's `.safetensors`, the start of trainings and exports, instead of its `.onnx`.

    Raises:
        ModelFileError: if a name without folder and ending is neither a file nor a shipped model, or a folder does not hold
            exactly one model.
    """
    path = Path(model)
    if path.is_file():
        return path
    named = len(path.parts) == 1 and not path.suffix
    for card in model_cards() if named else ():
        if card.name == str(model):
            return card.file(trained)
    if path.is_dir():
        return file_in(path)
    if not named:
        return path
    raise ModelFileError(
        f"There is no model file at {printable(str(path))[:80]}, and no model of that name ships; {_nearest(str(path))}."
    )


def _nearest(name: str) -> str:
    names = [card.name for card in model_cards()]
    near = get_close_matches(name, names, 1, 0.5)
    return f"the nearest is {near[0]} (lpn models lists all)" if near else f"lpn models lists {', '.join(names)}"


def _card(file: Path) -> ModelCard:
    name = f"The card {file.name}"
    try:
        return decode_json(file.read_bytes(), ModelCard, name, FORMAT, ModelFileError)
    except (OSError, ValueError, msgspec.MsgspecError, RecursionError) as error:
        raise ModelFileError(f"{name} is damaged ({printable(str(error))}); install lpn-explorer again.") from error
