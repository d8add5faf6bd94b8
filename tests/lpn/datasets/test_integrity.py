from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

import lpn
from lpn.core.errors import PictureError
from lpn.datasets.integrity import DAMAGED, list_errors, picture_error, picture_errors
from lpn.descriptors import describe
from tools.fixtures import small_worlds

KINDS = ("jpg", "png", "webp")


def picture(folder: Path, kind: str) -> Path:
    file = folder / f"whole.{kind}"
    Image.fromarray(small_worlds.place(1)).save(file)
    return file


@pytest.mark.parametrize("decode", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_a_whole_picture_has_no_flaw(kind: str, decode: bool, tmp_path: Path) -> None:
    file = picture(tmp_path, kind)
    assert picture_error(file, decode) is None
    file.write_bytes(file.read_bytes() + b"\0\0\n")
    assert picture_error(file, decode) is None


@pytest.mark.parametrize("kept", [0.3, 0.9, 0.999])
@pytest.mark.parametrize("kind", KINDS)
def test_a_picture_cut_anywhere_is_found_without_decoding_all(kind: str, kept: float, tmp_path: Path) -> None:
    file = picture(tmp_path, kind)
    whole = file.read_bytes()
    file.write_bytes(whole[: int(len(whole) * kept)])
    said = picture_error(file)
    assert said in ("is cut short or damaged", "is not a picture that can be read")
    assert picture_error(file, decode=True) is not None


def test_pngs_damaged_in_the_middle_are_named_together_when_they_are_described(
    tmp_path: Path, model_file: Path
) -> None:
    whole = picture(tmp_path, "png")
    files = [whole, *(whole.with_name(f"{letter}.png") for letter in "ab")]
    for file in files[1:]:
        harmed = bytearray(whole.read_bytes())
        harmed[len(harmed) // 2 : len(harmed) // 2 + 50] = bytes(50)
        file.write_bytes(harmed)
        assert (picture_error(file), picture_error(file, decode=True)) == (None, DAMAGED)
    model = lpn.load(model_file)
    with pytest.raises(PictureError, match=r"2 of 3 pictures cannot be described: a\.png, b\.png\. .*: .*a\.png is "):
        describe(model, files, "drone", tmp_path / "store", root=tmp_path)
    with pytest.raises(PictureError, match=r"a\.png is cut short or damaged"):
        describe(model, files[:2], "drone", tmp_path / "other", root=tmp_path)
    for file in files[1:]:
        file.write_bytes(whole.read_bytes())
    assert describe(model, files, "drone", tmp_path / "store", root=tmp_path).descriptors.shape == (3, 4, 512)


def test_trailing_data_after_a_jpeg_is_no_flaw(tmp_path: Path) -> None:
    file = picture(tmp_path, "jpg")
    file.write_bytes(file.read_bytes() + b"maker's notes" * 20)
    assert picture_error(file) is None


def test_other_flaws_are_said(tmp_path: Path) -> None:
    assert picture_error(tmp_path / "absent.jpg") == "cannot be read (No such file or directory)"
    (tmp_path / "web.jpg").write_text("<html>302 Found</html>")
    assert picture_error(tmp_path / "web.jpg") == "is not a picture that can be read"
    Image.new("1", (9000, 9000)).save(tmp_path / "large.png")
    assert picture_error(tmp_path / "large.png") == "has 9000 x 9000 pixels, too many to be read"


def test_files_keep_their_order_and_are_named(tmp_path: Path) -> None:
    good = picture(tmp_path, "jpg")
    bad = [tmp_path / f"{letter}.jpg" for letter in "hgfedcba"]
    told: list[int] = []
    found = picture_errors([good, *bad, good], on_progress=told.append)
    assert list(found) == bad
    assert told[-1] == 10
    assert list_errors(found, tmp_path) == (
        ", ".join(f"{letter}.jpg cannot be read (No such file or directory)" for letter in "hgfed") + ", and 3 more"
    )
    assert picture_errors([]) == {}
