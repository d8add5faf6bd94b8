"""The table of makers' properties: each row in every form, and namespaces as programs write them."""

from __future__ import annotations

import pytest

from lpn.flight.files.makers import NAMESPACES, ROWS, XmpRow, XmpValues, degrees_of, number
from lpn.flight.files.xmp import read_xmp
from tools.fixtures.photos import xmp_packet

_TEXTS = {"degrees": "-12.5", "degrees and minutes": "12,30.0000S", "text": "12.5 x"}


def values_of(content: str, uri: str, prefix: str = "p") -> XmpValues:
    """What a description says that declares one namespace."""
    return XmpValues(read_xmp(xmp_packet(content, {prefix: uri} if uri else {}))[0])


def forms(name: str, text: str) -> list[str]:
    """A property, by its name in the table, as XML in every form that XMP allows."""
    outer, _, inner = name.partition("/")
    if inner:
        return [
            f'<p:{outer} rdf:parseType="Resource"><p:{inner}>{text}</p:{inner}></p:{outer}>',
            f'<p:{outer} p:{inner}="{text}"/>',
            f'<p:{outer}><rdf:Description p:{inner}="{text}"/></p:{outer}>',
            f"<p:{outer}><rdf:Description><p:{inner}>{text}</p:{inner}></rdf:Description></p:{outer}>",
        ]
    return [
        f"<p:{name}>{text}</p:{name}>",
        f'<rdf:Description p:{name}="{text}"/>',
        f"<p:{name}><rdf:Seq><rdf:li>{text}</rdf:li></rdf:Seq></p:{name}>",
        f'<p:{name} rdf:parseType="Resource"><rdf:value>{text}</rdf:value></p:{name}>',
        f"<p:{name.upper()}>{text}</p:{name.upper()}>",
        f"<p:{name}>{text}</p:{name}><p:{name}>{text}</p:{name}>",
    ]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.namespace}:{row.name}:{row.convention}")
def test_each_row_is_read_in_every_form(row: XmpRow) -> None:
    assert row.source.strip()
    text = _TEXTS.get(row.unit, "12.5")
    expected = text if row.unit == "text" else float(text) if row.unit != "degrees and minutes" else -12.5
    address = NAMESPACES[row.namespace].uris[0]
    for uri in (f"http://www.{address}/1.0/", f"https://{address}/1.0", f"http://{address}/", f"HTTP://{address}/2.1#"):
        for form in forms(row.name, text):
            found = values_of(form, uri)
            assert found.values == {row: expected}
            assert (found.unread, found.unreadable, found.contradictory) == ([], [], [])
    for prefix in NAMESPACES[row.namespace].prefixes:
        assert values_of(forms(row.name, text)[0].replace("p:", f"{prefix}:"), "").values == {row: expected}


def test_no_property_is_in_the_table_twice() -> None:
    assert len({(row.namespace, row.name.casefold()) for row in ROWS}) == len(ROWS)
    assert {row.namespace for row in ROWS} == {*NAMESPACES}


@pytest.mark.parametrize("address", ["http://www.example.com/drone-new/1.0/", NAMESPACES["drone-parrot"].uris[0]])
def test_names_that_dji_coined_count_in_every_namespace(address: str) -> None:
    content = "<p:GimbalYawDegree>-41</p:GimbalYawDegree><p:RelativeAltitude>+33.0</p:RelativeAltitude><p:Latitude>7</p:Latitude>"
    copied = values_of(content, address)
    assert {row.name: value for row, value in copied.values.items()} == {
        "RelativeAltitude": 33.0,
        "GimbalYawDegree": -41.0,
    }
    assert {row.namespace for row in copied.values} == {"drone-dji"}
    assert copied.unread == ["p:Latitude"]
    assert not copied.heading_unread


def test_a_namespace_is_known_by_its_address_and_not_by_its_prefix() -> None:
    assert values_of("<p:Yaw>1</p:Yaw>", "http://pix4d.com/camera/1.0", "p").values
    assert not values_of("<Camera:Yaw>1</Camera:Yaw>", "http://example.org/camera/", "Camera").values
    # A Parrot writes "Camera/" for an address, and exiv2 asks for one of its user's own.
    assert values_of("<Camera:Yaw>1</Camera:Yaw>", "Camera/", "Camera").values
    assert values_of(
        "<drone-dji:GimbalYawDegree>1</drone-dji:GimbalYawDegree>", "http://ns.drone-dji.com/", "drone-dji"
    ).values


@pytest.mark.parametrize(
    "name",
    [
        "GimbalTiltDegree",
        "CameraHeading",
        "AircraftYaw",
        "Lat",
        "cameraLongitude",
        "HeightAGL",
        "BaroAltitude",
        "MountAzimuth",
    ],
)
def test_what_looks_like_a_position_height_or_angle_is_named(name: str) -> None:
    found = values_of(f"<drone-new:{name}>12.5</drone-new:{name}>", "http://new.example/drone-new/1.0/", "drone-new")
    assert found.unread == [f"drone-new:{name}"]


@pytest.mark.parametrize(
    ("prefix", "uri", "name", "text"),
    [
        ("drone-dji", "http://www.dji.com/drone-dji/1.0/", "RtkStdLat", "0.01"),
        ("drone-dji", "http://www.dji.com/drone-dji/1.0/", "FlightXSpeed", "+1.00"),
        ("drone-dji", "http://www.dji.com/drone-dji/1.0/", "GimbalReverse", "0"),
        ("drone-dji", "http://www.dji.com/drone-dji/1.0/", "LRFTargetLat", "47.1"),
        ("drone-dji", "http://www.dji.com/drone-dji/1.0/", "AltitudeType", "RtkAlt"),
        ("Camera", "http://pix4d.com/camera/1.0/", "IrradianceYaw", "81.5"),
        ("Camera", "http://pix4d.com/camera/1.0/", "IMUYawAccuracy", "2"),
        ("SENTERA", "http://sentera.com/camera/1.0/", "HomePointLatitude", "37.2"),
        ("DLS", "http://micasense.com/DLS/1.0/", "Yaw", "-1.8"),
        ("tiff", "http://ns.adobe.com/tiff/1.0/", "Orientation", "1"),
        ("crs", "http://ns.adobe.com/camera-raw-settings/1.0/", "PerspectiveHeight", "0"),
        ("GPano", "http://ns.google.com/photos/1.0/panorama/", "FullPanoHeightPixels", "6433"),
        ("FLIR", "http://ns.flir.com/xmp/1.0/", "MAVYawRate", "0/100"),
    ],
)
def test_what_tells_nothing_of_the_camera_is_not_named(prefix: str, uri: str, name: str, text: str) -> None:
    found = values_of(f"<{prefix}:{name}>{text}</{prefix}:{name}>", uri, prefix)
    assert (found.values, found.unread) == ({}, [])


def test_unreadable_and_contradictory_values_are_named() -> None:
    uri = "http://www.dji.com/drone-dji/1.0/"
    content = "<d:GimbalYawDegree>NA</d:GimbalYawDegree><d:RelativeAltitude>1e9</d:RelativeAltitude>"
    found = values_of(content + "<d:GpsLatitude>1</d:GpsLatitude><d:GpsLatitude>2</d:GpsLatitude>", uri, "d")
    assert found.unreadable == ["d:GimbalYawDegree", "d:RelativeAltitude"]
    assert found.contradictory == ["d:GpsLatitude"]
    assert found.first("latitude") == 1.0


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("+39.80", 39.8), ("-8759/100", -87.59), ("39,8", 39.8), ("12.5 m", 12.5), ("12.5 metres", 12.5), ("1e2", 100.0),
        ("45°", 45.0), (".5", 0.5), ("0/0", None), ("1/0", None), ("", None), ("NA", None), ("nan", None), ("1e999", None),
        ("12.5 feet", None), ("1 2", None),
    ],
)  # fmt: skip
def test_numbers_as_xmp_writes_them(text: str, value: float | None) -> None:
    assert number(text) == value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("47,18.0740N", 47.301234), ("8,30.07404E", 8.501234), ("47,18,4.4424N", 47.301234), ("33,51.0S", -33.85),
        ("47° 18' 4.4424\" N", 47.301234), ("N 47 18 4.4424", 47.301234), ("47 deg 18' 4.4424\" South", -47.301234),
        ("-47.301234", -47.301234), ("47,301234", 47.301234), ("47.301234 N", 47.301234), ("70.5W", -70.5),
        ("47,78.0N", None), ("47,18", 47.18), ("N", None), ("47 18 4", None), ("NA", None),
    ],
)  # fmt: skip
def test_degrees_as_xmp_writes_them(text: str, value: float | None) -> None:
    assert degrees_of(text) == (None if value is None else pytest.approx(value, abs=2e-6))


def test_a_heading_that_cannot_be_read_is_unread() -> None:
    assert values_of("<p:GimbalYawDegree>-4?.0</p:GimbalYawDegree>", "http://www.dji.com/drone-dji/1.0/").heading_unread


def test_angles_in_another_frame_are_named_where_those_of_the_table_are_missing() -> None:
    uri = f"https://{NAMESPACES['drone-skydio'].uris[0]}/1.0/"
    other = '<p:CameraOrientationQuatNED rdf:parseType="Resource"><p:W>1.0</p:W></p:CameraOrientationQuatNED>'
    alone = values_of(other, uri)
    assert (alone.unread, alone.heading_unread) == (["p:CameraOrientationQuatNED/W"], True)
    beside = '<p:CameraOrientationNED rdf:parseType="Resource"><p:Yaw>41.0</p:Yaw></p:CameraOrientationNED>'
    assert values_of(beside + other, uri).unread == []
