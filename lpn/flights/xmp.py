"""XMP packets of photos, read as a flat list of properties."""

from __future__ import annotations

import math
from xml.etree import ElementTree

_MOST_BYTES = 2_000_000


def read_xmp(packet: bytes) -> dict[str, str]:
    """Return the properties of an XMP packet by local name, such as "GimbalYawDegree".

    Properties of senseFly, whose names are general words, are named "sensefly:Heading". Nested properties are left out.

    Raises:
        ValueError: if the packet is not well-formed, is larger than 2 MB, or declares a document type. A packet needs none, and
            one could declare entities that expand without bound.
    """
    if len(packet) > _MOST_BYTES:
        raise ValueError("it is larger than 2 MB")
    text = packet.decode("utf-8").strip("\x00\ufeff \t\r\n")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it declares a document type")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, RecursionError) as error:
        raise ValueError("it is not well-formed") from error
    found: dict[str, str] = {}
    for description in root.iter("{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description"):
        children = {child.tag: child.text or "" for child in description if not len(child)}
        for tag, value in [*description.attrib.items(), *children.items()]:
            space, _, local = tag.removeprefix("{").rpartition("}")
            found[f"sensefly:{local}" if "sensefly" in space.lower() else local] = value.strip()
    return found


def number(properties: dict[str, str], *names: str) -> float | None:
    """Return the first property that is a finite number; None if there is none."""
    for name in names:
        try:
            value = float(properties.get(name, ""))
        except ValueError:
            continue
        if math.isfinite(value):
            return value
    return None
