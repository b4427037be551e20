"""Films as ingest sees them: when each frame was shown, what the file says about itself, its pictures and its sound.

Times are those of the container [s], so that pictures and sound of one file share a clock.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from av.sidedata.sidedata import Type as SideData

from data_prep.common.photos import resized
from gausim.core import DataError

FILMS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".mxf")

# Rates that cameras have; a measured rate that fits one of them is that one.
STANDARD_RATES = (
    *(Fraction(n) for n in (24, 25, 30, 48, 50, 60, 90, 100, 120, 240)),
    *(Fraction(1000 * n, 1001) for n in (24, 30, 48, 60, 120, 240)),
)
# Clocks of cameras agree to some 1e-5; a container may count in whole milliseconds on top.
RATE_TOLERANCE = 5e-5
# Time stamps of phones jitter; up to this part of an interval that is no other rate.
MOST_JITTER = 0.3
# Mean and usual gap between frames differ by more than this where frames are missing.
MISSING = 0.005
# Transfer functions of high dynamic range (ITU-T H.273): PQ and HLG. Eight bits of them look flat and grey.
HDR = {16: "PQ", 18: "HLG"}
SOUND_RATE = 16000
# Sound beyond this is not listened to: half an hour is far longer than any clip needs to be placed.
SOUND_SECONDS = 1800.0


@dataclass(frozen=True, eq=False)
class Film:
    """One video file."""

    path: Path  # the file
    pts: np.ndarray  # time stamps of its N frames in presentation order, in units of ``time_base``
    time_base: Fraction  # of the stamps [s]
    rate: Fraction  # frames per second
    size: tuple[int, int]  # width and height as shown, that is of square pixels, after rotation [pixels]
    rotation: int  # by which pictures are turned to be upright, counter-clockwise [degree], a multiple of 90
    before_key: int  # frames before the first key frame, which cannot be decoded and do not count
    sound: bool  # it has an audio track
    codec: str  # name of the video codec
    hdr: str | None  # name of a high-dynamic-range transfer function; None for the usual kind

    @property
    def times(self) -> np.ndarray:
        """When each of the N frames is shown, float64 [s]."""
        return np.asarray(self.pts * float(self.time_base), np.float64)

    @property
    def intervals(self) -> tuple[float, float]:
        """The shortest and the longest interval between frames [s]."""
        gaps = np.diff(self.pts) * float(self.time_base)
        return float(gaps.min()), float(gaps.max())

    @property
    def jitter(self) -> float:
        """How far intervals between frames usually are from the usual one [s]."""
        return _jitter(np.diff(self.times))

    @property
    def variable(self) -> bool:
        """Whether a frame is further than half an interval from its place at a constant rate."""
        places = (self.times - self.times[0]) * float(self.rate)
        return bool(np.abs(places - np.arange(len(self))).max() > 0.5 + float(self.time_base * self.rate))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.pts)


def probe(path: Path) -> Film:
    """Reads a film's facts: all packets, one picture."""
    if not path.is_file():
        raise DataError(f"{path}: no such film.")
    if path.stat().st_size == 0:
        raise DataError(f"{path}: is empty (0 bytes). Copy it again from the camera.")
    try:
        with av.open(str(path)) as container:
            stream = _video_stream(path, container)
            pts, before_key = _stamps(path, container, stream)
            time_base, declared = stream.time_base, stream.average_rate
            codec, sound = stream.codec_context.name, bool(container.streams.audio)
            aspect = Fraction(stream.sample_aspect_ratio or 1)
        with av.open(str(path)) as container:
            first = next(container.decode(_video_stream(path, container)), None)
    except (FFmpegError, OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as a film ({error}). Copy it again from the camera.") from error
    if first is None:
        raise DataError(f"{path}: no frame can be decoded. Copy it again from the camera.")
    rate = _rate(np.diff(pts) * float(time_base), declared, float(time_base))
    return Film(
        path=path, pts=pts, time_base=time_base, rate=rate, size=_shown_size(path, first, aspect),
        rotation=int(first.rotation) % 360, before_key=before_key, sound=sound, codec=codec,
        hdr=HDR.get(int(first.color_trc)),
    )  # fmt: skip


def pictures(film: Film) -> Iterator[tuple[int, av.VideoFrame]]:
    """Decodes all frames in presentation order, each with its index."""
    index = {int(stamp): i for i, stamp in enumerate(film.pts)}
    done = 0
    try:
        with av.open(str(film.path)) as container:
            for frame in container.decode(_video_stream(film.path, container)):
                if frame.pts in index and not frame.is_corrupt:
                    done += 1
                    yield index[frame.pts], frame
    except (FFmpegError, OSError, ValueError) as error:
        raise DataError(
            f"{film.path}: frame {done}: cannot be decoded ({error}). Copy the film again from the camera."
        ) from error
    if done != len(film):
        raise DataError(
            f"{film.path}: {len(film)} frames are in it, {done} can be decoded. Copy it again from the camera."
        )


def upright(film: Film, frame: av.VideoFrame) -> np.ndarray:
    """The picture as (H, W, 3) uint8 RGB of square pixels, turned as the file asks for."""
    turned = np.rot90(frame.to_ndarray(format="rgb24"), film.rotation // 90)
    return resized(np.ascontiguousarray(turned), film.size)


class FilmFrames:
    """Frames of a film of a constant rate, read by their numbers; rising numbers are read in one pass."""

    def __init__(self, path: Path) -> None:
        """Reads the film's facts."""
        self.facts = probe(path)
        if self.facts.variable:
            shortest, longest = (1000 * interval for interval in self.facts.intervals)
            raise DataError(
                f"{path}: its rate varies or frames are missing ({shortest:.1f} to {longest:.1f} ms between frames). "
                "Bring it to a constant rate with `gausim prepare ingest`."
            )
        self._next = 0
        self._frames: Iterator[tuple[int, av.VideoFrame]] = iter(())

    def rgba(self, number: int) -> np.ndarray:
        """Frame of this number, upright, (H, W, 4) uint8 opaque RGBA."""
        if number < self._next or self._next == 0:
            self._next, self._frames = 0, pictures(self.facts)
        for index, frame in self._frames:
            self._next = index + 1
            if index == number:
                rgb = upright(self.facts, frame)
                return np.dstack((rgb, np.full(rgb.shape[:2], 255, np.uint8)))
        raise DataError(f"{self.facts.path}: frame {number} cannot be decoded. Copy it again from the camera.")


def sound(film: Film) -> tuple[np.ndarray, float]:
    """The first audio track as one channel of ``SOUND_RATE`` samples per second.

    Returns:
        Samples (float32, about −1..1) and when the first is heard [s], on the clock of the pictures.
    """
    blocks: list[np.ndarray] = []
    first = end = 0.0
    try:
        with av.open(str(film.path)) as container:
            resampler = av.AudioResampler(format="fltp", layout="mono", rate=SOUND_RATE)
            for frame in container.decode(audio=0):
                start = float((frame.pts or 0) * frame.time_base)
                first, end = (start, start) if not blocks else (first, end)
                hole = round((start - end) * SOUND_RATE)
                if not -0.01 * SOUND_RATE <= hole < SOUND_SECONDS * SOUND_RATE:
                    raise DataError(f"{film.path}: the time stamps of its sound leap. Choose another --sync.")
                blocks += [np.zeros(max(0, hole), np.float32)]
                blocks += [part.to_ndarray()[0] for part in resampler.resample(frame)]
                end = max(end, start) + frame.samples / frame.sample_rate
                if end - first > SOUND_SECONDS:
                    break
            blocks += [part.to_ndarray()[0] for part in resampler.resample(None)]
    except (FFmpegError, OSError, ValueError, IndexError) as error:
        raise DataError(f"{film.path}: its sound cannot be decoded ({error}). Choose another --sync.") from error
    samples = np.concatenate(blocks) if blocks else np.zeros(0, np.float32)
    if not len(samples) or not np.isfinite(samples).all():
        raise DataError(f"{film.path}: its sound is empty or holds no numbers. Choose another --sync.")
    return samples, first


def _video_stream(path: Path, container: av.container.InputContainer) -> av.VideoStream:
    for stream in container.streams.video:
        if stream.disposition & stream.disposition.attached_pic:  # a cover is no film
            continue
        if stream.codec_context is None:
            raise DataError(
                f"{path}: its video has a codec that is unknown here. Convert it to H.264, or copy it again."
            )
        return stream
    raise DataError(f"{path}: holds no video stream.")


def _stamps(path: Path, container: av.container.InputContainer, stream: av.VideoStream) -> tuple[np.ndarray, int]:
    """Time stamps of the frames that are shown, of a film that is whole, and how many come before a key frame."""
    stamps, end, key = [], 0.0, None
    streams = [stream, *container.streams.audio[:1]]
    for packet in container.demux(streams):
        if packet.size == 0:
            continue
        if packet.is_corrupt:
            raise DataError(f"{path}: is damaged or cut off after {end:.3f} s. Copy it again from the camera.")
        if packet.pts is None:
            if packet.stream_index == stream.index:
                raise DataError(f"{path}: its frames have no time stamps. Put them into an MP4, MOV or MKV file.")
            continue
        end = max(end, float((packet.pts + (packet.duration or 0)) * packet.time_base))
        if packet.stream_index == stream.index:
            key = packet.pts if key is None and packet.is_keyframe else key
            stamps += [] if packet.is_discard else [packet.pts]
    # A film that was cut without being coded again may begin between key frames; these frames build on others.
    pts = np.array([stamp for stamp in sorted(stamps) if key is not None and stamp >= key], np.int64)
    if len(pts) < 2:
        raise DataError(f"{path}: holds {len(pts)} frames from its first key frame on, expected at least 2.")
    if (np.diff(pts) <= 0).any():
        raise DataError(f"{path}: several of its frames have one time stamp. Export it again.")
    declared = (container.duration or 0) / av.time_base
    if declared - end > 0.1:  # containers round; a film that was cut off lacks more
        raise DataError(
            f"{path}: is cut off: it says that it lasts {declared:.3f} s, its data end at {end:.3f} s. Copy it again "
            "from the camera, or cut it to what is there with a video editor."
        )
    return pts, len(stamps) - len(pts)


def _jitter(gaps: np.ndarray) -> float:
    apart = np.abs(gaps - np.median(gaps))
    return float(np.quantile(apart[apart < MOST_JITTER * np.median(gaps)], 0.95))


def _rate(gaps: np.ndarray, declared: Fraction | None, time_base: float) -> Fraction:
    """Frames per second: the declared or a standard rate where it explains the time stamps, else the measured one.

    Where frames are missing the usual gap tells the rate, not the mean.
    """
    span, count = float(gaps.sum()), len(gaps)
    wrong = {rate: abs(count / float(rate) - span) for rate in (declared, *STANDARD_RATES) if rate}
    exact, nearest = 1.01 * time_base + RATE_TOLERANCE * span, min(wrong, key=wrong.__getitem__)
    if declared and wrong[declared] <= exact:
        return Fraction(declared)
    if wrong[nearest] <= exact + 2 * _jitter(gaps):
        return Fraction(nearest)
    usual = 1 / float(np.median(gaps))
    nearest = min(STANDARD_RATES, key=lambda rate: abs(float(rate) / usual - 1))
    if abs(usual * span / count - 1) > MISSING and abs(1 / usual - 1 / float(nearest)) <= 1.01 * time_base:
        return nearest
    return Fraction(count / span).limit_denominator(100000)


def _shown_size(path: Path, frame: av.VideoFrame, aspect: Fraction) -> tuple[int, int]:
    """Width and height after rotation, of pixels that are made square by more of them."""
    if frame.interlaced_frame:
        raise DataError(
            f"{path}: is interlaced. Deinterlace it (for example `ffmpeg -vf bwdif`) and ingest the result."
        )
    if frame.rotation % 90:
        raise DataError(f"{path}: is to be turned by {frame.rotation} degrees; only multiples of 90 are supported.")
    matrix = frame.side_data.get(SideData.DISPLAYMATRIX)
    a, b, _, c, d, *_ = (1, 0, 0, 0, 1) if matrix is None else np.frombuffer(bytes(matrix), np.int32).tolist()
    if a * d < b * c:
        raise DataError(f"{path}: is to be mirrored by its metadata. Export it as it is to be seen.")
    width, height = round(frame.width * max(aspect, 1)), round(frame.height / min(aspect, 1))
    return (height, width) if frame.rotation % 180 else (width, height)
