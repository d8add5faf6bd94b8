"""How bands, alpha, masks, and nodata become colours and valid pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lpn.core.arrays import AnyArray
from lpn.core.errors import DataError, InputError
from lpn.flight.maps import Map, MapOptions, Window, open_map
from tests.lpn.flight.maps.small_maps import EAST, NORTH, smooth, write_geotiff

PICTURE = smooth(64, 64)
TWO_METRES = (2, 0, EAST, 0, -2, NORTH)
# The left quarter is transparent.
OPAQUE = np.ones((64, 64, 1))
OPAQUE[:, :16] = 0
CORNERS = MapOptions(corners=(48.0, 9.0, 47.999, 9.0014))


def write(path: Path, values: AnyArray, **options: Any) -> Path:
    return write_geotiff(path, values, matrix=TWO_METRES, **options)


def with_alpha(kind: str, alpha: AnyArray, scale: float = 1) -> AnyArray:
    return np.concatenate([PICTURE.astype(np.float64) * scale, alpha], 2).astype(kind)


def share(where: Path | Map) -> float:
    """The share of a map's bounds that has data; they are a little wider than its raster."""
    return float((where if isinstance(where, Map) else open_map(where)).coverage().mean())


def colour_of(where: Path, options: MapOptions | None = None) -> list[int]:
    """The colour 16 m east of the middle."""
    colour: list[int] = open_map(where, options).read(Window(16, 0, 8), 4)[0][2, 2].tolist()
    return colour


def with_notes(path: Path, *bands: str) -> Path:
    """Write GDAL's notes on the bands of a raster beside it."""
    notes = "".join(f'<PAMRasterBand band="{number}">{text}</PAMRasterBand>' for number, text in enumerate(bands, 1))
    Path(f"{path}.aux.xml").write_text(f"<PAMDataset>{notes}</PAMDataset>")
    return path


@pytest.mark.parametrize(
    ("kind", "full", "usual"),
    [
        ("uint8", 1, 255),
        ("uint8", 100, 255),
        ("uint16", 255, 65_535),
        ("int16", 1, 32_767),
        ("float32", 255, 1),
    ],
)
def test_alpha_of_a_smaller_range_than_its_type_is_alpha(tmp_path: Path, kind: str, full: float, usual: float) -> None:
    options = {"photometric": "RGB", "alpha": "yes"}
    towns = []
    for number, most in enumerate((full, usual)):
        (tmp_path / f"{number}").mkdir()
        towns.append(open_map(write(tmp_path / f"{number}" / "town.tif", with_alpha(kind, OPAQUE * most), **options)))
    assert towns[0].frame == towns[1].frame
    assert towns[0].notes == towns[1].notes
    for town in towns:
        assert share(town) == pytest.approx(0.75, abs=0.002)
    for one, other in zip(towns[0].overview(200), towns[1].overview(200), strict=True):
        np.testing.assert_array_equal(one, other)


def test_partial_alpha_has_data_where_gdal_says_so(tmp_path: Path) -> None:
    alpha = np.repeat(np.arange(64)[None, :, None] * 4, 64, axis=0)  # a gradient, and NIR taken for alpha, look so
    town = open_map(write(tmp_path / "town.tif", with_alpha("uint8", alpha), photometric="RGB", alpha="yes"))
    assert share(town) == pytest.approx(63 / 64, abs=0.01)
    assert town.notes == [
        "Band 4 of town.tif is marked as alpha, and most of it is between clear and opaque; data is where it is above 0. If it "
        "is another band, such as near infrared, mark it so (gdal_edit -colorinterp_4 undefined)."
    ]


def test_jpeg_smears_neither_alpha_nor_nodata_into_the_map(tmp_path: Path) -> None:
    rows, columns = np.mgrid[:300, :300]
    inside = (rows - 150) ** 2 + (columns - 150) ** 2 < 120**2
    picture = smooth(300, 300) * inside[:, :, None]
    alpha = np.concatenate([picture, inside[:, :, None] * 255], 2).astype(np.uint8)
    options = {"compress": "jpeg", "tiled": True, "blockxsize": 256, "blockysize": 256}
    path = write_geotiff(tmp_path / "alpha.tif", alpha, photometric="RGB", alpha="yes", **options)
    assert open_map(path).overview(300)[1].mean() == pytest.approx(inside.mean(), abs=0.006)
    small = np.concatenate([picture, inside[:, :, None]], 2).astype(np.uint8)
    path = write_geotiff(tmp_path / "small.tif", small, photometric="RGB", alpha="yes", interleave="band", **options)
    assert open_map(path).overview(300)[1].mean() == pytest.approx(inside.mean(), abs=0.03)
    path = write_geotiff(tmp_path / "nodata.tif", picture, photometric="YCBCR", nodata=0, **options)
    assert open_map(path).overview(300)[1].mean() == pytest.approx(inside.mean(), abs=0.006)


def test_alpha_of_grey_and_of_many_bands(tmp_path: Path) -> None:
    grey = np.concatenate([PICTURE[:, :, :1], OPAQUE * 255], 2).astype(np.uint16)
    path = write(tmp_path / "grey.tif", grey, photometric="MINISBLACK", alpha="yes")
    assert share(path) == pytest.approx(0.75, abs=0.002)
    # GDAL has no mask for these, as it has one for two and for four bands.
    many = np.concatenate([PICTURE, PICTURE[:, :, :2], OPAQUE * 255], 2).astype(np.uint8)
    path = write(tmp_path / "many.tif", many, photometric="MINISBLACK")
    import rasterio
    from rasterio.enums import ColorInterp

    with rasterio.open(path, "r+") as file:
        file.colorinterp = [ColorInterp.gray, *[ColorInterp.undefined] * 4, ColorInterp.alpha]
    assert share(path) == pytest.approx(0.75, abs=0.002)


def test_alpha_comes_before_nodata(tmp_path: Path) -> None:
    """Dark pixels that are opaque are data; so is white under a nodata value of 255."""
    values = with_alpha("uint8", OPAQUE * 255)
    values[:, 16:32, :3] = 0
    for nodata in (0, 255):
        path = write(tmp_path / f"{nodata}.tif", values, photometric="RGB", alpha="yes", nodata=nodata)
        assert share(path) == pytest.approx(0.75, abs=0.002)


@pytest.mark.parametrize(("internal", "nodata"), [("YES", None), ("NO", None), ("YES", -10_000)])
def test_masks_count_before_a_nodata_value_that_no_byte_has(tmp_path: Path, internal: str, nodata: int | None) -> None:
    import rasterio

    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=internal):
        path = write(tmp_path / "town.tif", PICTURE)
        with rasterio.open(path, "r+") as file:
            file.write_mask((OPAQUE[:, :, 0] * 255).astype(np.uint8))
    assert path.with_suffix(".tif.msk").exists() == (internal == "NO")
    if nodata is not None:
        with_notes(path, *[f"<NoDataValue>{nodata}</NoDataValue>"] * 3)
    assert share(path) == pytest.approx(0.75, abs=0.002)


@pytest.mark.parametrize("nodata", [np.nan, -9999.0, -3.4028234663852886e38])
def test_nodata_of_floats(tmp_path: Path, nodata: float) -> None:
    values = PICTURE.astype(np.float32)
    values[:, :16] = nodata
    town = open_map(write(tmp_path / "town.tif", values, nodata=nodata))
    assert share(town) == pytest.approx(0.75, abs=0.002)
    assert town.notes == [
        "town.tif holds float32 numbers; the percentiles 2 and 98 of each band (48 to 207, 99 to 207, 48 to 207) become 0 and "
        "255."
    ]


def test_nodata_of_each_band(tmp_path: Path) -> None:
    values = PICTURE.copy()
    values[:, :16] = (7, 8, 9)
    values[:, 16:32, 0] = 7  # one band alone does not hide a pixel
    notes = [f"<NoDataValue>{value}</NoDataValue>" for value in (7, 8, 9)]
    path = with_notes(write(tmp_path / "town.tif", values), *notes)
    assert share(path) == pytest.approx(0.75, abs=0.002)


@pytest.mark.parametrize(("colour", "name"), [(255, "white"), (0, "black")])
def test_a_compressed_border_has_no_data_but_the_same_colour_inside_has(tmp_path: Path, colour: int, name: str) -> None:
    picture = smooth(200, 200)
    picture[:, :80] = colour
    picture[100:120, 120:140] = colour  # a roof
    path = tmp_path / "a.jpg"
    Image.fromarray(picture).save(path, quality=80)
    town = open_map(path, CORNERS)
    assert town.overview(200)[1].mean() == pytest.approx(0.6, abs=0.015)
    assert town.notes == [f"The {name} border of a.jpg (40% of it) is taken as no data."]
    assert open_map(path, MapOptions(corners=CORNERS.corners, keep_borders=True)).overview(200)[1].mean() > 0.99


def test_neither_opaque_alpha_nor_nodata_that_no_pixel_has_hides_a_border(tmp_path: Path) -> None:
    values = np.maximum(smooth(200, 200), 1)
    values[:, :80] = 255
    opaque = np.concatenate([values, np.full((200, 200, 1), 255, np.uint8)], 2)
    for path in (
        write_geotiff(tmp_path / "town.tif", values, nodata=0),
        with_notes(write_geotiff(tmp_path / "a.tif", values), *["<NoDataValue>-9999</NoDataValue>"] * 3),  # of no byte
        write_geotiff(tmp_path / "alpha.tif", opaque, photometric="RGB", alpha="yes"),
    ):
        assert open_map(path).overview(200)[1].mean() == pytest.approx(0.6, abs=0.015)


def test_dark_water_at_the_border_is_part_of_the_map(tmp_path: Path) -> None:
    picture = smooth(200, 200)
    picture[:, :80] = np.random.default_rng(0).integers(0, 16, (200, 80, 3))
    assert open_map(write_geotiff(tmp_path / "a.tif", picture)).overview(200)[1].mean() > 0.98


def test_a_dark_picture_with_a_nodata_value_is_no_border(tmp_path: Path) -> None:
    path = write(tmp_path / "town.tif", PICTURE[:, :, :1] // 64 + 1, nodata=0)
    town = open_map(path)
    assert share(town) == pytest.approx(1, abs=0.01)
    assert not town.notes


def test_a_map_without_a_valid_pixel_is_refused(tmp_path: Path) -> None:
    for path in (
        write(tmp_path / "town.tif", np.zeros((64, 64, 3), np.uint8), nodata=0),
        write(tmp_path / "deep.tif", np.zeros((64, 64, 3), np.uint16), nodata=0),
        write(tmp_path / "clear.tif", with_alpha("uint8", OPAQUE * 0), photometric="RGB", alpha="yes"),
    ):
        with pytest.raises(DataError, match=rf"^{path.name} has no valid pixel; expected a map.$"):
            open_map(path)


@pytest.mark.parametrize(
    ("clear", "valid"), [([0, 255, 255, 255], 0.75), ([0, 0, 255, 255], 0.5), ([0, 9, 9, 9], 0.75)]
)
def test_transparent_entries_of_a_palette_are_no_data(tmp_path: Path, clear: list[int], valid: float) -> None:
    picture = Image.fromarray(np.repeat((np.arange(64) // 16)[None], 64, axis=0).astype(np.uint8), "P")
    picture.putpalette([9, 9, 9, 250, 0, 0, 0, 250, 0, 10, 20, 250])
    picture.save(tmp_path / "town.png", transparency=bytes(clear))
    town = open_map(tmp_path / "town.png", CORNERS)
    assert share(town) == pytest.approx(valid, abs=0.01)
    assert colour_of(tmp_path / "town.png", CORNERS) == [0, 250, 0]


def test_16_bits_are_stretched_by_percentiles_of_the_pixels_with_data(tmp_path: Path) -> None:
    deep = smooth(200, 200).astype(np.uint16) * 10 + 1000
    deep[:, :80] = 0
    floats = np.where(deep > 0, deep / 1000, np.nan).astype(np.float32)
    low, high = np.percentile(deep[:, 80:, 1], (2, 98))
    shown = np.clip((deep[100, 150, 1] - low) * 255 / (high - low), 0, 255)
    for name, values in (("deep", deep), ("floats", floats)):
        picture, valid = open_map(write_geotiff(tmp_path / f"{name}.tif", values)).overview(200)
        assert valid.mean() == pytest.approx(0.6, abs=0.02)
        assert picture[100, 150, 1] == pytest.approx(shown, abs=6)


def test_few_bits_are_stretched(tmp_path: Path) -> None:
    path = write(tmp_path / "town.tif", PICTURE[:, :, :1] // 16, nbits=4)
    town = open_map(path)
    assert town.notes == [
        "town.tif holds 4-bit numbers; the percentiles 2 and 98 of each band (3 to 12) become 0 and 255."
    ]
    assert np.ptp(town.overview(64)[0]) == 255


@pytest.mark.parametrize(
    ("kind", "colour", "shown"),
    [
        ("CMYK", (255, 0, 255, 0), (0, 255, 0)),
        ("CIELAB", (200, 136, 120), (0, 236, 0)),
        ("YCBCR", (0, 200, 0), (0, 200, 0)),
    ],
)
def test_other_colour_spaces_are_shown_as_gdal_converts_them(
    tmp_path: Path, kind: str, colour: tuple[int, ...], shown: tuple[int, ...]
) -> None:
    values = np.zeros((64, 64, len(colour)), np.uint8)
    values[:] = colour
    compress = {"compress": "jpeg"} if kind == "YCBCR" else {}
    path = write(tmp_path / "town.tif", values, photometric=kind, **compress)
    assert colour_of(path) == pytest.approx(shown, abs=12)


def test_colours_that_nothing_converts_are_refused(tmp_path: Path) -> None:
    colours = [f"<ColorInterp>{name}</ColorInterp>" for name in ("Hue", "Saturation", "Lightness")]
    path = with_notes(write(tmp_path / "town.tif", PICTURE), *colours)
    with pytest.raises(DataError, match=r"has the colours of HSL; convert it to RGB"):
        open_map(path)


def test_bands_by_their_marks_and_names(tmp_path: Path) -> None:
    import rasterio
    from rasterio.enums import ColorInterp

    values = np.zeros((64, 64, 5), np.uint8)
    values[:] = (10, 20, 30, 40, 50)
    turned = write(tmp_path / "bgr.tif", values[:, :, :3])
    with rasterio.open(turned, "r+") as file:
        file.colorinterp = [ColorInterp.blue, ColorInterp.green, ColorInterp.red]
    assert colour_of(turned) == [30, 20, 10]
    path = write(tmp_path / "five.tif", values, photometric="MINISBLACK")
    assert colour_of(path) == [10, 20, 30]
    with rasterio.open(path, "r+") as file:
        for number, name in enumerate(("Blue", "Green", "Red", "NIR", "Red edge"), 1):
            file.set_band_description(number, name)
    assert colour_of(path) == [30, 20, 10]
    assert open_map(path).notes == ["five.tif has 5 bands; 3, 2, 1 are shown as red, green, and blue."]
    assert colour_of(path, MapOptions(bands=(4, 3, 2))) == [40, 30, 20]
    assert colour_of(path, MapOptions(bands=(4,))) == [40, 40, 40]
    for bands in ((1, 2), (0, 1, 2), (1, 2, 6)):
        with pytest.raises(InputError, match="bands 1 to 5"):
            open_map(path, MapOptions(bands=bands))
    unmarked = write(tmp_path / "nir.tif", values[:, :, :4], photometric="RGB", alpha="unspecified")
    assert colour_of(unmarked) == [10, 20, 30]


def test_a_file_of_several_pages_says_so(tmp_path: Path) -> None:
    pages = [Image.fromarray(PICTURE), Image.fromarray(PICTURE[::-1])]
    pages[0].save(tmp_path / "town.tif", save_all=True, append_images=pages[1:])
    assert "town.tif holds 2 pictures; the first is shown." in open_map(tmp_path / "town.tif", CORNERS).notes
