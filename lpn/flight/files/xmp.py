"""XMP packets of photos, read as lists of properties. A damaged packet is read as far as it can be.

A well-formed packet is read by expat. Any other is read a second time by tags: attributes with both quotes, or without any, and
texts between two tags count, whatever is damaged around them. Entities are never expanded, except for the five of XML and
characters by number.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import unescape
from xml.etree import ElementTree
from xml.parsers.expat import errors

_MOST_BYTES = 2_000_000
_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
_META = "adobe:ns:meta/"
_XML = "http://www.w3.org/XML/1998/namespace"
_ARRAYS = tuple(f"{{{_RDF}}}{name}" for name in ("Seq", "Bag", "Alt"))
# Properties are nested less deeply than this, and an end tag is compared with so many open ones.
_MOST_LEVELS, _MOST_OPEN = 8, 64
# Characters of a value in a damaged packet.
_MOST_TEXT = 1000
_WIDE = (
    (b"\xff\xfe\x00\x00", "utf-32"),
    (b"\x00\x00\xfe\xff", "utf-32"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
)
# Characters that XML does not allow.
_FORBIDDEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")
_ESCAPED = re.compile("[\udc80-\udcff]")
_OPENING = re.compile(r"<(?:\?xpacket|\?xml|[\w.-]+:(?:xmpmeta|xapmeta|RDF|Description)\b)")
_DECLARATION = re.compile(r"<\?xml\b.*?\?>", re.DOTALL)
_TYPE = re.compile(r"<!(?:DOCTYPE|ENTITY)", re.IGNORECASE)
_PREFIX = re.compile(r"""\bxmlns:([\w.-]+)\s*=\s*["']([^"'<]*)["']""")
# No alternative of the tag's rest begins as another does, so that none is tried twice.
_TAG = re.compile(
    r"""<(?:!--.*?(?:-->|\Z)|!\[CDATA\[(?P<data>.*?)(?:\]\]>|\Z)|\?.*?(?:\?>|\Z)|/(?P<closed>[\w.:-]*)[^<>]*>?|"""
    r"""(?P<opened>[\w.:-]+)(?P<rest>(?:[^<>"']+|"[^"<]*"|'[^'<]*')*)(?P<whole>>?))""",
    re.DOTALL,
)
_ATTRIBUTE = re.compile(r"""([\w.:-]+)\s*=\s*(?:"([^"]*)"|'([^']*)'|([-+\w.,/]+))""")
_ENTITY = re.compile(r"&(?:amp|lt|gt|quot|apos|#[0-9]{1,7}|#x[0-9a-fA-F]{1,6});")
_FLAWS = {
    errors.codes[errors.XML_ERROR_DUPLICATE_ATTRIBUTE]: "an attribute occurs twice",
    errors.codes[errors.XML_ERROR_UNBOUND_PREFIX]: "a prefix is not declared",
    errors.codes[errors.XML_ERROR_INVALID_TOKEN]: "a character is out of place",
    errors.codes[errors.XML_ERROR_JUNK_AFTER_DOC_ELEMENT]: "text or a second packet follows its end",
    errors.codes[errors.XML_ERROR_NO_ELEMENTS]: "it is cut short",
    errors.codes[errors.XML_ERROR_UNCLOSED_TOKEN]: "it is cut short",
    errors.codes[errors.XML_ERROR_TAG_MISMATCH]: "its tags do not match",
    errors.codes[errors.XML_ERROR_UNDEFINED_ENTITY]: "an entity is not defined",
}  # fmt: skip


@dataclass(frozen=True)
class XmpProperty:
    """A property of an XMP packet.

    Attributes:
        namespace: URI of the outermost property; "" if its prefix is not declared.
        prefix: of the outermost property, as the packet writes it.
        name: local names from the outermost property inwards, joined by "/", such as "CameraOrientationNED/Yaw".
        text: the value; values of an array are joined by ", ".
    """

    namespace: str
    prefix: str
    name: str
    text: str

    def __str__(self) -> str:
        return f"{self.prefix}:{self.name}" if self.prefix else self.name


def read_xmp(packet: bytes) -> tuple[list[XmpProperty], list[str]]:
    """Return the properties of an XMP packet in their order, and its flaws, such as "an attribute occurs twice".

    Attributes, elements, and properties nested in them are read alike.

    Raises:
        ValueError: if the packet is larger than 2 MB, or damaged so that no property can be read. The message is a clause.
    """
    if len(packet) > _MOST_BYTES:
        raise ValueError("it is larger than 2 MB")
    text, flaws = _decoded(packet)
    text = _DECLARATION.sub("", text)
    prefixes = {uri: prefix for prefix, uri in reversed(_PREFIX.findall(text))}
    root = None
    if not _TYPE.search(text):
        try:
            root = ElementTree.fromstring(text)
        except ElementTree.ParseError as error:
            flaws.append(_FLAWS.get(error.code, "it is not well-formed"))
        except RecursionError:
            flaws.append("it is not well-formed")
    properties = list(_properties(_tree(text) if root is None else root, prefixes))
    if flaws and not properties:
        raise ValueError(flaws[-1] if text else "it is empty")
    return properties, flaws


def _decoded(packet: bytes) -> tuple[str, list[str]]:
    """Return the text of a packet from its first tag on, and flaws of its characters."""
    codec = next((codec for mark, codec in _WIDE if packet.startswith(mark)), None) or _wide(packet)
    flaws = []
    if codec is not None:
        text = packet.decode(codec, "replace")
    else:
        text = packet.decode("utf-8", "surrogateescape")
        # Programs write Latin-1 into fields such as the owner's name.
        text, others = _ESCAPED.subn(lambda byte: chr(ord(byte[0]) - 0xDC00), text)
        flaws += ["a byte is not UTF-8, and was read as Latin-1"] if others else []
    text, forbidden = _FORBIDDEN.subn("", text.strip("\x00\ufeff \t\r\n"))
    flaws += ["characters that XML does not allow were left out"] if forbidden else []
    flaws += ["it declares a document type, whose entities were not expanded"] if _TYPE.search(text) else []
    opening = _OPENING.search(text)
    return text if opening is None else text[opening.start() :], flaws


def _wide(packet: bytes) -> str | None:
    """Return the encoding of a packet that has several bytes a character and no mark; None for others."""
    sample = packet[:4096]
    zeros, at = sample.count(0), sample.find(b"<")
    if at < 0 or 3 * zeros < len(sample):
        return None
    if 3 * zeros > 2 * len(sample):
        return "utf-32-be" if at % 4 == 3 else "utf-32-le"
    return "utf-16-be" if at % 2 else "utf-16-le"


def _properties(root: ElementTree.Element, prefixes: Mapping[str, str]) -> Iterator[XmpProperty]:
    """Yield the properties below an element, in the order of the packet."""
    # Elements that are still to be read, with the URI of the outermost property about them, and their names.
    waiting = [(root, "", "")]
    while waiting:
        element, space, name = waiting.pop()
        for tag, value in element.attrib.items():
            uri, local = _split(tag)
            if uri not in (_RDF, _META, _XML) and (uri or ":" in local):
                yield _property(space or uri, f"{name}/{local.rpartition(':')[2]}" if name else local, value, prefixes)
        children = list(element)
        if name and not children and (text := (element.text or "").strip()):
            yield _property(space, name, text, prefixes)
        leaves = [child for child in children if not len(child)]
        if name and element.tag in _ARRAYS and len(leaves) == len(children):
            yield _property(space, name, ", ".join((leaf.text or "").strip() for leaf in leaves), prefixes)
            continue
        for child in reversed(children):
            uri, local = _split(child.tag)
            if uri in (_RDF, _META) or not (uri or name or ":" in local):
                waiting.append((child, space, name))
            elif name.count("/") < _MOST_LEVELS:
                waiting.append((child, space or uri, f"{name}/{local.rpartition(':')[2]}" if name else local))


def _property(space: str, name: str, text: str, prefixes: Mapping[str, str]) -> XmpProperty:
    """Return a property; one whose prefix is not declared has it in its name, as "drone-dji:GimbalYawDegree"."""
    prefix = prefixes.get(space, "")
    if not space:
        prefix, _, name = name.rpartition(":")
    return XmpProperty(space, prefix, name, text.strip())


def _split(tag: str) -> tuple[str, str]:
    uri, _, local = tag.removeprefix("{").rpartition("}")
    return uri, local


def _tree(text: str) -> ElementTree.Element:
    """Return the elements of a damaged packet below one root; a name whose prefix is not declared keeps it."""
    root = ElementTree.Element("root")
    # Open elements with their names in the text, and the prefixes declared there.
    stack: list[tuple[ElementTree.Element, str, Mapping[str, str]]] = [
        (root, "", {"rdf": _RDF, "x": _META, "xml": _XML})
    ]
    end = 0
    for token in _TAG.finditer(text):
        element, _, declared = stack[-1]
        # Text behind the last tag may be cut; it is never read here.
        if len(element.text or "") < _MOST_TEXT:
            between = text[end : min(token.start(), end + _MOST_TEXT)]
            element.text = (element.text or "") + _plain(between) + (token["data"] or "")[:_MOST_TEXT]
        end = token.end()
        if (closed := token["closed"]) is not None:
            last = len(stack) - 1
            opening = next((i for i in range(last, max(last - _MOST_OPEN, 0), -1) if stack[i][1] == closed), len(stack))
            # Elements that were not closed hold what follows them, which belongs beside them.
            for i in range(len(stack) - 1, opening, -1):
                stack[i - 1][0].extend(list(stack[i][0]))
                del stack[i][0][:]
            del stack[opening:]
        elif (opened := token["opened"]) is not None:
            pairs = [(name, _plain("".join(texts))) for name, *texts in _ATTRIBUTE.findall(token["rest"])]
            inner = {name.removeprefix("xmlns:"): uri for name, uri in pairs if name.startswith("xmlns:")}
            declared = {**declared, **inner} if inner else declared
            child = ElementTree.SubElement(element, _resolved(opened, declared))
            for name, value in pairs:
                if name == "xmlns" or name.startswith("xmlns:"):
                    continue
                if child.attrib.setdefault(key := _resolved(name, declared), value) != value:
                    ElementTree.SubElement(child, key).text = value  # so that the contradiction is seen
            if not (token["whole"] and token["rest"].rstrip().endswith("/")):
                stack.append((child, opened, declared))
    return root


def _resolved(name: str, declared: Mapping[str, str]) -> str:
    prefix, _, local = name.rpartition(":")
    return f"{{{declared[prefix]}}}{local}" if prefix in declared else name


def _plain(text: str) -> str:
    """Replace the entities that need no declaration."""
    return _ENTITY.sub(lambda entity: unescape(entity[0]), text)
