"""Lenses: DJI's table, files of cameras, and pictures without distortion."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags

from lpn.cli.main import main
from lpn.core.errors import DataError
from lpn.flight.files import make_flight, open_flight
from lpn.flight.files.lenses import Lens, lens_of_text, read_camera
from lpn.flight.files.photos import Photo, photo_of
from tests.conftest import Refused
from tools.fixtures.photos import dji_xmp, exif, photo_bytes, write_photo

# A Mavic 3E's table, of pictures of 5280 x 3956 pixels.
TABLE_TEXT = "2022-05-20;3713.29,3713.29,7.02,-8.72,-0.112575,0.01488,-0.00008,0.00001,-0.0273"
ORIGINAL = {ExifTags.Base.ExifImageWidth.value: 5280, ExifTags.Base.ExifImageHeight.value: 3956}
LENS = Lens(0.7, 0.71, 0.01, -0.005, -0.12, 0.02, 0.001, -0.002, -0.01)
OPENCV = """%YAML:1.0
---
image_width: 1000
image_height: 750
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 700., 0., 509.5, 0., 710., 369.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.12, 0.02, 0.001, -0.002, -0.01 ]
"""
ROS = OPENCV.replace("%YAML:1.0\n---\n", "distortion_model: plumb_bob\n").replace("!!opencv-matrix", "")
DJI = {
    "projection_type": "brown", "width": 1000, "height": 750, "focal_x": 0.7, "focal_y": 0.71, "c_x": 0.01,
    "c_y": -0.005, "k1": -0.12, "k2": 0.02, "p1": 0.001, "p2": -0.002, "k3": -0.01,
}  # fmt: skip
ODM = json.dumps({"v2 dji": DJI})


def test_a_picture_without_distortion_shows_a_ray_where_a_pinhole_does() -> None:
    ray, middle = np.array([0.35, -0.22, 1.0]), np.array([199.5, 149.5])
    camera = np.diag([400 * LENS.focal_x, 400 * LENS.focal_y, 1.0])
    camera[:2, 2] = middle + 400 * np.array([LENS.centre_x, LENS.centre_y])
    seen = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), camera, LENS.coefficients)[0].ravel()
    row, column = np.mgrid[:300, :400]
    spot = 255 * np.exp(-((column - seen[0]) ** 2 + (row - seen[1]) ** 2) / 8)
    picture = LENS.undistorted(np.repeat(spot.astype(np.uint8)[..., None], 3, axis=2))[..., 0].astype(float)
    found = np.array([(picture * column).sum(), (picture * row).sum()]) / picture.sum()
    pinhole = middle + LENS.focal_x * 400 * ray[:2]
    assert np.abs(found - pinhole).max() < 0.2
    assert np.abs(seen - pinhole).max() > 1


def photo_with(text: str, flag: str = "0", size: tuple[int, int] = (160, 120)) -> Photo:
    """A reduced photo of DJI with a table of its lens."""
    xmp = dji_xmp(DewarpData=text, DewarpFlag=flag)
    return photo_of(photo_bytes(exif(48.0, 9.0, camera=ORIGINAL), xmp, size), Path("a.jpg"))


def test_the_table_of_dji_is_read_for_pictures_of_any_size() -> None:
    frame = photo_with(TABLE_TEXT).frame
    assert frame.lens == lens_of_text(TABLE_TEXT, 5280)
    numbers = frame.lens.focal_x, frame.lens.centre_y, frame.lens.k3
    assert numbers == pytest.approx((3713.29 / 5280, -8.72 / 5280, -0.0273))
    assert frame.fov == pytest.approx(70.8, abs=0.1)


@pytest.mark.parametrize(
    ("text", "flag", "oddity"),
    [
        (TABLE_TEXT, "1", ""),
        ("2022-05-20;1,2,3", "0", "it has 3 numbers where 9 are expected"),
        (TABLE_TEXT.replace("3713.29", "3.7"), "0", "focal lengths of 0.000701 and 0.000701 widths of the picture"),
        (TABLE_TEXT.replace("-0.112575", "-3"), "0", "a distortion that folds the picture"),
        (TABLE_TEXT.replace("0.01488", "nan"), "0", "impossible coefficients"),
        (TABLE_TEXT.replace("0.01488", "a"), "0", "could not convert"),
        (TABLE_TEXT.replace("7.02", "2000"), "0", "an optical centre that is 0.379 widths of the picture off"),
    ],
)
def test_a_table_that_does_not_count_is_not_used(text: str, flag: str, oddity: str) -> None:
    photo = photo_with(text, flag)
    assert photo.frame.lens is None
    about_lens = [found for found in photo.oddities if "DewarpData" in found]
    assert len(about_lens) == bool(oddity)
    assert oddity in "".join(about_lens)


def test_the_table_is_not_that_of_a_cropped_picture() -> None:
    photo = photo_with(TABLE_TEXT, size=(160, 90))
    assert photo.frame.lens is None
    assert "because it has the table of a picture that was turned or cropped" in photo.oddities[0]


def test_a_log_does_not_change_the_field_of_view_of_a_known_lens(tmp_path: Path) -> None:
    file = tmp_path / "a.jpg"
    file.write_bytes(photo_bytes(exif(48.0, 9.0, camera=ORIGINAL), dji_xmp(DewarpData=TABLE_TEXT), (160, 120)))
    (tmp_path / "log.csv").write_text("name,lat,lon,fov\na.jpg,48.1,9.0,84\n")
    flight = make_flight([file, tmp_path / "log.csv"], tmp_path / "flight")
    assert (flight.frames[0].latitude, flight.frames[0].fov) == (48.1, photo_with(TABLE_TEXT).frame.fov)
    assert any("keeps the field of view of its lens, and not that in the log" in note for note in flight.notes)


ROWS = {
    "image_width": "1000", "image_height": 750, "camera_matrix": [[700.0, 0, 509.5], [0, 710.0, 369.5], [0, 0, 1]],
    "distortion_coefficients": [[-0.12, 0.02, 0.001, -0.002, -0.01]],
}  # fmt: skip
# As PyYAML writes it.
BLOCKS = """camera_matrix:
- - 700.0
  - 0.0
  - 509.5
- - 0.0
  - 710.0
  - '369.5'
- [0, 0, 1]
distortion_coefficients:
  data:
  - -0.12
  - 0.02
  - 0.001
  - -0.002
  - -0.01
image_height: 750
image_width: 1000
"""


def numbers(lens: Lens) -> list[float]:
    return [float(word) for word in lens.text().split()]


@pytest.mark.parametrize("text", [OPENCV, ROS, f"---\n{ROS}", ODM, json.dumps(ROWS), BLOCKS])
def test_a_camera_s_file_has_its_lens(tmp_path: Path, text: str) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    lens, proportions = read_camera(tmp_path / "camera.yaml")
    assert (numbers(lens), proportions) == (pytest.approx(numbers(LENS)), 0.75)


def test_a_camera_s_file_gives_its_lens_to_the_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "camera.yaml").write_text(OPENCV)
    photo = write_photo(tmp_path / "a.jpg", exif(48.0, 9.0))
    out = tmp_path / "flight"
    assert main(["flight", str(photo), "--camera", str(tmp_path / "camera.yaml"), "--out", str(out)]) == 0
    assert "1 of 1 photos is the one given with --camera" in capsys.readouterr().out
    frame = open_flight(out).frames[0]
    assert (numbers(frame.lens), frame.fov) == (pytest.approx(numbers(LENS)), pytest.approx(LENS.fov))


def test_a_camera_without_coefficients_has_no_distortion(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(OPENCV.partition("distortion_coefficients")[0])
    assert read_camera(tmp_path / "camera.yaml")[0].coefficients.tolist() == [0.0] * 5


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "has other contents; expected YAML or JSON by OpenCV, ROS, or ODM"),
        ("a: [", "has no readable line 1 (Missing , between the elements); expected YAML or JSON"),
        ("x: 1\n\ty: 2\n", "has no readable line 2 (Tabs"),
        (OPENCV.replace("cols: 3", "cols"), "has no readable line 7 ("),
        ("{}", "lacks 'width'"),
        ("a: " + 2000 * "[", "has too many brackets"),
        (ROS.replace("plumb_bob", "equidistant"), "has the model equidistant"),
        (ROS.replace("-0.01 ]", "-0.01, 0.5 ]"), "has 6 coefficients of distortion"),
        (ROS.replace("0., 1. ]", "1. ]"), "has 8 numbers in camera_matrix and not 9"),
        (OPENCV.replace(" 700.", " 7.").replace(" 710.", " 7.1"), "has focal lengths of 0.007 and 0.0071 widths"),
        (OPENCV.replace("image_width: 1000\n", ""), "lacks 'image_width'"),
        (OPENCV.replace("width: 1000", "width: 0"), "has a width of 0"),
        (json.dumps({"v2 dji": {}, "zoom": {"width": 1}}), "has 2 cameras (v2 dji, zoom) where one is"),
    ],
)
def test_a_file_that_is_no_camera_s_gets_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(DataError, match=re.escape(sentence)):
        read_camera(tmp_path / "camera.yaml")


def test_a_camera_of_other_proportions_is_refused(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "camera.yaml").write_text(OPENCV)
    photo = write_photo(tmp_path / "a.jpg", exif(48.0, 9.0), size=(40, 22))
    said = refused("flight", photo, "--camera", tmp_path / "camera.yaml", "--out", tmp_path / "f")
    assert "pictures are 0.750 times as high as wide" in said
    assert not (tmp_path / "f").exists()
