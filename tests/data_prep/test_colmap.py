"""COLMAP models: binary and text say the same, pycolmap agrees, and what is broken is named."""

import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers import colmap_files

from data_prep.common.colmap import PARAMETERS, find_colmap, read_colmap
from gausim.core import DataError

WRITERS: dict[str, Callable] = {"binary": colmap_files.write_binary, "text": colmap_files.write_text}


@pytest.mark.parametrize("form", WRITERS)
def test_both_forms_say_what_was_written_and_pycolmap_reads_the_same(tmp_path: Path, form: str) -> None:
    cameras, images, points = colmap_files.small_model()
    WRITERS[form](tmp_path, cameras, images, points)
    read = read_colmap(tmp_path)
    assert {n: (c.model, c.width, c.height, c.params.tolist()) for n, c in read.cameras.items()} == cameras
    assert [i.name for i in read.images] == ["photo_0.png", "photo_1.png", "sub/photo_2.png"]
    assert read.images[1].camera == 7 and read.images[1].point_ids.tolist() == [5, 9]
    assert read.images[1].xy.tolist() == [[11.5, 20.25], [30.0, 31.0]] and read.images[0].xy.shape == (0, 2)
    assert read.points.ids.tolist() == [5, 9, 12] and read.points.tracks.tolist() == [2, 2, 0]
    assert read.points.xyz.tolist() == [list(p[1]) for p in points]
    assert read.points.rgb.tolist() == [list(p[2]) for p in points] and read.points.error.tolist() == [0.5, 0.25, -1.0]
    theirs = {image.name: image for image in pycolmap.Reconstruction(tmp_path).images.values()}
    assert set(theirs) == {image.name for image in read.images}
    for image, azimuth in zip(read.images, (0.3, 1.4, 2.9), strict=True):
        np.testing.assert_allclose(theirs[image.name].cam_from_world().matrix(), image.viewmat[:3], atol=1e-12)
        eye = -image.viewmat[:3, :3].T @ image.viewmat[:3, 3]
        np.testing.assert_allclose(eye, 4 * np.array([np.cos(azimuth), np.sin(azimuth), 0]), atol=1e-9)


def test_every_lens_model_is_read_with_its_intrinsics(tmp_path: Path) -> None:
    theirs = {i: pycolmap.Camera.create_from_model_name(i, n, 500.0, 640, 480) for i, n in enumerate(PARAMETERS)}
    for camera in theirs.values():
        camera.params = [v + 0.01 * i for i, v in enumerate(camera.params)]
    _, images, points = colmap_files.small_model()
    cameras = {i: (c.model.name, 640, 480, list(map(float, c.params))) for i, c in theirs.items()}
    for form, write in WRITERS.items():
        write(tmp_path / form, cameras, {n: (i[0], 1, *i[2:]) for n, i in images.items()}, points)
        for number, camera in read_colmap(tmp_path / form).cameras.items():
            k = theirs[number].calibration_matrix()
            np.testing.assert_allclose((k[0, 0], k[1, 1], k[0, 2], k[1, 2]), camera.intrinsics)
            assert camera.distorted is not camera.model.endswith("PINHOLE")


def test_the_model_is_found_where_colmap_puts_it(tmp_path: Path) -> None:
    colmap_files.write_binary(tmp_path / "sparse" / "0", *colmap_files.small_model())
    assert find_colmap(tmp_path) == find_colmap(tmp_path / "sparse") == tmp_path / "sparse" / "0"
    (tmp_path / "sparse" / "0" / "points3D.bin").unlink()
    assert len(read_colmap(find_colmap(tmp_path)).points.ids) == 0
    (tmp_path / "sparse" / "0" / "images.bin").unlink()
    with pytest.raises(DataError, match=r"images\.bin: no such file"):
        read_colmap(find_colmap(tmp_path))
    with pytest.raises(DataError, match="no COLMAP model here"):
        find_colmap(tmp_path / "nothing")


@pytest.mark.parametrize("form", WRITERS)
def test_of_several_models_the_largest_counts_and_names_stay_as_they_are(form: str, tmp_path: Path) -> None:
    cameras, images, points = colmap_files.small_model()
    few = dict(list(images.items())[:1])
    many = {n: (f"left  {n}\u00a0a.png", *i[1:]) for n, i in images.items()}
    for number, part in enumerate((few, many)):
        WRITERS[form](tmp_path / "sparse" / str(number), cameras, part, points)
    assert find_colmap(tmp_path) == tmp_path / "sparse" / "1"
    found = {image.name for image in read_colmap(find_colmap(tmp_path)).images}
    assert found == {image[0] for image in many.values()}


# What is wrong, in a text model: file, what is replaced by what, and what the message must say.
FAULTS = {
    "model": ("cameras", "PINHOLE 64", "EQUIRECTANGULAR 64", "'model'"),
    "focal length": ("cameras", "60.0 61.0", "60.0 -61.0", "focal lengths"),
    "not a number": ("cameras", "61.0", "x61", "expected a number"),
    "camera of an image": ("images", " 7 photo_1", " 8 photo_1", "'camera_id'"),
    "name outside": ("images", "photo_1", "../photo_1", "inside the folder"),
    "name outside on Windows": ("images", "photo_1", "..\\photo_1", "inside the folder"),
    "translation": ("images", " 4.0 7 photo_1", " nan 7 photo_1", "'translation'"),
    "keypoints": ("images", "11.5 20.25 5", "11.5 20.25", "triples"),
    "point": ("points3D", "0.1 -0.2 0.3", "0.1 nan 0.3", "'xyz'"),
    "colour": ("points3D", "250 10 7", "256 10 7", "'rgb'"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named_with_file_and_field(tmp_path: Path, fault: str) -> None:
    colmap_files.write_text(tmp_path, *colmap_files.small_model())
    role, old, new, message = FAULTS[fault]
    path = tmp_path / f"{role}.txt"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DataError, match=message) as caught:
        read_colmap(tmp_path)
    assert str(path) in str(caught.value)


def test_a_quaternion_that_is_none_is_refused(tmp_path: Path) -> None:
    cameras, images, points = colmap_files.small_model()
    for bad in ((0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (float("nan"), 0.0, 0.0, 1.0)):
        images[3] = (*images[3][:2], bad, *images[3][3:])
        colmap_files.write_binary(tmp_path, cameras, images, points)
        with pytest.raises(DataError, match="'quaternion'"):
            read_colmap(tmp_path)


@pytest.mark.parametrize("role", ["cameras", "images", "points3D"])
def test_counts_are_not_believed(tmp_path: Path, role: str) -> None:
    colmap_files.write_binary(tmp_path, *colmap_files.small_model())
    path = tmp_path / f"{role}.bin"
    whole = path.read_bytes()
    tracemalloc.start()
    for count in (1 << 62, 1 << 40, 4):
        path.write_bytes(struct.pack("<Q", count) + whole[8:])
        with pytest.raises(DataError, match="truncated") as caught:
            read_colmap(tmp_path)
        assert path.name in str(caught.value)
    path.write_bytes(struct.pack("<Q", 1) + whole[8:])
    with pytest.raises(DataError, match="follow the last record"):
        read_colmap(tmp_path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1 << 20
