import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.blob import ring_of_cameras

from gausim.core import DataError
from gausim.io.transforms import DISTORTION, LEFT_ASIDE, REFUSED, read_transforms, write_transforms

CAMERAS = ring_of_cameras(("a/0.png", "a/1.png"), width=20, height=16)
CAMERAS.viewmats[:, :3, 3] += torch.tensor([[0.1, 0.2, -1.0], [-0.4, 0.3, -1.5]])
CAMERAS.Ks[:, 1, 2] = 7.0


def written(tmp_path: Path, second: dict[str, object] | None = None, **changes: object) -> Path:
    """A file of two entries, the second with some fields of its own."""
    path = tmp_path / "transforms.json"
    write_transforms(path, CAMERAS, [{"file_path": f"a/{i}.png", "camera": "a", "frame": i} for i in (0, 1)])
    data = json.loads(path.read_text())
    data["frames"][1].update(second or {})
    for key, value in changes.items():
        if value is None:
            del data[key]
        else:
            data[key] = value
    path.write_text(json.dumps(data))
    return path


def test_written_cameras_are_read_back(tmp_path: Path) -> None:
    posed = read_transforms(written(tmp_path, fps=24))
    torch.testing.assert_close(posed.cameras.viewmats, CAMERAS.viewmats)
    torch.testing.assert_close(posed.cameras.Ks, CAMERAS.Ks)
    assert (posed.cameras.width, posed.cameras.height, posed.fps) == (20, 16, 24.0)
    assert [(f.camera, f.frame, f.path.name) for f in posed.frames] == [("a", 0, "0.png"), ("a", 1, "1.png")]


def test_opengl_pose_becomes_opencv(tmp_path: Path) -> None:
    """A camera at (0, -5, 0) with the identity's axes turned to look along +y, z up: the origin is 5 ahead."""
    pose = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, -5.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    path = written(tmp_path, frames=[{"file_path": "x.png", "transform_matrix": pose}] * 2)
    viewmat = read_transforms(path).cameras.viewmats[0]
    torch.testing.assert_close(viewmat @ torch.tensor([0.0, 0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, 5.0, 1.0]))
    right_and_up = viewmat @ torch.tensor([1.0, 0.0, 2.0, 1.0])
    torch.testing.assert_close(right_and_up[:3], torch.tensor([1.0, -2.0, 5.0]))


def test_blenders_own_layout(tmp_path: Path) -> None:
    """camera_angle_x alone, no image size, file names without extension."""
    (tmp_path / "train").mkdir()
    cv2.imwrite(str(tmp_path / "train" / "r_0.png"), np.zeros((12, 18, 4), np.uint8))
    pose = torch.eye(4).tolist()
    data = {"camera_angle_x": 0.8, "frames": [{"file_path": "./train/r_0", "transform_matrix": pose}] * 2}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    posed = read_transforms(tmp_path / "transforms.json")
    assert (posed.cameras.width, posed.cameras.height) == (18, 12)
    focal = 9 / math.tan(0.4)
    expected = torch.tensor([[focal, 0.0, 9.0], [0.0, focal, 6.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(posed.cameras.Ks, expected.expand(2, 3, 3))
    assert posed.frames[0].path.is_file() and posed.frames[0].frame is None


def test_what_an_entry_says_itself_wins(tmp_path: Path) -> None:
    assert read_transforms(written(tmp_path, second={"fl_x": 77.0})).cameras.Ks[:, 0, 0].tolist() == [9.0, 77.0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"second": {"w": 21}}, r"frames\[1\]: is 21x16, frames\[0\] is 20x16"),
        *(({"second": {"transform_matrix": np.diag([*d, 1.0]).tolist()}}, "matrix of 'a/1.png' is not a rotation")
          for d in ((1.1, 1.1, 1.1), (1.0, 1.0, -1.0), (0.0, 0.0, 0.0))),
        ({"frames": []}, "field 'frames' must be a non-empty list"),
        ({"fl_x": None, "camera_angle_x": None}, "neither field 'fl_x'"),
        ({"fl_x": "wide"}, "field 'fl_x' must be a finite number"),
        ({"fl_x": -3.0}, "focal lengths must be positive"),
        ({"fl_x": None, "camera_angle_x": 0}, "'camera_angle_x' must be between 0 and pi"),
        ({"h": None}, "field 'h' must be a finite number"),
        ({"h": 0}, "fields 'w', 'h' must be positive"),
        ({"w": None, "h": None}, "has no 'w' and 'h'"),
        ({"k1": 0.02}, r"the lens is distorted \(\{'k1': 0.02\}\)"),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera_model 'OPENCV_FISHEYE' is not supported"),
        ({"frames": [{"transform_matrix": torch.eye(4).tolist()}]}, "field 'file_path' must name an image"),
        ({"frames": [{"file_path": "a.png"}]}, "field 'transform_matrix' is missing"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": [[1, 2], [3, 4]]}]}, "finite 4 x 4 matrix"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": "eye"}]}, "finite 4 x 4 matrix"),
    ],
)  # fmt: skip
def test_malformed_fields_are_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    path = written(tmp_path, **changes)
    with pytest.raises(DataError, match=message) as error:
        read_transforms(path)
    assert str(path) in str(error.value)


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    path = written(tmp_path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(read_transforms(path).frames) == 2


@pytest.mark.parametrize(
    ("name", "there", "found"),
    [
        ("a\\r.png", ["a/r.png"], "a/r.png"),
        ("a\\r", ["a/r.jpg"], "a/r.jpg"),
        ("./a/r", ["a/r.jpeg"], "a/r.jpeg"),
        ("a/r.png", ["a/r.JPG"], "a/r.JPG"),
        ("a/r.0001", ["a/r.0001.png", "a/r.0002.png"], "a/r.0001.png"),
        ("a/r", [], "a/r.png"),
        ("a\\r.jpg", [], "a/r.jpg"),
    ],
)
def test_names_of_other_programs_find_their_image(tmp_path: Path, name: str, there: list[str], found: str) -> None:
    (tmp_path / "a").mkdir()
    for one in there:
        (tmp_path / one).touch()
    path = written(tmp_path, second={"file_path": name})
    assert read_transforms(path).frames[1].path == tmp_path / found


def test_a_name_that_two_images_fit_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    for one in ("a/r.png", "a/r.jpg"):
        (tmp_path / one).touch()
    with pytest.raises(DataError, match=r"'a/r' fits a/r.png and a/r.jpg"):
        read_transforms(written(tmp_path, second={"file_path": "a/r"}))


@pytest.mark.parametrize(
    ("file", "entry", "focal"),
    [
        ({"camera_angle_x": 2 * math.atan(10 / 80), "camera_angle_y": 2 * math.atan(8 / 120)}, {}, (80.0, 120.0)),
        ({"fl_x": 80.0, "camera_angle_y": 2 * math.atan(8 / 90)}, {}, (80.0, 90.0)),
        ({"camera_angle_x": 2 * math.atan(10 / 60), "fl_y": 50.0}, {}, (60.0, 50.0)),
        ({"fl_x": 9.0, "fl_y": 9.0}, {"camera_angle_x": 2 * math.atan(10 / 70)}, (70.0, 70.0)),
        ({"camera_angle_x": 1.0}, {"fl_x": 30.0, "fl_y": 40.0}, (30.0, 40.0)),
    ],
)
def test_focal_lengths_of_all_dialects(tmp_path: Path, file, entry, focal: tuple[float, float]) -> None:
    changes = {"fl_x": None, "fl_y": None, "camera_angle_x": None, **file}
    own = {"fl_x": 9.0} if "fl_x" not in file and "camera_angle_x" not in file else {}
    path = written(tmp_path, second=entry, **changes)
    data = json.loads(path.read_text())
    data["frames"][0].update(own)
    path.write_text(json.dumps(data))
    k = read_transforms(path).cameras.Ks[1]
    assert (float(k[0, 0]), float(k[1, 1])) == pytest.approx(focal, rel=1e-5)


def test_the_last_row_of_a_pose_may_be_left_out(tmp_path: Path) -> None:
    path = written(tmp_path)
    data = json.loads(path.read_text())
    for entry in data["frames"]:
        del entry["transform_matrix"][3]
    path.write_text(json.dumps(data))
    torch.testing.assert_close(read_transforms(path).cameras.viewmats, CAMERAS.viewmats)


@pytest.mark.parametrize(
    "field",
    [{"is_fisheye": True}, {"mask_path": "m.png"}, {"lens": "ftheta"}, {"rolling_shutter": [0, 0, 0.1]},
     {"from_mitsuba": True}],
)  # fmt: skip
def test_fields_that_change_the_picture_are_refused_by_name(tmp_path: Path, field: dict[str, object]) -> None:
    with pytest.raises(DataError, match=rf"frames\[1\]: field '{next(iter(field))}' is .*not supported"):
        read_transforms(written(tmp_path, second=field))
    assert read_transforms(written(tmp_path, is_fisheye=False, rolling_shutter=[0, 0, 0], applied_transform=[[1]]))


@pytest.mark.parametrize("field", LEFT_ASIDE)
def test_fields_of_no_effect_change_nothing(tmp_path: Path, field: str) -> None:
    posed = read_transforms(written(tmp_path, **{field: [[0.0, 1.0, 0.0, 3.0]]}))
    torch.testing.assert_close(posed.cameras.viewmats, CAMERAS.viewmats)
    torch.testing.assert_close(posed.cameras.Ks, CAMERAS.Ks)


def test_the_reference_lists_every_field() -> None:
    page = (Path(__file__).parents[2] / "docs/reference/data-set.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    for field in (*REFUSED, *(f for f in DISTORTION if f[0] == "p")):
        assert any(f"`{field}`" in row and "refused" in row for row in rows), field
    for field in LEFT_ASIDE:
        assert any(f"`{field}`" in row and "left aside" in row for row in rows), field
