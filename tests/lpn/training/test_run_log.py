from __future__ import annotations

import csv
import io
import struct
from pathlib import Path

import pytest
from rich.console import Console
from tensorboardX.proto.event_pb2 import Event

from lpn.core.errors import OutputError
from lpn.training.model_selection import EpochMetrics, best_epoch
from lpn.training.run_log import RunLog


def row(epoch: int, loss: float, **more: float) -> EpochMetrics:
    return {"epoch": epoch, "loss": loss, "lr": 1e-3, "seconds": 1.0, "images_per_second": 8.0, **more}


def scalars(out: Path) -> list[tuple[str, int, float]]:
    """Read tag, step, and value of each scalar in a TensorBoard log; a record is a length, two checksums, and an event."""
    (file,) = (out / "tensorboard").iterdir()
    data, found, position = file.read_bytes(), [], 0
    while position < len(data):
        (length,) = struct.unpack_from("<Q", data, position)
        event = Event.FromString(data[position + 12 : position + 12 + length])
        found += [(value.tag, event.step, value.simple_value) for value in event.summary.value]
        position += length + 16
    return found


def test_logs_hold_every_epoch_once_although_the_run_was_resumed(tmp_path: Path) -> None:
    console = Console(file=io.StringIO(), width=100)
    history = [row(1, 4.0)]
    run_log = RunLog(tmp_path, history, console)
    run_log.save()
    history[-1] |= {"recall@1 drone-to-satellite": 25.0}
    run_log.save()
    run_log.close()
    again = [*history, row(2, 3.0)]
    run_log = RunLog(tmp_path, again, console)
    run_log.save()
    run_log.close()
    found = scalars(tmp_path)
    assert len({(tag, step) for tag, step, _ in found}) == len(found)
    assert [(step, value) for tag, step, value in found if tag == "loss"] == [(1, 4.0), (2, 3.0)]
    assert ("recall_at_1/drone-to-satellite", 1, 25.0) in found
    with (tmp_path / "log.csv").open() as file:
        assert [line["loss"] for line in csv.DictReader(file)] == ["4.0", "3.0"]


def test_an_epoch_is_one_line_with_what_was_tested(tmp_path: Path) -> None:
    said = io.StringIO()
    run_log = RunLog(tmp_path, [row(1, 4.0, **{"recall@1 drone-to-satellite": 25.0})], Console(file=said, width=40))
    run_log.print_epoch(30)
    run_log.close()
    assert said.getvalue() == "Epoch 1/30  loss 4.000  rate 1.0e-03  8.0 images/s  R@1 drone-to-satellite 25.00\n"


def test_a_log_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "tensorboard").write_text("a file")
    with pytest.raises(OutputError, match="tensorboard cannot be written"):
        RunLog(tmp_path, [], Console(quiet=True))


def test_the_best_epoch_is_the_first_of_the_highest() -> None:
    history = [row(1, 4.0, score=20.0), row(2, 3.0), row(3, 2.0, score=50.0), row(4, 1.0, score=50.0)]
    assert best_epoch(history, "score") == (3, 50.0)
    assert best_epoch(history, "other") is None
