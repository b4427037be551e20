import json
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.blob import ring_of_cameras

from gausim.core import DataError
from gausim.io.transforms import LEFT_ASIDE, REFUSED, read_transforms, write_transforms

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


@pytest.mark.parametrize(("changes", "message"), [
    ({"second": {"w": 21}}, r"frames\[1\]: is 21x16, frames\[0\] is 20x16"),
    *(({"second": {"transform_matrix": np.diag([*d, 1.0]).tolist()}}, "matrix of 'a/1.png' is not a rotation")
      for d in ((1.1, 1.1, 1.1), (1.0, 1.0, -1.0), (0.0, 0.0, 0.0))),
    ({"frames": []}, "field 'frames' must be a non-empty list"),
    ({"fl_x": None, "camera_angle_x": None}, "neither field 'fl_x'"),
    ({"fl_x": "wide"}, "field 'fl_x' must be a finite number"),
    ({"fl_x": 9.0, "camera_angle_x": 1.5}, r"'fl_x' \(9 pixels\) and 'camera_angle_x' \(1.5 radian.* contradict"),
    ({"fl_x": None, "camera_angle_x": 0}, "'camera_angle_x' must be between 0 and pi"),
    ({"h": 0}, "fields 'w', 'h' must be positive"),
    ({"k1": 0.02}, r"the lens is distorted \(\{'k1': 0.02\}\)"),
    ({"camera_model": "OPENCV_FISHEYE"}, "camera_model 'OPENCV_FISHEYE' is not supported"),
    ({"frames": [{"transform_matrix": torch.eye(4).tolist()}]}, "field 'file_path' must name an image"),
    ({"frames": [{"file_path": "a.png", "transform_matrix": "eye"}]}, "finite 4 x 4 matrix"),
])  # fmt: skip
def test_malformed_fields_are_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    path = written(tmp_path, **changes)
    with pytest.raises(DataError, match=message) as error:
        read_transforms(path)
    assert str(path) in str(error.value)


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    path = written(tmp_path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(read_transforms(path).frames) == 2


@pytest.mark.parametrize(("name", "there", "found"), [
    ("a\\r.png", ["a/r.png"], "a/r.png"),
    ("a\\r", ["a/r.jpg"], "a/r.jpg"),
    ("./a/r", ["a/r.jpeg"], "a/r.jpeg"),
    ("a/r.png", ["a/r.JPG"], "a/r.JPG"),
    ("a/r.0001", ["a/r.0001.png", "a/r.0002.png"], "a/r.0001.png"),
    ("a/r", [], "a/r.png"),
    ("a\\r.jpg", [], "a/r.jpg"),
])  # fmt: skip
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


@pytest.mark.parametrize(("file", "entry", "focal"), [
    ({"camera_angle_x": 2 * math.atan(10 / 80), "camera_angle_y": 2 * math.atan(8 / 120)}, {}, (80.0, 120.0)),
    ({"fl_x": 80.0, "camera_angle_y": 2 * math.atan(8 / 90)}, {}, (80.0, 90.0)),
    ({"camera_angle_x": 2 * math.atan(10 / 60), "fl_y": 50.0}, {}, (60.0, 50.0)),
    ({"fl_x": 9.0, "fl_y": 9.0}, {"camera_angle_x": 2 * math.atan(10 / 70)}, (70.0, 70.0)),
    ({"camera_angle_x": 1.0}, {"fl_x": 30.0, "fl_y": 40.0}, (30.0, 40.0)),
    ({"fl_x": 30.0, "fl_y": 31.0}, {"camera_angle_y": 2 * math.atan(8 / 90)}, (30.0, 90.0)),
])  # fmt: skip
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


# Fields by the programs that write them, as their exporters do today.
DIALECTS = {
    "instant-ngp": "camera_angle_x camera_angle_y fl_x fl_y k1 k2 k3 k4 p1 p2 is_fisheye cx cy w h aabb_scale scale "
    "offset up file_path sharpness transform_matrix lens rolling_shutter from_mitsuba n_extra_learnable_dims",
    "nerfstudio": "w h fl_x fl_y cx cy k1 k2 k3 k4 p1 p2 camera_model file_path transform_matrix colmap_im_id "
    "mask_path depth_file_path applied_transform applied_scale ply_file_path orientation_override",
    "Blender": "camera_angle_x file_path rotation transform_matrix",
    "Metashape": "camera_model w h fl_x fl_y cx cy k1 k2 k3 k4 p1 p2 aabb_scale scale offset up file_path sharpness "
    "transform_matrix",
    "D-NeRF": "camera_angle_x file_path rotation time transform_matrix",
}
# A value of each field that the reader obeys.
VALUES = {
    "w": 22, "h": 18, "fl_x": 31.0, "fl_y": 32.0, "cx": 3.0, "cy": 4.0, "camera_angle_x": 0.7, "camera_angle_y": 0.8,
    "file_path": "a/7.png", "transform_matrix": np.eye(4).tolist(), "time": 0.5, "k1": 0.1, "k2": 0.1, "k3": 0.1,
    "k4": 0.1, "p1": 0.1, "p2": 0.1, "camera_model": "OPENCV_FISHEYE",
}  # fmt: skip


def outcome(tmp_path: Path, field: str) -> str:
    """What the reader makes of a field of all entries."""
    own = {"fl_x": None, "fl_y": None, "camera_angle_x": 0.9} if field.startswith("camera_angle") else {}
    own |= {"camera_angle_x": None} if field in ("w", "h") else {}  # which would contradict the focal length
    before = read_transforms(written(tmp_path, **own))
    path = written(tmp_path, **own)
    data = json.loads(path.read_text())
    for entry in (*data["frames"], *[data] * (field in LEFT_ASIDE)):
        entry[field] = VALUES.get(field, "set")
    path.write_text(json.dumps(data))
    try:
        after = read_transforms(path)
    except DataError as error:
        return "refused" if field in str(error) else str(error)
    pairs = [(getattr(before.cameras, n), getattr(after.cameras, n)) for n in ("Ks", "viewmats")]
    same = all(torch.equal(*pair) for pair in pairs)
    alike = same and before.frames == after.frames and before.cameras.width == after.cameras.width
    if not alike or before.cameras.height != after.cameras.height:
        return "obeyed"
    return "left aside" if field in LEFT_ASIDE else "nothing"


def test_the_reference_says_what_becomes_of_every_field(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/reference/data-set.md").read_text()
    page = page[page.index("What becomes of the fields") : page.index("## Masks")]
    rows = [line.split("|")[1:4] for line in page.splitlines() if line.startswith("| `") and line.count("|") == 4]
    listed = {field: (writers, what) for names, writers, what in rows for field in re.findall(r"`(\w+)`", names)}
    for dialect, fields in DIALECTS.items():
        for field in fields.split():
            writers, what = listed[field]
            assert dialect in writers or "all" in writers, (dialect, field)
            assert outcome(tmp_path, field) in what, (dialect, field, what)
    for field, (writers, _) in listed.items():
        for dialect in DIALECTS:
            assert dialect not in writers or field in DIALECTS[dialect].split(), (dialect, field)
    assert {*REFUSED, *LEFT_ASIDE} <= set(listed)
