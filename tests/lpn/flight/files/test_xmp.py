"""XMP packets: every form of a property, and packets damaged as programs damage them."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lpn.flight.files.xmp import read_xmp
from tools.fixtures.photos import dji_xmp, xmp_packet

DJI = "http://www.dji.com/drone-dji/1.0/"
URIS = {"drone-dji": DJI, "s": "https://www.skydio.com/drone-skydio/1.0/", "dc": "http://purl.org/dc/elements/1.1/"}
ATTRIBUTES = 'drone-dji:RelativeAltitude="+61.20" drone-dji:GimbalYawDegree="-41.00"'
WHOLE = xmp_packet("<drone-dji:GimbalPitchDegree>-90.00</drone-dji:GimbalPitchDegree>", URIS, ATTRIBUTES)
VALUES = {"RelativeAltitude": "+61.20", "GimbalYawDegree": "-41.00", "GimbalPitchDegree": "-90.00"}


def values_of(packet: bytes) -> dict[str, str]:
    """The first value of each property of a drone, by name."""
    values: dict[str, str] = {}
    for item in read_xmp(packet)[0]:
        if item.prefix in ("drone-dji", "d", "s"):
            values.setdefault(item.name, item.text)
    return values


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("<s:A>1</s:A>", {"A": "1"}),
        ('<s:A rdf:parseType="Resource"><s:Yaw>2</s:Yaw></s:A>', {"A/Yaw": "2"}),
        ('<s:A s:Yaw="2" s:Roll="3"/>', {"A/Yaw": "2", "A/Roll": "3"}),
        ('<s:A><rdf:Description s:Yaw="2"><s:Roll>3</s:Roll></rdf:Description></s:A>', {"A/Yaw": "2", "A/Roll": "3"}),
        ("<s:A><rdf:Seq><rdf:li>4</rdf:li></rdf:Seq></s:A>", {"A": "4"}),
        ('<s:A><rdf:Alt><rdf:li xml:lang="x-default">4</rdf:li><rdf:li>5</rdf:li></rdf:Alt></s:A>', {"A": "4, 5"}),
        ('<s:A><rdf:Bag><rdf:li rdf:parseType="Resource"><s:B>6</s:B></rdf:li></rdf:Bag></s:A>', {"A/B": "6"}),
        ('<s:A rdf:parseType="Resource"><rdf:value>7</rdf:value></s:A>', {"A": "7"}),
        ("<s:A><![CDATA[8]]></s:A><!-- <s:B>9</s:B> -->", {"A": "8"}),
    ],
)
def test_properties_are_read_in_every_form(content: str, expected: dict[str, str]) -> None:
    packet = xmp_packet(content, URIS)
    assert (values_of(packet), read_xmp(packet)[1]) == (expected, [])
    # A second root makes the packet damaged, so that it is read by tags.
    twice = packet.replace(b'<?xpacket end="w"?>', b"<x/>")
    assert (values_of(twice), len(read_xmp(twice)[1])) == (expected, 1)


def test_a_property_tells_its_namespace_and_prefix() -> None:
    (item,) = read_xmp(dji_xmp(GimbalYawDegree="+45.00"))[0]
    assert (item.namespace, item.prefix, item.name, item.text) == (DJI, "d", "GimbalYawDegree", "+45.00")
    assert str(item) == "d:GimbalYawDegree"


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-le", "utf-32-be"]
)
def test_every_encoding_of_xmp_is_read(encoding: str) -> None:
    packet = WHOLE.decode().encode(encoding)
    assert (values_of(packet), read_xmp(packet)[1]) == (VALUES, [])
    declared = f'<?xml version="1.0" encoding="{encoding}"?>'.encode() + WHOLE
    assert (values_of(declared), read_xmp(declared)[1]) == (VALUES, [])


FLAWED = {
    "a byte of Latin-1": (WHOLE.replace(b"<drone", b"<dc:rights>M\xfcller</dc:rights><drone", 1), "a byte is not UTF-8"),
    "a doubled attribute": (WHOLE.replace(b"rdf:about", b'dc:format="a" dc:format="b" rdf:about'), "an attribute occurs twice"),
    "a bare ampersand": (WHOLE.replace(b"rdf:about", b'dc:rights="Map & Co" rdf:about'), "a character is out of place"),
    "an entity of HTML": (WHOLE.replace(b"<drone", b"<dc:a>M&uuml;ller</dc:a><drone", 1), "an entity is not defined"),
    "a bare bracket": (WHOLE.replace(b"<drone", b"<dc:rights>height < 60</dc:rights><drone", 1), "a character is out of place"),
    "a prefix without declaration": (WHOLE.replace(b"rdf:about", b'photoshop:Credit="me" rdf:about'), "a prefix is not declared"),
    "its own prefix without declaration": (WHOLE.replace(f'xmlns:drone-dji="{DJI}"'.encode(), b""), "a prefix is not declared"),
    "a second packet": (WHOLE + WHOLE, "a second packet follows its end"),
    "text after its end": (WHOLE + b"trailer", "text or a second packet follows its end"),
    "an open tag": (WHOLE.replace(b"<drone", b"<dc:rights>me<drone", 1), "its tags do not match"),
    "control characters": (WHOLE.replace(b"rdf:about", b'dc:a="\x01\x02" rdf:about'), "XML does not allow"),
    "zero bytes": (WHOLE.replace(b"<drone", b"\x00\x00<drone", 1), "XML does not allow"),
    "an attribute without quotes": (WHOLE.replace(b"rdf:about", b"dc:a=5 rdf:about"), "a character is out of place"),
    "a document type": (b'<!DOCTYPE x [<!ENTITY a "b">]>' + WHOLE, "entities were not expanded"),
}  # fmt: skip


@pytest.mark.parametrize("name", FLAWED)
def test_a_damaged_packet_is_read_and_its_flaw_is_named(name: str) -> None:
    packet, flaw = FLAWED[name]
    assert values_of(packet) == VALUES
    assert any(flaw in found for found in read_xmp(packet)[1])


def test_text_before_a_packet_is_no_flaw() -> None:
    for before in (b"xml:XMP=", b"\x00\x00", b"junk "):
        assert (values_of(before + WHOLE), read_xmp(before + WHOLE)[1]) == (VALUES, [])


def test_a_packet_that_is_cut_tells_no_half_value() -> None:
    packet = dji_xmp(RelativeAltitude="+61.20", GimbalYawDegree="-141.00")
    for end in range(packet.index(b"-141"), packet.index(b'-141.00"') + 7):
        assert values_of(packet[:end]) == {"RelativeAltitude": "+61.20"}
    packet = xmp_packet("<drone-dji:RelativeAltitude>+61.20</drone-dji:RelativeAltitude>", URIS)
    begin = packet.index(b"+61.20")
    assert values_of(packet[: begin + 9]) == {"RelativeAltitude": "+61.20"}
    with pytest.raises(ValueError, match="it is cut short"):
        read_xmp(packet[: begin + 3])


def test_entities_are_never_expanded() -> None:
    types = "<!DOCTYPE x [<!ENTITY a '99'>" + "".join(f"<!ENTITY b{i} '&a;&a;'>" for i in range(50)) + "]>"
    content = "<drone-dji:RelativeAltitude>&a;</drone-dji:RelativeAltitude>"
    packet = types.encode() + xmp_packet(content, URIS, 'drone-dji:GimbalYawDegree="&#52;5"')
    assert values_of(packet) == {"RelativeAltitude": "&a;", "GimbalYawDegree": "45"}


@pytest.mark.parametrize(
    ("packet", "reason"),
    [
        (b"", "it is empty"),
        (b"\x00 \x00", "it is empty"),
        (b"<x", "it is cut short"),
        (b"\xff\xfe", "it is empty"),
        (b"no XMP", "it is not well-formed"),
        (b'<!DOCTYPE x [<!ENTITY a "b"><!ENTITY c "&a;&a;">]><x>&c;</x>', "it declares a document type"),
        (b"<x>" + b" " * 2_000_000 + b"</x>", "it is larger than 2 MB"),
    ],
)
def test_a_packet_without_any_readable_property_is_refused(packet: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        read_xmp(packet)


def test_a_packet_of_a_program_without_a_drone_is_no_flaw() -> None:
    assert read_xmp(xmp_packet("<x:y>1</x:y>", {"x": "adobe:ns:meta/"})) == ([], [])


_NAMES = st.sampled_from(["GimbalYawDegree", "RelativeAltitude", "Latitude", "A", "B.c", "d_e"])
_TEXTS = st.text(
    st.characters(min_codepoint=32, max_codepoint=0x2FFF, exclude_characters="<>&\"'"), min_size=1, max_size=12
)
_DAMAGE = [
    "",
    "<x/>",
    "&",
    '<dc:a b="',
    "<dc:open>",
    "</nothing>",
    "\x02",
    '<dc:a b="1" b="2"/>',
    "<!DOCTYPE x>",
    "<dc:a b=1/>",
]


@settings(max_examples=150)
@given(st.dictionaries(_NAMES, _TEXTS, min_size=1), st.sampled_from(_DAMAGE), st.booleans())
def test_damage_beside_properties_changes_none(properties: dict[str, str], damage: str, nested: bool) -> None:
    content = "".join(f"<s:{name}>{text}</s:{name}>" for name, text in properties.items())
    content = f'<s:Outer rdf:parseType="Resource">{content}</s:Outer>' if nested else content
    expected = {f"Outer/{name}" if nested else name: text.strip() for name, text in properties.items() if text.strip()}
    assert values_of(xmp_packet(content + damage, URIS)) == expected


def test_attributes_without_quotes_are_read_and_doubled_ones_contradict() -> None:
    packet = xmp_packet("", {"d": "http://www.dji.com/drone-dji/1.0/"}, 'd:A=-41.0 d:B="1" d:B="2"')
    properties, flaws = read_xmp(packet)
    assert [(item.name, item.text) for item in properties] == [("A", "-41.0"), ("B", "1"), ("B", "2")]
    assert flaws
