"""Files are there whole or not at all, and killed writers leave nothing behind."""

import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gausim.io import video
from gausim.io.files import remove_leftovers, replacing, sha256, write_durably, write_json
from gausim.io.video import read_video, write_gif, write_video


def test_an_error_leaves_nothing_or_the_old_content(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "x.bin"
    for there in ([], ["x.bin"]):
        with pytest.raises(OSError), replacing(path, typed=True) as temporary:
            assert temporary.suffix == ".bin" and temporary.parent == path.parent
            temporary.write_bytes(b"half")
            raise OSError
        assert [p.name for p in path.parent.iterdir()] == there
        write_durably(path, b"old")
    assert path.read_bytes() == b"old"
    write_durably(path, b"new", previous=path.with_name("before.bin"))
    assert path.read_bytes() == b"new" and path.with_name("before.bin").read_bytes() == b"old"


def test_leftovers_of_killed_writers_go_and_nothing_else(tmp_path: Path) -> None:
    for typed in (False, True):
        if (child := os.fork()) == 0:
            with replacing(tmp_path / "x.png", typed=typed) as temporary:
                temporary.write_bytes(b"half")
                os._exit(0)
        os.waitpid(child, 0)
    assert len(list(tmp_path.iterdir())) == 2 and not (tmp_path / "x.png").exists()
    remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == []
    kept = ["a.tmp", ".notes.tmp", "frames.bin", ".a.png.tmp.bak", "deep/.x.tmp"]
    gone = [".last.ckpt.4711.tmp", ".0001.png.12.tmp.png"]
    for name in [*kept, *gone, *(f"deep/{n}" for n in gone)]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    remove_leftovers(tmp_path)
    assert all((tmp_path / "deep" / name).exists() for name in gone)
    remove_leftovers(tmp_path, deep=True)
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()) == sorted(kept)


def test_hashes_and_json(tmp_path: Path) -> None:
    write_json(tmp_path / "x.json", {"a": [1, 2.5]})
    content = (tmp_path / "x.json").read_bytes()
    assert json.loads(content) == {"a": [1, 2.5]} and content.endswith(b"\n")
    assert sha256(tmp_path / "x.json") == hashlib.sha256(content).hexdigest()
    with pytest.raises(ValueError):
        write_json(tmp_path / "y.json", {"a": float("nan")})
    assert not (tmp_path / "y.json").exists()


def ramp(count: int = 9, height: int = 50, width: int = 71) -> list[np.ndarray]:
    """Grey frames that brighten, with a bright left half."""
    frames = []
    for i in range(count):
        frame = np.full((height, width, 3), 20 + 20 * i, np.uint8)
        frame[:, : width // 2, 0] = 230
        frames.append(frame)
    return frames


def test_video_decodes_to_the_same_frames(tmp_path):
    frames = ramp()
    path = tmp_path / "new" / "v.mp4"
    assert write_video(path, iter(frames), 29.97) == len(frames)
    decoded = list(read_video(path))
    assert decoded[0].shape == (50, 72, 3)  # the odd width grew by one
    for before, after in zip(frames, decoded, strict=True):
        error = np.abs(before.astype(int) - after[:, :71].astype(int))[:, 40:]
        assert error.mean() < 6
    assert video.video_rate(path) == pytest.approx(29.97, abs=0.01)


def test_gif_keeps_frames_time_and_colours(tmp_path):
    frames = ramp(6)
    assert write_gif(tmp_path / "v.gif", frames, 24.0) == 6
    with Image.open(tmp_path / "v.gif") as image:
        assert image.n_frames == 6 and image.info["duration"] == 40
        image.seek(3)
        shown = np.asarray(image.convert("RGB")).astype(int)
    assert np.abs(shown - frames[3].astype(int)).mean() < 8
