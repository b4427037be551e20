"""Writes an object of a public set in our layout, and checks it as `gausim verify` does."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from data_prep.capture.cameras.output import write_cameras
from data_prep.common.objects import object_facts, refuse_faults
from data_prep.common.photos import resized, write_picture
from data_prep.common.progress import Tick
from data_prep.common.stage import copy_missing
from data_prep.public.scene import Motion, Picture, PublicObject, View
from gausim.core.errors import DataError
from gausim.io.files import write_json
from gausim.io.pixels import read_header


class ObjectWriter:
    """Writes one object; pictures that an interrupted attempt has written already stay."""

    def __init__(self, work: Path, found: PublicObject, *, longest: int | None, tick: Tick) -> None:
        """Takes the folder to write to, what was read, the longest side of pictures [pixels], and who is told."""
        self._work, self._found, self._longest, self._tick = work, found, longest, tick
        self._bare: set[str] = set()

    def write(self, out: Path) -> dict[str, Any]:
        """Writes everything that is missing and returns what is worth telling; ``out`` is the result's later name."""
        found = self._found
        for motion in found.motions:
            self._motion(motion)
        stills = self._stills()
        scene = found.scene(self._work)
        facts = object_facts(found.name, found.fps, found.views, found.heldout, found.train_frames) | dict(found.facts)
        write_json(self._work / "dataset.json", facts)
        if not self._bare:
            refuse_faults(self._work, out)
        frames = {motion.name: motion.count for motion in found.motions}
        return {"facts": facts, "stills": stills, "sequences": frames, "scene": scene,
                "without_alpha": sorted(self._bare), "notes": dict(found.notes)}  # fmt: skip

    def _motion(self, motion: Motion) -> None:
        folder = self._work / "sequences" / motion.name
        entries, posed = [], []
        for view in motion.views:
            small = view.smaller(self._longest)
            for number, picture in enumerate(motion.pictures[view.name]):
                name = f"{view.name}/{number:04d}.png"
                self._picture(folder / name, picture, view, small, motion.name)
                entries.append({"file_path": name, "camera": view.name, "frame": number})
                posed.append(small)
                self._tick(motion.name, len(posed), len(motion.views) * motion.count)
        _write_poses(folder / "transforms.json", posed, entries, self._found.fps)

    def _stills(self) -> int:
        """Posed stills, or frame 0 of the first sequence in the cameras that are trained on."""
        folder, first = self._work / "static", self._found.motions[0]
        seen = [view for view in first.views if view.name not in self._found.heldout]
        shots: Sequence[tuple[View, Picture | None]] = self._found.stills or [(view, None) for view in seen]
        posed = [view.smaller(self._longest) for view, _ in shots]
        for number, (small, (view, picture)) in enumerate(zip(posed, shots, strict=True), 1):
            target = folder / "images" / f"{view.name}.png"
            if picture is None:
                copy_missing(self._work / "sequences" / first.name / view.name / "0000.png", target)
            else:
                self._picture(target, picture, view, small, "stills")
                self._tick("stills", number, len(shots))
        entries = [{"file_path": f"images/{view.name}.png"} for view in posed]
        _write_poses(folder / "transforms.json", posed, entries, None)
        return len(posed)

    def _picture(self, target: Path, picture: Picture, view: View, small: View, what: str) -> None:
        """Writes a picture unless it is there, without alpha where it is opaque, and remembers that."""
        if not target.is_file():
            pixels = picture.read()
            if pixels.shape[:2] != (view.size[1], view.size[0]):
                raise DataError(
                    f"{picture.files[0]}: is {pixels.shape[1]}x{pixels.shape[0]}, its camera '{view.name}' is for "
                    f"{view.size[0]}x{view.size[1]}. Use the pictures that belong to the cameras."
                )
            opaque = pixels[..., 3].min() == 255
            pixels[pixels[..., 3] == 0] = 0  # keeps files small
            write_picture(target, resized(pixels[..., :3] if opaque else pixels, small.size))
        header = read_header(target)
        if header is None or header.mode != "RGBA":
            self._bare.add(what)


def _write_poses(path: Path, posed: Sequence[View], entries: list[dict[str, Any]], fps: float | None) -> None:
    for view in posed:
        if view.size != posed[0].size:
            raise DataError(
                f"{path}: '{view.name}' is {view.size[0]}x{view.size[1]}, '{posed[0].name}' is "
                f"{posed[0].size[0]}x{posed[0].size[1]}. All pictures of a set need one size."
            )
    viewmats, ks = [view.viewmat for view in posed], [view.k for view in posed]
    write_cameras(path, viewmats, ks, posed[0].size, tuple(view.name for view in posed), entries, fps)
