"""Sources of the frames of a sequence: image files or packed frames."""

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from gausim.core import Cameras, DataError
from gausim.data.images import read_rgba_into, room_for
from gausim.io.files import natural
from gausim.io.packed import HEADER, is_packed, read_packed
from gausim.io.transforms import PosedFrame, read_transforms

# Cameras are static during a sequence: their poses may differ by rounding only.
POSE_TOLERANCE = 1e-5
# Suffixes of films, which cannot be frames.
FILMS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".hevc", ".h265", ".mts")


def open_frames(root: Path, views: Sequence[str], fps: float) -> "PackedSource | ImageSource":
    """The frames of a sequence's folder, cameras in the order of ``views``; only headers are read.

    Raises:
        DataError: a file, view or frame is missing, a field is wrong, the file's frame rate differs from ``fps``, or a
            camera moves.
    """
    if is_packed(root):
        return PackedSource(root, views, fps)
    films = [p.name for p in sorted(root.glob("*")) if p.suffix.lower() in FILMS]
    if films and not (root / "transforms.json").is_file():
        raise DataError(
            f"{root}: expected transforms.json and a folder of PNG frames per camera, found films ({films[0]} …). Make "
            "frames of them with `gausim prepare ingest`, then `poses` and `segment` (docs/how-to/capture.md)."
        )
    return ImageSource(root, views, fps)


class PackedSource:
    """Packed frames: every call reads only the requested frames, so memory does not grow with the data set.

    Attributes:
        count: number of frames.
        cameras: one per view, in the data set's order.
    """

    def __init__(self, root: Path, views: Sequence[str], fps: float) -> None:
        """Reads the header only."""
        self._packed = packed = read_packed(root)
        if packed.fps != fps:
            raise DataError(
                f"{root / HEADER}: field 'fps' is {packed.fps:g}, dataset.json says {fps:g}. Make them agree."
            )
        if set(packed.cameras.names) != set(views):
            raise DataError(
                f"{root / HEADER}: has the views {list(packed.cameras.names)}, dataset.json says {list(views)}."
            )
        self._columns = [packed.cameras.names.index(view) for view in views]
        self.count, self.cameras = packed.count, packed.cameras.select(self._columns)

    def read(self, frames: range, columns: Sequence[int]) -> UInt8[Tensor, "F V H W 4"]:
        """Straight-alpha RGBA of these frames and cameras, all of which exist."""
        return self._packed.read(frames, [self._columns[column] for column in columns])

    def files(self) -> list[Path]:
        """The header and the files of the pixels, which it was checked against."""
        return [self._packed.folder / HEADER, *sorted(self._packed.folder.glob("view_*.npy"))]


class ImageSource:
    """Image files, with the attributes of :class:`PackedSource`: each is decoded once and cached."""

    def __init__(self, root: Path, views: Sequence[str], fps: float) -> None:
        """Reads ``transforms.json`` only."""
        self._root = root
        posed = read_transforms(root / "transforms.json")
        if posed.fps is not None and posed.fps != fps:
            raise DataError(f"{posed.path}: field 'fps' is {posed.fps:g}, dataset.json says {fps:g}. Make them agree.")
        index = _frames_of_views(posed.path, posed.frames, views)
        self._paths = [[posed.frames[i].path for i in row] for row in index]
        self.count = len(index[0])
        _check_static(posed.path, posed.cameras, index, views)
        chosen = posed.cameras.select([row[0] for row in index])
        self.cameras = Cameras(chosen.viewmats, chosen.Ks, chosen.width, chosen.height, tuple(views))
        self._pixels = room_for((self.count, len(views)), chosen, posed.path)
        self._decoded = np.zeros((self.count, len(views)), bool)

    def read(self, frames: range, columns: Sequence[int]) -> UInt8[Tensor, "F V H W 4"]:
        """Straight-alpha RGBA of these frames and cameras, all of which exist.

        Raises:
            DataError: an image is missing or malformed.
        """
        missing = [(f, v) for f in frames for v in columns if not self._decoded[f, v]]
        paths = [self._paths[v][f] for f, v in missing]
        read_rgba_into(paths, [self._pixels[f, v] for f, v in missing], (self.cameras.width, self.cameras.height))
        for f, v in missing:
            self._decoded[f, v] = True
        return torch.from_numpy(self._pixels[np.ix_(list(frames), list(columns))])

    def files(self) -> list[Path]:
        """``transforms.json`` and the image files that it names."""
        return [self._root / "transforms.json", *(path for row in self._paths for path in row)]


def _frames_of_views(path: Path, frames: Sequence[PosedFrame], views: Sequence[str]) -> list[list[int]]:
    """Numbers of the entries, indexed as [view][frame]."""
    table: dict[str, dict[int, int]] = {view: {} for view in views}
    entries: dict[str, list[int]] = {view: [] for view in views}
    for i, frame in enumerate(frames):
        if frame.camera not in table:
            raise DataError(f"{path}: frames[{i}] is of camera '{frame.camera}', dataset.json has {list(views)}.")
        entries[frame.camera].append(i)
    for view, own in entries.items():
        for number, i in _numbered(path, frames, view, own):
            if number in table[view]:
                raise DataError(f"{path}: frame {number} of camera '{view}' is listed twice.")
            table[view][number] = i
    count = max(max(row, default=-1) for row in table.values()) + 1
    for view, row in table.items():
        if len(row) < count:
            first = next(f for f in range(count) if f not in row)
            raise DataError(
                f"{path}: view '{view}' lacks {count - len(row)} of {count} frames (first: {first}). "
                "Restore them, or take the view out of dataset.json."
            )
    return [[table[view][f] for f in range(count)] for view in views]


def _numbered(path: Path, frames: Sequence[PosedFrame], view: str, own: list[int]) -> list[tuple[int, int]]:
    """The entries of a camera with their frame numbers: the stated ones, else by time, else in their order.

    Raises:
        DataError: times repeat or contradict the numbers, or names were sorted as text.
    """
    timed = [i for i in own if frames[i].time is not None]
    numbered = [i for i in own if frames[i].frame is not None]
    if len(numbered) == len(own):
        order = sorted(own, key=lambda i: frames[i].frame or 0)
    elif numbered:
        raise DataError(f"{path}: {len(own) - len(numbered)} entries of camera '{view}' lack 'frame'. Give it to all.")
    else:
        order = sorted(own, key=lambda i: frames[i].time or 0.0) if len(timed) == len(own) else own
    if len(timed) == len(own):
        for a, b in pairwise(order):
            if not (frames[a].time or 0.0) < (frames[b].time or 0.0):
                raise DataError(
                    f"{path}: field 'time' of camera '{view}' does not grow from frames[{a}] ({frames[a].path.name}, "
                    f"{frames[a].time:g}) to frames[{b}] ({frames[b].path.name}, {frames[b].time:g}). Correct 'time' "
                    "or 'frame'."
                )
    elif not numbered:
        _check_order(path, [frames[i].path.name for i in own], view)
    return [(stated if (stated := frames[i].frame) is not None else n, i) for n, i in enumerate(order)]


def _check_order(path: Path, names: Sequence[str], view: str) -> None:
    """Raises a :class:`DataError` where entries without number or time are not in the order of their names' numbers."""
    for a, b in pairwise(names):
        if natural(a) > natural(b) and re.search(r"[0-9]", a + b):
            raise DataError(
                f"{path}: entries of camera '{view}' go from {a} to {b}, as if sorted as text. Sort them by number, or "
                "give every entry 'frame' or 'time'."
            )


def _check_static(path: Path, cameras: Cameras, index: list[list[int]], views: Sequence[str]) -> None:
    for view, row in zip(views, index, strict=True):
        pose = (cameras.viewmats[row] - cameras.viewmats[row[0]]).abs().amax((1, 2))
        lens = (cameras.Ks[row] - cameras.Ks[row[0]]).abs().amax((1, 2))
        moved = ((pose > POSE_TOLERANCE * (1 + cameras.viewmats[row[0]].abs().max())) | (lens > 1e-3)).nonzero()
        if len(moved):
            raise DataError(f"{path}: camera '{view}' moves at frame {int(moved[0])}; sequences need static cameras.")
