"""What a reader of a public set has found of one object, before it is written in our layout."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.capture.cameras.lenses import Straightened, straighten
from data_prep.capture.cameras.sources import Posed
from data_prep.common.command import Options, names, option
from data_prep.common.photos import read_mask, read_picture
from gausim.core.errors import ConfigError, DataError

# Standard gravity of the sets whose worlds are in metres [m/s^2]; their simulators and ours use this value.
GRAVITY = 9.8


@dataclass(frozen=True)
class ImportOptions(Options):
    """Options of every reader."""

    name: str | None = option(None, "name the object (default: as the folder)")
    fps: float | None = option(None, "state the frames per second (what the set says)", least=1e-3, most=1e4)
    train_frames: int | None = option(None, "train on so many first frames (the set's own split)", least=2, metavar="N")
    heldout: tuple[str, ...] = option((), "never train on these cameras (none)", type=names, metavar="CAM,CAM")
    longest: int | None = option(
        None, "reduce pictures whose longer side is longer (keep them)", least=16, metavar="PIXELS"
    )


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera that stands still."""

    name: str  # of the camera, or of a still
    size: tuple[int, int]  # width and height of its pictures [pixels]
    k: np.ndarray  # (3, 3) intrinsics [pixels]; the centre of pixel 0 is at 0.5
    viewmat: np.ndarray  # (4, 4) world to camera, OpenCV axes

    def smaller(self, longest: int | None) -> View:
        """The same camera for pictures whose longer side is at most ``longest`` [pixels]; None leaves it alone."""
        width, height = self.size
        if longest is None or max(self.size) <= longest:
            return self
        scale = longest / max(self.size)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        return replace(self, size=size, k=np.diag([size[0] / width, size[1] / height, 1.0]) @ self.k)


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture to be read later."""

    files: tuple[Path, ...]  # everything that it is made of
    read: Callable[[], np.ndarray]  # its pixels, (H, W, 4) uint8 RGBA with straight alpha; opaque without a mask


@dataclass(frozen=True, eq=False)
class Motion:
    """One sequence of F frames."""

    name: str  # of its folder
    source: Path  # the file, or the folder, that lists its frames
    views: tuple[View, ...]  # its cameras
    pictures: Mapping[str, tuple[Picture, ...]]  # by camera, F each

    @property
    def count(self) -> int:
        """Number of frames F."""
        return len(next(iter(self.pictures.values())))


@dataclass(frozen=True, eq=False)
class PublicObject:
    """One object of a public set."""

    root: Path  # where it was read from
    name: str  # of the object
    fps: float  # frames per second
    train_frames: int  # the first frames, to train on
    motions: tuple[Motion, ...]  # its sequences, with the same cameras by name
    heldout: tuple[str, ...] = ()  # cameras that are never trained on
    facts: Mapping[str, Any] = field(default_factory=dict)  # further fields of dataset.json, such as gravity
    stills: tuple[tuple[View, Picture], ...] = ()  # posed stills of the rest state; none: frame 0 of the first sequence
    scene: Callable[[Path], dict[str, int] | None] = lambda work: None  # writes the set's Gaussians, tells their number
    files: Mapping[str, Path] = field(default_factory=dict)  # what was read besides pictures, by name
    notes: Mapping[str, str] = field(default_factory=dict)  # what is worth telling

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(view.name for view in self.motions[0].views)

    def inputs(self) -> dict[str, Path]:
        """Everything that is read, by name."""
        pictures = [picture for _, picture in self.stills]
        for motion in self.motions:
            pictures += [picture for row in motion.pictures.values() for picture in row]
        found = {path for picture in pictures for path in picture.files}
        return {**self.files, **{Path(os.path.relpath(path, self.root)).as_posix(): path for path in sorted(found)}}

    def checked(self) -> PublicObject:
        """Itself, or an error where parts do not go together: names, numbers of frames, held-out cameras."""
        stills = [view.name for view, _ in self.stills]
        if len(set(stills)) < len(stills):
            raise DataError(f"{self.root}: two stills would get one name, of {sorted(stills)[:20]}. Rename a file.")
        for motion in self.motions:
            counts = {name: len(row) for name, row in motion.pictures.items()}
            if len(set(counts.values())) > 1:
                raise DataError(
                    f"{motion.source}: cameras have different numbers of frames: {counts}. Restore the frames."
                )
            if motion.count < max(2, self.train_frames):
                raise DataError(
                    f"{motion.source}: {motion.name} has {motion.count} frames, fewer than the "
                    f"{max(2, self.train_frames)} to train on. Restore the frames, or give a smaller --train-frames."
                )
        if not set(self.heldout) < set(self.views):
            raise ConfigError(f"--heldout {','.join(self.heldout)}: expected a part of the cameras {list(self.views)}.")
        return self


def falling(axis: int, sign: int, height: float = 0.0, gravity: float = GRAVITY) -> dict[str, Any]:
    """Facts of a free body above a floor: up is an axis times a sign; friction and restitution are trained."""
    up, point = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    up[axis], point[axis] = float(sign), height
    pull = [0.0, 0.0, 0.0]
    pull[axis] = -sign * gravity
    return {"gravity": pull, "floor": {"point": point, "normal": up}, "free": True}


def pinhole(name: str, shot: Posed) -> tuple[View, Straightened]:
    """The pinhole camera of a posed photo whose lens may be distorted, and what removes the distortion."""
    straight = straighten(shot.camera, shot.photo.path)
    return View(name, (shot.photo.width, shot.photo.height), straight.intrinsics, shot.viewmat), straight


def flattened(
    path: Path, straight: Straightened, size: tuple[int, int], mask: Path | None,
    read: Callable[[], np.ndarray] | None = None,
) -> Picture:  # fmt: skip
    """A picture without distortion, with a mask as alpha where there is one; ``read`` gives pixels of no file."""

    def pixels() -> np.ndarray:
        found = read_picture(path) if read is None else read()
        if mask is not None and found.shape[:2] == (size[1], size[0]):
            found = np.dstack((found[..., :3], read_mask(mask, size, path.name)))
        return straight(found) if found.shape[:2] == (size[1], size[0]) else found

    return Picture((path, *((mask,) if mask is not None else ())), pixels)
