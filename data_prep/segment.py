"""Cut the object out of pictures or films: RGBA with straight alpha, and overlays to check by eye.

Run ``gausim prepare segment PICTURES --out OUT --backend …`` on a folder of pictures, on what ``ingest`` made, or
on a film. Every picture becomes a PNG of the same name and folder whose alpha is the mask; overlays/ holds a film, a
sheet and figures of each folder.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.capture.films.film import probe
from data_prep.capture.masks.backends import BACKENDS, ScreenOptions, make_backend
from data_prep.capture.masks.cleanup import UNTOUCHED, Cleanup, cleaned, matte, overlap, steady
from data_prep.capture.masks.clips import Clip, film_frames, find_clips, is_film
from data_prep.capture.masks.overlays import write_overlays
from data_prep.capture.masks.segmenters import Backend, MaskOf
from data_prep.common.command import add_options, chosen, given, headline, run_command, stage_parser
from data_prep.common.photos import read_picture, write_picture
from data_prep.common.progress import Tick, silent
from data_prep.common.stage import MANIFEST, Stage, read_manifest, run_stage
from gausim.core.errors import ConfigError, DataError
from gausim.io.files import write_json
from gausim.io.plain_json import read_json

# Raise when the same pictures and settings give other masks than before.
REVISION = 1
RAW, FRAMES, OVERLAYS = ".raw", ".frames", "overlays"
# Below this overlap with the mask before, a frame is worth a look.
STEADY = 0.8


def segment(
    source: Path, out: Path, backend: Backend, cleanup: Cleanup, *, kind: str = "auto", every: int = 1,
    overwrite: bool = False, tick: Tick = silent,
) -> dict[str, Any]:  # fmt: skip
    """Writes the pictures of ``source`` with their masks as alpha."""
    if every < 1:
        raise ConfigError(f"--every: expected at least 1, got {every}.")
    film = is_film(source)
    if not film and not source.is_dir():
        raise DataError(f"{source}: expected a folder of pictures, or a film.")
    clips = [] if film else find_clips(source, kind=kind, every=every)
    pictures = {path.as_posix(): source / path for clip in clips for path in clip.paths}
    carried = {} if film or every > 1 else _beside(source)
    inputs = {source.name: source} if film else {**pictures, **carried}
    inputs |= {f"backend/{name}": path for name, path in backend.inputs.items()}
    settings = {"backend": backend.name, **backend.settings, "cleanup": asdict(cleanup), "kind": kind, "every": every}
    packages = ("av", "numpy", "opencv-python-headless")

    def make(work: Path) -> dict[str, Any]:
        found = clips
        if film:
            film_frames(source, work / FRAMES / source.stem)
            found = find_clips(work / FRAMES, kind="stills" if kind == "stills" else "film", every=every)
        run = _Run(work, backend, cleanup, _rate(source), tick)
        results = {clip.name: run.clip(clip) for clip in found}
        _carry(carried, work, pictures)
        for folder in (RAW, FRAMES):
            shutil.rmtree(work / folder, ignore_errors=True)
        return {"backend": backend.name, "clips": results}

    return run_stage(Stage("segment", REVISION, inputs, settings, packages), out, make, overwrite=overwrite)


class _Run:
    """One run over all clips."""

    def __init__(self, work: Path, backend: Backend, cleanup: Cleanup, fps: float, tick: Tick) -> None:
        self._work, self._backend, self._cleanup, self._fps = work, backend, cleanup, fps
        self._tick = tick

    def clip(self, clip: Clip) -> dict[str, Any]:
        """Makes a clip's files; its figures, written last, say that it is complete."""
        marker = self._work / OVERLAYS / f"{clip.flat}.json"
        if marker.is_file():
            found: dict[str, Any] = json.loads(marker.read_bytes())
            return found
        self._raw_masks(clip)
        found = self._finish(clip)
        masks = [self._work / path.with_suffix(".png") for path in clip.paths]
        write_overlays(clip, masks, self._work / OVERLAYS, fps=self._fps)
        write_json(marker, found)
        return found

    def _raw_masks(self, clip: Clip) -> None:
        """The backend's masks, each an 8-bit file; those of an interrupted attempt are kept."""
        mask_of: MaskOf | None = None
        for i in range(len(clip)):
            path = self._raw(clip, i)
            if not path.is_file():
                mask_of = mask_of or self._backend.open(clip)
                mask, expected = mask_of(i), clip.rgb(i).shape[:2]
                if mask.shape != expected or not np.isfinite(mask).all():
                    raise DataError(
                        f"{clip.file(i)}: backend '{self._backend.name}' gave a mask of shape {mask.shape} or of no "
                        f"numbers, expected finite ones of {expected}."
                    )
                write_picture(path, np.round(np.clip(mask, 0, 1) * 255).astype(np.uint8))
            self._tick(clip.name, i + 1, len(clip))

    def _finish(self, clip: Clip) -> dict[str, Any]:
        """Cleans the masks, writes RGBA, and returns figures."""

        def raw(index: int) -> np.ndarray:
            return read_picture(self._raw(clip, index))[..., 0].astype(np.float32) / 255

        radius = self._cleanup.radius if clip.moving else 0
        coverage, overlaps, border = [], [], []
        before: np.ndarray | None = None
        for i in range(len(clip)):
            mask, rgb = raw(i), clip.rgb(i)
            # As many before as after: one-sided neighbours would vote against whatever moves one way.
            reach = min(radius, i, len(clip) - 1 - i)
            around = [i + d for d in range(-reach, reach + 1) if d]
            mask = steady(mask, [(abs(j - i), raw(j)) for j in around], self._cleanup.motion * max(mask.shape))
            alpha = cleaned(mask, rgb, self._cleanup, soft=self._backend.soft)
            write_picture(self._work / clip.paths[i].with_suffix(".png"), matte(rgb, alpha))
            inside = alpha > 127
            coverage.append(float(inside.mean()))
            border.append(float(np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]]).mean()))
            overlaps.append(overlap(before, alpha) if clip.moving and before is not None else 1.0)
            before = alpha
        return _figures(clip, coverage, overlaps, border)

    def _raw(self, clip: Clip, index: int) -> Path:
        return self._work / RAW / clip.flat / f"{index:05d}.png"


def _figures(clip: Clip, coverage: list[float], overlaps: list[float], border: list[float]) -> dict[str, Any]:
    """Entry of a clip in the manifest; refuses a clip without any foreground."""
    if max(coverage) == 0:
        raise DataError(
            f"{clip.root / clip.name}: nothing was found in any of {len(clip)} pictures. Look at them, try another "
            "--backend or its options, or --components 0 if the object is in many small parts."
        )
    names = [path.name for path in clip.paths]
    return {
        "pictures": len(clip), "film": clip.moving, "at_border": sum(border) / len(border),
        "coverage": {"mean": sum(coverage) / len(coverage), "least": min(coverage), "most": max(coverage)},
        "overlap_with_frame_before": {"mean": sum(overlaps) / len(overlaps), "least": min(overlaps)},
        "empty": [name for name, part in zip(names, coverage, strict=True) if part == 0],
        "look_at": [name for name, part in zip(names, overlaps, strict=True) if part < STEADY],
    }  # fmt: skip


def _rate(source: Path) -> float:
    """Frames per second of the overlay: the film's, ingest's, or 24."""
    if is_film(source):
        return float(probe(source).rate)
    if (source / MANIFEST).is_file():
        rate = read_manifest(source).get("results", {}).get("fps")
        if isinstance(rate, (int, float)) and math.isfinite(rate) and rate > 0:
            return float(rate)
    return 24.0


def _beside(source: Path) -> dict[str, Path]:
    """Files beside the pictures, by name: poses and facts."""
    found = [*source.rglob("transforms.json"), source / "dataset.json"]
    named = {path.relative_to(source).as_posix(): path for path in sorted(found) if path.is_file()}
    return {name: path for name, path in named.items() if not any(part.startswith(".") for part in Path(name).parts)}


def _carry(files: Mapping[str, Path], work: Path, pictures: Mapping[str, Path]) -> None:
    """Copies what belongs to the pictures; ``transforms.json`` gets their new names."""
    done = {path.resolve() for path in pictures.values()}
    for name, path in files.items():
        data = read_json(path)
        for entry in data.get("frames", []) if isinstance(data.get("frames"), list) else []:
            named = entry.get("file_path") if isinstance(entry, dict) else None
            if isinstance(named, str) and (path.parent / named).resolve() in done:
                entry["file_path"] = Path(named).with_suffix(".png").as_posix()
        write_json(work / name, data)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("segment", __doc__)
    add = parser.add_argument
    add("pictures", type=Path, metavar="PICTURES", help="folder of pictures, a result of ingest, or a film")
    add("--backend", choices=BACKENDS, required=True, help="make the masks in this way")
    add("--every", type=int, default=1, metavar="N", help="take each N-th picture only, to try out (%(default)s)")
    add("--kind", choices=("auto", "film", "stills"), default="auto",
        help="treat the pictures as a film of a static camera, or as stills; auto: films, and folders in "
        "sequences/ (%(default)s)")  # fmt: skip
    add_options(parser.add_argument_group("cleaning (backend alpha: nothing unless asked for)"), Cleanup, unset=True)
    add_options(parser.add_argument_group("backends masks, background and chroma"), ScreenOptions)

    def run(arguments: argparse.Namespace, tick: Tick) -> str:
        backend = make_backend(arguments.backend, chosen(ScreenOptions, arguments))
        cleanup = replace(UNTOUCHED if arguments.backend == "alpha" else Cleanup(), **given(Cleanup, arguments))
        manifest = segment(
            arguments.pictures, arguments.out, backend, cleanup,
            kind=arguments.kind, every=arguments.every, overwrite=arguments.overwrite, tick=tick,
        )  # fmt: skip
        return f"{headline(arguments.out, manifest)}, by {backend.name}\n{summary(manifest['results'])}"

    return run_command(parser, argv, run, waiting="segmenting")


def summary(results: Mapping[str, Any]) -> str:
    """A line about every clip, for people."""
    lines = []
    for name, found in results["clips"].items():
        part, over = found["coverage"], found["overlap_with_frame_before"]
        lines.append(
            f"  {name or '.'}: {found['pictures']} pictures, foreground {100 * part['mean']:.1f} % "
            f"({100 * part['least']:.1f} to {100 * part['most']:.1f}), overlap with the frame before at least "
            f"{over['least']:.3f}"
        )
        for what, key in (("EMPTY", "empty"), ("look at", "look_at")):
            lines += [f"    {what}: {', '.join(found[key][:6])}"] if found[key] else []
    return "\n".join([*lines, f"Look at {OVERLAYS}/ before you go on."])
