"""Poses: found from photos of a corner of a room, or taken over; undistorted images, worlds turned and scaled."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers import colmap_files

from data_prep import poses as command
from data_prep.capture.cameras.lenses import lens, straighten
from data_prep.capture.cameras.mapping import MappingOptions
from data_prep.capture.cameras.sources import Sources
from data_prep.common.colmap import ColmapCamera
from data_prep.common.stage import read_manifest
from data_prep.poses import WorldOptions, find_poses
from gausim.core import ConfigError, DataError
from gausim.data.records import SequenceRecord
from gausim.io.transforms import read_transforms
from gausim.ops.orbit import look_at

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
AZIMUTHS = (0.35, 0.55, 0.75, 0.95, 1.15, 1.35)
OPTIONS = MappingOptions(camera_model="SIMPLE_PINHOLE", features=1500, feature_size=WIDTH)


def room_viewmat(azimuth: float) -> np.ndarray:
    """(4, 4) of a camera that looks into the corner x = y = z = 0 of a room from its middle."""
    eye = 3.2 * np.array([np.cos(azimuth), np.sin(azimuth), 0.45 + 0.1 * np.sin(9 * azimuth)])
    return look_at(*map(torch.from_numpy, (eye, np.array([0.3, 0.3, 0.35]), np.array([0.0, 0.0, 1.0])))).numpy()


def apart(viewmats: np.ndarray, truth: np.ndarray) -> float:
    """Largest difference of the distances between centres, relative to the largest, and of relative rotations."""
    centers = [-np.einsum("nji,nj->ni", v[:, :3, :3], v[:, :3, 3]) for v in (viewmats, truth)]
    lengths = [np.linalg.norm(c[:, None] - c[None], axis=-1) for c in centers]
    turns = [v[:, :3, :3] @ v[0, :3, :3].T for v in (viewmats, truth)]
    scaled = lengths[0] / lengths[0].mean() - lengths[1] / lengths[1].mean()
    return float(max(np.abs(scaled).max(), np.abs(turns[0] - turns[1]).max()))


def photograph_room(viewmat: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of the walls x = 0 and y = 0 and the floor, each with its own texture (n, n)."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack(((x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)), -1) @ viewmat[:3, :3]
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    image, nearest = np.zeros((HEIGHT, WIDTH), np.float32), np.full((HEIGHT, WIDTH), np.inf)
    for axis in range(3):
        depth = -eye[axis] / rays[..., axis]
        hit = eye + depth[..., None] * rays
        u, v = (hit[..., other] / 3.0 * walls.shape[1] for other in range(3) if other != axis)
        seen = cv2.remap(walls[axis], u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR,
                         borderMode=cv2.BORDER_REFLECT)  # fmt: skip
        closer = (depth > 0) & (depth < nearest)
        image, nearest = np.where(closer, seen, image), np.where(closer, depth, nearest)
    return np.repeat(image.clip(0, 255).astype(np.uint8)[..., None], 3, -1)


def write_photos(folder: Path) -> Path:
    """What six cameras see of the room."""
    folder.mkdir()
    rng = np.random.default_rng(3)
    walls = np.stack([cv2.GaussianBlur(rng.normal(128, 260, (400, 400)).astype(np.float32), (0, 0), 2.2)] * 3)
    walls = np.stack([np.roll(wall, 97 * i, 0)[:: (-1) ** i] for i, wall in enumerate(walls)])
    for i, azimuth in enumerate(AZIMUTHS):
        cv2.imwrite(str(folder / f"photo {i}.png"), photograph_room(room_viewmat(azimuth), walls))
    return folder


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_photos(tmp_path_factory.mktemp("room") / "photos")


@pytest.fixture(scope="module")
def mapped(photos: Path) -> Path:
    out = photos.parent / "mapped"
    find_poses(out, Sources(images=photos), mapping=OPTIONS)
    return out


def test_photos_become_poses(photos: Path, mapped: Path) -> None:
    results = read_manifest(mapped, "poses")["results"]
    assert results["registered"] == results["images"] == len(AZIMUTHS) and results["without_pose"] == []
    assert results["reprojection"]["mean"] < 0.5
    assert results["points"]["count"] > 100 and results["points"]["mean_track"] > 2
    posed = read_transforms(mapped / "transforms.json")
    assert [f.path.name for f in posed.frames] == [f"photo {i}.png" for i in range(len(AZIMUTHS))]
    truth = np.stack([room_viewmat(a) for a in AZIMUTHS])
    assert apart(posed.cameras.viewmats.double().numpy(), truth) < 0.03
    assert float(posed.cameras.Ks[0, 0, 0]) == pytest.approx(FOCAL, rel=0.03)
    # Upright, around the origin, one unit away from it.
    assert (posed.cameras.viewmats[:, 1, 2] < -0.8).all()
    assert float(posed.cameras.centers.norm(dim=-1).mean()) == pytest.approx(1, abs=1e-3)
    stored = np.load(mapped / "points.npz")
    assert stored["points"].shape == (len(stored["ids"]), 3) and stored["colors"].std() > 10
    assert cv2.imread(str(mapped / "cameras.png")).shape[0] > 300
    assert not (mapped / "mapping").exists() and (mapped / "colmap" / "sparse" / "0" / "images.bin").is_file()


def test_a_found_model_is_taken_over_for_smaller_photos(photos: Path, mapped: Path, tmp_path: Path) -> None:
    (tmp_path / "half").mkdir()
    for path in photos.iterdir():
        small = cv2.resize(cv2.imread(str(path)), (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(tmp_path / "half" / path.name), small)
    sources = Sources(images=tmp_path / "half", colmap=mapped / "colmap")
    results = find_poses(tmp_path / "out", sources, mapping=OPTIONS)["results"]
    whole, half = read_transforms(mapped / "transforms.json"), read_transforms(tmp_path / "out" / "transforms.json")
    np.testing.assert_allclose(half.cameras.Ks[0, :2], whole.cameras.Ks[0, :2] / 2, rtol=1e-6)
    # Taken over, the world stays as COLMAP left it; it is the same but for a similarity.
    assert results["world"]["up"] == "as given"
    assert apart(half.cameras.viewmats.double().numpy(), whole.cameras.viewmats.double().numpy()) < 1e-5


def write_lens_transforms(root: Path, frames: list[dict], **lens: object) -> Path:
    root.mkdir(parents=True, exist_ok=True)
    data = {"fl_x": 60.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, **lens, "frames": frames}
    (root / "transforms.json").write_text(json.dumps(data))
    return root / "transforms.json"


def pose(azimuth: float) -> list[list[float]]:
    """Camera to world, OpenGL axes, of a camera that looks into the room."""
    return (np.linalg.inv(room_viewmat(azimuth)) * np.array([1.0, -1, -1, 1])).tolist()


def rig(root: Path, sequences: int = 2, frames: int = 3) -> Path:
    """A transforms.json of two stills and two fixed cameras, and films of these."""
    for name in ("still_0.png", "still_1.png", "cam_0.png", "cam_1.png"):
        root.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / name), np.full((48, 64, 3), 90, np.uint8))
    for s in range(sequences):
        for camera in ("cam_0", "cam_1"):
            (root / f"films/seq_{s}/{camera}").mkdir(parents=True)
            for f in range(frames):
                cv2.imwrite(str(root / f"films/seq_{s}/{camera}/{f}.png"), np.full((48, 64, 3), 40 * f, np.uint8))
    names = ("still_0", "still_1", "cam_0", "cam_1")
    return write_lens_transforms(
        root, [{"file_path": f"{n}.png", "transform_matrix": pose(0.4 * i)} for i, n in enumerate(names)], k1=-0.05
    )


def test_films_of_fixed_cameras_get_their_poses(tmp_path: Path) -> None:
    sources = Sources(transforms=rig(tmp_path / "in"), sequences=tmp_path / "in" / "films", fps=25.0)
    results = find_poses(tmp_path / "out", sources, mapping=OPTIONS)["results"]
    assert results["stills"] == 2 and results["sequences_without_poses"] == {}
    record = SequenceRecord(tmp_path / "out" / "sequences" / "seq_1", views=("cam_0", "cam_1"), fps=25.0)
    assert record.count == 3
    np.testing.assert_allclose(record.cameras.viewmats[1].numpy(), room_viewmat(1.2), atol=1e-6)
    image = cv2.imread(str(tmp_path / "out" / "sequences" / "seq_1" / "cam_1" / "0002.png"))
    assert image.shape == (48, 64, 3) and (image == 80).all()


def test_films_without_poses_are_left_out_by_name(tmp_path: Path) -> None:
    path = rig(tmp_path / "in")
    (tmp_path / "in/films/seq_1/cam_1").rename(tmp_path / "in/films/seq_1/cam_9")
    sources = Sources(transforms=path, sequences=tmp_path / "in" / "films", fps=25.0)
    results = find_poses(tmp_path / "out", sources, mapping=OPTIONS)["results"]
    assert list(results["sequences"]) == ["seq_0"] and results["sequences_without_poses"] == {"seq_1": ["cam_9"]}


def disc_masks(root: Path) -> dict[str, np.ndarray]:
    """A mask per still of a rig, in different encodings and under names of different programs."""
    disc = np.hypot(*np.mgrid[-24:24, -32:32]) < 15
    (root / "masks").mkdir()
    cv2.imwrite(str(root / "masks/still_0.png"), disc.astype(np.uint8))
    cv2.imwrite(str(root / "masks/still_1.jpg"), 255 * (~disc).astype(np.uint8))
    data = json.loads((root / "transforms.json").read_text())
    data["frames"][0]["mask_path"], data["frames"][1]["mask_path"] = "masks\\still_0.png", "./masks/still_1"
    (root / "transforms.json").write_text(json.dumps(data))
    return {"still_0.png": disc, "still_1.png": ~disc}


def test_masks_of_a_transforms_json_become_alpha(tmp_path: Path) -> None:
    path, out = rig(tmp_path / "in"), tmp_path / "out"
    known = disc_masks(path.parent)
    find_poses(out, Sources(transforms=path), mapping=OPTIONS)
    for name, mask in known.items():  # the lens moves their edges
        alpha = cv2.imread(str(out / "images" / name), cv2.IMREAD_UNCHANGED)[..., 3]
        assert ((alpha > 127) != mask).mean() < 0.03 and alpha.min() == 0 and alpha.max() == 255
    assert cv2.imread(str(out / "images/cam_0.png"), cv2.IMREAD_UNCHANGED).shape[2] == 3
    cv2.imwrite(str(path.parent / "masks/still_0.png"), np.ones((48, 64), np.uint8))
    with pytest.raises(DataError, match="other inputs"):
        find_poses(out, Sources(transforms=path), mapping=OPTIONS)
    (path.parent / "masks/still_1.jpg").unlink()
    with pytest.raises(DataError, match=r"masks/still_1\.png: not found"):
        find_poses(tmp_path / "other", Sources(transforms=path), mapping=OPTIONS)


def test_names_of_windows_find_their_photos(tmp_path: Path) -> None:
    cameras, images, points = colmap_files.small_model(size=(WIDTH, HEIGHT))
    images = {n: (f"left\\photo_{n}.png", *i[1:]) for n, i in images.items()}
    colmap_files.write_binary(tmp_path / "model", cameras, images, points)
    (tmp_path / "photos/left").mkdir(parents=True)
    for n in images:
        cv2.imwrite(str(tmp_path / f"photos/left/photo_{n}.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    sources = Sources(images=tmp_path / "photos", colmap=tmp_path / "model")
    find_poses(tmp_path / "out", sources, mapping=OPTIONS)
    assert len(read_transforms(tmp_path / "out/transforms.json").frames) == len(images)


LENSES = {
    "SIMPLE_RADIAL": [0.08], "RADIAL": [0.08, -0.02], "OPENCV": [0.08, -0.02, 0.004, -0.003],
    "OPENCV_FISHEYE": [0.03, 0.01, 0.0, 0.0], "FULL_OPENCV": [0.08, -0.02, 0.004, -0.003, 0.01, 0.0, 0.0, 0.0],
    "FOV": [0.4], "SIMPLE_RADIAL_FISHEYE": [0.03], "RADIAL_FISHEYE": [0.03, 0.01],
    "THIN_PRISM_FISHEYE": [0.03, 0.01, 0.002, -0.002, 0.0, 0.0, 0.003, 0.002],
}  # fmt: skip


@pytest.mark.parametrize("model", LENSES)
def test_every_lens_is_straightened(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    width, height = 160, 120
    template = pycolmap.Camera.create_from_model_name(1, model, 130.0, width, height)
    head = len(template.params) - len(LENSES[model])
    camera = ColmapCamera(model, width, height, np.array([*list(template.params)[:head], *LENSES[model]]))
    y, x = np.mgrid[:height, :width] + 0.5

    def shade(rays: np.ndarray) -> np.ndarray:
        slope = rays[:, :2] / rays[:, 2:]
        return (127 + 60 * np.sin(9 * slope[:, 0]) + 60 * np.cos(8 * slope[:, 1])).reshape(height, width)

    photo = shade(np.asarray(lens(camera).cam_ray_from_img(np.stack((x, y), -1).reshape(-1, 2))))
    straight = straighten(camera, Path(model))
    k = straight.intrinsics
    rays = np.stack(((x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], np.ones_like(x)), -1).reshape(-1, 3)
    pixels = np.dstack((*[photo.round().astype(np.uint8)] * 3, np.full((height, width), 255, np.uint8)))
    shown = straight(pixels)[..., 0]
    assert np.abs(shown - shade(rays)).max() < 4 < np.abs(pixels[..., 0] - shade(rays)).max()


def test_scale_and_up_make_the_world(tmp_path: Path) -> None:
    cameras, images, points = colmap_files.small_model(size=(WIDTH, HEIGHT))
    cameras = {1: ("PINHOLE", WIDTH, HEIGHT, [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])}
    images = {n: (f"photo_{n}.png", 1, *i[2:4], []) for n, i in images.items()}
    colmap_files.write_text(tmp_path / "model", cameras, images, points)
    (tmp_path / "photos").mkdir()
    for name, *_ in images.values():
        cv2.imwrite(str(tmp_path / "photos" / name), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    sources = Sources(images=tmp_path / "photos", colmap=tmp_path / "model")
    results = find_poses(tmp_path / "out", sources, mapping=OPTIONS, world=WorldOptions("0,1,0", 2.0))["results"]
    assert results["world"]["scale"] == 2
    stored = np.load(tmp_path / "out" / "points.npz")["points"]
    np.testing.assert_allclose(stored[:, 2], [2 * p[1][1] for p in points], atol=1e-6)
    with pytest.raises(ConfigError, match="--up"):
        find_poses(tmp_path / "bad", sources, mapping=OPTIONS, world=WorldOptions("sideways"))


def test_what_cannot_be_posed_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    command_line = ["--images", str(folder), "--out", str(tmp_path / "out")]
    assert command.main(command_line) == 2 and "no images here" in capsys.readouterr().err
    for i in range(3):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((80, 100 + 2 * (i == 2), 3), 128, np.uint8))
    assert command.main(command_line) == 2 and "no two photos that fit together" in capsys.readouterr().err
    (folder / "1.png").write_bytes(b"no image")
    assert command.main(command_line) == 2 and "1.png: cannot be read as an image" in capsys.readouterr().err
    assert command.main([*command_line, "--camera-model", "PERISCOPE"]) == 2
    assert "expected one of SIMPLE_PINHOLE" in capsys.readouterr().err
    assert command.main(["--out", str(tmp_path / "out")]) == 2 and "--images" in capsys.readouterr().err


def test_taken_over_photos_must_be_there(tmp_path: Path) -> None:
    path = rig(tmp_path / "other", sequences=1)
    (tmp_path / "other" / "still_1.png").unlink()
    with pytest.raises(DataError, match=r"still_1\.png"):
        find_poses(tmp_path / "out", Sources(transforms=path), mapping=OPTIONS)
