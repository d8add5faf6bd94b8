"""XMP packets: every form of a property, and packets damaged as programs damage them."""

from __future__ import annotations

import time

import pytest

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
    for namespace, name, text in read_xmp(packet)[0]:
        if namespace:
            values.setdefault(name, text)
    return values


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("<s:A>1</s:A>", {"A": "1"}),
        ('<s:A rdf:parseType="Resource"><s:Yaw>2</s:Yaw></s:A>', {"A/Yaw": "2"}),
        ('<s:A s:Yaw="2" s:Roll="3"/>', {"A/Yaw": "2", "A/Roll": "3"}),
        ('<s:A><rdf:Description s:Yaw="2"><s:Roll>3</s:Roll></rdf:Description></s:A>', {"A/Yaw": "2", "A/Roll": "3"}),
        ("<s:A><rdf:Seq><rdf:li>4</rdf:li><rdf:li>5</rdf:li></rdf:Seq></s:A>", {"A": "4"}),
        ('<s:A><rdf:Bag><rdf:li rdf:parseType="Resource"><s:B>6</s:B></rdf:li></rdf:Bag></s:A>', {"A/B": "6"}),
        ('<s:A rdf:parseType="Resource"><rdf:value>7</rdf:value></s:A>', {"A": "7"}),
        ("<s:A><![CDATA[8]]></s:A><!-- <s:B>9</s:B> -->", {"A": "8"}),
        ("<dc:a>1</dc:a>", {}),
    ],
)
def test_properties_are_read_in_every_form(content: str, expected: dict[str, str]) -> None:
    packet = xmp_packet(content, URIS)
    assert (values_of(packet), read_xmp(packet)[1]) == (expected, False)


DESCRIPTION, FIRST = b"rdf:about", b"<drone"
PACKETS = {
    "plain": WHOLE,
    "a mark": WHOLE.decode().encode("utf-8-sig"),
    "UTF-16": WHOLE.decode().encode("utf-16"),
    "text before": b"xml:XMP=" + WHOLE,
    "text after": WHOLE + b"\x00trailer",
    "a byte of Latin-1": WHOLE.replace(FIRST, b"<dc:rights>M\xfcller</dc:rights><drone", 1),
    # The document type stands before the packet's own element, and is not read.
    "a document type": b'<!DOCTYPE x [<!ENTITY a "b">]>' + WHOLE,
}
DAMAGED = {
    "a doubled attribute": WHOLE.replace(DESCRIPTION, b'dc:format="a" dc:format="b" rdf:about'),
    "a bare ampersand": WHOLE.replace(DESCRIPTION, b'dc:rights="Map & Co" rdf:about'),
    "an entity of HTML": WHOLE.replace(FIRST, b"<dc:a>M&uuml;ller</dc:a><drone", 1),
    "a bare bracket": WHOLE.replace(FIRST, b"<dc:rights>height < 60</dc:rights><drone", 1),
    "a prefix without declaration": WHOLE.replace(DESCRIPTION, b'photoshop:Credit="me" rdf:about'),
    "its own prefix without declaration": WHOLE.replace(f'xmlns:drone-dji="{DJI}"'.encode(), b""),
    "an open tag": WHOLE.replace(FIRST, b"<dc:rights>me<drone", 1),
    "control characters": WHOLE.replace(DESCRIPTION, b'dc:a="\x01\x02" rdf:about'),
    "a cut": WHOLE.replace(b"</rdf:RDF>", b""),
}


@pytest.mark.parametrize("name", [*PACKETS, *DAMAGED])
def test_a_packet_is_read_whatever_stands_around_it_and_is_damaged_in_it(name: str) -> None:
    packet = (PACKETS | DAMAGED)[name]
    assert (values_of(packet), read_xmp(packet)[1]) == (VALUES, name in DAMAGED)


def test_a_packet_that_is_cut_tells_no_half_value() -> None:
    packet = dji_xmp(RelativeAltitude="+61.20", GimbalYawDegree="-141.00")
    for end in range(packet.index(b"-141"), packet.index(b'-141.00"') + 7):
        assert values_of(packet[:end]) == {"RelativeAltitude": "+61.20"}
    packet = xmp_packet("<drone-dji:RelativeAltitude>+61.20</drone-dji:RelativeAltitude>", URIS)
    assert values_of(packet[: packet.index(b"+61.20") + 9]) == {}


def test_entities_are_never_expanded() -> None:
    types = "<!DOCTYPE x [<!ENTITY a '99'>" + "".join(f"<!ENTITY b{i} '&a;&a;'>" for i in range(50)) + "]>"
    content = "<drone-dji:RelativeAltitude>&a;</drone-dji:RelativeAltitude>"
    packet = types.encode() + xmp_packet(content, URIS, 'drone-dji:GimbalYawDegree="&#52;5"')
    assert values_of(packet) == {"RelativeAltitude": "&a;", "GimbalYawDegree": "45"}
    inside = xmp_packet(content, URIS).replace(b"<rdf:RDF", b"<!DOCTYPE x [<!ENTITY a '99'>]><rdf:RDF")
    assert values_of(inside) == {"RelativeAltitude": "&a;"}


@pytest.mark.parametrize("packet", [b"", b"\x00 \x00", b"\xff\xfe", b"no XMP", b"<x", b"<rdf:RDF" * 100])
def test_what_is_no_packet_has_no_property(packet: bytes) -> None:
    assert read_xmp(packet) == ([], True)


@pytest.mark.parametrize("piece", [b'a:b="', b"a:b>", b"a-", b"a:b  ", b"<a:RDF", b"<a:b>" * 3])
def test_damage_takes_time_in_proportion_to_the_packet(piece: bytes) -> None:
    begin = time.process_time()
    read_xmp(WHOLE[:200] + piece * (500_000 // len(piece)))
    assert time.process_time() - begin < 60
