"""What a training tells as it goes: log.csv, a TensorBoard log, a line for each epoch, and curves in the terminal."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from rich.console import Console
from tensorboardX import SummaryWriter

from lpn.core.errors import OutputError
from lpn.core.files import write_atomic
from lpn.training.model_selection import Row

_EIGHTHS = " ▁▂▃▄▅▆▇█"
_PLAIN = str.maketrans("▁▂▃▄▅▆▇█┤", "   #####|")
_ROWS = 6


class RunLog:
    """The log of a run's folder, a row for each epoch; only the process that leads has one.

    Both logs are written from the rows alone, so a resumed run repeats no step, and loses none.

    Args:
        history: rows of the epochs before, of a run that is resumed; those of the run are appended by the trainer.

    Raises:
        OutputError: when the TensorBoard log cannot be written.
    """

    def __init__(self, out: Path, history: Sequence[Row], console: Console) -> None:
        self.out, self.history, self.console = out, history, console
        self._written: set[tuple[str, int]] = set()
        folder = out / "tensorboard"
        try:
            for old in folder.glob("events.out.tfevents.*"):
                old.unlink()
            self._board = SummaryWriter(str(folder))
        except OSError as error:
            raise OutputError(
                f"{folder} cannot be written ({error.strerror or error}); free space or choose another --out."
            ) from error

    def save(self) -> None:
        """Write all rows to log.csv, and to TensorBoard those figures it does not have yet."""
        keys = list(dict.fromkeys(key for row in self.history for key in row))
        log = io.StringIO()
        writer = csv.DictWriter(log, keys)
        writer.writeheader()
        writer.writerows(self.history)
        write_atomic(self.out / "log.csv", log.getvalue().encode())
        for epoch, row in enumerate(self.history, 1):
            for key, value in row.items():
                if key != "epoch" and (key, epoch) not in self._written:
                    self._board.add_scalar(
                        key.replace("@", "_at_").replace(" ", "/", 1).replace(" ", "_"), value, epoch
                    )
                    self._written.add((key, epoch))
        self._board.flush()

    def say_epoch(self, epochs: int) -> None:
        """One line on the epoch that has ended."""
        row = self.history[-1]
        tested = "".join(
            f"  {key.replace('recall@1', 'R@1')} {value:.2f}"
            for key, value in row.items()
            if key.startswith("recall@1")
        )
        self.console.print(
            f"Epoch {len(self.history)}/{epochs}  loss {row['loss']:.3f}  rate {row['lr']:.1e}  "
            f"{row['images_per_second']:.1f} images/s{tested}",
            highlight=False,
            soft_wrap=True,
        )

    def say_curves(self, column: str | None) -> None:
        """Charts of the loss, and of the figure named, over the epochs."""
        blocks = str(self.console.encoding).lower().startswith("utf")
        for title, key in (("loss", "loss"), (column or "", column)):
            points = {epoch: row[key] for epoch, row in enumerate(self.history, 1) if key is not None and key in row}
            if len(points) > 1:
                text = "\n".join(chart(points, title.replace("recall@1", "R@1"), min(60, self.console.width - 12)))
                self.console.print(text if blocks else text.translate(_PLAIN), highlight=False, soft_wrap=True)

    def close(self) -> None:
        """Finish the TensorBoard log."""
        self._board.close()


def chart(points: Mapping[int, float], title: str, width: int = 60) -> list[str]:
    """A bar chart in text: values over epochs, in at most `width` columns, each the mean of its epochs.

    The highest bar is the greatest value; the axis begins at the least, which still has the lowest bar.

    Args:
        points: by epoch, in order.
    """
    epochs = list(points)
    columns = max(1, min(width, len(epochs)))
    bounds = [len(epochs) * i // columns for i in range(columns + 1)]
    groups = [[points[e] for e in epochs[a:b]] for a, b in pairwise(bounds)]
    means = [sum(group) / len(group) for group in groups]
    low, high = min(means), max(means)
    span = (high - low) or 1.0
    heights = [1 + round((value - low) / span * (8 * _ROWS - 1)) for value in means]
    wide = max(1, min(3, width // columns))
    lines = [f"{title} by epoch"]
    for level in reversed(range(_ROWS)):
        label = f"{high:9.3g}" if level == _ROWS - 1 else f"{low:9.3g}" if level == 0 else " " * 9
        bars = "".join(_EIGHTHS[min(8, max(0, height - 8 * level))] * wide for height in heights)
        lines.append(f"{label} ┤{bars}".rstrip())
    first, last = str(epochs[0]), str(epochs[-1])
    lines.append(" " * 11 + first + last.rjust(max(len(last) + 1, wide * columns - len(first))))
    return lines
