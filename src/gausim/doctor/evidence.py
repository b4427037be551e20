"""Input of the checks, some reduced frames of some sequences and the rest scene in every camera, and their findings."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from gausim.core import Cameras, GaussianScene
from gausim.data.objects import ObjectData
from gausim.data.records import SequenceRecord
from gausim.doctor.silhouettes import Fit, Silhouettes, draw_silhouettes, fit_silhouette
from gausim.io.pixels import is_premultiplied
from gausim.runs.bar import with_bar

Severity = Literal["fault", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("fault", "warning", "note")

# Sequences whose motion is examined, and whose first frames are compared with the rest scene.
WATCHED_SEQUENCES, FIRST_FRAMES = 4, 12
# Examined frames of each, from frame 0 on, and the number decoded at a time.
WATCHED_FRAMES, FRAMES_AT_A_TIME = 64, 8
# Length of the longer side of reduced images [pixels].
LONGEST = 192


@dataclass(frozen=True)
class Finding:
    """One finding."""

    severity: Severity  # "fault" if it makes training useless, "warning" if it lowers the quality, else "note"
    what: str  # the problem, in a sentence that names cameras, sequences and files
    remedy: str  # what to do
    views: tuple[str, ...] = ()  # cameras that a fault of calibration or clock is about
    check: str = ""  # the check that found it, which :func:`gausim.doctor.examine.examine` fills in


def listed(names: list[str]) -> str:
    """Names in a sentence: "a", "a and b", "a, b and c"; of more than six only the first five and a count."""
    if len(names) > 6:
        return f"{', '.join(names[:5])} and {len(names) - 5} more"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


@dataclass(frozen=True, eq=False)
class Watched:
    """Consecutive frames of one sequence from frame 0 on, reduced."""

    name: str  # of the sequence
    cameras: Cameras  # of the reduced images
    rgb: UInt8[np.ndarray, "F V h w 3"]  # over black
    alpha: UInt8[np.ndarray, "F V h w"]  # foreground
    premultiplied: tuple[bool, ...] = ()  # whether the colours of frame 0 are multiplied by alpha, of each view

    @cached_property
    def gray(self) -> Float[np.ndarray, "F V h w"]:
        """Mean of the colours over black, 0 to 1."""
        return self.rgb.mean(-1, dtype=np.float32) / np.float32(255)

    @property
    def masks(self) -> Float[np.ndarray, "V h w"]:
        """The foreground of frame 0, 0 to 1."""
        return self.alpha[0] / np.float32(255)


@dataclass(eq=False)
class Evidence:
    """Reduced data of one object, read by :func:`gather`."""

    data: ObjectData  # its facts
    sequences: int  # number of all sequences
    scene: GaussianScene | None  # the rest scene, pinned or not; None if it does not exist
    scale: float  # size of a pixel over that of a reduced pixel, at most 1
    watched: tuple[Watched, ...]  # sequences whose motion is examined
    first: tuple[Watched, ...]  # frame 0 of sequences, these and more

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the cameras, in the order of all arrays."""
        return self.data.views

    @property
    def free(self) -> bool:
        """Whether nothing holds the body, so that it may begin away from the place of the rest scene."""
        return self.data.surroundings.free

    def drawn(self, item: Watched, cameras: Cameras) -> Silhouettes:
        """The rest scene rendered in cameras, a free body where it is in frame 0 of ``item``."""
        assert self.scene is not None
        return draw_silhouettes(self.scene, cameras, item.masks if self.free else None)

    @cached_property
    def rest(self) -> tuple[Silhouettes, ...] | None:
        """The rest scene rendered for each of :attr:`first`, see :meth:`drawn`; None without a scene."""
        if self.scene is None:
            return None
        drawn: list[Silhouettes] = []
        for item in self.first:
            alike = (i for i in range(len(drawn)) if same_cameras(self.first[i].cameras, item.cameras))
            same = None if self.free else next(alike, None)
            drawn.append(self.drawn(item, item.cameras) if same is None else drawn[same])
        return tuple(drawn)

    @cached_property
    def fits(self) -> tuple[tuple[Fit, ...], ...] | None:
        """Alignment of the rest scene with frame 0 in each view, [sequence][view]; None without a scene."""
        if self.rest is None:
            return None
        return tuple(
            tuple(
                fit_silhouette(item.alpha[0, v] / np.float32(255), rest.alpha[v], float(item.cameras.Ks[v, 0, 0]))
                for v in range(len(self.views))
            )
            for item, rest in zip(self.first, self.rest, strict=True)
        )


def same_cameras(a: Cameras, b: Cameras) -> bool:
    """Whether two sets of cameras have the same poses and intrinsics."""
    return bool(torch.equal(a.viewmats, b.viewmats) and torch.equal(a.Ks, b.Ks))


def gather(data: ObjectData, scene: GaussianScene | None) -> Evidence:
    """Reads and reduces the input of the checks.

    Raises:
        DataError: an image is missing or malformed.
    """
    names = sorted(p.name for p in (data.root / "sequences").iterdir() if p.is_dir())
    watched_names, first_names = _spread(names, WATCHED_SEQUENCES), _spread(names, FIRST_FRAMES)
    watched, first, scale = [], [], 1.0
    chosen = [name for name in names if name in watched_names or name in first_names]
    for name in with_bar(chosen, "frames"):
        # A new record, because those of data.sequences keep all decoded images.
        record = data.record(name)
        frames = min(record.visible, WATCHED_FRAMES) if name in watched_names else 1
        scale = min(1.0, LONGEST / max(record.cameras.width, record.cameras.height))
        item = _reduced(record, frames, scale)
        watched += [item] if name in watched_names else []
        first.append(replace(item, rgb=item.rgb[:1], alpha=item.alpha[:1]))
    return Evidence(data, len(names), scene, scale, tuple(watched), tuple(first))


def _spread(names: list[str], count: int) -> list[str]:
    """At most ``count`` evenly spaced names, the first included."""
    chosen = np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int)
    return [names[i] for i in chosen]


def _reduced(record: SequenceRecord, frames: int, factor: float) -> Watched:
    cameras = record.cameras
    width, height = max(1, round(cameras.width * factor)), max(1, round(cameras.height * factor))
    shape = (frames, len(record.views), height, width)
    rgb, alpha = np.empty((*shape, 3), np.uint8), np.empty(shape, np.uint8)
    doubled: tuple[bool, ...] = ()
    for start in range(0, frames, FRAMES_AT_A_TIME):
        block = record.frames(range(start, min(start + FRAMES_AT_A_TIME, frames))).numpy()
        doubled = doubled or tuple(is_premultiplied(picture) for picture in block[0])
        for (f, v), pixels in ((i, block[i]) for i in np.ndindex(block.shape[:2])):
            over_black = (pixels[..., :3] * (pixels[..., 3:] / np.float32(255)) + 0.5).astype(np.uint8)
            rgb[start + f, v] = cv2.resize(over_black, (width, height), interpolation=cv2.INTER_AREA)
            alpha[start + f, v] = cv2.resize(pixels[..., 3], (width, height), interpolation=cv2.INTER_AREA)
    stretch = torch.tensor([[width / cameras.width], [height / cameras.height], [1.0]])
    small = Cameras(cameras.viewmats, cameras.Ks * stretch, width, height, cameras.names)
    return Watched(record.name, small, rgb, alpha, doubled)
