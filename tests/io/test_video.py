import numpy as np
import pytest
from PIL import Image

from gausim.io import video
from gausim.io.video import read_video, write_gif, write_video


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
