"""Recognise the published model of a state dict by the names of its entries."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import first_few, printable

if TYPE_CHECKING:
    from torch import Tensor

Kind = Literal[
    "lpn",
    "fsra",
    "mccg",
    "sdpl",
    "sample4geo",
    "dac",
    "camp",
    "mean",
    "game4loc",
    "denseuav",
    "sues200",
    "qdfl",
    "mfrgn",
    "dmnil",
    "salad",
]
KINDS: tuple[Kind, ...] = get_args(Kind)
# A vision transformer has no parts of its own: a pooling by name makes them, see `lpn.models.token_pooling`.
Recognised = Kind | Literal["vit"]
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
_HUB = (r"(.*\.)?patch_embed\.proj\.weight$", r"(.*\.)?blocks\.0\.ls1\.gamma$")
# Kinds of which a file of the one may be opened as the other by its name: the entries alone do not decide.
# DMNIL has what is left of DAC, CAMP, and MEAN without the modules of their training.
_ALIKE: tuple[frozenset[Recognised], ...] = (
    frozenset({"sample4geo", "game4loc"}),
    frozenset({"lpn", "sdpl"}),
    frozenset({"dmnil", "dac"}),
    frozenset({"dmnil", "camp"}),
    frozenset({"dmnil", "mean"}),
)
SIGNATURES: tuple[tuple[Recognised, Signature], ...] = (
    ("fsra", Signature("FSRA", (r"model_1\.transformer\.blocks\.", rf"model_1\.classifier1\.{_HEAD}"))),
    ("sdpl", Signature("SDPL", (r"model_1\.model\.", r"model_1\.shift_blocks\.", rf"classifier\d\.{_HEAD}"))),
    ("sdpl", Signature("SDPL", (r"model_1\.model\.", r"model_1\.gem\d\.p$", rf"classifier\d\.{_HEAD}"))),
    ("mean", Signature("MEAN", (r"model_1\.convnext\.", r"model_1\.(DEG|MSE)\.FC11\.weight$", r"model_1\.MSF\."))),
    (
        "qdfl",
        Signature(
            "QDFL",
            (r"backbone\.model\.blocks\.", r"components\.AQEU\.coarse\.queries$", rf"components\.classifier0\.{_HEAD}"),
        ),
    ),
    (
        "mfrgn",
        Signature(
            "MFRGN", (r"backbone\.backbone\.", r"transformer_H\.layers\.", r"proj_gl\.0\.", r"proj_local\.weight$")
        ),
    ),
    (
        "salad",
        Signature("SALAD", (r"backbone\.model\.blocks\.", r"aggregator\.dust_bin$", r"aggregator\.cluster_features\.")),
    ),
    (
        "salad",
        Signature("MegaLoc", (r"backbone\.blocks\.", r"aggregator\.agg\.dust_bin$", r"aggregator\.linear\.weight$")),
    ),
    ("camp", Signature("CAMP", (r"model_1\.convnext\.", r"model_1\.pos_embed$"))),
    ("dac", Signature("DAC", (r"model_1\.convnext\.", r"model_1\.proj\.mlp\.0\.weight$"))),
    ("dmnil", Signature("DMNIL", (r"model_1\.convnext\.", r"w_blocks1$"), (r"model_\d\.(?!convnext\.)",))),
    (
        "mccg",
        Signature(
            "MCCG",
            (r"model_1\.convnext\.", r"model_1\.tri_layer\.cw\.", rf"model_1\.classifier_mcb1\.{_HEAD}"),
            (r"logit_scale$", r"model_1\.proj\.mlp\.", r"model_1\.pos_embed$"),
        ),
    ),
    (
        "game4loc",
        Signature(
            "Game4Loc",
            (r"model[12]?\.blocks\.", r"model[12]?\.reg_token$", r"model[12]?\.fc_norm\."),
            (r"model\.(pos_embed$|blocks\.0\.attn\.qkv\.bias$)",),
        ),
    ),
    ("game4loc", Signature("Game4Loc", (r"model1\.", r"model2\.", r"logit_scale$"), (r"model\.",))),
    ("sample4geo", Signature("Sample4Geo", (r"model\.stem\.0\.weight$", r"model\.head\.norm\."))),
    ("sample4geo", Signature("Sample4Geo", (r"model\.", r"logit_scale$"))),
    ("denseuav", Signature("DenseUAV", (r"backbone\.backbone\.", r"head\.head\."))),
    (
        "sues200",
        Signature(
            "SUES-200",
            (r"model_1\.", r"model_2\.", rf"classifier\d?\.{_HEAD}0\."),
            (rf"classifier\d?\.{_HEAD}1\.",),
        ),
    ),
    ("lpn", Signature("LPN", (r"model_1\.model\.", rf"classifier\d*\.{_HEAD}1\."))),
    (
        "vit",
        Signature(
            "a vision transformer of transformers", (r"(.*\.)?embeddings\.patch_embeddings?\.(projection\.)?weight$",)
        ),
    ),
    ("vit", Signature("a vision transformer of torch.hub", (*_HUB, r"(.*\.)?mask_token$"))),
    ("vit", Signature("CLIP", (r"(.*\.)?class_embedding$", r"(.*\.)?conv1\.weight$"))),
)
# Names that tell methods apart, each with the kinds whose released code has them. The first kind is the one to name in a message.
# The last two are vision transformers under a prefix that no method has.
_MARKS: tuple[tuple[str, tuple[Recognised, ...]], ...] = (
    (r"model_\d\.(transformer|classifier_heat\d+)\.", ("fsra",)),
    (r"model_\d\.(shift_blocks|gem\d+)\.", ("sdpl",)),
    (r"model_\d\.(DEG|MSE|MSF)\.", ("mean",)),
    (r"model_\d\.proj\.mlp\.", ("dac",)),
    (r"model_\d\.pos_scale$", ("camp",)),
    (r"model_\d\.pos_embed$", ("camp", "sues200")),
    (r"model_\d\.convnext\.", ("mccg", "dac", "camp", "mean", "dmnil")),
    (r"model_\d\.classifier_mcb\d+\.", ("mccg", "dac", "camp", "mean")),
    (r"model_\d\.tri_layer\.", ("mccg", "dac", "camp")),
    (r"w_blocks1$", ("dmnil", "dac", "camp", "mean")),
    (r"model_\d\.(conv1|conv_stem|features|patch_embed)\.", ("sues200",)),
    (rf"classifier\d*\.{_HEAD}", ("lpn", "sdpl", "sues200")),
    (r"model[12]\.", ("game4loc",)),
    (r"model\.(stem|patch_embed|blocks|layers|stages)\.", ("sample4geo", "game4loc", "vit")),
    (r"model_\d\.model\.layer\d\.\d+\.se\.", ("sues200", "lpn")),
    (r"head\.head\.", ("denseuav",)),
    (r"backbone\.backbone\.", ("denseuav", "mfrgn", "vit")),
    (r"components\.(AQEU|classifier\d)\.", ("qdfl",)),
    (r"(transformer_H|proj_gl|proj_local)\.", ("mfrgn",)),
    (r"aggregator\.(agg\.)?(dust_bin$|cluster_features\.)", ("salad",)),
    (r"(.*\.)?(embeddings\.patch_embeddings?\.(projection\.)?weight|class_embedding)$", ("vit",)),
    (r"(?!(model[_\d]*|backbone)\.)(.*\.)?blocks\.0\.ls1\.gamma$", ("vit",)),
)
# Published checkpoints that are not read, each with the reason.
_UNREAD: tuple[tuple[Signature, str], ...] = (
    (
        Signature("MFRGN of CVUSA, CVACT, or VIGOR", (r"(.*\.)?transformer_sat_H\.", r"(.*\.)?transformer_grd_H\.")),
        "its panoramas and tiles differ in size and weights, and a model here has one size; its model of University-1652 opens",
    ),
)
# Prefixes of all names after training with DataParallel, torch.compile, or a class that holds the network as `model` or `net`.
_WRAPPERS = ("module.", "_orig_mod.", "model.", "net.", "network.")


def unwrapped(state: Mapping[str, Tensor], name: str) -> tuple[Recognised, dict[str, Tensor]]:
    """Return the kind of a state dict, and its entries without a prefix that training put before all names.

    Raises:
        ModelFileError: as for `recognise`.
    """
    whole, inner = dict(state), dict(state)
    transformer: dict[str, Tensor] | None = None
    while True:
        kind = _kind(inner)
        if kind is not None and kind != "vit":
            return kind, inner
        # The entries of a vision transformer are known under any prefix, also where a method holds one.
        if kind == "vit" and transformer is None:
            transformer = inner
        prefix = _wrapper(inner)
        if prefix is None:
            return ("vit", transformer) if transformer is not None else (recognise(whole, name), whole)
        inner = {key.removeprefix(prefix): value for key, value in inner.items()}


def unwrapped_as(kind: Kind, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the entries of a state dict of a named kind without a prefix that training put before all names.

    Prefixes are left out until some name begins as the kind's do. Where none does, as in a bare network, all prefixes are.
    """
    begins = [signature.all_of[0] for named, signature in SIGNATURES if named == kind]
    inner = dict(state)
    while not any(_matched(pattern, inner) for pattern in begins):
        prefix = _wrapper(inner)
        if prefix is None:
            break
        inner = {key.removeprefix(prefix): value for key, value in inner.items()}
    return inner


def recognise(keys: Collection[str], name: str) -> Recognised:
    """Return the kind of a state dict with these names.

    Raises:
        ModelFileError: if it is none of the known ones, with the names found and the nearest kind; or if its names fit two kinds.
    """
    if (kind := _kind(keys)) is not None:
        return kind
    _refuse_unread(keys, name)
    if _fitting(keys):
        _refuse_mixed(keys, name)
    convnext = [key for key in keys if "model_1.convnext." in key]
    if convnext and not (any("tri_layer" in key for key in keys) and not any("logit_scale" in key for key in keys)):
        raise ModelFileError(
            f"{name} holds a ConvNeXt under model_1.convnext and nothing that distinguishes DAC from CAMP; say which with "
            "--kind dac or --kind camp, of a second model with --beside-kind."
        )
    # A file of another branch alone is nearest to its own method, too.
    alike = [re.sub(r"^model_\d\.", "model_1.", key) for key in keys]
    _, nearest = max(SIGNATURES, key=lambda pair: _share(pair[1], alike))
    entries = first_few([printable(key)[:80] for key in keys], _SHOWN) or "nothing"
    near = "none of the known models has such names"
    if _share(nearest, alike) > 0:
        lacking = [pattern for pattern in nearest.all_of if not _matched(pattern, keys)]
        near = f"the nearest is {nearest.title}, for which it lacks {', '.join(_plain(p) for p in lacking)}"
    raise ModelFileError(
        f"{name} is not a checkpoint of a known model: it holds {entries}; {near}. If it is one under other names, "
        f"name it with --kind ({', '.join(KINDS)})."
    )


def _refuse_unread(keys: Collection[str], name: str) -> None:
    for signature, reason in _UNREAD:
        if _share(signature, keys) == 1:
            raise ModelFileError(f"{name} is a checkpoint of {signature.title}, which is not read: {reason}.")


def _wrapper(keys: Collection[str]) -> str | None:
    """Return the prefix of training that all names begin with; None without one."""
    return next((prefix for prefix in _WRAPPERS if keys and all(key.startswith(prefix) for key in keys)), None)


def _kind(keys: Collection[str]) -> Recognised | None:
    """Return the kind whose signature fits, if all marks are its own; None if there is none, or if two fit alike."""
    marks = _marked(keys)
    alone = [(kind, signature) for kind, signature in _fitting(keys) if all(kind in kinds for _, kinds in marks)]
    most = max((len(signature.all_of) for _, signature in alone), default=0)
    kinds = {kind for kind, signature in alone if len(signature.all_of) == most}
    return kinds.pop() if len(kinds) == 1 else None


def _fitting(keys: Collection[str]) -> list[tuple[Recognised, Signature]]:
    """Return the signatures that fit, those with most patterns first."""
    fitting = [(kind, signature) for kind, signature in SIGNATURES if _share(signature, keys) == 1]
    # A method may hold a vision transformer.
    fitting = [pair for pair in fitting if pair[0] != "vit"] or fitting
    return sorted(fitting, key=lambda pair: -len(pair[1].all_of))


def _marked(keys: Collection[str]) -> list[tuple[str, tuple[Recognised, ...]]]:
    """Return the first name of each mark that is there, with the kinds whose released code has it."""
    first = ((next((key for key in keys if re.match(pattern, key)), None), kinds) for pattern, kinds in _MARKS)
    return [(key, kinds) for key, kinds in first if key is not None]


def _refuse_mixed(keys: Collection[str], name: str) -> None:
    """Refuse names that some kind fits beside names of another."""
    marks = _marked(keys)
    own = {kind: {key for key, kinds in marks if kind in kinds} for kind, _ in _fitting(keys)}
    # A kind that another one is built on is no second one.
    whole = [kind for kind, names in own.items() if not any(names < others for others in own.values())]
    titles = {kind: signature.title for kind, signature in (*reversed(SIGNATURES), *_fitting(keys))}
    titles["vit"] = "a vision transformer"
    shown = {kind: titles[kind] for kind in whole}
    for key, kinds in marks:
        if not set(kinds) & set(whole):
            shown.setdefault(kinds[0], f"{titles[kinds[0]]} ({printable(key)[:80]})")
    if named := [kind for kind in whole if kind != "vit"]:
        raise ModelFileError(
            f"{name} has the entries of {' and of '.join(shown.values())}, and nothing decides between them; say which with "
            f"--kind ({', '.join(named)}), of a second model with --beside-kind."
        )
    others = first_few([printable(key)[:80] for key, kinds in marks if "vit" not in kinds], _SHOWN)
    raise ModelFileError(
        f"{name} holds a vision transformer and entries of a method ({others}), of which it has not all; give a whole "
        "checkpoint, or read the transformer alone with --pooling mean."
    )


def title_of_other(kind: Recognised, keys: Collection[str]) -> str | None:
    """Return the title of the method by whose signature names fit; None if it is `kind`, or if there is none."""
    fitting = _fitting(keys)
    return fitting[0][1].title if fitting and kind not in {own for own, _ in fitting} else None


def check_named(kind: Kind, keys: Collection[str], name: str) -> None:
    """Refuse a kind that a user named for a file whose entries are of another.

    Raises:
        ModelFileError: with the method that the entries tell, also if it is one that is not read.
    """
    _refuse_unread(keys, name)
    own = {other for other, _ in _fitting(keys)}
    if own and kind not in own and not any(kind in alike and own & alike for alike in _ALIKE):
        raise ModelFileError(
            f"{name} is not opened as {kind}: by its entries it is a checkpoint of {title_of_other(kind, keys)}, so leave --kind "
            "out."
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
    plain = pattern.replace(r"(.*\.)?", "").replace(r"(projection\.)?", "")
    plain = (
        plain.replace(r"embeddings?", "embeddings")
        .replace(r"\d*", "0")
        .replace(r"\d", "1")
        .replace("[12]?", "")
        .replace("\\", "")
    )
    return plain[:-1] if plain.endswith("$") else plain + "*"
