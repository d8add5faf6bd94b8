"""The notes below a table: protocol, data, and networks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lpn.reproduce.jobs import TrainingJob
from lpn.reproduce.sources import Source, counted
from lpn.reproduce.tables import PaperTable, Scale, Training


def protocol(rows: Mapping[str, str]) -> str:
    """Merge the protocols of rows, by label: shared clauses first, then each other clause with its rows."""
    clauses = {label: text.removeprefix("Protocol: ").removesuffix(".").split("; ") for label, text in rows.items()}
    held: dict[str, list[str]] = {}
    for label, of_row in clauses.items():
        for clause in of_row:
            held.setdefault(clause, []).append(label)
    if not held:
        return "Nothing was measured."
    shared = [clause for clause, labels in held.items() if len(labels) == len(rows)]
    others = [f"{clause} ({_rows(labels, list(rows))})" for clause, labels in held.items() if len(labels) < len(rows)]
    apart = f" Not in every row: {'; '.join(others)}." if others else ""
    return f"Protocol: {'; '.join(shared)}.{apart}"


def _rows(labels: Sequence[str], every: Sequence[str]) -> str:
    """Name some rows of a table, or "all but" the others if these are fewer."""
    others = [label for label in every if label not in labels]
    return " / ".join(labels) if len(labels) <= len(others) else f"all but {' / '.join(others)}"


def about(table: PaperTable, data: Sequence[Source], scale: Scale) -> list[str]:
    """Describe a table and the pictures it was measured on."""
    notes = [table.google] if table.google and (not data or data[0].has_google) else []
    notes += table.notes
    if table.protocols:
        notes.append(table.protocols[scale.protocol])
    if not data:
        return notes
    if any(source.rendered for source in data):
        notes.append(
            "**Data: the rendered world, not the paper's data sets**; its figures compare with one another only."
        )
    else:
        notes.append(f"Data: {', '.join(f'{source.name} ({source.dataset.kind})' for source in data)}.")
    notes.append(f"Measured on {'; '.join(f'{source.name}: {source.sizes(table.measure)}' for source in data)}.")
    return notes


def networks(own: Sequence[TrainingJob], scale: Scale, seeds: Sequence[int]) -> list[str]:
    """Describe the trainings of the networks that were not given."""
    notes: list[str] = []
    done = [job for job in own if job.done]
    if done:
        notes += [scale.described, f"Trained on {_places(done)}."]
        of = {job.recipe.backbone: job.start for job in done}
        begin = [f"{name} from {start.name if start else 'random weights'}" for name, start in of.items()]
        notes.append(f"Before training: {', '.join(begin)}.")
        if scale.changes:
            notes.append(changed(scale, [job.training for job in done]))
        if len(seeds) > 1:
            notes.append("Mean of the seeds trained so far, ± half the width of its 95 % interval (Student's t).")
    if lost := [job.name for job in own if job.ended == "diverged"]:
        notes.append(f"Diverged, and given up: {', '.join(lost)}.")
    return notes


def changed(scale: Scale, trainings: Sequence[Training]) -> str:
    """Name the user's changes, each with the networks that keep their own setting."""
    kept: dict[str, dict[str, None]] = {}
    for training in trainings:
        for name in scale.kept(training):
            kept.setdefault(name, {})[training.name] = None
    changes = [
        f"{name} = {value}" + (f" (not for {', '.join(kept[name])})" if name in kept else "")
        for name, value in scale.changes.items()
    ]
    return f"Changed: {', '.join(changes)}."


def _places(jobs: Sequence[TrainingJob]) -> str:
    """Count the training places, by network where they differ."""
    of: dict[str, dict[str, None]] = {}
    for job in jobs:
        full = job.source.dataset.published_sizes.get("train/satellite")
        count = counted(len(job.source.places(job.recipe.sets)), full.places if full else None)
        of.setdefault(f"{count} places", {})[job.training.name] = None
    return "; ".join(f"{places} ({', '.join(names)})" if len(of) > 1 else places for places, names in of.items())
