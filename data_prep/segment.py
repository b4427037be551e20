"""Foreground masks: pictures or films to RGBA with straight alpha, and overlays to check them by eye.

Run ``gausim prepare segment PICTURES --out OUT --backend …`` on a folder of pictures, on what ``ingest`` made, or
on a film. Every picture becomes a PNG of the same name and folder whose alpha is the mask; overlays/ holds a film, a
sheet and figures of each folder.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gausim.core import DataError
from gausim.io.files import write_durably, write_json

if TYPE_CHECKING:
    import numpy as np

    from data_prep.capture.masks.backend import Backend
    from data_prep.capture.masks.cleanup import Cleanup
    from data_prep.capture.masks.clips import Clip
    from data_prep.capture.masks.segmenters import MaskOf, Segmenter
    from data_prep.common.progress import Tick

# Raise when the same pictures and settings give other masks than before.
REVISION = 1
BACKENDS = ("alpha", "background", "chroma", "onnx", "sam2")
RAW, FRAMES, OVERLAYS = ".raw", ".frames", "overlays"
# Below this overlap with the mask before, a frame is worth a look.
STEADY = 0.8


def segment(
    source: Path,
    out: Path,
    backend: Backend,
    cleanup: Cleanup,
    *,
    kind: str = "auto",
    every: int = 1,
    force: bool = False,
    advance: Tick | None = None,
) -> dict[str, Any]:
    """Writes the pictures of ``source`` with their masks as alpha.

    Args:
        source: folder of pictures (any depth), or a film.
        out: directory of the result, laid out as ``source``.
        backend: what makes the masks.
        cleanup: what is done to them.
        kind: ``film`` (neighbours in time agree), ``stills``, or ``auto``: film for films and folders in ``sequences``.
        every: only each n-th picture of a folder.
        force: replace a result of other pictures or settings.
        advance: told the folder, pictures done and pictures in all.

    Returns:
        The manifest; its ``results`` have figures of every folder.

    Raises:
        DataError: a picture is unusable, or a folder's masks are all empty.
    """
    from data_prep.capture.masks.clips import film_frames, find_clips, is_film
    from data_prep.common.stage import Stage, run_stage

    film = is_film(source)
    if not film and not source.is_dir():
        raise DataError(f"{source}: expected a folder of pictures, or a film.")
    clips = [] if film else find_clips(source, kind=kind, every=every)
    pictures = {path.as_posix(): source / path for clip in clips for path in clip.paths}
    carried = {} if film or every > 1 else _beside(source)
    stage = Stage(
        name="segment",
        revision=REVISION,
        inputs={
            **({source.name: source} if film else {**pictures, **carried}),
            **{f"backend/{k}": v for k, v in backend.inputs.items()},
        },
        settings={
            "backend": backend.name,
            **backend.settings,
            "cleanup": asdict(cleanup),
            "kind": kind,
            "every": every,
        },
        packages=("av", "numpy", "opencv-python-headless", *backend.packages),
    )

    def make(work: Path) -> dict[str, Any]:
        found = clips
        if film:
            film_frames(source, work / FRAMES / source.stem)
            found = find_clips(work / FRAMES, kind="stills" if kind == "stills" else "film", every=every)
        run = _Run(work, backend, cleanup, _rate(source), advance)
        results = {clip.name: run.clip(clip) for clip in found}
        _carry(carried, work, pictures)
        for folder in (RAW, FRAMES):
            shutil.rmtree(work / folder, ignore_errors=True)
        return {"backend": backend.name, "clips": results}

    return run_stage(stage, out, make, force=force)


class _Run:
    """One run over all clips; the segmenter is made when the first mask is missing."""

    def __init__(self, work: Path, backend: Backend, cleanup: Cleanup, fps: float, advance: Tick | None) -> None:
        self._work, self._backend, self._cleanup, self._fps = work, backend, cleanup, fps
        self._advance = advance
        self._segmenter: Segmenter | None = None

    def clip(self, clip: Clip) -> dict[str, Any]:
        """Makes a clip's files; its figures, written last, say that it is complete."""
        from data_prep.capture.masks.overlays import write_overlays

        marker = self._work / OVERLAYS / f"{clip.flat}.json"
        if marker.is_file():
            found = json.loads(marker.read_bytes())
            assert isinstance(found, dict)
            return found
        self._raw_masks(clip)
        found = self._finish(clip)
        masks = [self._work / path.with_suffix(".png") for path in clip.paths]
        write_overlays(clip, masks, self._work / OVERLAYS, fps=self._fps)
        write_json(marker, found)
        return found

    def _raw_masks(self, clip: Clip) -> None:
        """The backend's masks, each an 8-bit file; those of an interrupted attempt are kept."""
        import numpy as np

        from data_prep.capture.masks.clips import write_picture

        mask_of: MaskOf | None = None
        for i in range(len(clip)):
            path = self._raw(clip, i)
            if not path.is_file():
                self._segmenter = self._segmenter or self._backend.make()
                mask_of = mask_of or self._segmenter.open(clip)
                mask = _checked(mask_of(i), clip, i, self._backend.name)
                write_picture(path, np.round(mask * 255).astype(np.uint8))
            if self._advance:
                self._advance(clip.name, i + 1, len(clip))

    def _finish(self, clip: Clip) -> dict[str, Any]:
        """Cleans the masks, writes RGBA, and returns figures."""
        import numpy as np

        from data_prep.capture.masks.cleanup import cleaned, matte, overlap, steady
        from data_prep.capture.masks.clips import read_picture, write_picture

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
            coverage.append(float((alpha > 127).mean()))
            inside = alpha > 127
            edge = np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]])
            border.append(float(edge.mean()))
            overlaps.append(1.0 if before is None or before.shape != alpha.shape else overlap(before, alpha))
            before = alpha
        return _figures(clip, coverage, overlaps, border)

    def _raw(self, clip: Clip, index: int) -> Path:
        return self._work / RAW / clip.flat / f"{index:05d}.png"


def _checked(mask: np.ndarray, clip: Clip, index: int, backend: str) -> np.ndarray:
    import numpy as np

    expected = clip.rgb(index).shape[:2]
    if mask.shape != expected or not np.isfinite(mask).all():
        raise DataError(
            f"{clip.file(index)}: backend '{backend}' gave a mask of shape {mask.shape}"
            f"{'' if np.isfinite(mask).all() else ' with values that are no numbers'}, expected {expected}."
        )
    return np.clip(mask, 0, 1)


def _figures(clip: Clip, coverage: list[float], overlaps: list[float], border: list[float]) -> dict[str, Any]:
    """What the manifest says of a clip; refuses one in which nothing was found at all."""
    if max(coverage) == 0:
        raise DataError(
            f"{clip.root / clip.name}: nothing was found in any of {len(clip)} pictures. Look at them, try another "
            "--backend or its options, or --components 0 if the object is in many small parts."
        )
    names = [path.name for path in clip.paths]
    return {
        "pictures": len(clip),
        "film": clip.moving,
        "coverage": {"mean": sum(coverage) / len(coverage), "least": min(coverage), "most": max(coverage)},
        "overlap_with_frame_before": {"mean": sum(overlaps) / len(overlaps), "least": min(overlaps)}
        if clip.moving
        else None,
        "at_border": sum(border) / len(border),
        "empty": [name for name, part in zip(names, coverage, strict=True) if part == 0],
        "look_at": [name for name, part in zip(names, overlaps, strict=True) if clip.moving and part < STEADY],
    }


def _rate(source: Path) -> float:
    """Frames per second of the overlay: the film's, ingest's, or 24."""
    from data_prep.capture.masks.clips import is_film
    from data_prep.common.stage import MANIFEST, read_manifest

    if is_film(source):
        from data_prep.capture.films.film import probe

        return float(probe(source).rate)
    if (source / MANIFEST).is_file():
        rate = read_manifest(source).get("results", {}).get("fps")
        if isinstance(rate, (int, float)) and math.isfinite(rate) and rate > 0:
            return float(rate)
    return 24.0


def _beside(source: Path) -> dict[str, Path]:
    """What belongs to the pictures, by its name: poses, facts, points."""
    found = [*source.rglob("transforms.json"), *(source / name for name in ("dataset.json", "points.npz"))]
    named = {path.relative_to(source).as_posix(): path for path in sorted(found) if path.is_file()}
    return {name: path for name, path in named.items() if not any(part.startswith(".") for part in Path(name).parts)}


def _carry(files: Mapping[str, Path], work: Path, pictures: Mapping[str, Path]) -> None:
    """Copies what belongs to the pictures; ``transforms.json`` gets their new names."""
    from gausim.io.transforms import read_json

    done = {path.resolve() for path in pictures.values()}
    for name, path in files.items():
        if path.suffix != ".json":
            write_durably(work / name, path.read_bytes())
            continue
        data = read_json(path)
        for entry in data.get("frames", []) if isinstance(data.get("frames"), list) else []:
            named = entry.get("file_path") if isinstance(entry, dict) else None
            if isinstance(named, str) and (path.parent / named).resolve() in done:
                entry["file_path"] = Path(named).with_suffix(".png").as_posix()
        write_json(work / name, data)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    from data_prep.capture.masks.options import make_backend, make_cleanup
    from data_prep.common.command import headline, told
    from data_prep.common.progress import bars

    def run() -> str:
        backend, cleanup = make_backend(arguments), make_cleanup(arguments)
        with bars("segmenting") as tick:
            manifest = segment(
                arguments.pictures, arguments.out, backend, cleanup,
                kind=arguments.kind, every=arguments.every, force=arguments.force, advance=tick,
            )  # fmt: skip
        return f"{headline(arguments.out, manifest)}, by {backend.name}\n{summary(manifest['results'])}"

    return told(run)


def summary(results: Mapping[str, Any]) -> str:
    """A line about every clip, for people."""
    lines = []
    for name, found in results["clips"].items():
        over = found["overlap_with_frame_before"]
        lines.append(
            f"  {name or '.'}: {found['pictures']} pictures, foreground {100 * found['coverage']['mean']:.1f} % "
            f"({100 * found['coverage']['least']:.1f} to {100 * found['coverage']['most']:.1f})"
            + (f", overlap with the frame before {over['mean']:.3f} (least {over['least']:.3f})" if over else "")
            + _some("EMPTY", found["empty"])
            + _some("look at", found["look_at"])
        )
    return "\n".join([*lines, f"Look at {OVERLAYS}/ before you go on."])


def _some(what: str, names: list[str]) -> str:
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return f", {what}: {', '.join(names[:4])}{more}" if names else ""


def _parser() -> argparse.ArgumentParser:
    from data_prep.capture.masks.options import add_options

    parser = argparse.ArgumentParser(prog="gausim prepare segment", description=__doc__.split("\n")[0])
    add_options(parser, BACKENDS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
