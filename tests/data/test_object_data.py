from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers import mistakes
from helpers.blob import FRAMES, POINTS, VIEWS, frame_pixels
from helpers.plain import edit_json
from helpers.toy_object import surround

from gausim.compose.config import compose
from gausim.core import ConfigError, DataError, SceneError
from gausim.data.frames import open_frames
from gausim.data.idle import idle_sequences
from gausim.data.images import composite, write_rgba
from gausim.data.objects import ObjectData, find_objects
from gausim.data.records import read_stills
from gausim.ops.visual_hull import project


def test_facts_true_motion_stills_and_frames_are_those_of_the_files(blob: Path) -> None:
    record = ObjectData(blob).sequences[1]
    frames = record.frames(range(4, 7), ["cam_2", "cam_0"])
    expected = [[frame_pixels(1, v, f) for v in (2, 0)] for f in (4, 5, 6)]
    assert torch.equal(frames, torch.from_numpy(np.array(expected)))
    assert record.cameras_of(["cam_2", "cam_0"]).names == ("cam_2", "cam_0")
    assert torch.equal(record.cameras_of(["cam_2"]).viewmats[0], record.cameras.viewmats[2])
    item = ObjectData(blob)
    assert (item.name, item.fps, item.diagonal) == ("blob", 24.0, 1.5)
    assert (item.train_views, item.heldout_views, item.train_frames) == (VIEWS[:2], VIEWS[2:], range(16))
    truth = item.ground_truth(item.sequences[0])
    assert truth is not None and truth.positions.shape == (FRAMES, POINTS, 3)
    torch.testing.assert_close(truth.positions[8], truth.rest + 8 / 64)
    assert torch.equal(truth.rest, item.scene().means)
    stills = ObjectData(blob).stills()
    assert stills.images.shape == (12, 6, 8, 4) and stills.heldout == (9,) and len(stills.train) == 11
    assert torch.equal(stills.images[5], torch.from_numpy(frame_pixels(0, 0, 5)))
    assert torch.equal(read_stills(blob / "static" / "transforms.json").images, stills.images)
    assert [s.name for s in ObjectData(blob, sequences=2).sequences] == ["seq_000", "seq_001"]
    assert [s.name for s in ObjectData(blob, sequences=["seq_002"]).sequences] == ["seq_002"]
    for wrong in (4, 0, ["seq_009"]):
        with pytest.raises(DataError, match="asked for, it has 3"):
            _ = ObjectData(blob, sequences=wrong).sequences


def test_a_frame_is_decoded_once(blob: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = ObjectData(blob).sequences[0]
    first = record.frames(range(3), ["cam_0"])
    monkeypatch.setattr(cv2, "imread", lambda *_: pytest.fail("decoded again"))
    again = record.frames(range(3), ["cam_0"])
    assert torch.equal(first, again)
    again += 1
    assert torch.equal(record.frames(range(3), ["cam_0"]), first), "samples must not share memory with the store"


def test_surroundings_are_those_of_the_facts(spoilt: Path) -> None:
    surround(spoilt, free=True, gravity="trained", floor={"point": [0, 0, 1], "normal": [0, 0, 2]})
    world = ObjectData(spoilt).surroundings
    assert world.free and world.trains_gravity and world.gravity is None and not world.still
    assert world.floor is not None and world.floor.normal == (0.0, 0.0, 1.0) and world.floor.friction is None
    assert ObjectData(spoilt).scene().surroundings == world


def _hold(root: Path, **changed: object) -> None:
    """Hands at the first and the last kernel of the scene, in every sequence."""
    means = ObjectData(root).scene().means.numpy()
    arrays = {"points": np.repeat(means[[0, -1]][None], FRAMES, 0), "hand": np.array([0, 1])} | changed
    for folder in (root / "sequences").iterdir():
        np.savez(folder / "hands.npz", **arrays)


def test_kernels_near_a_hand_are_pinned_to_it(spoilt: Path) -> None:
    _hold(spoilt)
    surround(spoilt, grip=1e-6)
    item = ObjectData(spoilt)
    scene, path = item.scene(), item.sequences[0].hands
    assert scene.hand is not None and (scene.hand[0], scene.hand[-1]) == (0, 1)
    assert scene.pinned[scene.hand >= 0].all()
    assert path is not None and path.frames == FRAMES
    pose = path.pose(FRAMES + 5)
    torch.testing.assert_close(pose.move(scene.means[:1], torch.tensor([0])), scene.means[:1])


@pytest.mark.parametrize(("changed", "message"), [
    ({"points": np.zeros((3, 2, 3))}, "'points' is of shape"),
    ({"points": np.full((FRAMES, 2, 3), np.nan)}, "'points' holds values that are no finite"),
    ({"hand": np.array([0, 2])}, "'hand' has"),
    ({"hand": np.array([0])}, "'hand' is"),
])  # fmt: skip
def test_wrong_hands_are_refused(spoilt: Path, changed: dict[str, object], message: str) -> None:
    _hold(spoilt, **changed)
    with pytest.raises(DataError, match=rf"hands\.npz.*{message}"):
        _ = ObjectData(spoilt).sequences


@pytest.mark.parametrize(
    ("away", "grip", "message"),
    [(99.0, 0.1, "'grip' is 0.1: hand 0 holds none"), (0.0, 1e9, "no simulated kernel is left outside the hands")],
)
def test_hands_that_hold_nothing_or_everything_are_refused(spoilt, away, grip, message) -> None:
    means = ObjectData(spoilt).scene().means.numpy()
    _hold(spoilt, points=np.repeat(means[[0, -1]][None], FRAMES, 0) + away)
    surround(spoilt, grip=grip)
    with pytest.raises(DataError, match=rf"dataset\.json: .*{message}"):
        ObjectData(spoilt).scene()


@pytest.mark.parametrize("place", ["static", "sequences/seq_000"])
def test_images_too_large_for_memory_are_refused(spoilt: Path, place: str) -> None:
    path = spoilt / place / "transforms.json"
    posed = json.loads(path.read_text()) | {"w": 1 << 62}
    del posed["camera_angle_x"]  # of the narrower images
    path.write_text(json.dumps(posed))
    with pytest.raises(DataError, match=rf"{place}/transforms\.json: \d+ images of {1 << 62}x6 do not fit into memory"):
        _ = ObjectData(spoilt).stills() if place == "static" else ObjectData(spoilt).sequences[0]


def test_composite_over_black_and_over_a_color() -> None:
    frame = torch.tensor([[[255, 102, 0, 51], [10, 20, 30, 0]]], dtype=torch.uint8)
    rgb, alpha = composite(frame)
    torch.testing.assert_close(rgb[0, 0], torch.tensor([0.2, 0.08, 0.0]))
    torch.testing.assert_close(alpha[0], torch.tensor([0.2, 0.0]))
    assert rgb[0, 1].abs().max() == 0
    rgb, _ = composite(frame, torch.tensor([0.5, 0.25, 1.0]))
    torch.testing.assert_close(rgb[0], torch.tensor([[0.6, 0.28, 0.8], [0.5, 0.25, 1.0]]))


def _moved(data: dict) -> None:
    data["frames"][FRAMES + 5]["transform_matrix"][0][3] += 0.1


def _without_a_view(data: dict) -> None:
    data.update(frames=[f for f in data["frames"] if f["camera"] != "cam_1"])


@pytest.mark.parametrize(("edit", "message"), [
    (_without_a_view, r"seq_000/transforms.json: view 'cam_1' lacks 20 of 20 frames"),
    (lambda data: data["frames"].pop(FRAMES + 7), r"view 'cam_1' lacks 1 of 20 frames \(first: 7\)"),
    (_moved, "camera 'cam_1' moves at frame 5"),
    (lambda data: data.update(fps=30), "'fps' is 30, dataset.json says 24"),
])  # fmt: skip
def test_wrong_cameras_of_a_sequence(spoilt: Path, edit: Callable, message: str) -> None:
    edit_json(spoilt / "sequences" / "seq_000" / "transforms.json", edit)
    with pytest.raises(DataError, match=message):
        _ = ObjectData(spoilt).sequences


def test_wrong_images(spoilt: Path) -> None:
    folder, record = spoilt / "sequences" / "seq_000" / "cam_0", ObjectData(spoilt).sequences[0]
    cv2.imwrite(str(folder / "0000.png"), frame_pixels(0, 0, 0).astype(np.uint16))
    (folder / "0001.png").write_bytes(b"no image")
    (folder / "0002.png").unlink()
    cv2.imwrite(str(folder / "0003.png"), frame_pixels(0, 0, 2)[..., :3].copy())
    write_rgba(folder / "0004.png", frame_pixels(0, 0, 4)[:4, :4])
    expected = (r"got 8x6 RGBA \(16 bit\)", "cannot be decoded", "no such image", "got 8x6 RGB .*with alpha",
                r"expected 8x6 RGBA \(8 bit\), got 4x4 RGBA")  # fmt: skip
    for frame, message in enumerate(expected):
        with pytest.raises(DataError, match=rf"cam_0/{frame:04d}.png: .*{message}"):
            record.frames(range(frame, frame + 1), ["cam_0"])


@pytest.mark.parametrize(("field", "value", "message"), [
    ("fps", 0, r"dataset\.json: field 'fps': expected 'float' > 0"),
    ("views", "cam_0", r"dataset\.json: field 'views': expected 'array', got 'str'"),
    ("train_views", ["cam_0", "cam_7"], "must be disjoint parts of 'views'"),
    ("train_frames", [1, 16], "field 'train_frames"),
    ("train_frames", [0, 40], "has 20 frames, dataset.json trains on"),
    ("floor", {"point": [0, 0, 0], "normal": [0, 0, 0]}, r"dataset\.json.*'floor.normal'"),
    ("floor", {"point": [0, 0, 0], "normal": [0, 0, 1], "friction": -1}, r"dataset\.json.*friction"),
    ("grip", 0, r"dataset\.json.*grip"),
])  # fmt: skip
def test_wrong_facts(spoilt: Path, field: str, value: object, message: str) -> None:
    surround(spoilt, **{field: value})
    with pytest.raises(DataError, match=message):
        _ = ObjectData(spoilt).sequences


def test_missing_dataset_and_broken_json(spoilt: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no data set here"):
        find_objects(tmp_path / "nowhere")
    (spoilt / "dataset.json").write_text("{")
    with pytest.raises(DataError, match=r"dataset.json: cannot be read as JSON"):
        ObjectData(spoilt)


def test_true_motion_that_is_missing_or_of_another_shape(spoilt: Path) -> None:
    path = spoilt / "sequences" / "seq_000" / "ground_truth.npz"
    item = ObjectData(spoilt)
    np.savez(path, displacement=np.zeros((FRAMES, POINTS + 1, 3), np.float32))
    with pytest.raises(DataError, match=r"ground_truth.npz: field 'displacement'"):
        item.ground_truth(item.sequences[0])
    np.savez(path, other=np.zeros(3))
    with pytest.raises(DataError, match="array 'displacement' is missing"):
        item.ground_truth(item.sequences[0])
    (spoilt / "rest_points.npz").unlink()
    item = ObjectData(spoilt)
    assert item.ground_truth(item.sequences[0]) is None


def test_scene_without_a_pinned_kernel_says_how_to_pin_one(spoilt: Path) -> None:
    (spoilt / "scene.masks.npz").unlink()
    with pytest.raises(SceneError, match=r"no kernel is pinned.*gausim inspect SCENE --pin") as caught:
        ObjectData(spoilt).scene()
    override = re.findall(r"'(data\.selections=.*)'", str(caught.value))
    config = compose([*override, f"data.root={spoilt}"])  # the override that is proposed, as it is
    assert ObjectData(spoilt, selections=config.data.selections).scene().pinned.any()


def test_selections_replace_masks(blob: Path) -> None:
    means = ObjectData(blob).scene().means
    height = float(means[:, 2].median())
    scene = ObjectData(blob, selections={"pinned": f"z={height}"}).scene()
    assert torch.equal(scene.pinned, means[:, 2] < height) and scene.pinned.any()
    with pytest.raises(ConfigError, match="no such mask"):
        ObjectData(blob, selections={"pined": "z=0.5"}).scene()


def test_true_points_of_the_bunny_fall_on_its_silhouettes(data_root: Path) -> None:
    """This fails if a camera's axes are mixed up."""
    item = ObjectData(data_root / "bunny")
    record, truth = item.sequences[11], item.ground_truth(item.sequences[11])
    assert truth is not None and torch.equal(truth.positions[0], truth.rest)
    cameras, frames = record.cameras_of(item.train_views), record.frames(range(1), item.train_views)
    pixels, _ = project(truth.rest, cameras.viewmats, cameras.Ks)
    for v, (column, row) in enumerate(pixels.long().movedim(-1, 1)):
        assert (frames[0, v, row, column, 3] > 0).float().mean() > 0.98


def sequence(folder: Path, entries: list[dict[str, object]]) -> Path:
    """A sequence of one camera whose image NUMBER.png has that grey value."""
    pose = torch.eye(4).tolist()
    (folder / "cam").mkdir(parents=True)
    for entry in entries:
        name = folder / str(entry["file_path"])
        cv2.imwrite(str(name), np.full((4, 4, 4), int("".join(c for c in name.stem if c.isdigit())), np.uint8))
    frames = [{**entry, "transform_matrix": pose} for entry in entries]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 4, "w": 4, "h": 4, "frames": frames}))
    return folder


def values(folder: Path) -> list[int]:
    source = open_frames(folder, ("cam",), 24)
    return source.read(range(source.count), [0])[:, 0, 0, 0, 3].tolist()


AS_TEXT = sorted(range(12), key=str)


@pytest.mark.parametrize(
    "stated", [lambda n: {"time": n / 24}, lambda n: {"frame": n}, lambda n: {"frame": n, "time": n / 11}]
)
def test_time_or_number_orders_the_frames(tmp_path: Path, stated) -> None:
    entries = [{"file_path": f"cam/{n}.png", **stated(n)} for n in AS_TEXT]
    assert values(sequence(tmp_path / "s", entries)) == list(range(12))


@pytest.mark.parametrize("name", ["{}.png", "frame_{}.png", "r{}.png"])
def test_names_sorted_as_text_are_refused(tmp_path: Path, name: str) -> None:
    entries = [{"file_path": f"cam/{name.format(n)}"} for n in AS_TEXT]
    with pytest.raises(DataError, match=r"go from .*11.png to .*2.png, as if sorted as text"):
        open_frames(sequence(tmp_path / "s", entries), ("cam",), 24)


def test_what_contradicts_itself_is_refused(tmp_path: Path) -> None:
    backwards = [{"file_path": f"cam/{n}.png", "frame": n, "time": -n} for n in range(3)]
    with pytest.raises(DataError, match="'time' of camera 'cam' does not grow"):
        open_frames(sequence(tmp_path / "b", backwards), ("cam",), 24)
    twice = [{"file_path": f"cam/{n}.png", "time": 0.5} for n in range(2)]
    with pytest.raises(DataError, match="does not grow"):
        open_frames(sequence(tmp_path / "t", twice), ("cam",), 24)


def still(root: Path) -> None:
    for folder in (root / "sequences/seq_001").glob("*/"):
        mistakes.reorder(folder, lambda number: 0)


def black(root: Path) -> None:
    mistakes.every_image(root, lambda p: np.dstack((0 * p[..., :3], p[..., 3])), "seq_001/*/*")


KINDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "sound": (lambda root: None, ""),
    "one camera still": (lambda root: mistakes.reorder(root / "sequences/seq_001/cam_0", lambda number: 0), ""),
    "still": (still, "nothing moves (the frames of every training view are one picture) in seq_001."),
    "black": (black, "the object is black in seq_001."),
    "empty": (lambda root: mistakes.every_image(root, np.zeros_like, "seq_001/*/*"),
              "nothing is visible (alpha is 0 in all training views) in seq_001."),
    "all empty": (lambda root: mistakes.every_image(root, np.zeros_like), "training views) in seq_000, seq_001."),
    "opaque": (lambda root: mistakes.every_image(root, lambda p: np.dstack((0 * p[..., :3], 255 + 0 * p[..., 3]))),
               "black in seq_000, seq_001."),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_idle_sequences_are_named(kind: str, toy: Path, tmp_path: Path) -> None:
    root = shutil.copytree(toy, tmp_path / "data")
    spoil, expected = KINDS[kind]
    spoil(root)
    told = list(idle_sequences([ObjectData(root)]))
    assert [expected in text for text in told] == [True] * bool(expected)
