"""The notes below a table: protocol, data, and networks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lpn.reproduce.sources import Source, counted
from lpn.reproduce.tables import PaperTable, Scale, Training
from lpn.reproduce.trainings import TrainingJob

# Notes on single tables.
_APART = {
    "table1": (
        "Metric losses as released (layumi/University1652-triplet-loss): cosines of each satellite with the hardest of four "
        "drone pictures of its place, and with the hardest of other places among 96 drone pictures of the batch; no street "
        "pictures, and so no google.",
    ),
    "table2": (
        "The paper quotes the rows that say so from other work; nothing of them is trained or measured here. It has one row "
        "of the LPN: its text has the sequential partition, and the released run rings and rows. SAFA and SAFA + LPN are "
        "described without their mirror.",
    ),
    "table4": (
        "Queries are turned counter-clockwise by the degrees named, on their own canvas, corners black. A drop is not "
        "significant here if it is at most the largest of the paper's own in the same column. The paper has no rows of the "
        "baseline.",
    ),
    "table5": ("The parts named, counted from the centre, are compared and no others.",),
    "table6": (
        "Both sides are described by the branch named; ImageNet alone: the mean over the last feature map. Baseline and LPN are "
        "those of Table I.",
    ),
    "figure5": ("The paper's values are those of Table I; for other n it draws a curve only.",),
    "figure7": (
        "An even map has the centre's share of the cells; the paper shows heatmaps of single pictures and gives no number.",
    ),
}
_GOOGLE = "LPN and the baseline are trained with google, as the baseline of 58.49 is in the released script."
# Notes on what differs between the protocols, by table.
_OF_PROTOCOL: dict[str, dict[str, str]] = {
    "table4": {
        "ours": "Turned queries, protocol ours: bicubic; the paper does not say.",
        "released": "Turned queries, protocol released: to the nearest pixel, as wtyhub/LPN image_folder.py does.",
    },
    "table6": {
        "ours": "Transfer, protocol ours: the descriptors of retrieval, pictures resized to the network's input.",
        "released": "Transfer, protocol released (layumi/cnnimageretrieval-pytorch): the mean over the last feature map.",
    },
}


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
    google = table.key == "table1" and (not data or data[0].has_google)
    notes = [*[_GOOGLE] * google, *_APART.get(table.key, ())]
    if table.key in _OF_PROTOCOL:
        notes.append(_OF_PROTOCOL[table.key][scale.protocol])
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
        notes += [scale.note, f"Trained on {_places(done)}."]
        of = {job.recipe.backbone: job.start for job in done}
        begin = [f"{name} from {start.name if start else 'random weights'}" for name, start in of.items()]
        notes.append(f"Before training: {', '.join(begin)}.")
        if scale.changes:
            notes.append(changed(scale, [job.training for job in done]))
        if len(seeds) > 1:
            notes.append("Mean of the seeds trained so far, ± half the width of its 95 % interval (Student's t).")
    if lost := [job.name for job in own if job.diverged]:
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
