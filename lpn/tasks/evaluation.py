"""Recall and AP of an opened task, whatever it was opened from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.datasets import Dataset
from lpn.models.base import Model
from lpn.retrieval.calibration import Calibration
from lpn.retrieval.evaluate import Result, evaluate_descriptors
from lpn.retrieval.protocol import Protocol
from lpn.tasks.opening import task_calibration
from lpn.tasks.task import Task


def evaluate_task(task: Task, protocol: Protocol | None = None) -> Result:
    """Evaluate a task by its own descriptors.

    Part weights of the task do not count; CSLS of the task does, unless the protocol has its own. Queries whose truth is not
    known are left out.

    Args:
        protocol: what is evaluated; by default whole descriptors.

    Raises:
        InputError: when no query's truth is known, or the protocol needs pictures.
    """
    task = replace(task, weights=None)
    if task.neighbours:
        protocol = replace(protocol or Protocol(), csls=(protocol and protocol.csls) or task.neighbours)
    task.check_truth()
    made = "descriptors as saved" if task.model is None else "each part normalised"
    result = evaluate_descriptors(
        task.sides(),
        (task.query_labels, task.gallery_labels),
        task.truth,
        task.name,
        protocol,
        clauses=[
            made,
            *([] if task.calibration is None else [task.calibration.describe()]),
            *([f"tiles {task.of_index}"] if task.of_index else []),
        ],
    )
    changed = protocol is not None and (protocol.average or protocol.csls or protocol.centre or protocol.parts)
    return result if changed else replace(result, errors=_errors(task))


def protocol_calibration(
    model: Model, dataset: Dataset, protocol: Protocol, calibrate: bool | None = None
) -> Calibration | None:
    """Choose as `task_calibration` does; by default none for a protocol that centres descriptors or takes its own branch."""
    own = protocol.centre or protocol.branch or protocol.released
    return task_calibration(model, dataset, False if calibrate is None and own else calibrate)


def _errors(task: Task) -> Float64Array | None:
    """Return metres from each query of known truth to its answer, (K,); None without positions."""
    geometry, known = task.geometry, task.known
    if geometry is None:
        return None
    answers = task.retrieved.best
    metres = np.where(answers < 0, np.inf, geometry.answer_errors_m(answers))
    metres = metres if known is None else metres[known]
    return None if np.isnan(metres).any() else metres
