"""PhysTwin: a real object that hands move.

ROOT is data/different_types/CASE (metadata.json, calibrate.pkl, final_data.pkl, split.json, color/, mask/). Colour and
the object's mask become RGBA; pixels of the human mask (data/different_types_human_mask/CASE, where it is there) are
left out. Controller points become the hands' paths, points that stay together one hand; kernels within --grip of them
in frame 0 are pinned to them. Gravity is along +z, the table is the floor z = 0. split.json says which frames are
trained on. Labelled tracks (gt_track_3d.pkl) become the ground truth: those of points that are tracked throughout, as
ours has no gaps. Depth is not read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import pdist

from data_prep.common.command import option
from data_prep.common.photos import read_mask, read_picture
from data_prep.public.fields import REMEDY, lens, numbers, read_record, size_of, viewmat
from data_prep.public.pickles import read_pickle
from data_prep.public.scene import GRAVITY, ImportOptions, Motion, Picture, PublicObject, View
from gausim.core.errors import DataError

META, POSES, FINAL, TRACKS, SPLIT = "metadata.json", "calibrate.pkl", "final_data.pkl", "gt_track_3d.pkl", "split.json"
HUMAN, HAND = "different_types_human_mask", "hand"
# The distance up to which the authors tie an object's points to a controller point at first [m].
GRIP = 0.04


@dataclass(frozen=True)
class Options(ImportOptions):
    """Facts that the folder does not contain."""

    grip: float = option(
        GRIP, "distance to the hands' points within which kernels are pinned [m] (%(default)s)", least=1e-9
    )
    hands: int | None = option(
        None, "number of hands (the largest that a camera's mask_info names)", least=1, most=8, metavar="N"
    )


class _Meta(Struct):
    intrinsics: list[list]
    WH: tuple[int, int]
    fps: float
    frame_num: Annotated[int, Meta(ge=2, le=100_000)]


class _Split(Struct):
    frame_len: int
    train: tuple[int, int]
    test: tuple[int, int]


def read(root: Path, options: Options) -> PublicObject:
    """One case."""
    meta = read_record(root / META, _Meta)
    views, count = _views(root, meta), meta.frame_num
    infos = [_mask_info(root / "mask" / f"mask_info_{i}.json") for i in range(len(views))]
    pictures = {view.name: _pictures(root, i, infos[i][0], view.size, count) for i, view in enumerate(views)}
    points, body, colors = _final(root / FINAL, count)
    hands = options.hands or max(named for _, named in infos)
    if not 1 <= hands <= points.shape[1]:
        raise DataError(
            f"{root / 'mask'}: mask_info or --hands names {hands} hands, {FINAL}: field 'controller_points' has "
            f"{points.shape[1]} points. State the number of --hands."
        )
    hand = together(points, hands)
    tracks, labelled = _tracks(root / TRACKS, count)
    notes = {"hands": f"{len(hand)} points, " + " + ".join(str(int(n)) for n in np.bincount(hand))}
    apart = [np.array([pdist(frame) for frame in points[:, hand == h]]) for h in range(hands)]
    if any(np.abs(a - a[0]).max(initial=0.0) > options.grip for a in apart):
        notes["look at"] = "points of a hand move apart by more than --grip: is it several --hands?"
    if labelled:
        notes["tracks"] = (
            f"{0 if tracks is None else tracks.shape[1]} of {labelled} labelled points are tracked throughout"
        )
    files = (META, POSES, FINAL, TRACKS, SPLIT, *(f"mask/mask_info_{i}.json" for i in range(len(views))))
    facts = {"gravity": [0.0, 0.0, GRAVITY], "floor": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, -1.0]},
             "grip": options.grip, "object_diagonal": float(np.linalg.norm(np.ptp(body[0], axis=0)))}  # fmt: skip
    return PublicObject(
        root, options.name or root.absolute().name, options.fps or meta.fps,
        options.train_frames or _split(root / SPLIT, count),
        (Motion("seq_000", root / META, views, pictures, (points, hand), tracks),), options.heldout, facts,
        cloud=(body[0], np.round(colors[0].clip(0, 1) * 255).astype(np.uint8)),
        files={name: root / name for name in files if (root / name).is_file()}, notes=notes,
    )  # fmt: skip


def _views(root: Path, meta: _Meta) -> tuple[View, ...]:
    """The cameras by ``metadata.json`` and ``calibrate.pkl``."""
    poses = read_pickle(root / POSES)
    found = list(poses) if isinstance(poses, list | tuple | np.ndarray) else []
    if not found or len(found) != len(meta.intrinsics):
        raise DataError(f"{root / POSES}: expected a list of {len(meta.intrinsics)} poses, got {len(found)}. {REMEDY}")
    views = []
    for i, (k, pose) in enumerate(zip(meta.intrinsics, found, strict=True)):
        first = root / "color" / str(i) / "0.png"
        if size_of(first) != meta.WH:
            raise DataError(
                f"{first}: is {size_of(first)}, {root / META}: field 'WH' says {meta.WH}. Use the original frames."
            )
        matrix = viewmat(pose, f"{root / POSES}: [{i}]", inverse=True)
        views.append(View(f"cam_{i}", meta.WH, lens(k, f"{root / META}: field 'intrinsics'[{i}]"), matrix))
    return tuple(views)


def _mask_info(path: Path) -> tuple[str, int]:
    """The number of the object's masks, and how many hands are named."""
    names = read_record(path, dict[str, str])
    objects = [number for number, name in names.items() if name != HAND]
    if len(objects) != 1 or not (objects[0].isascii() and objects[0].isdecimal()):
        raise DataError(f"{path}: expected one mask that is not '{HAND}', got {dict(list(names.items())[:8])}.")
    return objects[0], len(names) - 1


def _pictures(root: Path, camera: int, number: str, size: tuple[int, int], count: int) -> tuple[Picture, ...]:
    human = root.absolute().parent.parent / HUMAN / root.absolute().name / "mask" / str(camera) / "0"
    pictures = []
    for t in range(count):
        path = root / "color" / str(camera) / f"{t}.png"
        if not path.is_file():
            raise DataError(f"{path}: no such frame, though {META}: field 'frame_num' is {count}. Restore the frames.")
        mask = root / "mask" / str(camera) / number / f"{t}.png"
        ignored = (human / f"{t}.png",) if human.is_dir() else ()
        pictures.append(Picture((path, mask, *ignored), partial(_masked, size, path, mask, *ignored)))
    return tuple(pictures)


def _masked(size: tuple[int, int], path: Path, mask: Path, *ignored: Path) -> np.ndarray:
    """Colour and the object's mask, without the human's pixels."""
    pixels, alpha = read_picture(path), read_mask(mask, size, path.name)
    for other in ignored:
        alpha = np.where(read_mask(other, size, path.name) > 0, 0, alpha)
    if pixels.shape[:2] == alpha.shape:  # else it is refused later
        pixels[..., 3] = alpha
    return pixels


def _final(path: Path, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Paths of controller points (F, C, 3) and of the object's points (F, P, 3) with colours 0..1."""
    data = read_pickle(path)
    keys = ("controller_points", "object_points")
    if not isinstance(data, dict) or not set(keys) <= set(data):
        raise DataError(f"{path}: expected a dict of arrays with the fields {', '.join(keys)}. {REMEDY}")
    points, body = (numbers(data[key], (count, -1, 3), f"{path}: field '{key}'") for key in keys)
    colors: Any = data.get("object_colors", np.full_like(body, 0.5))
    return points, body, numbers(colors, body.shape, f"{path}: field 'object_colors'")


def together(paths: np.ndarray, count: int) -> np.ndarray:
    """(C,) int64 which of ``count`` hands each of the points (F, C, 3) belongs to.

    Points of a hand stay near each other: points are joined by the largest distance that they ever have (average
    linkage). Hands are numbered in the order of their first points.
    """
    if count == 1 or paths.shape[1] == 1:
        return np.zeros(paths.shape[1], np.int64)
    apart = np.max([pdist(frame) for frame in paths], axis=0)
    labels = fcluster(linkage(apart, "average"), count, "maxclust").tolist()
    order = list(dict.fromkeys(labels))
    return np.array([order.index(label) for label in labels], np.int64)


def _tracks(path: Path, count: int) -> tuple[np.ndarray | None, int]:
    """(F, P, 3) of the labelled points that are tracked throughout, if there are some, and the number of all."""
    if not path.is_file():
        return None, 0
    data = read_pickle(path)
    if not isinstance(data, np.ndarray) or data.dtype.kind != "f" or data.ndim != 3 or data.shape[::2] != (count, 3):
        raise DataError(f"{path}: expected an array of floats of shape ({count}, points, 3). {REMEDY}")
    kept = data[:, np.isfinite(data).all((0, 2))]
    return (numbers(kept, (count, -1, 3), str(path)) if kept.shape[1] else None), data.shape[1]


def _split(path: Path, count: int) -> int:
    """First frames to train on."""
    split = read_record(path, _Split)
    end = split.train[1]
    if split.frame_len != count or split.train[0] != 0 or not 2 <= end <= count or split.test != (end, count):
        raise DataError(
            f"{path}: expected 'frame_len' {count}, 'train' [0, n] and 'test' [n, {count}], got {split}. Restore "
            "it, or state --train-frames."
        )
    return end
