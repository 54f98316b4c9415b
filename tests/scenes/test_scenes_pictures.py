"""Whatever wrote a picture, its colours come back in 0..255, its matte in 0..1, and its turn is known."""

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from physics3d.scenes.pictures import is_picture, photographs_in, read_picture

# a ramp with every level, and colours that differ by channel
RAMP = np.stack([np.arange(256)[None].repeat(4, 0), np.full((4, 256), 40), 255 - np.arange(256)[None].repeat(4, 0)], -1)
RAMP = RAMP.astype(np.uint8)
GREY = RAMP[..., 0]
MATTE = np.where(np.arange(256)[None].repeat(4, 0) % 7 < 3, 0, 200).astype(np.uint8)


def palette() -> Image.Image:
    picture = Image.fromarray(RAMP[:, ::64]).quantize(8)
    return picture


# name of the file, how it is written, colour in 0..255, largest error and why
CASES = {
    "rgb.png": (lambda f: Image.fromarray(RAMP).save(f), RAMP, 0),
    "rgb.webp": (lambda f: Image.fromarray(RAMP).save(f, lossless=True), RAMP, 0),
    "rgb.bmp": (lambda f: Image.fromarray(RAMP).save(f), RAMP, 0),
    "rgb.TIF": (lambda f: Image.fromarray(RAMP).save(f, "TIFF"), RAMP, 0),
    "no_ending": (lambda f: Image.fromarray(RAMP).save(f, "PNG"), RAMP, 0),
    "wrong_ending.jpg": (lambda f: Image.fromarray(RAMP).save(f, "PNG"), RAMP, 0),
    "grey.png": (lambda f: Image.fromarray(GREY).save(f), GREY, 0),
    "one_bit.png": (lambda f: Image.fromarray(GREY > 99).save(f), np.where(GREY > 99, 255, 0), 0),
    "palette.png": (lambda f: palette().save(f), np.asarray(palette().convert("RGB")), 0),
    # an exact inverse of the naive separation, which is what Pillow takes
    "cmyk.tif": (
        lambda f: Image.fromarray(np.dstack([255 - RAMP, 0 * GREY]), "CMYK").save(f, compression="tiff_lzw"), RAMP, 0,
    ),
    "grey16.png": (lambda f: cv2.imwrite(str(f), GREY.astype(np.uint16) * 257), GREY, 1e-3),
    "grey16.tif": (lambda f: Image.fromarray(GREY.astype(np.uint16) * 257).save(f), GREY, 1e-3),
    "grey16.pgm": (lambda f: cv2.imwrite(str(f), GREY.astype(np.uint16) * 257), GREY, 1e-3),
    # Pillow would keep the upper byte of three channels
    "rgb16.png": (lambda f: cv2.imwrite(str(f), RAMP[..., ::-1].astype(np.uint16) * 257), RAMP, 1e-3),
    "rgb16.tif": (lambda f: cv2.imwrite(str(f), RAMP[..., ::-1].astype(np.uint16) * 257), RAMP, 1e-3),
    "dark16.png": (lambda f: cv2.imwrite(str(f), RAMP[..., ::-1].astype(np.uint16)), RAMP / 257, 1e-3),
    "unit_float.tif": (lambda f: Image.fromarray(GREY.astype(np.float32) / 255).save(f), GREY, 1e-3),
    "byte_float.tif": (lambda f: Image.fromarray(GREY.astype(np.float32)).save(f), GREY, 1e-3),
    "rgb_float.tif": (lambda f: cv2.imwrite(str(f), RAMP[..., ::-1].astype(np.float32) / 255), RAMP, 1e-3),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_colours_come_back_whatever_stored_them(name, tmp_path):
    write, expected, error = CASES[name]
    write(tmp_path / name)
    picture = read_picture(tmp_path / name)
    expected = np.asarray(expected, np.float32)
    expected = expected[..., None].repeat(3, -1) if expected.ndim == 2 else expected
    assert picture.alpha is None and picture.turn == 1 and is_picture(tmp_path / name)
    np.testing.assert_allclose(picture.color, expected, atol=error + 1e-4)


def transparent_palette(f) -> None:
    picture = Image.fromarray(GREY)  # levels are their own palette
    picture.convert("P").save(f, transparency=0)


MATTES = {
    "rgba.png": (lambda f: Image.fromarray(np.dstack([RAMP, MATTE])).save(f), MATTE, RAMP, 0),
    "grey_alpha.png": (lambda f: Image.fromarray(np.dstack([GREY, MATTE])).save(f), MATTE, GREY, 0),
    "rgba.webp": (
        lambda f: Image.fromarray(np.dstack([RAMP, MATTE])).save(f, lossless=True, exact=True), MATTE, RAMP, 0,
    ),
    "rgba16.tif": (
        lambda f: cv2.imwrite(str(f), np.dstack([RAMP[..., ::-1], MATTE]).astype(np.uint16) * 257), MATTE, RAMP, 1,
    ),
    "palette.png": (transparent_palette, np.where(GREY == 0, 0, 255), GREY, 0),
}  # fmt: skip


@pytest.mark.parametrize("name", MATTES)
def test_mattes_come_back_whatever_stored_them(name, tmp_path):
    write, matte, expected, error = MATTES[name]
    write(tmp_path / name)
    picture = read_picture(tmp_path / name)
    np.testing.assert_allclose(picture.alpha, matte / 255, atol=(error + 1e-3) / 255)
    expected = np.asarray(expected, np.float32)
    expected = expected[..., None].repeat(3, -1) if expected.ndim == 2 else expected
    seen = matte > 0  # where nothing is seen, a file may hold anything
    np.testing.assert_allclose(picture.color[seen], expected[seen], atol=error + 1e-4)


@pytest.mark.parametrize("turn", range(1, 9))
def test_a_turned_picture_is_shown_as_pillow_shows_it(turn, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = turn
    noise = np.random.default_rng(0).integers(0, 256, (*RAMP.shape[:2], 4), np.uint8)  # no two places are alike
    Image.fromarray(noise).save(tmp_path / "a.png", exif=exif)
    picture = read_picture(tmp_path / "a.png")
    shown = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / "a.png")), np.float32)
    assert picture.turn == turn and picture.size == (256, 4) and picture.shown_size == shown.shape[1::-1]
    np.testing.assert_array_equal(picture.shown().color, shown[..., :3])
    np.testing.assert_allclose(picture.shown().alpha, shown[..., 3] / 255)


def cut(file) -> None:
    Image.fromarray(RAMP).save(file, "PNG")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


BROKEN = {
    "absent.png": (lambda f: None, "there is no image"),
    "empty.jpg": (lambda f: f.write_bytes(b""), "is empty"),
    "cut.png": (cut, "is broken"),
    "text.png": (lambda f: f.write_text("no picture"), "of no known format"),
    "phone.HEIC": (lambda f: f.write_bytes(b"\0\0\0 ftypheic"), "convert .HEIC to JPEG"),
    "nan.tif": (lambda f: Image.fromarray(np.full((4, 4), np.nan, np.float32)).save(f), "NaN"),
    "negative.tif": (lambda f: Image.fromarray(np.full((4, 4), -0.5, np.float32)).save(f), "down to -0.5"),
    "below.tif": (lambda f: Image.fromarray(np.full((4, 4), -7, np.int32)).save(f), "down to -7"),
    "wide.tif": (lambda f: Image.fromarray(np.full((4, 4), 70000, np.int32)).save(f), "all would be black"),
    "lab.tif": (lambda f: Image.fromarray(RAMP, "LAB").save(f), "colours are LAB"),
    "hdr.tif": (lambda f: Image.fromarray(np.full((4, 4), 3.0, np.float32)).save(f), "neither 0..1 nor 0..255"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_cannot_be_read_is_one_line_that_names_the_file(name, tmp_path):
    write, message = BROKEN[name]
    write(tmp_path / name)
    with pytest.raises(ValueError, match=message) as caught:
        read_picture(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)


def test_what_systems_leave_in_a_folder_is_no_photograph(tmp_path):
    for name in ("b.JPG", "a.webp", "c"):
        Image.fromarray(RAMP).save(tmp_path / name, "PNG")
    for name in ("._b.JPG", ".DS_Store", "notes.txt", "Thumbs.db", "readme"):
        (tmp_path / name).write_bytes(b"\0\5\26\7")
    assert [p.name for p in photographs_in(tmp_path)] == ["a.webp", "b.JPG", "c"]
