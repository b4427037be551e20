"""Brings an object of 3DGSim's data (elastic bodies and cloth, simulated by Genesis) to our layout.

ROOT is a sample (a folder with metadata.json) or the folder of an object's samples. Samples with the same cameras
become sequences of one object; where cameras differ, OUT becomes a folder of objects. Alpha is 1 where the segmentation
shows the object: anything but its background (0) and its static part (3), or what --segments names. The world is z up,
with gravity and a floor at z = 0. The files do not say how many frames per second there are: state --fps. The authors
hold out whole samples, so all frames are trained on unless --train-frames says otherwise.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from data_prep.common.command import option
from data_prep.public.fields import check_name, field, inside, lens, viewmat
from data_prep.public.importing import Importer, ImportOptions, rate_option
from data_prep.public.pictures import read_sized, straight
from data_prep.public.scene import Motion, Picture, PublicObject, View, floor
from gausim.core.errors import ConfigError, DataError
from gausim.io.files import natural
from gausim.io.pixels import decode
from gausim.io.plain_json import read_any_json

DATA = "metadata.json"
# Genesis' default [m/s^2].
GENESIS_GRAVITY = 9.81
# Segments of their renderer, once the background is 0.
BACKGROUND, STATIC = 0, 3
# A place of a template: numbers may have a width of one digit.
_PLACE = re.compile(r"\{(img_type|(?:cam_ix|n_step)(?::0?[0-9]?d?)?)\}")
_SAME = 1e-5


def identities(text: str) -> tuple[int, ...]:
    """Whole numbers between commas."""
    return tuple(int(part) for part in text.split(","))


@dataclass(frozen=True)
class GenesisOptions(ImportOptions):
    """Facts that the folders do not contain."""

    fps: float | None = rate_option("has to be stated")
    segments: tuple[int, ...] = option(
        (),
        "numbers of the segments that are the object (all but 0 and 3)",
        type=identities,
        metavar="N,N",
        least=1,
        most=65535,
    )


def read_3dgsim(root: Path, options: GenesisOptions) -> list[PublicObject]:
    """The samples as one object, or as one for each set of cameras.

    Raises:
        DataError: ``metadata.json`` or a picture is missing or malformed.
        ConfigError: --fps is not stated.
    """
    if options.fps is None:
        raise ConfigError(f"--fps: {DATA} does not say how many frames per second there are; state it.")
    single = (root / DATA).is_file()
    samples = [root] if single else sorted((p.parent for p in root.glob(f"*/{DATA}")), key=lambda p: natural(p.name))
    if not samples:
        raise DataError(
            f"{root}: neither {DATA} nor folders with one. Give a sample, or the folder of an object's samples."
        )
    groups: list[list[tuple[Path, Motion]]] = []
    for sample in samples:
        motion = _motion(sample, "seq_000" if single else check_name(sample.name, str(root)), options.segments)
        group = next((g for g in groups if _alike(g[0][1].views, motion.views)), None)
        if group is None:
            groups.append(group := [])
        group.append((sample, motion))
    name = options.name or root.absolute().name
    world = {"gravity": [0.0, 0.0, -GENESIS_GRAVITY], "floor": floor((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), "free": True}
    return [
        PublicObject(
            root, name if len(groups) == 1 else f"{name}_{i}", options.fps,
            options.train_frames or min(motion.count for _, motion in group), tuple(motion for _, motion in group),
            options.heldout, world,
            files={(sample / DATA).relative_to(root).as_posix(): sample / DATA for sample, _ in group},
        )
        for i, group in enumerate(groups)
    ]  # fmt: skip


def _alike(first: tuple[View, ...], second: tuple[View, ...]) -> bool:
    """Whether two sets of cameras are the same."""
    return len(first) == len(second) and all(
        a.size == b.size and np.allclose(a.k, b.k, rtol=_SAME) and np.allclose(a.viewmat, b.viewmat, atol=_SAME)
        for a, b in zip(first, second, strict=True)
    )


def _motion(sample: Path, name: str, segments: tuple[int, ...]) -> Motion:
    path = sample / DATA
    data, where = read_any_json(path), str(path)
    steps = field(data, "n_steps", Annotated[int, Meta(ge=1, le=100_000)], where)
    cameras = field(data, "n_cams", Annotated[int, Meta(ge=1, le=1000)], where)
    template = _template(field(data, "file_path_template", str, where), f"{where}: field 'file_path_template'")

    def file(camera: int, step: int, kind: str) -> Path:
        text = template.format(cam_ix=camera, n_step=step, img_type=kind)
        return inside(sample, f"{text}.png", f"{where}: field 'file_path_template'")

    views = tuple(_view(data, i, where) for i in range(cameras))

    @lru_cache(maxsize=8)
    def shift(step: int) -> int:
        """1 where the segments of a step are numbered from 1, that is where no camera shows a 0."""
        return int(not any((_segments(file(i, step, "seg"), views[i].size) == 0).any() for i in range(cameras)))

    def rgba(camera: int, step: int) -> np.ndarray:
        rgb = read_sized(file(camera, step, "rgb"), views[camera].size, "a picture")[..., :3]
        shown = _segments(file(camera, step, "seg"), views[camera].size).astype(np.int64) - shift(step)
        object_ = np.isin(shown, segments) if segments else (shown > BACKGROUND) & (shown != STATIC)
        return straight(rgb, np.where(object_, 255, 0))

    pictures = {
        view.name: tuple(
            Picture((file(i, t, "rgb"), file(i, t, "seg")), partial(rgba, i, t)) for t in range(steps)
        )
        for i, view in enumerate(views)
    }  # fmt: skip
    return Motion(name, path, views, pictures)


def _template(text: str, where: str) -> str:
    """A template of file names that has the fields of the layout and nothing else."""
    named = {place.partition(":")[0] for place in _PLACE.findall(text)}
    if named != {"cam_ix", "n_step", "img_type"} or re.search("[{}]", _PLACE.sub("", text)):
        raise DataError(f"{where}: expected cam_ix, n_step and img_type in braces, got {text!r:.80}.")
    return text


def _view(data: Any, index: int, where: str) -> View:
    name = f"cam_{index}"
    camera, here = field(data, name, dict, where), f"{where}: field '{name}"
    side = Annotated[int, Meta(ge=1, le=100_000)]
    width, height = field(camera, "resolution", tuple[side, side], f"{here}'")
    return View(
        name, (width, height), lens(field(camera, "intrinsics", list, f"{here}'"), f"{here}.intrinsics'"),
        viewmat(field(camera, "extrinsics", list, f"{here}'"), f"{here}.extrinsics'"),
    )  # fmt: skip


def _segments(path: Path, size: tuple[int, int]) -> np.ndarray:
    """(H, W) numbers of segments."""
    numbers = decode(path)
    if numbers is not None and numbers.ndim == 3 and (numbers[..., :3] == numbers[..., :1]).all():
        numbers = numbers[..., 0]
    if numbers is None or numbers.shape != (size[1], size[0]):
        found = "no picture" if numbers is None else f"shape {numbers.shape}"
        raise DataError(
            f"{path}: expected one number per pixel, {size[0]}x{size[1]}, got {found}. Restore the segmentation."
        )
    return numbers


# The number rises when the same inputs and settings give another result than before.
import_3dgsim = Importer(
    "import_3dgsim", 1, GenesisOptions, read_3dgsim,
    "a sample with metadata.json, or a folder of samples", __doc__,
)  # fmt: skip
main = import_3dgsim.main
