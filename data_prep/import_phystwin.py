"""Brings a case of PhysTwin's real data to our layout.

ROOT is data/different_types/CASE (metadata.json, calibrate.pkl, final_data.pkl, split.json, color/, mask/). Colour and
the object's mask become RGBA; pixels of the human mask (data/different_types_human_mask/CASE, where it is there) are
left out. Controller points become the hands' paths, points that stay together one hand; kernels within --grip of them
in frame 0 are pinned to them. Gravity is along +z, the table is the floor z = 0. split.json says which frames are
trained on. Labelled tracks (gt_track_3d.pkl) become the ground truth: those of points that are tracked throughout, as
ours has no gaps. Depth is not read. Pickles go through a reader that executes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import pdist

from data_prep.common.command import option
from data_prep.public.fields import REMEDY, field, lens, numbers, viewmat
from data_prep.public.importing import Importer, ImportOptions, rate_option
from data_prep.public.pickles import read_pickle
from data_prep.public.pictures import masked, size_of
from data_prep.public.scene import GRAVITY, Hands, Motion, Picture, PublicObject, View, floor
from gausim.core.errors import ConfigError, DataError
from gausim.io.plain_json import read_any_json

META, POSES, FINAL, TRACKS, SPLIT = "metadata.json", "calibrate.pkl", "final_data.pkl", "gt_track_3d.pkl", "split.json"
HUMAN = "different_types_human_mask"
HAND = "hand"
# The distance up to which the authors tie an object's points to a controller point at first [m].
GRIP = 0.04
# More points than this say no more about where a hand is.
_MOST_CONTROLLERS = 1000


@dataclass(frozen=True)
class PhysTwinOptions(ImportOptions):
    """Facts that the folder does not contain."""

    fps: float | None = rate_option("metadata.json's")
    grip: float = option(
        GRIP, "distance to the hands' points within which kernels are pinned [m] (%(default)s)", least=1e-9
    )
    hands: int | None = option(
        None,
        "number of hands (the largest number of hands that a camera's mask_info names)",
        least=1,
        most=8,
        metavar="N",
    )
    human_masks: Path | None = option(
        None, f"masks of the human, mask/CAMERA/0/FRAME.png (../../{HUMAN}/CASE)", type=Path
    )


def read_phystwin(root: Path, options: PhysTwinOptions) -> PublicObject:
    """One case.

    Raises:
        DataError: a file is missing or malformed, or files do not go together.
        ConfigError: an option does not suit the case.
    """
    meta = root / META
    data = read_any_json(meta)
    count = field(data, "frame_num", Annotated[int, Meta(ge=2, le=100_000)], str(meta))
    views = _views(root, data)
    infos = [_mask_info(root / "mask" / f"mask_info_{i}.json") for i in range(len(views))]
    human = _human(root, options.human_masks)
    pictures = {view.name: _pictures(root, i, infos[i][0], human, view.size, count) for i, view in enumerate(views)}
    final = _final(root / FINAL, count)
    hands = _hands(root, final["controller_points"], [count for _, count in infos], options.hands)
    tracks, of = _tracks(root / TRACKS, count)
    notes = {"hands": f"{len(hands.hand)} points, " + " + ".join(str(int(n)) for n in np.bincount(hands.hand))}
    loose = [h for h in range(int(hands.hand.max()) + 1) if stretch(hands.points[:, hands.hand == h]) > options.grip]
    if loose:
        notes["look at"] = f"points of hand {loose[0]} move apart by more than --grip: is it several --hands?"
    if of:
        notes["tracks"] = f"{0 if tracks is None else tracks.shape[1]} of {of} labelled points are tracked throughout"
    read = (META, POSES, FINAL, TRACKS, SPLIT, *(f"mask/mask_info_{i}.json" for i in range(len(views))))
    world = {"gravity": [0.0, 0.0, GRAVITY], "floor": floor((0.0, 0.0, 0.0), (0.0, 0.0, -1.0)), "grip": options.grip,
             "object_diagonal": float(np.linalg.norm(np.ptp(final["object_points"][0], axis=0)))}  # fmt: skip
    return PublicObject(
        root, options.name or root.absolute().name, options.fps or field(data, "fps", float, str(meta)),
        options.train_frames or _split(root / SPLIT, count), (Motion("seq_000", meta, views, pictures, hands, tracks),),
        options.heldout, world, cloud=_cloud(final), told={"notes": notes},
        files={name: root / name for name in read if (root / name).is_file()},
    )  # fmt: skip


def _views(root: Path, data: Any) -> tuple[View, ...]:
    """The cameras by ``metadata.json`` and ``calibrate.pkl``."""
    where = str(root / META)
    ks = field(data, "intrinsics", list, where)
    width, height = field(data, "WH", tuple[int, int], where)
    poses = read_pickle(root / POSES)
    several = isinstance(poses, list | tuple) or (isinstance(poses, np.ndarray) and poses.ndim == 3)
    found = list(poses) if several else []
    if not found or len(found) != len(ks):
        raise DataError(
            f"{root / POSES}: expected a list of {len(ks)} poses, one per camera of {META}, got {len(found)}."
        )
    views = []
    for i, (k, pose) in enumerate(zip(ks, found, strict=True)):
        first = root / "color" / str(i) / "0.png"
        if size_of(first) != (width, height):
            raise DataError(
                f"{first}: is {size_of(first)}, {where}: field 'WH' says {width, height}. Use the original frames."
            )
        matrix = viewmat(pose, f"{root / POSES}: [{i}]", inverse=True)
        views.append(View(f"cam_{i}", (width, height), lens(k, f"{where}: field 'intrinsics'[{i}]"), matrix))
    return tuple(views)


def _mask_info(path: Path) -> tuple[str, int]:
    """The number of the object's masks, and how many hands are named."""
    names = field({"masks": read_any_json(path)}, "masks", dict[str, str], str(path))
    objects = [number for number, name in names.items() if name != HAND]
    if len(objects) != 1 or not (objects[0].isascii() and objects[0].isdecimal()):
        raise DataError(f"{path}: expected one mask that is not '{HAND}', got {dict(list(names.items())[:8])}.")
    return objects[0], len(names) - 1


def _human(root: Path, given: Path | None) -> Path | None:
    """The folder of the human's masks, where there is one."""
    if given is not None and not given.is_dir():
        raise ConfigError(f"--human-masks {given}: no such folder.")
    usual = root.absolute().parent.parent / HUMAN / root.absolute().name
    return given or (usual if usual.is_dir() else None)


def _pictures(
    root: Path, camera: int, number: str, human: Path | None, size: tuple[int, int], count: int
) -> tuple[Picture, ...]:
    folder = root / "color" / str(camera)
    paths = [folder / f"{t}.png" for t in range(count)]
    absent = [path for path in paths if not path.is_file()]
    if absent:
        raise DataError(
            f"{absent[0]}: no such frame, though {META}: field 'frame_num' is {count} ({len(absent)} are missing). "
            "Restore the frames."
        )
    pictures = []
    for t, path in enumerate(paths):
        mask = root / "mask" / str(camera) / number / f"{t}.png"
        ignore = human / "mask" / str(camera) / "0" / f"{t}.png" if human is not None else None
        files = tuple(p for p in (path, mask, ignore) if p is not None)
        pictures.append(Picture(files, partial(masked, path, mask, size, ignore)))
    return tuple(pictures)


def _final(path: Path, count: int) -> dict[str, np.ndarray]:
    """Controller points, and those of the object, of ``final_data.pkl``."""
    data = read_pickle(path)
    if not isinstance(data, dict):
        raise DataError(f"{path}: expected a dict of arrays, got a {type(data).__name__}. {REMEDY}")
    found = {}
    for key in ("controller_points", "object_points"):
        found[key] = numbers(field(data, key, Any, str(path)), (count, -1, 3), f"{path}: field '{key}'")
    if found["controller_points"].shape[1] > _MOST_CONTROLLERS:
        raise DataError(f"{path}: field 'controller_points' has more than {_MOST_CONTROLLERS} points. {REMEDY}")
    if "object_colors" in data:
        shape = found["object_points"].shape
        found["object_colors"] = numbers(data["object_colors"], shape, f"{path}: field 'object_colors'")
    return found


def _hands(root: Path, points: np.ndarray, named: list[int], given: int | None) -> Hands:
    """The paths of the controller points (F, C, 3), and the hands that they belong to: the most that a camera names."""
    count = given or max(named)
    if not 1 <= count <= points.shape[1]:
        path = root / "mask" / f"mask_info_{named.index(max(named))}.json"
        said = f"--hands is {count}" if given else f"{path} names {count} hands"
        raise DataError(
            f"{said}, {FINAL}: field 'controller_points' has {points.shape[1]} points. State the number of --hands."
        )
    return Hands(points, together(points, count))


def _cloud(final: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The object's points in frame 0 with their colours, to begin a reconstruction with."""
    points = final["object_points"][0]
    colors = final.get("object_colors", np.full_like(final["object_points"], 0.5))[0]
    return points, np.round(colors.clip(0, 1) * 255).astype(np.uint8)


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


def stretch(points: np.ndarray) -> float:
    """The most that a distance between two of the points (F, C, 3) differs from that in frame 0."""
    apart = np.array([pdist(frame) for frame in points])
    return float(np.abs(apart - apart[0]).max(initial=0.0))


def _tracks(path: Path, count: int) -> tuple[np.ndarray | None, int]:
    """(F, P, 3) of the labelled points that are tracked throughout, if there are some, and the number of all."""
    if not path.is_file():
        return None, 0
    data = read_pickle(path)
    if not isinstance(data, np.ndarray) or data.dtype.kind != "f" or data.ndim != 3 or data.shape[::2] != (count, 3):
        got = f"{data.dtype} {data.shape}" if isinstance(data, np.ndarray) else f"a {type(data).__name__}"
        raise DataError(f"{path}: expected an array of floats of shape ({count}, points, 3), got {got}. {REMEDY}")
    kept = data[:, np.isfinite(data).all((0, 2))]
    return (numbers(kept, (count, -1, 3), str(path)) if kept.shape[1] else None), data.shape[1]


def _split(path: Path, count: int) -> int:
    """First frames to train on."""
    data = read_any_json(path)
    first, end = field(data, "train", tuple[int, int], str(path))
    test = field(data, "test", tuple[int, int], str(path))
    if field(data, "frame_len", int, str(path)) != count or first != 0 or not 2 <= end <= count or test != (end, count):
        raise DataError(
            f"{path}: expected 'frame_len' {count}, 'train' [0, n] and 'test' [n, {count}], got {str(data)[:200]}. "
            "Restore it, or state --train-frames."
        )
    return end


# The number rises when the same inputs and settings give another result than before.
import_phystwin = Importer(
    "import_phystwin", 1, PhysTwinOptions, lambda root, options: [read_phystwin(root, options)],
    "data/different_types/CASE", __doc__,
)  # fmt: skip
main = import_phystwin.main
