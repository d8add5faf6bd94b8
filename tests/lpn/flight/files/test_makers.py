"""The table of makers' properties: each row in every form, and namespaces as programs write them."""

from __future__ import annotations

import pytest

from lpn.flight.files.makers import NAMESPACES, ROWS, Properties, PropertyRow, degrees, number
from lpn.flight.files.xmp import read_xmp
from tools.fixtures.photos import xmp_packet


def told_by(content: str, uri: str, prefix: str = "p") -> Properties:
    """What a description says that declares one namespace."""
    told = Properties()
    for item in read_xmp(xmp_packet(content, {prefix: uri} if uri else {}))[0]:
        told.add(*item)
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


@pytest.mark.parametrize(
    "address", ["http://www.example.com/drone-new/1.0/", "http://www.parrot.com/drone-parrot/1.0/"]
)
def test_names_that_dji_coined_count_in_every_namespace(address: str) -> None:
    content = "<p:GimbalYawDegree>-41</p:GimbalYawDegree><p:RelativeAltitude>+33.0</p:RelativeAltitude><p:Latitude>7</p:Latitude>"
    told = told_by(content, address)
    assert [(row.namespace, numbers[0]) for row, numbers in told.rows("angles")] == [("drone-dji", -41.0)]
    assert told.first("height_above_takeoff") == 33.0
    assert list(told.rows("position")) == []


def test_a_namespace_is_known_by_its_address_and_not_by_its_prefix() -> None:
    yaw = "<{0}:Yaw>1</{0}:Yaw>"
    for prefix, address, known in (
        ("p", "http://pix4d.com/camera/1.0", True), ("Camera", "http://example.org/camera/", False), ("Camera", "Camera/", True),
    ):  # fmt: skip
        assert bool(list(told_by(yaw.format(prefix), address, prefix).rows("angles"))) == known
    # exiv2 asks its user for an address.
    dji = "<d:GimbalYawDegree>1</d:GimbalYawDegree>"
    assert list(told_by(dji, "http://ns.drone-dji.com/", "d").rows("angles"))


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
        ("+39.80", 39.8), ("-8759/100", -87.59), ("12.5 m", 12.5), ("39,8", 39.8), ("1e2", 100.0), (".5", 0.5), ((7,), 7.0),
        (b"\x37\x00", 7.0),
        ("0/0", None), ("1/0", None), ("", None), ("NA", None), ("nan", None), ("1e999", None), ((1, 2), None), (None, None),
    ],
)  # fmt: skip
def test_numbers_as_exif_and_xmp_write_them(text: object, value: float | None) -> None:
    assert number(text) == value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("47,18.0740N", 47.301234), ("8,30.07404E", 8.501234), ("47,18,4.4424N", 47.301234), ("33,51.0S", -33.85),
        ("47° 18' 4.4424\" N", 47.301234), ("-47.301234", -47.301234), ("-473012340/10000000", -47.301234),
        ((47.0, 18.0, 4.4424), 47.301234), ((47.0, 18.07404, 4.4), 47.301234), ((-47.0, 18.07404), -47.301234), (47.5, 47.5),
        ("47,78.0N", None), ("N", None), ("NA", None), ((47.0, 61.0), None), ((47.0, None, 0.0), None),
    ],
)  # fmt: skip
def test_degrees_as_exif_and_xmp_write_them(text: object, value: float | None) -> None:
    assert degrees(text) == (None if value is None else pytest.approx(value, abs=2e-6))
