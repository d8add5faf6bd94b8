"""A contract as metadata of an ONNX file: a few short strings that any exporter can write; docs/contract.md has the table."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import msgspec

from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import printable
from lpn.core.images import MEAN, STD, Triple
from lpn.core.views import View
from lpn.models.contract import Contract, check_shapes, shown
from lpn.models.partition import Partition
from lpn.models.spec import ModelSpec

FORMAT = "lpn-explorer-onnx/2"
# The format of the shipped models, which state an LPN's architecture instead of a contract.
SHIPPED = "lpn-explorer-onnx/1"
REQUIRED = ("method", "views", "resize", "mirror")
# Maximum of characters of a text.
_SHOWN = 200


def to_metadata(contract: Contract) -> dict[str, str]:
    """Return the metadata of a contract; sizes and level follow from the graph's outputs."""
    first = contract.views[0]
    metadata = {
        "format": FORMAT,
        "method": contract.method,
        "title": contract.title,
        "views": " ".join(contract.views),
        "groups": ", ".join(" ".join(group) for group in contract.groups),
        "roles": contract.roles,
        "resize": contract.resize,
        "mean": " ".join(map(str, contract.mean)),
        "std": " ".join(map(str, contract.std)),
        "mirror": contract.mirror,
        "held": contract.held,
        "polar": " ".join(contract.polar),
    }
    if first in contract.part_names:
        metadata["parts"] = ", ".join(contract.part_names[first])
    if contract.partitions:
        metadata["partitions"] = json.dumps({view: asdict(one) for view, one in contract.partitions.items()})
    return metadata


def of_shipped(metadata: Mapping[str, str]) -> dict[str, str]:
    """Return the metadata of a shipped model with its contract in place of its architecture."""
    kept = {key: value for key, value in metadata.items() if key not in ("format", "spec")}
    return {**kept, **to_metadata(ModelSpec.from_json(metadata["spec"]).contract())}


def from_metadata(metadata: Mapping[str, str], name: str, shapes: Mapping[str, Sequence[int]]) -> Contract:
    """Read the contract of an ONNX file.

    Args:
        name: of the file, for messages.
        shapes: of `images` and `parts` (B, n, D), and of the graph's other outputs.

    Raises:
        ModelFileError: if an entry is missing or wrong, or contradicts the shapes.
    """
    if missing := [key for key in REQUIRED if not metadata.get(key)]:
        raise ModelFileError(
            f"{name} has no entry {missing[0]!r} in its metadata; a contract needs {', '.join(REQUIRED)}, see docs/contract.md."
        )
    n, size = shapes["parts"][1:]
    held = metadata.get("held", "")
    level = "one vector" if n == 1 else "parts only"
    if "features" in shapes:
        level = "exact, with held" if held else "exact"
        if "cells" not in shapes:
            raise ModelFileError(
                f"{name} has an output features {shown(shapes['features'])} but no output cells, the weights of the cells in "
                "each part; add cells, or leave features out."
            )
    views = tuple(metadata["views"].split())
    names = [part.strip() for part in metadata["parts"].split(",")] if metadata.get("parts") else None
    title = metadata.get("title") or f"{metadata['method']}, n = {n}, {shapes['images'][2]} x {shapes['images'][3]}"
    values: dict[str, Any] = {
        "method": printable(metadata["method"][:_SHOWN]),
        "title": printable(title[:_SHOWN]),
        "views": views,
        "input_size": (int(shapes["images"][2]), int(shapes["images"][3])),
        "n_parts": int(n),
        "embedding": int(size),
        "level": level,
        "held": printable(held[:_SHOWN]),
        "groups": tuple(tuple(group.split()) for group in metadata.get("groups", "").split(",") if group.strip()),
        "mean": _triple(metadata, "mean", MEAN, name),
        "std": _triple(metadata, "std", STD, name),
        "part_names": dict.fromkeys(views, tuple(printable(part[:_SHOWN]) for part in names)) if names else {},
        "polar": tuple(metadata.get("polar", "").split()),
    }
    values |= {key: metadata[key] for key in ("roles", "resize", "mirror") if metadata.get(key)}
    try:
        values["partitions"] = msgspec.json.decode(metadata.get("partitions", "{}"), type=dict[View, Partition])
        contract = Contract(**values)
    except (InputError, msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise ModelFileError(f"The metadata of {name} contradict each other: {error}") from error
    heads = {"head_weight": "the heads' weight", "head_bias": "the heads' bias"}
    if len(shapes.get("cells", ())) == 3:
        heads["cells"] = "the heads' cells"
    check_shapes(contract, {heads.get(key, key): shape for key, shape in shapes.items()})
    return contract


def _triple(metadata: Mapping[str, str], key: str, default: Triple, name: str) -> Triple:
    if not metadata.get(key):
        return default
    try:
        red, green, blue = (float(value) for value in metadata[key].split())
    except ValueError:
        red = green = blue = math.nan
    if not all(map(math.isfinite, (red, green, blue))):
        raise ModelFileError(
            f"{name} says {key}: {printable(metadata[key][:60])}; expected three numbers with blanks between them."
        )
    return red, green, blue
