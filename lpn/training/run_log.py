"""The log of a training run: log.csv, a TensorBoard log, and a line in the terminal for each epoch."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from tensorboardX import SummaryWriter

from lpn.core.consoles import Console
from lpn.core.errors import OutputError
from lpn.core.files import space_remedy, write_atomic
from lpn.training.model_selection import EpochMetrics


class RunLog:
    """The log of a run's folder, with a row for each epoch.

    Both files are written from the rows alone, so a resumed run neither repeats nor loses an epoch.

    Args:
        history: rows of the epochs so far; the trainer appends to it.

    Raises:
        OutputError: when the TensorBoard log cannot be written.
    """

    def __init__(self, out: Path, history: Sequence[EpochMetrics], console: Console) -> None:
        self.out, self.history, self.console = out, history, console
        self._written: set[tuple[str, int]] = set()
        folder = out / "tensorboard"
        try:
            for old in folder.glob("events.out.tfevents.*"):
                old.unlink()
            self._board = SummaryWriter(str(folder))
        except OSError as error:
            raise OutputError(
                f"{folder} cannot be written ({error.strerror or error}); {space_remedy(error)}choose another --out."
            ) from error

    def save(self) -> None:
        """Write all rows to log.csv, and new metrics to TensorBoard."""
        keys = list(dict.fromkeys(key for row in self.history for key in row))
        log = io.StringIO()
        writer = csv.DictWriter(log, keys)
        writer.writeheader()
        writer.writerows(self.history)
        write_atomic(self.out / "log.csv", log.getvalue().encode())
        for epoch, row in enumerate(self.history, 1):
            for key, value in row.items():
                if key != "epoch" and (key, epoch) not in self._written:
                    tag = key.replace("@", "_at_").replace(" ", "/", 1).replace(" ", "_")
                    self._board.add_scalar(tag, value, epoch)
                    self._written.add((key, epoch))
        self._board.flush()

    def print_epoch(self, epochs: int) -> None:
        """Print one line about the last epoch."""
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

    def close(self) -> None:
        """Finish the TensorBoard log."""
        self._board.close()
