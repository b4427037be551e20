"""Video files through PyAV (no system ffmpeg needed): MP4 for players, GIF for web pages, not for training."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError

from gausim.core import DataError
from gausim.io.files import replacing

H264 = "libx264"  # included in the wheels of PyAV
# Constant rate factors of H.264 (lower is better): visually lossless, and half its size for web pages.
FINE, SMALL = 16, 21


def write_video(path: Path | str, frames: Iterable[np.ndarray], fps: float, *, quality: int = FINE) -> int:
    """Writes (H, W, 3) uint8 RGB frames as MP4 (H.264), one at a time; returns their number.

    Odd sizes are padded by one repeated row or column, because the chroma planes have half the size. ``quality`` is the
    constant rate factor.

    Raises:
        DataError: no frames, frames of different size or type, or the encoder fails.
    """
    path = Path(path)
    checked = _checked(path, frames)
    first = next(checked)
    height, width = (n + n % 2 for n in first.shape[:2])
    count = 0
    try:
        with replacing(path, typed=True) as temporary, av.open(str(temporary), "w") as container:
            stream = container.add_stream(H264, rate=Fraction(fps).limit_denominator(1001))
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.options = {"crf": str(quality), "preset": "medium"}
            for pixels in chain([first], checked):
                padded = np.pad(pixels, ((0, height - len(pixels)), (0, width - pixels.shape[1]), (0, 0)), mode="edge")
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(padded), format="rgb24")
                container.mux(stream.encode(frame))
                count += 1
            container.mux(stream.encode())
    except (FFmpegError, ValueError) as error:
        raise DataError(
            f"{path}: encoder '{H264}' failed ({error}). Check the folder and the free space, and that PyAV has the "
            "encoder (`pip install av`)."
        ) from error
    return count


@contextmanager
def _opened(path: Path | str) -> Iterator[Any]:
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise DataError(f"{path}: holds no video stream.")
            yield container
    except (FFmpegError, OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be decoded as video ({error}). Check the file.") from error


def read_video(path: Path | str) -> Iterator[np.ndarray]:
    """Decodes the first video stream, one (H, W, 3) uint8 RGB frame at a time.

    Raises:
        DataError: the file is missing, has no video stream or cannot be decoded.
    """
    with _opened(path) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24")


def video_rate(path: Path | str) -> float:
    """Frames per second of the first video stream.

    Raises:
        DataError: the file is missing, has no video stream or cannot be read.
    """
    with _opened(path) as container:
        rate = container.streams.video[0].average_rate
    if not rate:
        raise DataError(f"{path}: its video stream states no frame rate.")
    return float(rate)


def write_gif(path: Path | str, frames: Iterable[np.ndarray], fps: float) -> int:
    """Writes (H, W, 3) uint8 RGB frames as an endless GIF with one palette for all; returns their number.

    GIF times are whole hundredths of a second, and most programs slow down below 0.02 s; the rate is therefore limited
    to 50 fps.

    Raises:
        DataError: no frames, or frames of different size or type.
    """
    from PIL import Image

    path = Path(path)
    images = [Image.fromarray(pixels) for pixels in _checked(path, frames)]
    # One palette, computed from all frames, avoids flicker between palettes.
    step = max(1, len(images) // 8)
    overview = Image.fromarray(np.concatenate([np.asarray(i) for i in images[::step]], axis=1))
    palette = overview.quantize(colors=256)
    indexed = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    duration = max(20, round(1000 / fps / 10) * 10)
    with replacing(path, typed=True) as temporary:
        indexed[0].save(temporary, save_all=True, append_images=indexed[1:], duration=duration, loop=0)
    return len(indexed)


def _checked(path: Path, frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The frames, each after a check that it is an RGB image of the first one's size; at least one."""
    shape = None
    for pixels in frames:
        shape = shape or pixels.shape
        if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.shape != shape:
            raise DataError(
                f"{path}: expected uint8 RGB frames of one size (first {shape}), got {pixels.dtype} {pixels.shape}."
            )
        yield pixels
    if shape is None:
        raise DataError(f"{path}: no frames to write; a video needs at least one.")
