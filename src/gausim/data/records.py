"""Records of a data set on disk: sequences, true motion and stills. Frames are read on request."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gausim.core import Cameras, DataError, HandPath
from gausim.data.frames import open_frames
from gausim.data.images import read_rgba_into, room_for
from gausim.data.surroundings import read_hands
from gausim.io.npz import read_array
from gausim.io.transforms import read_transforms

# One still in this many is held out of the reconstruction for its evaluation.
STILLS_PER_HELDOUT = 10


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """True motion of P points of one sequence."""

    rest: Float[Tensor, "P 3"]  # positions in the rest state [scene units]
    positions: Float[Tensor, "F P 3"]  # positions in every frame, frame 0 first [scene units]


@dataclass(frozen=True, eq=False)
class Stills:
    """Posed images of the rest state."""

    images: UInt8[Tensor, "N H W 4"]  # straight-alpha RGBA
    cameras: Cameras  # one per image
    train: tuple[int, ...]  # indices to reconstruct from
    # indices of the images held out for evaluation, by default every tenth
    heldout: tuple[int, ...]


def read_stills(path: Path, *, every: int = STILLS_PER_HELDOUT) -> Stills:
    """Reads all images named by a ``transforms.json`` of the rest scene; one in ``every`` is held out of training.

    Raises:
        DataError: an image or pose is unusable.
    """
    posed = read_transforms(path)
    cameras = posed.cameras
    images = room_for((len(posed.frames),), cameras, path)
    read_rgba_into([f.path for f in posed.frames], list(images), (cameras.width, cameras.height))
    heldout = tuple(range(every - 1, len(images), every))
    train = tuple(sorted(set(range(len(images))) - set(heldout)))
    return Stills(torch.from_numpy(images), cameras, train, heldout)


class SequenceRecord:
    """One recorded motion: F frames seen by V static cameras.

    Attributes:
        name: folder name, e.g. ``seq_003``.
        root: the sequence's folder.
        views: names of its cameras, in the data set's order.
        cameras: their calibration, in the same order.
        count: number of frames F.
        fps: frames per second.
        hands: path of the hands that move the pins; None without hands.
        holds: points of the hands at frame 0 (C, 3) and the hand of each (C,); None without hands.
        limit: of a sealed sequence of the test part, the number of frames that may be read; None: all.
    """

    def __init__(self, root: Path, *, views: Sequence[str], fps: float, limit: int | None = None) -> None:
        """Reads and checks ``transforms.json``, or ``frames.json`` of packed frames; but no image.

        Raises:
            DataError: a view or a frame is missing, or a camera moves.
        """
        self.root, self.name, self.views, self.fps, self.limit = root, root.name, tuple(views), fps, limit
        self._source = open_frames(root, self.views, fps)
        self.count, self.cameras = self._source.count, self._source.cameras
        found = read_hands(root, self.count)
        self.hands: HandPath | None = None if found is None else found[0]
        self.holds: tuple[Tensor, Tensor] | None = None if found is None else found[1:]

    @property
    def visible(self) -> int:
        """Number of frames that may be read."""
        return self.count if self.limit is None else min(self.count, self.limit)

    def camera_indices(self, views: Sequence[str] | None = None) -> list[int]:
        """Indices of these views in :attr:`views` (all when None), or :class:`DataError`."""
        unknown = [v for v in views or () if v not in self.views]
        if unknown:
            raise DataError(f"{self.root}: has no view {unknown}; it has {list(self.views)}.")
        return [self.views.index(v) for v in (self.views if views is None else views)]

    def cameras_of(self, views: Sequence[str] | None = None) -> Cameras:
        """The cameras of these views, in that order."""
        return self.cameras.select(self.camera_indices(views))

    def frames(self, frames: range, views: Sequence[str] | None = None) -> UInt8[Tensor, "F V H W 4"]:
        """Straight-alpha RGBA of these frames and views.

        Raises:
            DataError: a frame or view does not exist, an image is missing or malformed, or the frame is an unseen one
                of the sealed test part.
        """
        if len(frames) == 0 or frames[0] < 0 or frames[-1] >= self.count:
            raise DataError(f"{self.root}: frames {frames} asked for, it has frames 0..{self.count - 1}.")
        if frames[-1] >= self.visible:
            raise DataError(f"{self.root}: frames {frames} asked for, but {self._sealed()}")
        return self._source.read(frames, self.camera_indices(views))

    def absent(self) -> list[Path]:
        """Images that ``transforms.json`` names but that are missing."""
        return [path for path in self._source.files() if not path.is_file()]

    def files(self) -> list[Path]:
        """The files of its frames, and of its hands if there are any."""
        return [*self._source.files(), *filter(Path.is_file, [self.root / "hands.npz"])]

    def ground_truth(self, rest: Float[Tensor, "P 3"] | None) -> GroundTruth | None:
        """True motion of the points with these rest positions, or None where the data set has none (real captures)."""
        path = self.root / "ground_truth.npz"
        if rest is None or not path.is_file():
            return None
        if self.limit is not None:
            raise DataError(f"{path}: true motion asked for, but {self._sealed()}")
        displacement = torch.from_numpy(read_array(path, "displacement").astype(np.float32))
        if displacement.shape != (self.count, *rest.shape):
            raise DataError(
                f"{path}: field 'displacement' must be of shape {(self.count, *rest.shape)}, "
                f"got {tuple(displacement.shape)}. Re-export the true motion."
            )
        return GroundTruth(rest, rest + displacement)

    def _sealed(self) -> str:
        return (
            f"the sequence belongs to the test part, of which only images of frames 0..{self.visible - 1} are shown "
            "until `gausim evaluate RUN --test` has evaluated them. Use sequences of the development part."
        )
