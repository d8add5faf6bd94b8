"""The table of makers' properties, namespaces as programs write them, and XMP packets, whole and damaged."""

from __future__ import annotations

import time

import pytest

from lpn.flight.files.makers import NAMESPACES, ROWS, Properties, PropertyRow, number
from tools.fixtures.photos import dji_xmp, xmp_packet


def told_by(content: str, uri: str, prefix: str = "p") -> Properties:
    """What a description says that declares one namespace."""
    told = Properties()
    told.add_xmp(xmp_packet(content, {prefix: uri} if uri else {}))
    return told


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.namespace}:{row.names}:{row.convention}")
def test_each_row_is_read_below_each_spelling_of_its_address(row: PropertyRow) -> None:
    assert row.source.strip()
    address = NAMESPACES[row.namespace][0]
    expected = "-12.5" if row.unit == "text" else -12.5
    for i, name in enumerate(row.names.split()):
        outer, _, inner = name.partition("/")
        form = f'<p:{outer} p:{inner}="-12.5"/>' if inner else f"<p:{name.upper()}>-12.5</p:{name.upper()}>"
        for uri in (f"http://www.{address}/1.0/", f"https://{address}/1.0", f"HTTP://{address.upper()}/2.1#"):
            assert (row, expected) in [(other, found[i]) for other, found in told_by(form, uri).rows(row.field)]
        undeclared = told_by(form.replace("p:", f"{row.namespace}:"), "")
        assert inner or undeclared.raw(name, row.namespace) == "-12.5"


def test_no_property_is_in_the_table_twice_for_one_field() -> None:
    assert len({(row.field, row.namespace, row.names.casefold()) for row in ROWS}) == len(ROWS)
    assert {row.namespace for row in ROWS} == {*NAMESPACES}


def test_names_that_dji_coined_count_in_every_namespace() -> None:
    content = "<p:GimbalYawDegree>-41</p:GimbalYawDegree><p:RelativeAltitude>+33.0</p:RelativeAltitude><p:Latitude>7</p:Latitude>"
    told = told_by(content, "http://www.parrot.com/drone-parrot/1.0/")
    assert [(row.namespace, numbers[0]) for row, numbers in told.rows("angles")] == [("drone-dji", -41.0)]
    assert told.first("height_above_takeoff") == 33.0
    assert list(told.rows("position")) == []


def test_a_namespace_is_known_by_its_address_and_not_by_its_prefix() -> None:
    yaw = "<{0}:Yaw>1</{0}:Yaw>"
    for prefix, address, known in (
        ("p", "http://pix4d.com/camera/1.0", True), ("Camera", "http://example.org/camera/", False), ("Camera", "Camera/", True),
    ):  # fmt: skip
        assert bool(list(told_by(yaw.format(prefix), address, prefix).rows("angles"))) == known


def test_unreadable_values_are_named_and_the_first_of_two_counts() -> None:
    content = "<d:GimbalYawDegree>NA</d:GimbalYawDegree><d:RelativeAltitude>1e9</d:RelativeAltitude>"
    content += "<d:GpsLatitude>1</d:GpsLatitude><d:GpsLatitude>2</d:GpsLatitude><d:AbsoluteAltitude/>"
    told = told_by(content, "http://www.dji.com/drone-dji/1.0/", "d")
    assert [numbers[:2] for _, numbers in told.rows("position")] == [(1.0, None)] * 2
    assert [told.first(field) for field in ("angles", "height_above_takeoff", "altitude")] == [None] * 3
    assert told.unreadable == ["drone-dji:GimbalYawDegree", "drone-dji:RelativeAltitude"]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("+39.80", 39.8), ("39,8", 39.8), ((7,), 7.0), (b"\x37\x00", 7.0), (2.5, 2.5),
        ("NA", None), ((1, 2), None), (None, None),
    ],
)  # fmt: skip
def test_numbers_as_exif_and_xmp_write_them(text: object, value: float | None) -> None:
    assert number(text) == value


DJI = "http://www.dji.com/drone-dji/1.0/"
URIS = {"drone-dji": DJI, "s": "https://www.skydio.com/drone-skydio/1.0/", "dc": "http://purl.org/dc/elements/1.1/"}
ATTRIBUTES = 'drone-dji:RelativeAltitude="+61.20" drone-dji:GimbalYawDegree="-41.00"'
WHOLE = xmp_packet("<drone-dji:GimbalPitchDegree>-90.00</drone-dji:GimbalPitchDegree>", URIS, ATTRIBUTES)
VALUES = {"RelativeAltitude": "+61.20", "GimbalYawDegree": "-41.00", "GimbalPitchDegree": "-90.00"}
NAMES = ("RelativeAltitude", "GimbalYawDegree", "GimbalPitchDegree", "A", "A/Yaw", "A/Roll", "A/B", "B")


def read(packet: bytes) -> tuple[dict[str, str], bool]:
    """The properties of a packet by name, and whether it is damaged."""
    told = Properties()
    damaged = told.add_xmp(packet)
    found = {name: told.raw(name, "drone-skydio") or told.raw(name, "drone-dji") for name in NAMES}
    return {name: text for name, text in found.items() if text is not None}, damaged


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
    assert read(xmp_packet(content, URIS)) == (expected, False)


FIRST = b"<drone"
PACKETS = {
    "plain": WHOLE,
    "a mark": WHOLE.decode().encode("utf-8-sig"),
    # The document type stands before the packet's own element, and is not read.
    "a document type": b'<!DOCTYPE x [<!ENTITY a "b">]>' + WHOLE,
}
DAMAGED = {
    "a doubled attribute": WHOLE.replace(b"rdf:about", b'dc:format="a" dc:format="b" rdf:about'),
    "an entity of HTML": WHOLE.replace(FIRST, b"<dc:a>M&uuml;ller</dc:a><drone", 1),
    "a bare bracket": WHOLE.replace(FIRST, b"<dc:rights>height < 60</dc:rights><drone", 1),
    "control characters": WHOLE.replace(b"rdf:about", b'dc:a="\x01\x02" rdf:about'),
}


@pytest.mark.parametrize("name", [*PACKETS, *DAMAGED])
def test_a_packet_is_read_whatever_stands_around_it_and_is_damaged_in_it(name: str) -> None:
    packet = (PACKETS | DAMAGED)[name]
    assert read(packet) == (VALUES, name in DAMAGED)


def test_a_packet_that_is_cut_tells_no_half_value() -> None:
    packet = dji_xmp(RelativeAltitude="+61.20", GimbalYawDegree="-141.00")
    for end in range(packet.index(b"-141"), packet.index(b'-141.00"') + 7):
        assert read(packet[:end])[0] == {"RelativeAltitude": "+61.20"}
    packet = xmp_packet("<drone-dji:RelativeAltitude>+61.20</drone-dji:RelativeAltitude>", URIS)
    assert read(packet[: packet.index(b"+61.20") + 9])[0] == {}


def test_entities_are_never_expanded() -> None:
    types = "<!DOCTYPE x [<!ENTITY a '99'>" + "".join(f"<!ENTITY b{i} '&a;&a;'>" for i in range(50)) + "]>"
    content = "<drone-dji:RelativeAltitude>&a;</drone-dji:RelativeAltitude>"
    packet = types.encode() + xmp_packet(content, URIS, 'drone-dji:GimbalYawDegree="&#52;5"')
    assert read(packet)[0] == {"RelativeAltitude": "&a;", "GimbalYawDegree": "45"}
    inside = xmp_packet(content, URIS).replace(b"<rdf:RDF", b"<!DOCTYPE x [<!ENTITY a '99'>]><rdf:RDF")
    assert read(inside)[0] == {"RelativeAltitude": "&a;"}


@pytest.mark.parametrize("packet", [b"", b"\x00 \x00", b"\xff\xfe", b"no XMP", b"<x", b"<rdf:RDF" * 100])
def test_what_is_no_packet_has_no_property(packet: bytes) -> None:
    assert read(packet) == ({}, True)


@pytest.mark.parametrize("piece", [b'a:b="', b"a:b>", b"a-", b"a:b  ", b"<a:RDF", b"<a:b>" * 3])
def test_damage_takes_time_in_proportion_to_the_packet(piece: bytes) -> None:
    begin = time.process_time()
    read(WHOLE[:200] + piece * (250_000 // len(piece)))
    assert time.process_time() - begin < 15
