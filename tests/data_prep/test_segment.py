"""Segment: known discs are found by every backend, masks are steady, and broken inputs are named."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from data_prep.capture.masks.cleanup import (
    UNTOUCHED,
    Cleanup,
    cleaned,
    fill_holes,
    keep_largest,
    overlap,
    soften,
    steady,
)
from data_prep.capture.masks.clips import find_clips
from data_prep.capture.masks.segmenters import Backend
from data_prep.common.photos import read_picture
from data_prep.common.stage import read_manifest
from data_prep.segment import main, segment
from gausim.core import DataError
from gausim.io.video import read_video, write_video

SIZE = 96, 72
FRAMES = 9


def disc(k: int) -> np.ndarray:
    """Where the object is in frame k, (H, W) bool: it crosses the picture and comes back to no place twice."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    return (x - (16 + 8 * k)) ** 2 + (y - 36) ** 2 < 13**2


def picture(k: int, background: tuple[int, int, int] | None = None) -> np.ndarray:
    """An orange disc over a textured wall, or over a screen of one colour, with noise."""
    random = np.random.default_rng(5)
    wall = cv2.GaussianBlur(random.uniform(40, 180, (SIZE[1], SIZE[0], 3)).astype(np.float32), (0, 0), 3)
    wall = np.broadcast_to(np.array(background, np.float32), wall.shape) if background else wall
    rgb = np.where(disc(k)[..., None], np.array([235, 120, 20], np.float32), wall)
    return np.clip(rgb + np.random.default_rng(k + 100).normal(0, 2, rgb.shape), 0, 255).astype(np.uint8)


def write(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    code = cv2.COLOR_RGBA2BGRA if pixels.shape[-1] == 4 else cv2.COLOR_RGB2BGR
    assert cv2.imwrite(str(path), cv2.cvtColor(pixels, code))
    return path


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """A camera's frames as ingest lays them out."""
    for k in range(FRAMES):
        write(tmp_path / "in" / "sequences" / "seq_000" / "cam_0" / f"{k:04d}.png", picture(k))
    return tmp_path / "in"


def found_masks(out: Path) -> list[np.ndarray]:
    return [read_picture(out / "sequences" / "seq_000" / "cam_0" / f"{k:04d}.png")[..., 3] for k in range(FRAMES)]


def agreement(masks: list[np.ndarray]) -> float:
    return min(overlap(mask, disc(k).astype(np.uint8) * 255) for k, mask in enumerate(masks))


@pytest.mark.parametrize("options", [["--no-grabcut", "--plate", "PLATE"], ["--plate", "PLATES"]])
def test_background_difference_finds_what_moves(film: Path, tmp_path: Path, options: list[str]) -> None:
    """Against a picture of the empty scene, and one per camera."""
    empty = picture(-20)
    write(tmp_path / "plates" / "cam_0.png", empty)
    places = {"PLATE": write(tmp_path / "empty.png", empty), "PLATES": tmp_path / "plates"}
    arguments = [str(places.get(option, option)) for option in options]
    assert main([str(film), "--out", str(tmp_path / "out"), "--backend", "background", *arguments]) == 0
    masks = found_masks(tmp_path / "out")
    assert agreement(masks) > 0.9
    figures = read_manifest(tmp_path / "out", "segment")["results"]["clips"]["sequences/seq_000/cam_0"]
    assert figures["pictures"] == FRAMES and figures["empty"] == []
    assert figures["coverage"]["mean"] == pytest.approx(disc(3).mean(), rel=0.15)
    overlays = tmp_path / "out" / "overlays"
    assert len(list(read_video(overlays / "sequences_seq_000_cam_0.mp4"))) == FRAMES
    assert (overlays / "sequences_seq_000_cam_0.jpg").is_file()
    assert not list((tmp_path / "out").glob(".*"))


@pytest.mark.parametrize("options", [[], ["--key", "00b140", "--no-grabcut"]])
def test_chroma_key_finds_what_is_not_the_screen(tmp_path: Path, options: list[str]) -> None:
    for k in (2, 5):
        write(tmp_path / "in" / f"{k}.png", picture(k, (0, 177, 64)))
    assert main([str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--backend", "chroma", *options]) == 0
    for k in (2, 5):
        rgba = read_picture(tmp_path / "out" / f"{k}.png")
        assert overlap(rgba[..., 3], disc(k).astype(np.uint8) * 255) > 0.93
        assert (rgba[..., 3][cv2.dilate(disc(k).astype(np.uint8), np.ones((9, 9))) == 0] == 0).all()


def test_grey_screens_and_stills_without_a_plate_are_refused(film: Path, tmp_path: Path, capsys: Any) -> None:
    write(tmp_path / "grey" / "0.png", picture(1, (128, 128, 128)))
    assert main([str(tmp_path / "grey"), "--out", str(tmp_path / "o"), "--backend", "chroma"]) == 2
    assert "nearly grey" in capsys.readouterr().err
    assert main([str(tmp_path / "grey"), "--out", str(tmp_path / "o"), "--backend", "background"]) == 2
    assert "--plate" in capsys.readouterr().err
    small = write(tmp_path / "small.png", picture(1)[:40])
    assert main([str(film), "--out", str(tmp_path / "o"), "--backend", "background", "--plate", str(small)]) == 2
    assert "small.png: is 96x40" in capsys.readouterr().err


def test_alpha_is_taken_as_it_is(tmp_path: Path, capsys: Any) -> None:
    """To the bit, faint values too; a picture without alpha has no mask."""
    alpha = np.random.default_rng(0).integers(0, 256, SIZE[::-1], np.uint8)
    rgba = np.dstack([picture(1), alpha])
    write(tmp_path / "in" / "static" / "a.png", rgba)
    assert main([str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--backend", "alpha"]) == 0
    assert np.array_equal(read_picture(tmp_path / "out" / "static" / "a.png"), rgba)
    write(tmp_path / "in" / "static" / "b.png", picture(1))
    assert main([str(tmp_path / "in"), "--out", str(tmp_path / "o"), "--backend", "alpha"]) == 2
    assert "b.png: has no transparent pixel" in capsys.readouterr().err


def test_poses_are_carried_over(tmp_path: Path) -> None:
    """transforms.json points to the new pictures, and is otherwise as it was."""
    write(tmp_path / "in" / "static" / "images" / "a.jpg", picture(1, (0, 177, 64)))
    poses = {"fl_x": 90.0, "frames": [{"file_path": "images/a.jpg", "transform_matrix": np.eye(4).tolist()}]}
    (tmp_path / "in" / "static" / "transforms.json").write_text(json.dumps(poses))
    assert main([str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--backend", "chroma"]) == 0
    carried = json.loads((tmp_path / "out" / "static" / "transforms.json").read_text())
    assert carried["frames"][0].pop("file_path") == "images/a.png"
    poses["frames"][0].pop("file_path")
    assert carried == poses


def test_a_film_can_be_segmented_directly(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.mp4", (picture(k, (0, 177, 64)) for k in range(FRAMES)), 25)
    assert main([str(tmp_path / "clip.mp4"), "--out", str(tmp_path / "out"), "--backend", "chroma"]) == 0
    masks = [read_picture(p)[..., 3] for p in sorted((tmp_path / "out" / "clip").glob("*.png"))]
    assert len(masks) == FRAMES and agreement(masks) > 0.85


def test_masks_of_another_program_are_taken(film: Path, tmp_path: Path, capsys: Any) -> None:
    """Labels 0 and 1 under the pictures' names; a mask that is missing is named."""
    for k in range(FRAMES):
        path = tmp_path / "masks" / "sequences" / "seq_000" / "cam_0" / f"{k:04d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), disc(k).astype(np.uint8))
    command = [str(film), "--backend", "masks", "--masks", str(tmp_path / "masks")]
    assert main([*command, "--out", str(tmp_path / "out"), "--motion", "0.09"]) == 0
    assert agreement(found_masks(tmp_path / "out")) > 0.95
    path.unlink()
    assert main([*command, "--out", str(tmp_path / "o")]) == 2 and "0008.png: no mask of" in capsys.readouterr().err


def test_masks_that_are_no_masks_are_refused(film: Path, tmp_path: Path) -> None:
    for shape, value, message in (
        ((3, 3), 0.5, "shape"), (SIZE[::-1], np.nan, "no numbers"), (SIZE[::-1], 0, "nothing was found in any of 9"),
    ):  # fmt: skip
        mask = np.full(shape, value, np.float32)
        with pytest.raises(DataError, match=message):
            segment(film, tmp_path / "out", Backend("mine", lambda clip, mask=mask: lambda index: mask), Cleanup())
    assert not (tmp_path / "out").exists()


def test_unclear_inputs_are_refused(tmp_path: Path, capsys: Any) -> None:
    command = ["--out", str(tmp_path / "out"), "--backend", "chroma"]
    assert main([str(tmp_path / "none"), *command]) == 2 and "expected a folder of pictures" in capsys.readouterr().err
    (tmp_path / "in").mkdir()
    assert main([str(tmp_path / "in"), *command]) == 2 and "no pictures in it" in capsys.readouterr().err
    (tmp_path / "in" / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(50))
    assert main([str(tmp_path / "in"), *command]) == 2 and "a.png: cannot be decoded" in capsys.readouterr().err
    (tmp_path / "in" / "a.jpg").write_bytes(b"")
    assert main([str(tmp_path / "in"), *command]) == 2 and "would become the same PNG" in capsys.readouterr().err
    for option, value in (("--components", "-1"), ("--motion", "nan"), ("--every", "0")):
        assert main([str(tmp_path / "in"), *command, option, value]) == 2 and option in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([str(tmp_path / "in"), *command, "--key", "12345"])


def test_clips_are_found_in_natural_order(tmp_path: Path) -> None:
    sheets = ("sequences/seq_000/sync.png", "cameras.png")
    for name in ("b/10.png", "b/9.png", "sequences/seq_000/cam_0/0.png", ".hidden/1.png", *sheets):
        write(tmp_path / name, picture(0))
    assert [c.name for c in find_clips(tmp_path)] == ["", "b", "sequences/seq_000", "sequences/seq_000/cam_0"]
    for name in ("sequences/seq_000/sync.json", "stage.json"):  # stages drew them, and say so beside
        (tmp_path / name).write_text("{}")
    clips = find_clips(tmp_path)
    assert [(c.name, c.moving) for c in clips] == [("b", False), ("sequences/seq_000/cam_0", True)]
    assert [p.name for p in clips[0].paths] == ["9.png", "10.png"]
    films, stills = (find_clips(tmp_path, kind=kind) for kind in ("film", "stills"))
    assert all(c.moving for c in films) and not stills[1].moving


def square(top: int, left: int, side: int, size: int = 60) -> np.ndarray:
    mask = np.zeros((size, size), np.float32)
    mask[top : top + side, left : left + side] = 1
    return mask


def test_holes_and_parts_go_by_their_size() -> None:
    mask = square(10, 10, 40)
    mask[20:24, 20:24] = 0  # 1 % of the foreground
    mask[30:42, 30:42] = 0  # 9 %
    filled = fill_holes(mask, 0.02)
    assert (filled[20:24, 20:24] == 1).all() and (filled[30:42, 30:42] == 0).all()
    notch = square(0, 0, 40)
    notch[0:3, 10:13] = 0  # open to the border: no hole
    assert np.array_equal(fill_holes(notch, 0.5), notch)
    mask = np.maximum(square(5, 5, 30), square(45, 45, 8))
    mask[35:37, 5:35] = 0.3  # soft edge of the large one
    one, two = keep_largest(mask, 1, 0), keep_largest(mask, 2, 0)
    assert one[45:53, 45:53].max() == 0 and (one[35:37, 5:35] == np.float32(0.3)).all()
    assert two[45:53, 45:53].min() == 1


def test_flashes_in_time_go_and_motion_stays() -> None:
    """A blob of one frame vanishes, a frame's loss is mended, an edge that moves by 2 pixels a frame is left alone."""
    masks = [square(20, 10 + 2 * k, 20) for k in range(5)]
    neighbours = [(abs(k - 2), masks[k]) for k in (0, 1, 3, 4)]
    assert np.array_equal(steady(masks[2], neighbours, 2.0), masks[2])
    flash = np.maximum(masks[2], square(50, 50, 6))
    assert np.array_equal(steady(flash, neighbours, 2.0), masks[2])
    lost = masks[2].copy()
    lost[28:36, 20:28] = 0
    assert steady(lost, neighbours, 2.0)[28:36, 20:28].min() == 1
    assert np.array_equal(steady(flash, neighbours[:1], 2.0), flash)  # one neighbour is no majority


def test_edges_follow_the_picture() -> None:
    """A mask that is a pixel off is softened to the picture's edge; far from the edge nothing changes."""
    rgb = np.full((60, 60, 3), 30, np.uint8)
    rgb[20:40, 20:40] = 220
    soft = soften(square(19, 19, 22), rgb, 3)
    assert 0 < soft[30, 19] < soft[30, 21] and soft[30, 30] == 1 and soft[30, 10] == 0
    alpha = cleaned(square(19, 19, 22), rgb, Cleanup(edge=0.05), soft=False)
    assert alpha.dtype == np.uint8 and ((alpha == 0) | (alpha >= 12)).all() and len(np.unique(alpha)) > 3
    assert set(np.unique(cleaned(square(19, 19, 22), rgb, UNTOUCHED, soft=False))) == {0, 255}
