"""How the command line shows the words that an option takes."""

from __future__ import annotations

from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

# While it is entered, `tyro.cli` lists the words of `Literal[...] | None` in their own order and without None.
IN_ORDER = ConstructorRegistry()


@IN_ORDER.primitive_rule
def _words_or_none(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    if info.type_origin not in (Union, UnionType):
        return None
    members = [member for member in get_args(info.type) if member is not NoneType]
    words = tuple(word for member in members for word in get_args(member))
    if not all(get_origin(member) is Literal for member in members) or not all(isinstance(w, str) for w in words):
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(words)}}}",
        instance_from_str=lambda given: given[0],
        is_instance=lambda value: value is None or value in words,
        str_from_instance=lambda value: [str(value)],
        choices=words,
    )
