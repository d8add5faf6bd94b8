"""XMP packets of photos as lists of properties.

ElementTree reads a well-formed packet. From a damaged one, complete attributes and elements are used. Entities of a document type
are never expanded.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from html import unescape
from xml.etree import ElementTree

from lpn.flight.files.makers import namespace_of

# A namespace of `lpn.flight.files.makers.NAMESPACES`, "" for others; local names from the outermost property inwards, joined by
# "/", such as "CameraOrientationNED/Yaw"; and the value.
XmpProperty = tuple[str, str, str]

_MOST_BYTES = 2_000_000
_OPENING = re.compile(r"<([\w-]{1,40}:(?:xmpmeta|RDF))\b")
# Namespaces of XMP's envelope; their elements are no properties.
_FRAME = ("{http://www.w3.org/1999/02/22-rdf-syntax-ns#}", "{adobe:ns:meta/}", "{http://www.w3.org/XML/1998/namespace}")
_MOST_LEVELS = 12
_PREFIX = re.compile(r"""\bxmlns:([\w-]{1,40})="([^"<]{0,200})""")
# An attribute with its value, or an element with its text. The bounded repeats keep the search linear.
_PROPERTY = re.compile(
    r'(?<![\w-])([\w-]{1,40}):(\w{1,60})(?:\s{0,9}=\s{0,9}"([^"<>]{0,2000})"|>([^<>]{0,2000})</\1:\2>)'
)


def read_xmp(packet: bytes) -> tuple[list[XmpProperty], bool]:
    """Return the properties of an XMP packet in their order, and whether it is damaged.

    Attributes, elements, and nested properties are read alike. Nested properties of a damaged packet are left out.
    """
    wide = packet[:2] in (b"\xff\xfe", b"\xfe\xff")
    text = packet[:_MOST_BYTES].decode("utf-16" if wide else "utf-8", "replace")
    if (opening := _OPENING.search(text)) is None:
        return [], True
    # The cut removes a document type, which precedes the first element, so the parser sees none of its entities.
    end = text.rfind(f"</{opening[1]}")
    text = text[opening.start() : None if end < 0 else text.find(">", end) + 1]
    try:
        return list(_properties(ElementTree.fromstring(text), ())), False
    except (ElementTree.ParseError, RecursionError):
        declared = dict(_PREFIX.findall(text))
    found = _PROPERTY.findall(text)
    return [
        (namespace_of(declared.get(prefix, prefix)), name, unescape(attribute or element).strip())
        for prefix, name, attribute, element in found
        if prefix != "xmlns"
    ], True


def _properties(element: ElementTree.Element, tags: tuple[str, ...]) -> Iterator[XmpProperty]:
    """Yield the properties of an element, within those of `tags`, in the order of the packet."""
    tags = tags if element.tag.startswith(_FRAME) else (*tags, element.tag)
    for tag, text in [*element.attrib.items(), ("", element.text or "")]:
        path = [name.removeprefix("{").rpartition("}") for name in (*tags, tag) if name]
        if path and text.strip() and not tag.startswith(_FRAME):
            yield namespace_of(path[0][0]), "/".join(name for _, _, name in path), text.strip()
    for child in element if len(tags) < _MOST_LEVELS else ():
        yield from _properties(child, tags)
