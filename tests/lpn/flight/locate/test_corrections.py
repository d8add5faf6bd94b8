from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import DataError, InputError
from lpn.flight.locate.corrections import NAME, Correction, read_corrections, set_correction
from lpn.flight.locate.coverage import corners_of
from lpn.flight.maps import LocalFrame

FRAME = LocalFrame(48.0, 9.0)
CORNERS = np.array([(100.0, 60.0), (180.0, 70.0), (170.0, 0.0), (95.0, 5.0)])


def test_the_middle_is_where_the_diagonals_cross() -> None:
    found = Correction.of(CORNERS, FRAME)
    first, second = CORNERS[2] - CORNERS[0], CORNERS[3] - CORNERS[1]
    along = np.linalg.solve(np.stack([first, -second], axis=1), CORNERS[1] - CORNERS[0])[0]
    np.testing.assert_allclose(FRAME.xy(*found.middle[:, None])[0], CORNERS[0] + along * first, atol=1e-3)
    np.testing.assert_allclose(corners_of(found.homography(FRAME, 80, 60), 80, 60), CORNERS, atol=1e-3)


@pytest.mark.parametrize(
    "corners",
    [
        CORNERS[::-1],
        CORNERS[[0, 2, 1, 3]],
        np.zeros((4, 2)),
        CORNERS * 1e4,
        np.array([(0.0, 10.0), (10, 10), (9, 9), (0, 0)]) * [1, -1],
    ],
)
def test_a_photo_cannot_be_turned_over_folded_or_vanish(corners: np.ndarray) -> None:
    with pytest.raises(InputError, match="tie points"):
        Correction.of(corners, FRAME)


def test_corrections_are_kept_beside_the_flight_one_line_a_frame(tmp_path: Path) -> None:
    file = tmp_path / NAME
    assert read_corrections(file) == {}
    set_correction(file, "b,1.jpg", Correction.of(CORNERS, FRAME))
    set_correction(file, "a.jpg", Correction.of(CORNERS + 50, FRAME))
    found = set_correction(file, "a.jpg", Correction.of(CORNERS + 7, FRAME))
    again = read_corrections(file)
    assert list(again) == ["a.jpg", "b,1.jpg"]
    assert set(found) == set(again)
    np.testing.assert_allclose(FRAME.xy(*again["a.jpg"].corners.T), CORNERS + 7, atol=1e-3)
    assert list(set_correction(file, "a.jpg", None)) == ["b,1.jpg"]
    assert file.read_text().count("\n") == 2


@pytest.mark.parametrize(("latitude", "longitude"), [(48.0, 9.0), (85.0, 179.9999), (-16.0, -179.9999)])
@pytest.mark.parametrize("length", [1.01, 19_990.0])
def test_what_is_saved_can_be_read(tmp_path: Path, latitude: float, longitude: float, length: float) -> None:
    file, frame = tmp_path / NAME, LocalFrame(latitude, longitude)
    corners = np.array([(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.02, 0.0)]) * length
    set_correction(file, "a", Correction.of(corners, frame))
    np.testing.assert_allclose(frame.xy(*read_corrections(file)["a"].corners.T), corners, atol=2e-3)


def test_names_that_are_not_utf_8_survive(tmp_path: Path) -> None:
    file = tmp_path / NAME
    name = os.fsdecode(b"caf\xe9.jpg")
    set_correction(file, name, Correction.of(CORNERS, FRAME))
    assert list(read_corrections(file)) == [name]
    assert list(set_correction(file, "b.jpg", Correction.of(CORNERS, FRAME))) == [name, "b.jpg"]
    assert list(set_correction(file, name, None)) == ["b.jpg"]
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert list(read_corrections(file)) == ["b.jpg"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("x,y\n", "The first line"),
        ("", "The first line"),
        ("{head}\na,1,2,1 2,1 2,1 2\n", "Line 2 of "),
        ("{head}\na,1,2,1 2,1 2,1 2,1\n", "Line 2 of "),
        ("{head}\na,nan,2,1 2,1 2,1 2,1 2\n", "Line 2 of "),
        ("{head}\na,91,2,1 2,1 2,1 2,1 2\n", "Line 2 of "),
        ('{head}\n"a\n', "not comma-separated"),
        ("{head}\na,48,9,48 9,48 9,48 9,48 9\n", "Line 2 .* over, fold it"),
        ("{head}\na,48,9,48.1 9,48 9.1,48.1 9.1,48 9\n", "Line 2 .* over, fold it"),
        ("{head}\na,40,10,50 0,50 20,30 20,30 0\n", "Line 2 .* too large"),
        ("{head}\na,48,9,48.3 9,48.3 9.3,48 9.3,48 9\n", "Line 2 .* too large"),
        ("{head}\n{line}\nb.jpg,{rest}\n{line}\n", "Line 4 .* the second line for the photo a.jpg"),
    ],
)
def test_a_damaged_file_gets_one_sentence_and_stays(tmp_path: Path, text: str, sentence: str) -> None:
    file = tmp_path / NAME
    rest = "48.0005,9.0005,48.001 9,48.001 9.001,48 9.001,48 9"
    text = text.replace("{line}", f"a.jpg,{rest}").replace("{rest}", rest)
    file.write_text(text.replace("{head}", "frame,latitude,longitude,top left,top right,bottom right,bottom left"))
    before = file.read_bytes()
    with pytest.raises(DataError, match=sentence):
        read_corrections(file)
    with pytest.raises(DataError, match=sentence):
        set_correction(file, "a", None)
    assert file.read_bytes() == before
