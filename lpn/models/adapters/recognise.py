"""Which published model a state dict is of, by the names of its entries."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, get_args

from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import printable

Kind = Literal["lpn", "fsra", "mccg", "sdpl", "sample4geo", "dac", "camp", "game4loc", "denseuav"]
KINDS: tuple[Kind, ...] = get_args(Kind)
_SHOWN = 4


@dataclass(frozen=True)
class Signature:
    """The entries by which a format is recognised.

    Attributes:
        title: of the method, for messages.
        all_of: patterns of names, each of which some entry must match from its begin.
        none_of: patterns that no entry may match.
    """

    title: str
    all_of: tuple[str, ...]
    none_of: tuple[str, ...] = ()


_HEAD = r"add_block\."
# In this order: the first that fits is the model.
SIGNATURES: dict[Kind, Signature] = {
    "fsra": Signature("FSRA", (r"model_1\.transformer\.blocks\.", rf"model_1\.classifier1\.{_HEAD}")),
    "sdpl": Signature("SDPL", (r"model_1\.model\.", r"model_1\.shift_blocks\.", rf"classifier\d\.{_HEAD}")),
    "camp": Signature("CAMP", (r"model_1\.convnext\.", r"model_1\.pos_embed$")),
    "dac": Signature("DAC", (r"model_1\.convnext\.", r"model_1\.proj\.mlp\.0\.weight$")),
    "mccg": Signature(
        "MCCG",
        (r"model_1\.convnext\.", r"model_1\.tri_layer\.cw\.", rf"model_1\.classifier_mcb1\.{_HEAD}"),
        (r"logit_scale$",),
    ),
    "game4loc": Signature("Game4Loc", (r"model[12]?\.blocks\.", r"model[12]?\.reg_token$", r"model[12]?\.fc_norm\.")),
    "sample4geo": Signature("Sample4Geo", (r"model\.stem\.0\.weight$", r"model\.head\.norm\.")),
    "denseuav": Signature("DenseUAV", (r"backbone\.backbone\.", r"head\.head\.")),
    "lpn": Signature("LPN", (r"model_1\.model\.", rf"classifier\d*\.{_HEAD}"), (r"model_\d\.shift_blocks\.",)),
}


def recognise(keys: Collection[str], name: str) -> Kind:
    """Return the kind of a state dict with these names.

    Raises:
        ModelFileError: if it is none of the known ones, with the names found and the nearest kind; or if its names fit two kinds.
    """
    shares = {kind: _share(signature, keys) for kind, signature in SIGNATURES.items()}
    for kind, share in shares.items():
        if share == 1:
            return kind
    convnext = [key for key in keys if key.startswith("model_1.convnext.")]
    if convnext and not any("tri_layer" in key for key in keys):
        raise ModelFileError(
            f"{name} holds a ConvNeXt under model_1.convnext and nothing that tells DAC from CAMP; say which with --kind dac or "
            "--kind camp."
        )
    # A file of another branch alone is nearest to its own method, too.
    alike = [re.sub(r"^model_\d\.", "model_1.", key) for key in keys]
    shares = {kind: _share(signature, alike) for kind, signature in SIGNATURES.items()}
    nearest = max(shares, key=lambda kind: shares[kind])
    found = ", ".join(printable(key)[:80] for key in list(keys)[:_SHOWN]) or "nothing"
    more = f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
    near = "none of the known models has such names"
    if shares[nearest] > 0:
        lacking = [pattern for pattern in SIGNATURES[nearest].all_of if not _matched(pattern, keys)]
        near = f"the nearest is {SIGNATURES[nearest].title}, for which it lacks {', '.join(_plain(p) for p in lacking)}"
    raise ModelFileError(
        f"{name} is not a checkpoint of a known model: it holds {found}{more}; {near}. If it is one under other names, "
        f"name it with --kind ({', '.join(KINDS)})."
    )


def check_kind(kind: str) -> Kind:
    """Return a kind that a user named.

    Raises:
        InputError: if there is no such kind.
    """
    if kind not in KINDS:
        raise InputError(f"There is no kind of model {kind!r}; expected one of {', '.join(KINDS)}.")
    return kind


def _share(signature: Signature, keys: Collection[str]) -> float:
    """Return the share of a signature's patterns that some key matches; below 1 if a key matches what none may."""
    share = sum(_matched(pattern, keys) for pattern in signature.all_of) / len(signature.all_of)
    return share / 2 if any(_matched(pattern, keys) for pattern in signature.none_of) else share


def _matched(pattern: str, keys: Collection[str]) -> bool:
    return any(re.match(pattern, key) for key in keys)


def _plain(pattern: str) -> str:
    """Return a pattern as a person writes it: `model_1.shift_blocks.*`."""
    plain = pattern.replace(r"\d*", "0").replace(r"\d", "1").replace("[12]?", "").replace("\\", "")
    return plain[:-1] if plain.endswith("$") else plain + "*"
