"""Order of the frames of a sequence's image files."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from gausim.core import DataError
from gausim.data.frames import open_frames


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
