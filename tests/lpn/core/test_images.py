from __future__ import annotations

import io
import struct
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from lpn.core import images
from lpn.core.errors import PictureError
from lpn.core.resources import usable_cores
from tools.fixtures import small_worlds


def test_preparation_is_the_published_one() -> None:
    picture = small_worlds.place(1)
    reference = np.asarray(Image.fromarray(picture).resize((64, 48), Image.Resampling.BICUBIC), np.float32) / 255
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    prepared = images.prepare(picture, (48, 64))
    assert prepared.shape == (3, 48, 64)
    assert prepared.dtype == np.float32
    np.testing.assert_allclose(prepared, ((reference - mean) / std).transpose(2, 0, 1), atol=1e-5)


def test_a_picture_is_encoded_as_jpeg_in_its_colours() -> None:
    orange = np.full((16, 16, 3), (220, 120, 20), np.uint8)
    found = images.jpeg(orange, 95)
    assert found.startswith(b"\xff\xd8")
    np.testing.assert_allclose(images.decode_picture(found, "it"), orange, atol=3)
    noisy = small_worlds.place(1)
    assert len(images.jpeg(noisy, 40)) < len(images.jpeg(noisy, 95))


@pytest.mark.parametrize(("degrees", "turns"), [(90, 1), (180, 2), (270, 3), (-90, 3)])
def test_quarter_turns_are_exact_and_counter_clockwise(degrees: float, turns: int) -> None:
    picture = small_worlds.place(2)
    turned = images.rotate(picture, degrees).astype(int)
    assert np.abs(turned - np.rot90(picture, turns).astype(int)).max() <= 1


def test_rotation_keeps_the_canvas_and_leaves_corners_black() -> None:
    picture = np.full((60, 80, 3), 200, np.uint8)
    turned = images.rotate(picture, 45)
    assert turned.shape == picture.shape
    assert turned[0, 0].sum() == 0
    assert turned[30, 40].tolist() == [200, 200, 200]
    assert images.rotate(picture, 360) is picture


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "CMYK", "I;16"])
def test_other_pixel_formats_become_rgb(mode: str, tmp_path: Path) -> None:
    suffix = "jpg" if mode == "CMYK" else "png"
    grey = Image.fromarray(small_worlds.place(3)).convert("L")
    picture = Image.fromarray(np.asarray(grey).astype(np.uint16) * 257) if mode == "I;16" else grey.convert(mode)
    picture.save(tmp_path / f"picture.{suffix}")
    loaded = images.load_picture(tmp_path / f"picture.{suffix}")
    assert loaded.shape == (small_worlds.SIZE, small_worlds.SIZE, 3)
    assert loaded.dtype == np.uint8
    assert np.abs(loaded.mean() - np.asarray(grey).mean()) < 12


@pytest.mark.parametrize("suffix", [".bmp", ".gif", ".tif", ".tiff"])
def test_further_kinds_are_read(suffix: str) -> None:
    shown = Image.fromarray(small_worlds.place(3)).convert("P")
    whole = io.BytesIO()
    shown.save(whole, {".bmp": "BMP", ".gif": "GIF"}.get(suffix, "TIFF"))
    np.testing.assert_array_equal(images.decode_picture(whole.getvalue(), "a.jpg"), np.asarray(shown.convert("RGB")))
    assert suffix in images.SUFFIXES
    with pytest.raises(PictureError, match=r"a is (cut short|not a picture)"):
        images.decode_picture(whole.getvalue()[:800], "a")


@pytest.mark.parametrize("kind", ["EPS", "TGA", "PPM"])
def test_other_kinds_are_not_read_whatever_their_names(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow would start Ghostscript for an EPS file."""
    monkeypatch.setattr(subprocess, "Popen", None)
    whole = io.BytesIO()
    Image.fromarray(small_worlds.place(3)).save(whole, kind)
    assert images.header_error(whole) == "is not a picture that can be read"
    with pytest.raises(
        PictureError, match=r"a\.jpg is not a picture that can be read; expected a JPEG, PNG, WebP, BMP, GIF, or TIFF"
    ):
        images.decode_picture(whole.getvalue(), "a.jpg")


@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_an_animation_is_its_first_frame_without_transparency(kind: str) -> None:
    first, second = (Image.fromarray(picture) for picture in (small_worlds.place(1), 255 - small_worlds.place(1)))
    first.putalpha(0 if kind == "PNG" else 255)  # WebP drops the colours below full transparency
    whole = io.BytesIO()
    first.save(whole, kind, save_all=True, append_images=[second], lossless=True)
    np.testing.assert_array_equal(images.decode_picture(whole.getvalue(), kind), small_worlds.place(1))


@pytest.mark.parametrize(
    ("size", "flaw"),
    [
        ((8192, 6144), None),
        ((8000, 8000), None),
        ((8001, 8000), "has 8001 x 8000 pixels, too many to be read"),
        ((16_384, 16_384), "has far too many pixels to be read"),
    ],
)
def test_the_largest_pictures_of_drones_are_read_and_larger_ones_refused_undecoded(
    size: tuple[int, int], flaw: str | None
) -> None:
    data = io.BytesIO()
    Image.new("1", size).save(data, "PNG")
    started = time.process_time()
    assert images.header_error(data) == flaw
    assert time.process_time() - started < 1


@pytest.mark.parametrize("bits", [8, 12, 14, 16])
@pytest.mark.parametrize("suffix", [".tif", ".png"])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_upper_bits_of_sixteen_are_read_and_none_is_refused(bits: int, suffix: str, channels: int) -> None:
    picture = small_worlds.place(3)[..., :channels].astype(np.uint16)
    numbers = picture << (bits - 8)
    data = cv2.imencode(suffix, numbers[..., ::-1])[1].tobytes()
    if bits <= 12:
        with pytest.raises(PictureError, match=r"uses the lowest 12 .* save it with 8 bits"):
            images.decode_picture(data, "a")
        return
    shape = (*picture.shape[:2], 3)
    np.testing.assert_array_equal(images.decode_picture(data, "a"), np.broadcast_to(numbers >> 8, shape))


@pytest.mark.parametrize(
    ("channels", "interleave", "photometric", "compress", "tiled"),
    [
        (1, "pixel", "miniswhite", "deflate", False),
        (3, "band", "rgb", "zstd", True),
        (3, "pixel", "rgb", "deflate", True),
    ],
)
def test_sixteen_bits_keep_planes_apart_and_white_white(
    channels: int, interleave: str, photometric: str, compress: str, tiled: bool, tmp_path: Path
) -> None:
    truth = small_worlds.place(3)[..., :channels]
    inverted = photometric == "miniswhite"
    rasterio = pytest.importorskip("rasterio")
    options = {"interleave": interleave, "photometric": photometric, "compress": compress, "tiled": tiled}
    options |= {"blockxsize": 32, "blockysize": 32} if tiled else {}
    shape = {"width": truth.shape[1], "height": truth.shape[0], "count": channels, "dtype": np.uint16}
    placed = rasterio.Affine(1, 0, 5, 0, -1, 5)
    for bits in (16, 12):
        numbers = (255 - truth if inverted else truth).astype(np.uint16) << (bits - 8)
        with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", transform=placed, **shape, **options) as written:
            written.write(np.moveaxis(numbers, 2, 0))
        if bits == 12:  # the lowest, though white may be 0
            with pytest.raises(PictureError, match=r"a\.tif has numbers of 16 bits and uses the lowest 12 at most"):
                images.load_picture(tmp_path / "a.tif")
        else:
            assert np.abs(images.load_picture(tmp_path / "a.tif").astype(int) - truth).max() <= 1


def test_a_tiff_is_read_upright(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(small_worlds.place(3)[:40]).save(tmp_path / "a.tif", compression="zstd", exif=exif)
    shown = images.load_picture(tmp_path / "a.tif")
    np.testing.assert_array_equal(shown, np.rot90(small_worlds.place(3)[:40], -1))


@pytest.mark.parametrize("kind", [2, 16])
def test_a_tiff_whose_pixels_lie_at_no_place_is_damaged(kind: int) -> None:
    stream = io.BytesIO()
    Image.fromarray(small_worlds.place(3)).save(stream, "TIFF")
    data = bytearray(stream.getvalue())
    entry = data.index(struct.pack("<HH", 273, 4))  # StripOffsets, as text or as a number of 64 bits
    data[entry + 2] = kind
    if kind == 16:
        data[entry + 8 : entry + 12] = len(data).to_bytes(4, "little")
        data += b"\xff" * 8
    with pytest.raises(PictureError, match="a is cut short or damaged"):
        images.decode_picture(bytes(data), "a")


@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_heights_are_no_picture_and_called_so(kind: type, tmp_path: Path) -> None:
    Image.fromarray(np.full((20, 20), 312, kind)).save(tmp_path / "dsm.tif")
    with pytest.raises(PictureError, match="heights of the ground"):
        images.load_picture(tmp_path / "dsm.tif")


@pytest.mark.parametrize("orientation", range(10))
def test_exif_orientation_is_obeyed_unless_told_otherwise(orientation: int, tmp_path: Path) -> None:
    picture = Image.fromarray(small_worlds.place(4)[:40])
    exif = picture.getexif()
    exif[0x0112] = orientation
    picture.save(tmp_path / "turned.png", exif=exif)
    with Image.open(tmp_path / "turned.png") as saved:
        expected = np.asarray(ImageOps.exif_transpose(saved))
    np.testing.assert_array_equal(images.load_picture(tmp_path / "turned.png"), expected)
    np.testing.assert_array_equal(images.load_picture(tmp_path / "turned.png", upright=False), np.asarray(picture))


def test_damaged_exif_is_no_damage_of_the_picture(tmp_path: Path) -> None:
    picture = Image.fromarray(small_worlds.place(4))
    picture.save(tmp_path / "a.png", exif=b"Exif\0\0II*\0\x08\0\0\0\xff\xff\x12\x01")
    np.testing.assert_array_equal(images.load_picture(tmp_path / "a.png"), np.asarray(picture))


def test_what_is_not_a_picture_gets_one_sentence(tmp_path: Path) -> None:
    png = cv2.imencode(".png", small_worlds.place(5))[1].tobytes()
    for name, content, flaw in (
        ("empty.png", b"", "is not a picture"),
        ("svg.png", b"<svg/>", "is a drawing"),
        ("xml.jpg", b'<?xml version="1.0"?>\n<svg xmlns="http://www.w3.org/2000/svg"/>', "is a drawing"),
        ("phone.jpg", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(100), "is a HEIC picture"),
        ("cut.png", png[:60], "is cut short"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(PictureError, match=f"{name} {flaw}") as caught:
            images.load_picture(tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(PictureError, match="check the path"):
        images.load_picture(tmp_path / "absent.png")


SHARED_THREADS = """
import os, threading, time
import cv2
import numpy as np
from lpn.core import images
from lpn.core.resources import yield_cores

def work():
    yield_cores()
    cv2.GaussianBlur(np.zeros((2000, 2000, 3), np.uint8), (0, 0), 2)

def niceness():
    return {os.getpriority(os.PRIO_PROCESS, int(thread)) for thread in os.listdir("/proc/self/task")}

cv2.setNumThreads(8)
images.use_all_cores()
thread = threading.Thread(target=work)
thread.start()
thread.join()
for _ in range(500):  # the system removes a thread some time after its end
    if len(niceness()) == 1:
        break
    time.sleep(0.01)
print(len(niceness()))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux has a niceness for each thread")
@pytest.mark.skipif(usable_cores() < 2, reason="needs two cores")
def test_threads_that_all_share_do_not_yield_because_one_thread_does() -> None:
    done = subprocess.run([sys.executable, "-c", SHARED_THREADS], check=True, stdout=subprocess.PIPE, text=True)
    assert int(done.stdout) == 1


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize(
    ("longer", "shape"), [(399, (300, 399)), (400, (150, 200)), (799, (150, 399)), (800, (75, 200))]
)
def test_a_far_larger_picture_is_decoded_at_a_part_of_its_size(
    suffix: str, longer: int, shape: tuple[int, int]
) -> None:
    data = cv2.imencode(suffix, cv2.resize(small_worlds.place(3), (longer, 300)), [cv2.IMWRITE_JPEG_QUALITY, 95])[
        1
    ].tobytes()
    whole = images.decode_picture(data, "a")
    reduced = images.decode_picture(data, "a", side=100)
    assert np.abs(reduced.shape[:2] - np.array(shape)).max() <= 1
    if longer < 400:
        np.testing.assert_array_equal(reduced, whole)
    difference = images.resize(whole, 24, 64).astype(int) - images.resize(reduced, 24, 64)
    assert np.abs(difference).mean() < 0.6
    assert np.abs(difference).max() <= 12


def test_a_picture_that_is_decoded_at_a_part_of_its_size_is_upright_and_whole() -> None:
    data = io.BytesIO()
    exif = Image.Exif()
    exif[0x0112] = 6  # its top is at the right
    Image.fromarray(cv2.resize(small_worlds.place(3), (800, 400))).save(data, "JPEG", exif=exif, quality=95)
    reduced = images.decode_picture(data.getvalue(), "a", side=100)
    assert reduced.shape == (200, 100, 3)
    turned = images.resize(np.rot90(cv2.resize(small_worlds.place(3), (800, 400)), -1), 64, 64)
    assert np.abs(images.resize(reduced, 64, 64).astype(int) - turned).mean() < 3
    with pytest.raises(PictureError, match="cut short or damaged"):
        images.decode_picture(data.getvalue()[:9000], "a", side=100)
