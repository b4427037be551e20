"""One reader of pictures and masks for all stages: stored pixels, every depth, every way to write a mask."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from data_prep.capture.cameras.sources import fitted
from data_prep.common.colmap import ColmapCamera
from data_prep.common.photos import open_photo, read_mask, read_picture, unread_in
from gausim.core import DataError
from gausim.io.pixels import exif_turned

RGBA = np.random.default_rng(0).integers(0, 256, (6, 8, 4)).astype(np.uint8)
DISC = np.hypot(*np.mgrid[-8:8, -12:12]) < 6


def with_orientation(path: Path, pixels: np.ndarray, orientation: int) -> Path:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(path, exif=exif)
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["rgb.png", "rgba.png", "rgb.tif"])
def test_pixels_are_those_that_are_stored(name: str, orientation: int, tmp_path: Path) -> None:
    pixels = RGBA if name == "rgba.png" else RGBA[..., :3]
    path = with_orientation(tmp_path / name, pixels, orientation)
    photo = open_photo(path, name)
    assert (photo.width, photo.height) == (8, 6)
    np.testing.assert_array_equal(photo.read()[..., : pixels.shape[2]], pixels)
    upright = Image.open(path)
    upright = upright if name == "rgb.tif" else __import__("PIL.ImageOps").ImageOps.exif_transpose(upright)
    np.testing.assert_array_equal(exif_turned(pixels, orientation), np.asarray(upright))


@pytest.mark.parametrize("name", ["rgb.png", "rgb.tif"])
def test_a_picture_is_turned_where_its_lens_was_calibrated_for_that(name: str, tmp_path: Path) -> None:
    photo = open_photo(with_orientation(tmp_path / name, RGBA[..., :3], 6), name)
    stored, _ = fitted(ColmapCamera("PINHOLE", 16, 12, np.array([9.0, 9, 8, 6])), photo)
    turned, camera = fitted(ColmapCamera("PINHOLE", 12, 16, np.array([9.0, 9, 6, 8])), photo)
    np.testing.assert_array_equal(stored.read()[..., :3], RGBA[..., :3])
    np.testing.assert_array_equal(turned.read()[..., :3], np.rot90(RGBA[..., :3], -1))
    assert (camera.width, camera.height) == (turned.width, turned.height) == (6, 8)
    with pytest.raises(DataError, match="another shape"):
        fitted(ColmapCamera("PINHOLE", 12, 40, np.array([9.0, 9, 6, 20])), photo)


def test_every_depth_keeps_its_alpha(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "deep.png"), RGBA[..., [2, 1, 0, 3]].astype(np.uint16) * 257)
    Image.fromarray(RGBA[..., [0, 3]], "LA").save(tmp_path / "grey.png")
    Image.fromarray(RGBA[..., 0]).save(tmp_path / "plain.png")
    np.testing.assert_array_equal(read_picture(tmp_path / "deep.png"), RGBA)
    np.testing.assert_array_equal(read_picture(tmp_path / "grey.png"), RGBA[..., [0, 0, 0, 3]])
    np.testing.assert_array_equal(read_picture(tmp_path / "plain.png")[..., 3], 255)
    (tmp_path / "a.HEIC").touch()
    assert "1 files (.HEIC)" in unread_in(tmp_path)


COLORS = {"bright": (200, 120, 40), "dark": (30, 20, 12), "black": (0, 0, 0)}


@pytest.mark.parametrize("ending", [".png", ".tif"])
@pytest.mark.parametrize("color", COLORS)
def test_colours_are_divided_by_alpha_where_they_are_multiplied(color: str, ending: str, tmp_path: Path) -> None:
    """OpenCV multiplies those of a TIFF; what a dark picture does not prove stays."""
    soft = (255 * np.clip(6 - np.hypot(*np.mgrid[-8:8, -12:12]), 0, 4) / 4 + 0.5).astype(np.uint8)
    plain = np.dstack((np.broadcast_to(np.uint8(COLORS[color]), (*soft.shape, 3)), soft))
    cut = plain * (soft > 0)[..., None].astype(np.uint8)
    multiplied = np.dstack(((plain[..., :3] * (soft[..., None] / 255) + 0.5).astype(np.uint8), soft))
    for stored, known in ((plain, plain), (cut, cut), (multiplied, multiplied if color == "dark" else plain)):
        Image.fromarray(stored).save(tmp_path / f"a{ending}")
        off = np.abs(read_picture(tmp_path / f"a{ending}").astype(int) - known)
        assert off[soft > 100].max() <= 2


@pytest.mark.parametrize("mode", ["RGBA", "RGB", "L", "LA", "1", "P", "I;16", "CMYK"])
def test_tiffs_of_every_kind_are_read_as_stored(mode: str, tmp_path: Path) -> None:
    image = Image.fromarray(RGBA if mode != "P" else RGBA[..., :3])
    image = Image.fromarray(RGBA[..., 0].astype(np.uint16) * 257) if mode == "I;16" else image.convert(mode)
    expected = RGBA[..., [0, 0, 0]] if mode == "I;16" else np.asarray(image.convert("RGBA"))
    for orientation in (1, 3, 6, 8):
        image.save(tmp_path / "a.tif", tiffinfo={0x0112: orientation})
        found = read_picture(tmp_path / "a.tif")
        np.testing.assert_array_equal(found[..., : expected.shape[2]], expected)
        assert open_photo(tmp_path / "a.tif", "a").width == found.shape[1] == 8


def write_masks(folder: Path) -> dict[str, Path]:
    """The disc in all the ways in which programs write masks."""
    grey, paths = DISC.astype(np.uint8), {}
    palette = Image.fromarray(grey, "P")
    palette.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    two_bits = palette.copy()
    white_first = Image.fromarray(1 - grey, "P")
    white_first.putpalette([255, 255, 255, 0, 0, 0])
    opaque = np.dstack([255 * grey] * 3 + [np.full_like(grey, 255)])
    alpha = np.dstack([np.full((*DISC.shape, 3), 90, np.uint8), 255 * grey])
    two_bits.save(paths.setdefault("two bits.png", folder / "two bits.png"), bits=2)
    for name, image in {
        "bit.tif": Image.fromarray(DISC), "palette.tif": palette,
        "deep labels.tif": Image.fromarray(DISC.astype(np.uint16)),
        "grey alpha.tif": Image.fromarray(alpha).convert("LA"), "palette.gif": palette,
        "values.png": Image.fromarray(255 * grey), "labels.png": Image.fromarray(grey), "palette.png": palette,
        "greys.png": white_first, "bit.png": Image.fromarray(DISC), "opaque.png": Image.fromarray(opaque),
        "alpha.png": Image.fromarray(alpha), "ringing.jpg": Image.fromarray(255 * grey),
        "deep.png": Image.fromarray(65535 * DISC.astype(np.uint16)),
        "deep labels.png": Image.fromarray(DISC.astype(np.uint16)),
    }.items():  # fmt: skip
        image.save(paths.setdefault(name, folder / name))
    return paths


def test_the_reference_says_what_becomes_of_every_mask(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/reference/data-set.md").read_text()
    table = page[page.index("## Masks") : page.index("## scene.ply and its masks")]
    rows = dict(line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| "))
    del rows["mask"], rows["---"]
    read = write_masks(tmp_path)
    files = {
        "picture with alpha": ["alpha.png", "grey alpha.tif"],
        "grey, colour, 16 bit, palette of greys": ["values.png", "opaque.png", "deep.png", "greys.png"],
        "values 0 and 1, or one bit": ["labels.png", "deep labels.png", "bit.png", "bit.tif"],
        "palette of colours": ["palette.png", "palette.tif", "palette.gif", "two bits.png"],
        "JPEG": ["ringing.jpg"],
    }
    refused = {"largest value 2 to 127; another size": (2 * DISC, 31 * DISC, 32 * DISC, 127 * DISC, 255 * DISC[:4])}
    assert set(rows) == {*files, *refused}
    for kind, names in files.items():
        assert "refused" not in rows[kind]
        for name in names:
            mask = read_mask(read[name], (24, 16), "a")
            wrong = abs(mask.astype(int) - 255 * DISC)
            assert (wrong > 40).mean() < 0.05 if name == "ringing.jpg" else wrong.max() == 0, name
    for kind, masks in refused.items():
        assert rows[kind].startswith("refused")
        for values in masks:
            cv2.imwrite(str(tmp_path / "no.png"), values.astype(np.uint8))
            with pytest.raises(DataError, match=r"no\.png: "):
                read_mask(tmp_path / "no.png", (24, 16), "a")
    cv2.imwrite(str(tmp_path / "none.png"), np.zeros(DISC.shape, np.uint8))
    assert not read_mask(tmp_path / "none.png", (24, 16), "a").any()  # the object is out of the picture
