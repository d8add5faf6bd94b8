"""The three views of a place, and the tasks between them."""

from __future__ import annotations

from typing import Literal, cast, get_args

View = Literal["satellite", "street", "drone"]
TaskName = Literal[
    "drone-to-satellite",
    "satellite-to-drone",
    "street-to-satellite",
    "satellite-to-street",
    "drone-to-street",
    "street-to-drone",
    "street-to-street",
]

# The most common first.
TASKS: tuple[TaskName, ...] = get_args(TaskName)
VIEWS: tuple[View, ...] = ("satellite", "street", "drone")
BRANCH: dict[View, str] = {"satellite": "model_1", "street": "model_2", "drone": "model_3"}


def branch_of(pictures: str) -> View:
    """Return the view whose branch describes a set of training pictures; "google" pictures use the street branch."""
    return "street" if pictures == "google" else cast(View, pictures)


def views_of(task: str) -> tuple[View, View]:
    """Return the views of a task's queries and gallery: drone and satellite for "drone-to-satellite"."""
    query, gallery = task.split("-to-")
    return cast(View, query), cast(View, gallery)
